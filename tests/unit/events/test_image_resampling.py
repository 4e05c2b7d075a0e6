"""Finished pictures on a new grid: areas are averaged exactly, and joints stay where they were seen."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.encodings import event_histogram
from ctlev_core.events.image_resampling import average_areas, find_overlaps, resample_images


def point_map(scale, offset):
    return lambda points: points * np.asarray(scale) + np.asarray(offset)


def test_identity_changes_nothing():
    images = np.random.default_rng(0).integers(0, 256, (2, 5, 7), np.uint8)
    np.testing.assert_array_equal(resample_images(images, point_map(1.0, 0.0), (7, 5)), images)


def test_halving_averages_blocks_and_bars_are_black():
    images = np.random.default_rng(1).integers(0, 256, (1, 4, 8), np.uint8)
    half = resample_images(images, point_map(0.5, (0.0, 1.0)), (4, 4))
    blocks = images[0].reshape(2, 2, 4, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(half[0, 1:3], blocks, rtol=1e-6)
    assert not half[0, 0].any() and not half[0, 3].any()


def slow_weights(old_edges, num_new):
    """Share [num_new, num_old] of each new pixel that each old one covers, all pairs looked at."""
    low = np.maximum(np.arange(num_new)[:, None], old_edges[None, :-1])
    high = np.minimum(np.arange(1, num_new + 1)[:, None], old_edges[None, 1:])
    return np.maximum(high - low, 0.0)


def dense(overlaps, num_old):
    weights = np.zeros((len(overlaps.first), num_old))
    for row, (first, shares) in enumerate(zip(*overlaps, strict=True)):
        weights[row, first : first + len(shares)] = shares
    return weights


AXIS = st.tuples(st.integers(1, 40), st.integers(1, 40), st.floats(0.02, 6.0), st.floats(-10, 10))


@given(AXIS)
def test_overlaps_are_the_covered_shares(axis):
    num_old, num_new, scale, offset = axis
    edges = offset + scale * np.arange(num_old + 1)
    weights = dense(find_overlaps(edges, num_new), num_old)
    np.testing.assert_array_equal(weights, slow_weights(edges, num_new))
    low, high = offset, offset + scale * num_old
    covered = np.clip(np.minimum(np.arange(1, num_new + 1), high) - np.maximum(np.arange(num_new), low), 0, 1)
    np.testing.assert_allclose(weights.sum(axis=1), covered, atol=1e-9)


@settings(deadline=None)
@given(AXIS, AXIS, st.integers(0, 2**32 - 1))
def test_averages_equal_those_of_dense_matrices(across, down, seed):
    (width, new_width, *_), (height, new_height, *_) = across, down
    columns, rows = (offset + scale * np.arange(num + 1) for num, _, scale, offset in (across, down))
    images = np.random.default_rng(seed).integers(0, 256, (2, height, width), np.uint8)
    expected = slow_weights(rows, new_height) @ images @ slow_weights(columns, new_width).T
    found = average_areas(images, find_overlaps(columns, new_width), find_overlaps(rows, new_height))
    assert found.dtype == np.float32 and found.max() <= 255
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("fit", ["pad", "crop", "stretch"])
def test_a_bright_spot_stays_under_its_joint(fit):
    options = event_histogram.Options(polarity=False, image_size=(64, 64), fit=fit)
    sensor = (346, 260)
    centre = np.array([180.5, 120.5])
    images = np.zeros((1, 260, 346), np.uint8)
    images[0, 110:131, 170:191] = 255  # a square around the centre
    image = resample_images(images, lambda p: event_histogram.map_points(p, sensor, options), (64, 64))[0].astype(float)
    rows, columns = np.mgrid[0:64, 0:64] + 0.5
    found = np.array([(columns * image).sum(), (rows * image).sum()]) / image.sum()
    np.testing.assert_allclose(found, event_histogram.map_points(centre, sensor, options), atol=0.02)
