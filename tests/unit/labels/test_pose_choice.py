"""Which labelled moments are sampled from."""

from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.labels.label_sampling import balanced_choice, surrounded

LABELLED = st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from("rstu")), min_size=1, max_size=30)


@given(LABELLED, st.integers(1, 60), st.integers(0, 1000))
def test_classes_and_their_recordings_take_turns_and_no_row_comes_twice_before_all(moments, count, seed):
    names, recordings = zip(*moments, strict=True)
    chosen = balanced_choice(names, recordings, count, seed)
    assert len(chosen) == count
    per_class = Counter(names[row] for row in chosen)
    assert max(per_class.values()) - min(per_class.get(name, 0) for name in set(names)) <= 1
    for name in set(names):
        rows = [int(row) for row in chosen if names[row] == name]
        available = names.count(name)
        assert not rows or max(Counter(rows).values()) <= -(-len(rows) // available)
        # Before a recording comes for the second time, every other one of the class has had its turn.
        groups = len({recordings[row] for row in range(len(names)) if names[row] == name})
        first_turn = [recordings[row] for row in rows[:groups]]
        assert len(set(first_turn)) == len(first_turn)


def test_more_rows_start_with_the_same_rows():
    names, recordings = ("a", "b") * 10, ("r", "s", "t", "u") * 5
    np.testing.assert_array_equal(
        balanced_choice(names, recordings, 6, 3), balanced_choice(names, recordings, 12, 3)[:6]
    )


def test_moments_near_the_ends_of_their_recording_are_left_out_where_it_has_others():
    recordings = ["a"] * 5 + ["b"] + ["c"] * 2
    t_us = np.array([0, 50, 100, 150, 200, 7, 0, 20])
    kept = surrounded(recordings, t_us, 50)
    assert kept.tolist() == [False, True, True, True, False, True, True, True]
    assert surrounded(recordings, t_us, 0).all()
