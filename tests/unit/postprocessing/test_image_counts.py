"""Counts from event images: recorded ones come back exactly, blurred ones nearly, and nothing else passes."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core import plugins
from ctlev_core.events import files as event_files
from ctlev_core.events.windows import cut
from ctlev_core.postprocessing import image_counts
from ctlev_core.postprocessing.image_count_kernels import find_scale_ranges, settle_saturated
from ctlev_core.postprocessing.image_counts import estimate_counts, fit_counts
from data_contracts.config import Windows
from data_contracts.errors import DataError

ENCODING = plugins.load("encodings", "event_histogram")
ALL_OPTIONS = [
    ENCODING.Options(polarity=polarity, normalisation=normalisation)
    for polarity in (True, False)
    for normalisation in ("three_sigma", "max", "count")
]


def name_of(options) -> str:
    return f"{options.normalisation}-{'polarity' if options.polarity else 'grey'}"


def edge_counts(count: int, polarity: bool, seed: int = 0, size: tuple[int, int] = (40, 56)) -> np.ndarray:
    """Windows [N, C, H, W] uint16 with bright bands, isolated events, and few pixels that fire much more often."""
    rng = np.random.default_rng(seed)
    channels = 2 if polarity else 1
    distance = np.abs(np.arange(size[1]) - rng.uniform(0, size[1], (count, channels, size[0], 1)))
    rate = 3 * np.exp(-((distance / 3) ** 2)) + 0.01
    rate[rng.random(rate.shape) < 0.002] = 12
    return rng.poisson(rate).astype(np.uint16)


@pytest.mark.parametrize("options", ALL_OPTIONS, ids=name_of)
def test_unseen_real_images_come_back_exactly(options):
    counts = edge_counts(24, options.polarity)
    frames = ENCODING.render_image(counts, options)
    found = estimate_counts(frames[::2], fit_counts(counts[1::2], options), seeds=range(12))
    assert found.is_exact.all() and (found.error_levels == 0).all()
    np.testing.assert_array_equal(found.frames, frames[::2])
    np.testing.assert_array_equal(ENCODING.render_image(found.counts, options), frames[::2])
    is_saturated = np.moveaxis(frames[::2][..., [0, 2] if options.polarity else [0]], 3, 1) == 255
    if options.normalisation == "max":
        np.testing.assert_array_equal(found.counts, counts[::2])
    else:
        # What is not saturated was never lost; what is, is made up from the other windows.
        np.testing.assert_array_equal(found.counts[~is_saturated], counts[::2][~is_saturated])
        total, expected = int(found.counts.sum()), int(counts[::2].sum())
        assert total == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("options", ALL_OPTIONS, ids=name_of)
def test_images_of_a_noisy_decoder_keep_their_events(options):
    """Noise of 3 grey levels, the levels being 10 apart or more."""
    counts = edge_counts(24, options.polarity)
    frames = ENCODING.render_image(counts, options)
    noise = np.random.default_rng(1).normal(0, 3, frames[::2].shape)
    noisy = np.clip(np.rint(frames[::2] + noise), 0, 255).astype(np.uint8)
    found = estimate_counts(noisy, fit_counts(counts[1::2], options), seeds=range(12))
    assert not found.is_exact.any()
    # The mean of a normal variable's magnitude is 3 sqrt(2 / pi) = 2.4, and of those that are not 0 somewhat more.
    assert found.error_levels.mean() < 3.2
    totals, expected = found.counts.sum(axis=(1, 2, 3)), counts[::2].sum(axis=(1, 2, 3))
    np.testing.assert_allclose(totals, expected, rtol=0.06)
    assert (found.counts != counts[::2]).sum() < 0.06 * (counts[::2] > 0).sum()


def test_rows_do_not_depend_on_one_another():
    options = ENCODING.Options()
    counts = edge_counts(12, True)
    model, frames = fit_counts(counts[6:], options), ENCODING.render_image(counts[:6], options)
    together = estimate_counts(frames, model, seeds=range(6)).counts
    backwards = estimate_counts(frames[::-1], model, seeds=range(5, -1, -1)).counts[::-1]
    alone = np.concatenate([estimate_counts(frames[row : row + 1], model, seeds=[row]).counts for row in range(6)])
    np.testing.assert_array_equal(together, backwards)
    np.testing.assert_array_equal(together, alone)
    other = estimate_counts(frames, model, seeds=range(100, 106))
    assert other.is_exact.all() and (other.counts != together).any()


@settings(deadline=None, max_examples=80)
@given(
    seed=st.integers(0, 10_000),
    size=st.tuples(st.integers(1, 6), st.integers(1, 6)),
    largest=st.integers(1, 40),
    share=st.floats(0.05, 1),
    options=st.sampled_from(ALL_OPTIONS),
)
def test_tiny_images_never_fail_and_are_exact_but_for_three_sigma(seed, size, largest, share, options):
    """With three standard deviations and a handful of pixels, the few counts that give the scale may not be found."""
    rng = np.random.default_rng(seed)
    shape = (4, 2 if options.polarity else 1, *size)
    counts = np.where(rng.random(shape) < share, rng.integers(1, largest + 1, shape), 0).astype(np.uint16)
    counts[0, 0, 0, 0] = 1
    frames = ENCODING.render_image(counts, options)
    found = estimate_counts(frames, fit_counts(counts, options), seeds=range(4))
    assert found.counts.shape == counts.shape and found.counts.dtype == np.uint16
    np.testing.assert_array_equal(found.is_exact, (found.frames == frames).all(axis=(1, 2, 3)))
    assert ((found.error_levels == 0) == found.is_exact).all()
    if options.normalisation != "three_sigma":
        assert found.is_exact.all()


@pytest.mark.parametrize("options", ALL_OPTIONS, ids=name_of)
def test_black_white_and_random_images(options):
    counts = edge_counts(8, options.polarity)
    rng = np.random.default_rng(0)
    shape = (3, *counts.shape[2:], 3)
    frames = np.stack([np.zeros(shape[1:]), np.full(shape[1:], 255), rng.integers(0, 256, shape[1:])]).astype(np.uint8)
    if options.polarity:
        frames[..., 1] = 0
    found = estimate_counts(frames, fit_counts(counts, options), seeds=[0, 1, 2])
    assert not found.counts[0].any() and found.is_exact[0]
    assert found.counts[1].all() and found.is_exact[1]
    assert found.counts[2].any()


def test_the_real_person_comes_back_exactly(real_recordings):
    (path,) = (real_recordings / "person").iterdir()
    events = event_files.read_events_file(path)
    for options in ALL_OPTIONS:
        for num_events in (500, 7500):
            counts = ENCODING.encode(events, cut(events, Windows(num_events=num_events, max_windows=12)), options)
            frames = ENCODING.render_image(counts, options)
            found = estimate_counts(frames[::2], fit_counts(counts[1::2], options), seeds=range(len(frames[::2])))
            assert found.is_exact.all(), f"{name_of(options)}, {num_events} events"
            totals = found.counts.sum(axis=(1, 2, 3), dtype=np.int64)
            np.testing.assert_allclose(totals, num_events, rtol=0.05)


@settings(deadline=None, max_examples=100)
@given(scale=st.floats(1.01, 200), counts=st.sets(st.integers(1, 150), min_size=1, max_size=12), low=st.floats(0.5, 1))
def test_the_true_scale_is_in_a_range_and_all_ranges_fit(scale, counts, low):
    levels = {int(255 * count / scale) for count in counts if 0 < int(255 * count / scale) < 255}
    if not levels:
        return
    ranges = np.empty((1 << 14, 2))
    values = np.array(sorted(levels))
    used = find_scale_ranges(values, scale * low, min(scale * 1.5, 255.0), ranges)
    assert used >= 1
    # Up to rounding of the ends, by a few parts in 10^12.
    assert any(first * (1 - 1e-11) <= scale <= last * (1 + 1e-11) for first, last in ranges[:used])
    for middle in ranges[:used].mean(axis=1):
        possible = {int(255 * count / middle) for count in range(int(middle) + 2)}
        assert levels <= possible


def test_too_many_ranges_are_reported():
    assert find_scale_ranges(np.array([200]), 1.0, 255.0, np.empty((3, 2))) == -1


def test_saturated_counts_are_settled_without_going_below_the_least():
    rng = np.random.default_rng(0)
    totals = rng.integers(1, 4, 500)
    pixels = np.arange(40)
    counts = np.full(40, 8)
    totals[:40] += counts
    rest = totals[:40] - counts
    draws = rng.integers(0, 40, (1024, 2))
    assert settle_saturated(totals, pixels, counts, 7, 9.0, 9.001, draws)
    assert 9.0 < 3 * totals.std(ddof=1) <= 9.001 and counts.min() >= 7
    np.testing.assert_array_equal(totals[:40], rest + counts)
    # Out of reach: a larger count only moves the standard deviation up.
    assert not settle_saturated(totals, pixels, counts, 7, 0.1, 0.2, draws)


def test_a_pixel_with_very_many_events_takes_no_more_memory(monkeypatch):
    """A table of every count, of which up to 98,000 share 256 levels, took 200 MB and half a second for each scale."""
    monkeypatch.setattr(image_counts, "MAX_SCALES", 3)
    counts = edge_counts(4, polarity=True)
    counts[:, 0, 3, 5] = 65_535
    options = ENCODING.Options(normalisation="max")
    fit_counts(counts[:1] % 50, options)  # what is kept between calls
    tracemalloc.start()
    try:
        model = fit_counts(counts, options)
        assert tracemalloc.get_traced_memory()[1] < 20 * 2**20
    finally:
        tracemalloc.stop()
    assert model.grid[-1] == pytest.approx(1.5 * 65_535, abs=1)
    # Grey level 128 is some 33,000 events at the middle of the three scales.
    assert model.counts[1, 0, 128] == pytest.approx(128.5 / 255 * model.grid[1], rel=0.01)


def test_what_nothing_can_be_learnt_from_is_refused():
    options = ENCODING.Options()
    with pytest.raises(DataError, match="none of 3 recorded windows has an event"):
        fit_counts(np.zeros((3, 2, 4, 4), np.uint16), options)
    with pytest.raises(DataError, match="none of 0"):
        fit_counts(np.zeros((0, 2, 4, 4), np.uint16), options)
    with pytest.raises(ValueError, match="uint16"):
        fit_counts(np.ones((3, 1, 4, 4), np.uint16), options)
    model = fit_counts(edge_counts(3, True), options)
    with pytest.raises(ValueError, match="one seed a frame"):
        estimate_counts(np.zeros((2, 4, 4, 3), np.uint8), model, seeds=[0])
    with pytest.raises(ValueError, match="uint8"):
        estimate_counts(np.zeros((2, 4, 4), np.uint8), model, seeds=[0, 1])
    assert estimate_counts(np.zeros((0, 4, 4, 3), np.uint8), model, seeds=[]).counts.shape == (0, 2, 4, 4)
