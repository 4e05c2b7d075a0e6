"""Counts as classes: nothing is lost of small ones, and large ones are drawn as training frames have them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.pixel_decoder.value_classes import NUM_SINGLE, fit_classes
from data_contracts.errors import DataError

COUNTS = st.lists(st.integers(0, 65535), min_size=2, max_size=60).filter(lambda counts: len(set(counts)) > 1)


def fitted(counts):
    return fit_classes(np.array(counts, np.uint16)[:, None])


@given(COUNTS)
def test_every_training_count_is_in_one_class_and_the_classes_ascend(counts):
    classes = fitted(counts)
    members = classes.classes_of(np.array(counts))
    assert (np.diff(classes.starts) > 0).all() and classes.starts[0] == 0
    assert members.min() >= 0 and members.max() <= len(classes) - 1
    ends = np.append(classes.starts[1:], 1 << 17)
    assert (classes.starts[members] <= counts).all() and (counts < ends[members]).all()
    assert len(classes) <= 60, "large counts share classes"


@given(COUNTS, st.integers(0, 2**32))
def test_a_count_that_is_drawn_is_one_of_its_class_that_training_frames_have(counts, seed):
    classes = fitted(counts)
    members = classes.classes_of(np.array(counts))
    drawn = classes.draw(members, np.random.default_rng(seed).random(len(members)))
    np.testing.assert_array_equal(classes.classes_of(drawn), members)
    assert set(drawn.tolist()) <= set(counts)
    small = np.array(counts) < NUM_SINGLE
    np.testing.assert_array_equal(drawn[small], np.array(counts)[small])


def test_counts_of_one_class_are_drawn_as_often_as_training_frames_have_them():
    counts = np.repeat([0, 40, 41, 42], [100, 30, 60, 10]).astype(np.uint16)
    classes = fit_classes(counts[:, None])
    member = int(classes.classes_of(np.array([40]))[0])
    assert member == classes.classes_of(np.array([42]))[0]
    drawn = classes.draw(np.full(30_000, member), np.random.default_rng(0).random(30_000))
    shares = [np.mean(drawn == count) for count in (40, 41, 42)]
    np.testing.assert_allclose(shares, [0.3, 0.6, 0.1], atol=0.01)


def test_embeddings_are_square_roots_with_a_mean_of_0_and_a_deviation_of_1():
    counts = np.random.default_rng(1).poisson(0.4, (50, 8, 8)).astype(np.uint16)
    classes = fit_classes(counts)
    embedded = classes.embeddings[classes.classes_of(counts)]
    assert abs(embedded.mean()) < 1e-5 and abs(embedded.std() - 1) < 1e-5
    roots = np.sqrt(counts)
    np.testing.assert_allclose(embedded, (roots - roots.mean()) / roots.std(), atol=1e-5)
    assert classes.active_step == pytest.approx(1 / roots.std())


@pytest.mark.parametrize("counts", [np.zeros((3, 4), np.uint16), np.full((3, 4), 7, np.uint16)])
def test_frames_without_differences_are_refused(counts):
    with pytest.raises(DataError, match="needs training frames with events in some pixels and fewer in others"):
        fit_classes(counts)
