"""Realism numbers of recordings and of simulated noise, against references that share no code with them."""

from __future__ import annotations

import numpy as np
import pytest

from ctlev_core.events.files import read_events_file
from ctlev_core.realism.summary import AXES, HOT_FACTOR, HOT_MIN_EVENTS, RADIUS_US, summarise_events
from data_contracts.events import Events


def isolated_by_brute_force(events: Events) -> float:
    """Every event against every other."""
    t, x, y = (getattr(events, name).astype(np.int64) for name in ("t", "x", "y"))
    joined = np.zeros(len(events), bool)
    for event in range(len(events)):
        distance = np.maximum(np.abs(x - x[event]), np.abs(y - y[event]))
        joined[event] = ((distance == 1) & (np.abs(t - t[event]) <= RADIUS_US)).any()
    return float((~joined).mean())


def intervals_by_sorting(events: Events) -> np.ndarray:
    """Sort by pixel, then by time; neighbours in that order of one pixel are its intervals."""
    pixel = events.y.astype(np.int64) * events.sensor_size[0] + events.x
    order = np.lexsort((np.arange(len(events)), pixel))
    same = pixel[order][1:] == pixel[order][:-1]
    return (events.t[order][1:] - events.t[order][:-1])[same]


def hot_by_neighbour_stack(events: Events) -> np.ndarray:
    """Second largest of eight shifted copies of the count image."""
    width, height = events.sensor_size
    counts = np.zeros((height, width), np.int64)
    np.add.at(counts, (events.y, events.x), 1)
    padded = np.pad(counts, 1)
    shifts = [(dy, dx) for dy in range(3) for dx in range(3) if (dy, dx) != (1, 1)]
    stack = np.sort([padded[dy : dy + height, dx : dx + width] for dy, dx in shifts], axis=0)
    return (counts >= HOT_MIN_EVENTS) & (counts > HOT_FACTOR * np.maximum(stack[-2], 1))


@pytest.mark.parametrize("name", ["person", "spot"])
def test_real_recordings_equal_slow_references(name, real_recordings):
    events = read_events_file(next((real_recordings / name).iterdir()))
    events = events.slice(10_000, 14_000)
    summary = summarise_events(events)
    assert summary.numbers["isolated_share"] == pytest.approx(isolated_by_brute_force(events))
    intervals = intervals_by_sorting(events)
    axis = AXES["interval"]
    bins = np.clip(np.floor((np.log10(np.maximum(intervals, 1)) - axis.low) / axis.width + 1e-9), 0, axis.num_bins - 1)
    expected = np.bincount(bins.astype(int), minlength=axis.num_bins) / len(intervals)
    np.testing.assert_allclose(summary.distributions["interval"], expected)


@pytest.mark.parametrize("name", ["person", "spot"])
def test_hot_pixels_of_real_recordings_equal_a_slow_reference(name, real_recordings):
    events = read_events_file(next((real_recordings / name).iterdir()))
    summary, is_hot = summarise_events(events), hot_by_neighbour_stack(events)
    assert summary.numbers["hot_pixel_share"] == pytest.approx(is_hot.mean()) and is_hot.any()
    assert summary.numbers["hot_event_share"] == pytest.approx(is_hot[events.y, events.x].mean())


@pytest.mark.parametrize("rate_hz", [0.05, 1.0, 20.0])
def test_the_noise_rate_has_no_bias_at_any_rate(rate_hz):
    # Mean over repetitions against the standard error of their mean, at rates where most events are isolated and where
    # almost none is.
    size, seconds, found = (40, 30), 4.0, []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        count = max(rng.poisson(rate_hz * seconds * size[0] * size[1]), 2)
        t = np.sort(rng.integers(0, round(seconds * 1e6), count))
        x, y = (rng.integers(0, n, count).astype(np.uint16) for n in size)
        found.append(summarise_events(Events(t, x, y, np.ones(count, np.uint8), size)).numbers["noise_rate_hz"])
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert abs(np.mean(found) - rate_hz) < 4 * error + 0.01 * rate_hz
