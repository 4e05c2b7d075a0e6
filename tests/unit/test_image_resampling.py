"""Finished pictures on a new grid: areas are averaged exactly, and joints stay where they were seen."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.encodings import event_histogram
from ctlev_core.image_resampling import overlap_weights, resample_images


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


@given(st.integers(1, 40), st.integers(1, 40), st.floats(0.05, 4.0), st.floats(-10, 10))
def test_weights_are_the_covered_shares(num_old, num_new, scale, offset):
    weights = overlap_weights(num_old, num_new, scale, offset)
    low, high = offset, offset + scale * num_old
    covered = np.clip(np.minimum(np.arange(1, num_new + 1), high) - np.maximum(np.arange(num_new), low), 0, 1)
    np.testing.assert_allclose(weights.sum(axis=1), covered, atol=1e-9)
    assert (weights >= 0).all()


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
