"""Windows: known cuts, properties, and time stamps that stand still or jump."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.windows import cut
from data_contracts.config import Windows
from data_contracts.events import Events


def events_at(times: list[int]) -> Events:
    zeros = np.zeros(len(times), np.uint16)
    return Events(np.array(times, np.int64), zeros, zeros, zeros.astype(np.uint8), (1, 1))


def ranges(times: list[int], **options) -> list[list[int]]:
    result = cut(events_at(times), Windows(**options))
    assert result.shape[1:] == (2,)
    assert result.dtype == np.int64
    return result.tolist()


def test_count_drops_the_events_left_over():
    assert ranges(list(range(10)), num_events=4) == [[0, 4], [4, 8]]
    assert ranges(list(range(8)), num_events=4) == [[0, 4], [4, 8]]


@pytest.mark.parametrize("num", [0, 1, 3])
def test_count_gives_none_for_a_recording_that_is_too_short(num):
    assert ranges(list(range(num)), num_events=4) == []


def test_duration_starts_at_the_first_event_and_is_half_open():
    # Windows of 10 us from 100: [100, 110) and [110, 120); event 119 is the last microsecond of the second.
    assert ranges([100, 109, 110, 119], method="duration", duration_us=10) == [[0, 2], [2, 4]]


def test_duration_drops_a_last_window_that_is_not_over():
    assert ranges([100, 109, 110, 118], method="duration", duration_us=10) == [[0, 2]]
    assert ranges([100], method="duration", duration_us=10) == []
    assert ranges([100], method="duration", duration_us=1) == [[0, 1]]


def test_duration_drops_windows_without_enough_events():
    times = [0, 1, 25, 30, 31, 39]
    assert ranges(times, method="duration", duration_us=10) == [[0, 2], [2, 3], [3, 6]]
    assert ranges(times, method="duration", duration_us=10, min_events=2) == [[0, 2], [3, 6]]
    assert ranges(times, method="duration", duration_us=10, min_events=4) == []


def test_duration_survives_a_clock_that_jumps_by_centuries():
    # 2^63 us of 1 us windows: a list of all windows, empty ones too, would not fit any memory.
    assert ranges([0, 2**63 - 1], method="duration", duration_us=1) == [[0, 1], [1, 2]]
    assert ranges([0, 0, 2**62, 2**62 + 1], method="duration", duration_us=2) == [[0, 2], [2, 4]]


def test_time_that_stands_still_is_one_window():
    assert ranges([5] * 6, method="duration", duration_us=1) == [[0, 6]]


def test_whole_is_one_window_unless_events_are_missing():
    assert ranges([1, 2, 3], method="whole") == [[0, 3]]
    assert ranges([], method="whole") == []
    assert ranges([1, 2, 3], method="whole", min_events=4) == []


@pytest.mark.parametrize(("limit", "expected"), [(1, [5]), (2, [2, 7]), (3, [1, 5, 8]), (10, list(range(10)))])
def test_max_windows_spreads_evenly(limit, expected):
    starts = [start for start, _ in ranges(list(range(20)), num_events=2, max_windows=limit)]
    assert starts == [2 * window for window in expected]


TIMES = st.lists(st.integers(0, 200), max_size=60).map(sorted)


@settings(deadline=None)
@given(TIMES, st.integers(1, 20))
def test_count_windows_tile_the_recording(times, num_events):
    result = ranges(times, num_events=num_events)
    assert [event for start, stop in result for event in range(start, stop)] == list(range(num_events * len(result)))
    assert len(times) - num_events * len(result) < num_events


@settings(deadline=None)
@given(TIMES, st.integers(1, 50), st.integers(1, 5))
def test_duration_windows_equal_a_slow_search(times, duration_us, min_events):
    expected = []
    for number in range(201 // duration_us + 1 if times else 0):
        start_us = times[0] + number * duration_us
        inside = [i for i, t in enumerate(times) if start_us <= t < start_us + duration_us]
        if len(inside) >= min_events and start_us + duration_us - 1 <= times[-1]:
            expected.append([inside[0], inside[-1] + 1])
    assert ranges(times, method="duration", duration_us=duration_us, min_events=min_events) == expected


@settings(deadline=None)
@given(TIMES, st.sampled_from(["count", "duration", "whole"]), st.integers(1, 12), st.integers(1, 10))
def test_max_windows_keeps_a_subset_in_order(times, method, size, limit):
    options = {"method": method, "num_events": size, "duration_us": size}
    everything, kept = ranges(times, **options), ranges(times, **options, max_windows=limit)
    assert len(kept) == min(limit, len(everything))
    assert kept == [window for window in everything if window in kept]
