"""Windows: known cuts, properties, and time stamps that stand still or jump."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.events.windows import Cutter, check_ranges, cut, cut_at_labels, cut_chunks, spread, window_around
from data_contracts.config import Windows, cache_material
from data_contracts.errors import DataError
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


# Recordings in chunks ----------------------------------------------------------------------------------------------


@settings(max_examples=200, deadline=None)
@given(
    TIMES,
    st.lists(st.integers(0, 60), max_size=6),
    st.sampled_from(["count", "duration", "whole"]),
    st.integers(1, 12),
    st.integers(1, 4),
    st.none() | st.integers(1, 5),
)
def test_chunks_give_the_same_windows_however_they_are_cut(times, bounds, method, size, min_events, limit):
    options = {
        "method": method, "num_events": size, "duration_us": size, "min_events": min_events, "max_windows": limit
    }  # fmt: skip
    edges = [0, *sorted(min(bound, len(times)) for bound in bounds), len(times)]
    chunks = [np.array(times[a:b], np.int64) for a, b in itertools.pairwise(edges)]
    result = cut_chunks(iter(chunks), Windows(**options))
    assert result.tolist() == ranges(times, **options)
    assert result.dtype == np.int64 and result.shape[1:] == (2,)


def test_a_window_is_given_out_as_soon_as_it_is_complete():
    cutter = Cutter(Windows(method="duration", duration_us=10))
    assert cutter.add(np.array([0, 3])).tolist() == []
    assert cutter.add(np.array([9, 10])).tolist() == [[0, 3]]
    assert cutter.add(np.array([], np.int64)).tolist() == []
    assert cutter.add(np.array([25, 39])).tolist() == [[3, 4], [4, 5]]
    assert cutter.finish().tolist() == [[5, 6]]
    assert cutter.num_events == 6


@pytest.mark.parametrize("method", ["count", "duration", "whole"])
def test_a_recording_without_chunks_or_events_has_no_windows(method):
    assert cut_chunks([], Windows(method=method)).shape == (0, 2)
    assert cut_chunks([np.zeros(0, np.int64)] * 2, Windows(method=method)).shape == (0, 2)


def test_one_event():
    assert ranges([7], method="whole") == [[0, 1]]
    assert ranges([7], num_events=1) == [[0, 1]]
    assert ranges([7], method="duration", duration_us=2) == []


def test_equal_time_stamps_across_two_chunks_stay_in_one_window():
    chunks = [np.array([5, 10]), np.array([10, 10]), np.array([14, 15])]
    assert cut_chunks(chunks, Windows(method="duration", duration_us=5)).tolist() == [[0, 1], [1, 5]]


def test_a_jump_of_the_clock_between_two_chunks():
    chunks = [np.array([0, 1]), np.array([2**62, 2**62 + 9])]
    assert cut_chunks(chunks, Windows(method="duration", duration_us=2)).tolist() == [[0, 2], [2, 3], [3, 4]]


def test_windows_of_the_dataset_are_not_cut_here():
    with pytest.raises(DataError, match=r"'dataset': the ranges come from the dataset; cut by count"):
        cut(events_at([1, 2]), Windows(method="dataset"))


@pytest.mark.parametrize(("count", "wanted"), [(0, 3), (5, None), (5, 9), (10, 3), (10, 1)])
def test_spread_takes_the_middles_of_equal_stretches(count, wanted):
    expected = [
        n for n in range(count)
        if wanted is None or count <= wanted or any((2 * k + 1) * count // (2 * wanted) == n for k in range(wanted))
    ]  # fmt: skip
    assert spread(count, wanted).tolist() == expected


def test_ranges_are_checked_against_the_events():
    assert check_ranges(np.array([[0, 3], [2, 2]], np.int32), 3).dtype == np.int64
    for wrong in ([[0, 4]], [[-1, 0]], [[2, 1]]):
        with pytest.raises(ValueError, match=r"window 0 must be a range within 3 events, got \["):
            check_ranges(np.array(wrong), 3)
    with pytest.raises(ValueError, match=r"must be \[N, 2\]"):
        check_ranges(np.zeros((2, 3)), 3)


# Windows that end at labels ----------------------------------------------------------------------------------------


@settings(max_examples=200, deadline=None)
@given(
    TIMES,
    st.lists(st.integers(-20, 220), max_size=12).map(sorted),
    st.lists(st.integers(0, 60), max_size=4),
    st.sampled_from(["count", "duration"]),
    st.integers(1, 30),
    st.integers(1, 4),
)
def test_windows_at_labels_equal_a_slow_search(times, labels, bounds, method, size, min_events):
    windows = Windows(anchor="labels", method=method, num_events=size, duration_us=size, min_events=min_events)
    edges = [0, *sorted(min(bound, len(times)) for bound in bounds), len(times)]
    chunks = [np.array(times[a:b], np.int64) for a, b in itertools.pairwise(edges)]
    expected, ended = [], []
    for row, label in enumerate(labels):
        if label in labels[:row] or not times or label > times[-1]:
            continue
        before = [i for i, t in enumerate(times) if t <= label]
        if method == "count":
            inside = before[-size:] if len(before) >= size else []
        else:
            inside = [i for i in before if times[i] > label - size] if label - size + 1 >= times[0] else []
            inside = inside if len(inside) >= min_events else []
        if inside:
            expected.append([inside[0], inside[-1] + 1])
            ended.append(row)
    found, rows = cut_at_labels(iter(chunks), np.array(labels, np.int64), windows)
    assert found.tolist() == expected and rows.tolist() == ended
    assert found.dtype == rows.dtype == np.int64 and found.shape[1:] == (2,)
    for (start, stop), row in zip(expected, ended, strict=True):
        assert window_around(np.array(times), labels[row], 0, windows) == (start, stop)


@pytest.mark.parametrize("method", ["whole", "dataset", "duration", "count"])
def test_windows_around_a_moment_end_at_it_where_labels_are_those_of_the_end(method):
    windows = Windows(method=method, duration_us=20, num_events=20, labels="interpolated")
    assert windows.end_at_labels and not Windows(method=method).end_at_labels
    assert window_around(np.arange(100), 60, 20, windows) == (41, 61)
    assert window_around(np.arange(100), 60, 20, windows.model_copy(update={"labels": "mean"})) == (50, 70)


def test_windows_at_labels_are_spread_and_need_labels():
    windows = Windows(anchor="labels", num_events=2, max_windows=2)
    _, rows = cut_at_labels([np.arange(20)], np.arange(3, 13), windows)
    assert rows.tolist() == [2, 7]
    with pytest.raises(DataError, match="windows end at labels, which events do not have"):
        cut(events_at([1, 2]), windows)
    with pytest.raises(ValueError, match="'labels' needs method count or duration, got 'whole'"):
        Windows(anchor="labels", method="whole")


def test_windows_of_before_keep_their_keys():
    assert list(cache_material(Windows())) == ["method", "num_events", "duration_us", "max_windows", "min_events"]
    asked = cache_material(Windows(anchor="labels", labels="interpolated"))
    assert (asked["anchor"], asked["labels"]) == ("labels", "interpolated")
    assert Windows.model_validate(Windows(anchor="labels").model_dump()) == Windows(anchor="labels")
