"""Which rows make a batch, and which are held back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from ctlev_core.supervised.batches import batch_rows, plan_rows
from ctlev_core.supervised.options import SupervisedOptions
from data_contracts.errors import DataError


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 20), st.integers(1, 30), st.integers(0, 5))
def test_batches_walk_through_permutations(count, batch_size, seed):
    rows = np.concatenate([batch_rows(count, batch_size, seed, step) for step in range(8)])
    for epoch in range(len(rows) // count):
        assert sorted(rows[epoch * count : (epoch + 1) * count]) == list(range(count))


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 20), st.integers(1, 20), st.integers(0, 5))
def test_without_options_all_rows_are_one_pool(first, others, seed):
    plan = plan_rows(first + others, SupervisedOptions(), seed=seed, parts=(first, others))
    for step in range(4):
        assert np.array_equal(plan.batch(7, seed, step), batch_rows(first + others, 7, seed, step))
    assert len(plan.held_back) == 0


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 12),
    st.lists(st.integers(0, 12), min_size=1, max_size=3).filter(any),
    st.floats(0.02, 0.98),
    st.integers(1, 9),
    st.integers(0, 3),
)
def test_mixed_batches_keep_the_share_and_walk_through_permutations(first, others, mixing, batch_size, seed):
    parts = (first, *others)
    plan = plan_rows(sum(parts), SupervisedOptions(mixing=mixing), seed=seed, parts=parts)
    batches = [plan.batch(batch_size, seed, step) for step in range(20)]
    drawn = np.concatenate(batches)
    for number in range(1, 21):
        of_first = np.count_nonzero(drawn[: number * batch_size] < first)
        assert abs(of_first - number * batch_size * mixing) <= 0.5 + 1e-9
    for pool, size in ((drawn[drawn < first], first), (drawn[drawn >= first] - first, sum(others))):
        for epoch in range(len(pool) // size):
            assert sorted(pool[epoch * size : (epoch + 1) * size]) == list(range(size))
    assert all(len(batch) == batch_size for batch in batches)


def test_mixing_applies_to_several_sets_only():
    """The same options train every setting: on real frames alone there is nothing to mix."""
    plan = plan_rows(9, SupervisedOptions(mixing=0.3), seed=0, parts=(9,))
    assert np.array_equal(plan.batch(4, 0, 1), batch_rows(9, 4, 0, 1))
    for parts in ((0, 9), (9, 0)):
        with pytest.raises(DataError, match=r"mixing 0.3 needs rows in the first training set and in others, got \("):
            plan_rows(9, SupervisedOptions(mixing=0.3), seed=0, parts=parts)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(1, 9), min_size=2, max_size=12), st.floats(0.01, 0.5), st.integers(0, 9), st.integers(0, 20)
)
def test_groups_are_held_back_whole_and_from_the_first_set(sizes, share, seed, others):
    groups = np.repeat([f"subject {number}" for number in range(len(sizes))], sizes)
    np.random.default_rng(seed).shuffle(groups)
    count, options = len(groups), SupervisedOptions(validation_share=share)
    # The other set shows the same people: what is synthetic is learnt from all the same.
    names = [*groups.tolist(), *["subject 0"] * others]
    if 2 * min(np.unique(groups, return_counts=True)[1]) > count:
        with pytest.raises(DataError, match="can be held back"):
            plan_rows(count + others, options, seed=seed, parts=(count, others), groups=names)
        return
    plan = plan_rows(count + others, options, seed=seed, parts=(count, others), groups=names)
    held = set(groups[plan.held_back].tolist())
    assert 0 < len(plan.held_back) <= count / 2 and (plan.held_back < count).all()
    assert sorted([*plan.held_back, *plan.pools[0]]) == list(range(count + others))
    assert not held & set(groups[plan.pools[0][plan.pools[0] < count]].tolist())
    # No group more than needed, as far as groups go into half of the rows.
    largest = max(np.count_nonzero(groups == name) for name in held)
    assert len(plan.held_back) - largest < share * count


def test_rows_are_their_own_groups_without_names():
    plan = plan_rows(40, SupervisedOptions(validation_share=0.1), seed=1)
    assert len(plan.held_back) == 4
    assert not np.array_equal(plan.held_back, plan_rows(40, SupervisedOptions(validation_share=0.1), seed=2).held_back)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 3), min_size=4, max_size=30), st.integers(0, 9))
def test_every_class_keeps_rows_to_learn_from(classes, seed):
    targets = np.unique(classes, return_inverse=True)[1]
    options = SupervisedOptions(validation_share=0.5)
    if np.bincount(targets).max() == 1:
        with pytest.raises(DataError, match="all rows of a class"):
            plan_rows(len(targets), options, seed=seed, classes=targets)
        return
    plan = plan_rows(len(targets), options, seed=seed, classes=targets)
    assert set(targets[plan.pools[0]]) == set(targets)


def test_mixed_sets_hold_back_rows_of_the_first():
    options = SupervisedOptions(mixing=0.5, validation_share=0.25)
    plan = plan_rows(20, options, seed=0, parts=(8, 12))
    assert len(plan.held_back) == 2 and (plan.held_back < 8).all()
    drawn = np.concatenate([plan.batch(6, 0, step) for step in range(30)])
    assert not set(drawn.tolist()) & set(plan.held_back.tolist())
    assert set(drawn.tolist()) | set(plan.held_back.tolist()) == set(range(20))


def test_wrong_calls_are_named():
    with pytest.raises(ValueError, match=r"must cover 5 rows, got parts \(2, 2\) and 0 groups"):
        plan_rows(5, SupervisedOptions(), seed=0, parts=(2, 2))
    with pytest.raises(ValueError, match="and 4 groups"):
        plan_rows(5, SupervisedOptions(), seed=0, groups=list("abcd"))
    with pytest.raises(ValidationError, match="patience needs a validation_share above 0"):
        SupervisedOptions(patience=3)
