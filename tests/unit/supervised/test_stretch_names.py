"""Stretches of frames: found where windows follow one another, and chosen among labels."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.labels.label_sampling import choose_stretches
from ctlev_core.supervised.frame_sequences import frame_interval_us, name_stretches, stretch_lengths
from data_contracts.errors import DataError


def frames_of(names, starts, ends, **further):
    return pa.table({"recording_id": names, "t_start_us": starts, "t_end_us": ends, **further})


def lengths_of(table, interval_us=None):
    rows = np.arange(len(table))
    return stretch_lengths(name_stretches(table, rows, interval_us or frame_interval_us(table, rows, "frames")))


def test_windows_without_a_gap_follow_one_another():
    starts = np.array([3, 20, 40, 60, 0, 20, 40])
    frames = frames_of(["a"] * 4 + ["b"] * 3, starts, starts + 19)
    assert frame_interval_us(frames, np.arange(7), "frames") == 20
    assert lengths_of(frames) == [4, 3]


def test_a_window_left_out_ends_a_stretch():
    starts = np.array([0, 20, 60, 80, 100])
    assert lengths_of(frames_of(["a"] * 5, starts, starts + 20)) == [2, 3]


def test_windows_of_equal_count_follow_one_another_whatever_they_last():
    starts, ends = np.array([0, 10, 50, 70]), np.array([10, 50, 69, 140])
    assert lengths_of(frames_of(["a"] * 4, starts, ends)) == [4]


@pytest.mark.parametrize(("step", "expected"), [(20, [4]), (24, [4]), (26, [1] * 4), (10, [1] * 4), (45, [1] * 4)])
def test_labels_follow_one_another_at_the_interval_of_frames(step, expected):
    """Labels to sample from have windows around them that overlap, or leave gaps."""
    times = step * np.arange(4)
    frames = frames_of(["c"] * 4, np.maximum(times - 10, 0), times + 10, source_id=[f"pose:{t}" for t in times])
    assert lengths_of(frames, 20) == expected


def test_time_that_goes_back_begins_another_stretch():
    times = np.array([0, 20, 40, 0, 20])
    frames = frames_of(["c"] * 5, times, times + 20, source_id=[f"pose:{t}" for t in times])
    assert lengths_of(frames, 20) == [3, 2]


def test_synthetic_frames_follow_one_another_as_their_labels_do():
    """Labels of moments in us, or of frames that are numbered; what has no such label is by itself."""
    sources = ["a:0", "a:20", "a:40", "a:90", "b:train:00003", "b:train:00004", "b:train:00006", "prompt", "prompt"]
    assert lengths_of(pa.table({"source_id": sources}), 20) == [3, 1, 2, 1, 1, 1]


def test_single_frames_have_no_interval():
    frames = frames_of(["a", "b"], [0, 0], [20, 20])
    with pytest.raises(DataError, match="no two frames follow one another"):
        frame_interval_us(frames, np.arange(2), "frames")


def test_chosen_stretches_keep_the_interval():
    """Labels every 5 us: every fourth is taken, and those left over at the end of a recording are not."""
    names, times = ["a"] * 20 + ["b"] * 9, np.concatenate([5 * np.arange(20), 5 * np.arange(9)])
    rows = choose_stretches(names, times, 6, 2, 20)
    assert times[rows].tolist() == [0, 20, 40, 60, 0, 20]
    assert [names[row] for row in rows] == ["a"] * 4 + ["b"] * 2


def test_a_gap_among_labels_is_not_crossed():
    times = np.array([0, 20, 40, 95, 115, 135, 155])
    assert times[choose_stretches(["a"] * 7, times, 4, 4, 20)].tolist() == [95, 115, 135, 155]
    assert times[choose_stretches(["a"] * 7, times, 6, 3, 20)].tolist() == [0, 20, 40, 95, 115, 135]
    with pytest.raises(DataError, match="a stretch of 5 frames, one every 20 us"):
        choose_stretches(["a"] * 7, times, 5, 5, 20)


def test_an_interval_is_kept_to_within_a_tenth():
    for last_us in (38, 42):
        assert choose_stretches(["a"] * 3, np.array([0, 20, last_us]), 3, 3, 20).tolist() == [0, 1, 2]
    for last_us in (37, 43):
        with pytest.raises(DataError, match="a stretch of 3 frames, one every 20 us"):
            choose_stretches(["a"] * 3, np.array([0, 20, last_us]), 3, 3, 20)


@given(
    st.lists(st.integers(1, 30), min_size=1, max_size=6),
    st.integers(1, 8),
    st.integers(1, 60),
    st.integers(1, 4),
)
def test_stretches_are_whole_and_lie_in_one_recording(sizes, length, count, every):
    names = [str(number) for number, size in enumerate(sizes) for _ in range(size)]
    times = np.concatenate([7 + 10 * np.arange(size) for size in sizes])
    if max(1 + (size - 1) // every for size in sizes) < length:
        with pytest.raises(DataError, match="no recording"):
            choose_stretches(names, times, count, length, 10 * every)
        return
    rows = choose_stretches(names, times, count, length, 10 * every)
    assert len(rows) == count
    for start in range(0, count, length):
        part = rows[start : start + length]
        assert len({names[row] for row in part}) == 1
        assert (np.diff(times[part]) == 10 * every).all()
