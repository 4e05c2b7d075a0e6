"""Stretches of consecutive frames: found by a slow and obvious search beside them, spread, shuffled and stacked."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.realism.stretches import (
    STACKED_SIDE_PX,
    Stretches,
    check_stretches,
    find_stretches,
    labelled_stretches,
    recorded_stretches,
    shuffle_time,
    stack_frames,
    used_channels,
)
from data_contracts.errors import DataError
from data_contracts.manifest import Manifest, ManifestRef
from data_contracts.tables import CONDITIONS, FRAMES

STEP = 100


def search(names: list[str], times: list[int], length: int) -> list[list[int]]:
    """Row by row: a stretch grows until a frame does not follow, and is kept when it is full."""
    found, grown = [], []
    for row, (name, time) in enumerate(zip(names, times, strict=True)):
        goes_on = row > 0 and name == names[row - 1] != "" and 50 < time - times[row - 1] < 150
        grown = [*grown, row] if goes_on else [row]
        if len(grown) == length:
            found.append(grown)
            grown = []
    return found


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(["a", "b", ""]), st.sampled_from([0, 50, 51, 100, 149, 150, 200])), max_size=24),
    st.integers(3, 5),
)
def test_stretches_are_those_of_a_search_row_by_row(steps, length):
    names = [name for name, _ in sorted(steps, key=lambda step: step[0])]
    times = np.cumsum([step for _, step in steps], dtype=np.int64)
    found = find_stretches(names, times, STEP, length)
    assert found.shape == (len(found), length)
    assert found.tolist() == search(names, times.tolist(), length)


def test_a_gap_another_recording_and_a_frame_of_its_own_end_a_stretch():
    names = ["a"] * 7 + ["b"] * 3 + [""] * 3
    times = [0, 100, 210, 400, 500, 595, 700, 0, 100, 200, 0, 100, 200]
    found = find_stretches(names, np.array(times), STEP, 3)
    assert found.tolist() == [[0, 1, 2], [3, 4, 5], [7, 8, 9]]
    assert find_stretches([], np.zeros(0, np.int64), STEP, 3).shape == (0, 3)


@pytest.mark.parametrize(
    ("names", "step", "length", "told"),
    [
        (["a"], STEP, 3, r"times must be \[1\]"),
        (["a", "a"], STEP, 2, "3 frames"),
        (["a", "a"], 0, 3, "above 0 us"),
    ],
)
def test_stretches_that_are_none_are_refused(names, step, length, told):
    with pytest.raises(ValueError, match=told):
        find_stretches(names, np.zeros(2, np.int64), step, length)


def some_stretches(counts: list[int]) -> Stretches:
    names = np.repeat([f"r{number}" for number in range(len(counts))], counts)
    return Stretches(np.arange(3 * len(names)).reshape(-1, 3), names)


@pytest.mark.parametrize("wanted", [1, 3, 4, 6, 9, 20])
def test_few_stretches_are_of_many_recordings(wanted):
    every = some_stretches([4, 1, 3, 2])
    some = every.spread(wanted)
    assert len(some) == min(wanted, 10)
    taken = [int((some.names == f"r{number}").sum()) for number in range(4)]
    assert sum(count > 0 for count in taken) == min(wanted, 4)
    # Nobody has two more than another who has some left.
    assert all(
        mine <= other + 1 or other == full for mine in taken for other, full in zip(taken, [4, 1, 3, 2], strict=True)
    )
    assert (np.diff(some.rows[:, 0]) > 0).all() and {tuple(row) for row in some.rows} <= {tuple(r) for r in every.rows}


def test_shuffled_stretches_have_the_same_frames_in_all_orders():
    rows = np.arange(6000).reshape(2000, 3)
    shuffled = shuffle_time(rows, seed=3)
    assert np.array_equal(np.sort(shuffled, axis=1), rows) and np.array_equal(shuffled, shuffle_time(rows, seed=3))
    assert not np.array_equal(shuffled, shuffle_time(rows, seed=4))
    orders, counts = np.unique(shuffled - rows[:, :1], axis=0, return_counts=True)
    assert len(orders) == 6 and counts.min() > 333 - 5 * np.sqrt(333)


def test_channels_that_say_nothing_are_left_out():
    values = np.random.default_rng(0).integers(1, 255, (4, 5, 6), np.uint8)
    zero = np.zeros_like(values)
    for channels, shown in (
        ((values, zero, values), 2),
        ((values, values, values), 1),
        ((values, values, zero), 3),
        ((zero, zero, zero), 2),
    ):
        frames = np.stack(channels, axis=-1)
        assert frames[..., used_channels(frames)].shape[-1] == shown
        assert used_channels(frames[0]) == used_channels(frames)


def test_stacked_frames_are_frames_and_their_differences():
    frames = np.random.default_rng(0).integers(0, 255, (4, 6, 5, 2)).astype(np.uint8)
    stacked = stack_frames(frames)
    assert stacked.shape == (6, 5, 14) and stacked.dtype == np.uint8
    for number in range(4):
        assert np.array_equal(stacked[..., 2 * number : 2 * number + 2], frames[number])
    for number, (before, after) in enumerate(pairwise(frames.astype(int))):
        assert np.array_equal(stacked[..., 8 + 2 * number : 10 + 2 * number], abs(after - before))


@pytest.mark.parametrize("channels", [1, 2])
def test_large_frames_are_averaged_before_they_are_stacked(channels):
    side = 2 * STACKED_SIDE_PX
    frames = np.random.default_rng(1).integers(0, 255, (3, side, side, channels)).astype(np.uint8)
    stacked = stack_frames(frames)
    blocks = frames.reshape(3, side // 2, 2, side // 2, 2, channels).astype(float).mean(axis=(2, 4))
    assert stacked.shape == (side // 2, side // 2, 5 * channels)
    assert np.abs(stacked[..., :channels].astype(float) - blocks[0]).max() <= 0.5
    assert stack_frames(np.zeros((3, side + 1, 7, 2), np.uint8)).shape == (round((side + 1) / 3), 2, 10)


def recorded_frames(names: list[str], times: list[int], splits: list[str]) -> Manifest:
    columns = {
        "sample_id": [f"{n}:{s}:{row:05d}" for row, (n, s) in enumerate(zip(names, splits, strict=True))],
        "recording_id": names,
        "split": splits,
        "t_start_us": pa.array(times, pa.int64()),
    }
    return Manifest(ManifestRef(key="f", path=Path("frames")), FRAMES, pa.table(columns), {})


def asked(sources: list[str]) -> Manifest:
    return Manifest(ManifestRef(key="c", path=Path("conditions")), CONDITIONS, pa.table({"source_id": sources}), {})


FRAMES_IN_TIME = recorded_frames(["a"] * 4 + ["b"] * 4, [0, 100, 200, 300] * 2, ["train"] * 4 + ["test"] * 4)


def test_recorded_stretches_are_of_a_split():
    for split, rows, name in (("train", [0, 1, 2], "a"), ("test", [4, 5, 6], "b")):
        found = recorded_stretches(FRAMES_IN_TIME, split, STEP, 3)
        assert found.rows.tolist() == [rows] and found.names.tolist() == [name]
    assert len(recorded_stretches(FRAMES_IN_TIME, "validation", STEP, 3)) == 0


def test_labels_follow_one_another_by_their_moments_or_by_the_frames_they_are_of():
    moments = [f"pose/x:{time}" for time in (0, 100, 200, 400, 500)]
    of_frames = FRAMES_IN_TIME.column("sample_id")[4:7]
    unnamed = ["word", "word", "word"]
    found = labelled_stretches(asked([*moments, *of_frames, *unnamed]), FRAMES_IN_TIME, STEP, 3)
    assert found.rows.tolist() == [[0, 1, 2], [5, 6, 7]] and found.names.tolist() == ["pose/x", "b"]


@pytest.mark.parametrize(("step", "count"), [(100, 1), (91, 1), (89, 0), (109, 1), (111, 0)])
def test_labels_keep_the_step_of_windows_more_closely_than_windows_do(step, count):
    moments = asked([f"x:{number * step}" for number in range(3)])
    assert len(labelled_stretches(moments, FRAMES_IN_TIME, STEP, 3)) == count
    late = recorded_frames(["a"] * 3, [0, step, 2 * step], ["train"] * 3)
    assert len(recorded_stretches(late, "train", STEP, 3)) == 1


def test_what_has_no_stretch_is_refused_with_what_to_change():
    in_time = asked([f"x:{time}" for time in (0, 100, 200)])
    check_stretches(FRAMES_IN_TIME, in_time, STEP, 3)
    with pytest.raises(DataError, match=r"5 frames in a row, each 100 us.*frames has so many training frames"):
        check_stretches(FRAMES_IN_TIME, in_time, STEP, 5)
    with pytest.raises(DataError, match=r"labels to sample from in conditions do not follow.*condition_rate_hz"):
        check_stretches(FRAMES_IN_TIME, asked([f"x:{time}" for time in (0, 50, 200)]), STEP, 3)
