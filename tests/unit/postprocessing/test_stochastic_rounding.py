"""Stochastic rounding: whole counts whose expectation is the image."""

import numpy as np
import pytest

from ctlev_core.encodings import event_histogram
from ctlev_core.plugins import Plugin
from ctlev_core.postprocessing.stochastic_rounding import round_frames, round_stochastically

RANDOM = np.random.default_rng(0)
SEEDS = range(400)


def grey(values):
    return np.repeat(np.asarray(values, np.uint8)[..., None], 3, axis=-1)


def test_counts_are_right_on_average_and_never_off_by_one():
    image = grey(RANDOM.integers(0, 256, (8, 8)))
    counts = round_stochastically(np.stack([image] * 400), np.array([100]), polarity=False, seeds=SEEDS)[:, 0]
    expected = image[..., 0] * (100 / image[..., 0].sum())
    # The mean of 400 Bernoulli draws: five standard deviations of at most 0.5 / 20.
    np.testing.assert_allclose(counts.mean(axis=0), expected, atol=0.125)
    assert (np.abs(counts - expected) < 1).all()
    # The sum of 64 of them, over 400 windows.
    assert counts.sum(axis=(1, 2)).mean() == pytest.approx(100, abs=5 * 4 / 20)


def test_sparse_noise_stays_as_dense():
    image = grey(np.full((64, 64), 12))
    counts = round_stochastically(image[None], np.array([700]), polarity=False, seeds=[0])
    assert counts.sum() == pytest.approx(700, abs=5 * np.sqrt(700)) and counts.max() == 1


def test_the_number_of_events_is_that_of_a_real_window():
    images = np.stack([grey(200 * RANDOM.integers(0, 2, (32, 32)))] * 40)
    counts = round_stochastically(images, np.array([200, 2000]), polarity=False, seeds=range(40))
    sums = counts.sum(axis=(1, 2, 3), dtype=np.int64)
    near = [np.abs(sums - total) < 5 * np.sqrt(total) for total in (200, 2000)]
    assert np.logical_xor(*near).all() and near[0].any() and near[1].any()


def test_polarities_keep_their_channels_and_black_stays_black():
    image = np.zeros((1, 6, 6, 3), np.uint8)
    image[0, :3, :, 0], image[0, 3:, :, 2], image[..., 1] = 90, 200, 77
    counts = round_stochastically(image, np.array([300]), polarity=True, seeds=[1])
    assert counts[0, 0, :3].all() and counts[0, 1, 3:].all()
    assert not counts[0, 0, 3:].any() and not counts[0, 1, :3].any()
    rendered = event_histogram.render_image(counts, event_histogram.Options())
    assert not rendered[..., 1].any()
    assert not round_stochastically(np.zeros_like(image), np.array([300]), polarity=True, seeds=[1]).any()


def test_a_count_is_no_more_than_16_bits_hold():
    image = np.zeros((1, 2, 2, 3), np.uint8)
    image[0, 0, 0] = 200
    counts = round_stochastically(image, np.array([70_000]), polarity=False, seeds=[0])
    assert counts.tolist() == [[[[65_535, 0], [0, 0]]]]


def test_images_of_one_scale_say_their_number_of_events():
    """A count of 1 is 85 in each: an image twice as bright has twice the events, whatever recorded windows had."""
    options = event_histogram.Options(normalisation="count", full_scale_count=3)
    counts = RANDOM.poisson(0.4, (6, 2, 32, 32)).clip(max=3).astype(np.uint16)
    encoder = Plugin("encodings", "event_histogram", event_histogram, options)
    images = event_histogram.render_image(counts, options)
    assert np.array_equal(round_frames(images, np.array([7]), encoder, seeds=range(6)), images)
    half = round_frames(images // 2, np.array([7]), encoder, seeds=range(6)).sum(axis=(1, 2, 3), dtype=np.int64)
    np.testing.assert_allclose(half / images.sum(axis=(1, 2, 3), dtype=np.int64), 0.5, atol=0.06)


@pytest.mark.parametrize("full_scale_count", [1, 3, 8, 64, 100, 128, 200, 255])
def test_recorded_images_of_normalisation_count_stay_as_they_are(full_scale_count):
    """Also where levels were rounded down: 128 events to 255 levels make one event level 1, half of 255 / 128."""
    options = event_histogram.Options(normalisation="count", full_scale_count=full_scale_count)
    encoder = Plugin("encodings", "event_histogram", event_histogram, options)
    counts = np.random.default_rng(0).poisson(0.3, (4, 2, 24, 32)).astype(np.uint16)
    images = event_histogram.render_image(counts, options)
    assert np.array_equal(round_frames(images, np.array([7]), encoder, seeds=range(4)), images)
    # What lies between black and one event keeps its events on average.
    one = 255 // full_scale_count
    if one >= 2:
        faint = np.full((40, 24, 32, 3), one // 2, np.uint8)
        rounded = round_frames(faint, np.array([7]), encoder, seeds=range(40))[..., 0]
        assert (rounded > 0).mean() == pytest.approx(one // 2 / one, abs=0.01)


def test_a_row_depends_on_its_own_seed_alone():
    images = grey(RANDOM.integers(0, 256, (5, 8, 8)))
    together = round_stochastically(images, np.array([50, 60]), polarity=False, seeds=[3, 1, 4, 1, 5])
    for row, seed in enumerate([3, 1, 4, 1, 5]):
        alone = round_stochastically(images[row : row + 1], np.array([50, 60]), polarity=False, seeds=[seed])
        np.testing.assert_array_equal(alone[0], together[row])


@pytest.mark.parametrize(
    ("frames", "num_events", "seeds", "message"),
    [
        (np.zeros((2, 4, 4), np.uint8), [5], [0, 1], "must be"),
        (np.zeros((2, 4, 4, 3)), [5], [0, 1], "must be"),
        (np.zeros((2, 4, 4, 3), np.uint8), [5], [0], "one seed a frame"),
        (np.zeros((1, 4, 4, 3), np.uint8), [], [0], "recorded windows"),
    ],
)
def test_what_does_not_fit_is_refused(frames, num_events, seeds, message):
    with pytest.raises(ValueError, match=message):
        round_stochastically(frames, np.array(num_events), polarity=False, seeds=seeds)
