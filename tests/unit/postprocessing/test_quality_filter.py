"""The quality filter for generated images, on images that are plainly right or wrong."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core import plugins
from ctlev_core.postprocessing.quality_filter import (
    find_causes,
    fit_quality_filter,
    sample_until_accepted,
    seed_of_attempt,
)
from data_contracts.errors import DataError


def event_frames(count: int, seed: int = 0, *, polarity: bool = True, share: float = 0.1) -> np.ndarray:
    """Frames of random counts, as the event histogram renders them."""
    encoding = plugins.load("encodings", "event_histogram")
    rng = np.random.default_rng(seed)
    shape = (count, 2 if polarity else 1, 24, 32)
    counts = np.where(rng.random(shape) < share, rng.integers(1, 9, shape), 0).astype(np.uint16)
    return encoding.render_image(counts, encoding.Options(polarity=polarity))


@pytest.mark.parametrize("polarity", [True, False])
def test_real_frames_pass_and_gross_failures_do_not(polarity):
    real = event_frames(200, polarity=polarity)
    quality_filter = fit_quality_filter(real[::2], polarity=polarity)
    assert find_causes(real[1::2], quality_filter) == [""] * 100
    black, white = np.zeros_like(real[:1]), np.full_like(real[:1], 255)
    noise = np.random.default_rng(0).integers(0, 256, real[:1].shape, np.uint8)
    one_pixel = black.copy()
    one_pixel[0, 5, 5] = (255, 0, 255) if polarity else 255
    causes = find_causes(np.concatenate([black, white, noise, one_pixel]), quality_filter)
    assert all(causes)
    assert causes[0].startswith("empty: active_share 0, expected ") and causes[3].startswith("empty")
    assert causes[1].startswith("too many active pixels")


def test_a_saturated_scene_and_wrong_colours_are_named():
    real = event_frames(100)
    quality_filter = fit_quality_filter(real, polarity=True)
    yellow = real[:1].copy()
    yellow[..., 1] = yellow[..., 0]
    assert find_causes(yellow, quality_filter)[0].startswith("not the colours of event images: off_palette")
    saturated = (real[:1] > 0) * np.uint8(255)
    assert find_causes(saturated, quality_filter)[0].startswith("saturated: bright_share 1, expected 0 to 0.")
    assert find_causes(np.minimum(real[:1], 27), quality_filter)[0].startswith("too dark: brightness")


def test_a_faint_cast_of_green_passes():
    real = event_frames(100)
    cast = np.maximum(real, np.array([0, 3, 0], np.uint8))
    assert find_causes(cast, fit_quality_filter(real, polarity=True)) == [""] * 100


@settings(deadline=None, max_examples=20)
@given(share=st.floats(0.02, 0.9), seed=st.integers(0, 100), polarity=st.booleans())
def test_frames_a_gate_was_fitted_to_pass_it(share, seed, polarity):
    """Up to 2 % of them lie outside the central 98 %; the widening takes them in unless one is very odd."""
    real = event_frames(20, seed, polarity=polarity, share=share)
    assert find_causes(real, fit_quality_filter(real, polarity=polarity)) == [""] * 20


def test_refused_rows_are_sampled_again_from_seeds_of_their_own():
    real = event_frames(50)
    quality_filter = fit_quality_filter(real, polarity=True)
    calls = []

    def sample(rows, seeds):
        calls.append((rows.tolist(), list(seeds)))
        frames = []
        for row, seed in zip(rows, seeds, strict=True):
            is_good = row != 3 and (seed % 3 == 0 or row == 2)
            frames.append(real[row] if is_good else np.zeros_like(real[row]))
        return np.stack(frames)

    seeds = [1, 3, 5, 7, 11]
    made = sample_until_accepted(sample, seeds, quality_filter, max_attempts=30)
    assert calls[0] == ([0, 1, 2, 3, 4], seeds) and calls[1][0] == [0, 3, 4]
    assert made.num_attempts[1:4] == [1, 1, 30] and made.seeds[1:3] == [3, 5]
    assert made.causes[:3] == ["", "", ""] and made.causes[3].startswith("empty") and made.causes[4] == ""
    for row, (seed, tries) in enumerate(zip(made.seeds, made.num_attempts, strict=True)):
        assert seed == seed_of_attempt(seeds[row], tries - 1)
    np.testing.assert_array_equal(made.frames[[0, 1, 2, 4]], real[[0, 1, 2, 4]])
    assert not made.frames[3].any()
    # A row alone comes out as it does among others.
    alone = sample_until_accepted(lambda rows, seeds: sample(rows + 4, seeds), [11], quality_filter, max_attempts=30)
    np.testing.assert_array_equal(alone.frames[0], made.frames[4])
    assert alone.seeds == [made.seeds[4]] and alone.num_attempts == [made.num_attempts[4]]


def test_seeds_of_tries_differ():
    seeds = {seed_of_attempt(seed, number) for seed in range(50) for number in range(20)}
    assert len(seeds) == 1000 and seed_of_attempt(7, 0) == 7


@pytest.mark.parametrize(
    ("frames", "error"),
    [
        (np.zeros((0, 4, 4, 3), np.uint8), DataError),
        (np.zeros((2, 4, 4, 3), np.uint8), DataError),
        (np.zeros((2, 4, 4), np.uint8), ValueError),
        (np.zeros((2, 4, 4, 3), np.float32), ValueError),
    ],
)
def test_what_no_gate_can_be_fitted_to_is_refused(frames, error):
    with pytest.raises(error):
        fit_quality_filter(frames, polarity=True)


def test_wrong_calls_are_refused():
    quality_filter = fit_quality_filter(event_frames(3), polarity=True)
    with pytest.raises(ValueError, match="at least one try"):
        sample_until_accepted(lambda rows, seeds: event_frames(len(rows)), [1], quality_filter, max_attempts=0)
    with pytest.raises(ValueError, match="0 rows"):
        sample_until_accepted(lambda rows, seeds: event_frames(len(rows)), [], quality_filter, max_attempts=1)
