"""Recorded frames after a part of a generator, against what they were: closed forms and things that are known."""

from __future__ import annotations

import numpy as np
import pytest

from ctlev_core.realism.chain import measure_processed, measure_recorded, summarise_recordings
from ctlev_core.realism.two_sample import MIN_FRAMES
from data_contracts import tables

COUNT, PER_RECORDING = 80, 2
GROUPS = [f"r{row // PER_RECORDING}" for row in range(COUNT)]

pytestmark = pytest.mark.usefixtures("quick_two_sample_tests")


def recorded(count=COUNT, seed=0):
    """Lone active pixels on a grid of which no two touch: all of them are isolated."""
    random = np.random.default_rng(seed)
    frames = np.zeros((count, 16, 16, 3), np.uint8)
    frames[:, 1::3, 1::3] = np.where(random.random((count, 5, 5, 1)) < 0.6, 150, 0)
    return frames


def measured(frames, before, groups=GROUPS):
    found = measure_processed(frames, before, groups, summarise_recordings(before, groups), seed=0)
    return {one.metric: one for one in found}


def test_frames_that_come_out_unchanged_have_an_area_of_a_half_and_no_difference():
    by_name = measured(recorded(), recorded())
    assert by_name["c2st"].value == by_name["c2st"].low == by_name["c2st"].high == 0.5
    differences = [one for name, one in by_name.items() if name != "c2st"]
    assert len(differences) >= 6
    for one in differences:
        assert one.difference == one.difference_low == one.difference_high == 0


def test_what_is_lost_is_told_and_counted_recording_by_recording():
    """A third of the active pixels of each recording's second frame is lost, and all are dimmed by a third."""
    before = recorded()
    after = (before // 3 * 2).astype(np.uint8)
    after[1::2, 1] = 0
    by_name = measured(after, before)
    assert by_name["c2st"].value > 0.9 and by_name["c2st"].low > 0.5
    assert by_name["value_mean"].value == pytest.approx(100) and by_name["value_mean"].difference == pytest.approx(-50)
    active = [(frames[..., 0] > 0).reshape(-1, PER_RECORDING * 256).mean(axis=1) for frames in (after, before)]
    lost = by_name["active_pixel_share"]
    assert lost.value == pytest.approx(active[0].mean())
    assert lost.difference == pytest.approx((active[0] - active[1]).mean())
    assert lost.difference_low < lost.difference < lost.difference_high < 0
    # 40 independent recordings: the bootstrap's interval is about 2 x 1.96 standard errors of their mean.
    error = (active[0] - active[1]).std(ddof=1) / np.sqrt(COUNT / PER_RECORDING)
    assert lost.difference_high - lost.difference_low == pytest.approx(2 * 1.96 * error, rel=0.15)
    assert by_name["isolated_pixel_share"].difference == 0, "what is left is still alone"


def test_a_number_that_one_set_lacks_has_no_difference():
    black = np.zeros_like(recorded())
    by_name = measured(black, recorded())
    assert "value_mean" not in by_name, "black frames have no active pixel"
    assert by_name["active_pixel_share"].value == 0
    assert "80 of 80 processed frames are empty" in by_name["c2st"].note
    by_name = measured(recorded(), black)
    assert np.isnan(by_name["value_mean"].difference) and by_name["value_mean"].row()["difference"] is None


def test_the_floor_is_that_of_halves_and_the_numbers_are_those_of_the_frames():
    halved, groups = recorded(2 * COUNT, seed=3), [f"h{row // 2}" for row in range(2 * COUNT)]
    by_name = {one.metric: one for one in measure_recorded(recorded(), GROUPS, halved, groups, seed=0)}
    tested = by_name["c2st"]
    assert tested.num_samples == COUNT and tested.low < 0.5 < tested.high
    assert by_name["active_pixel_share"].value == pytest.approx((recorded()[..., 0] > 0).mean())
    assert by_name["active_pixel_share"].num_samples == COUNT
    assert np.isnan(by_name["active_pixel_share"].difference)


def test_with_few_frames_the_numbers_stay_and_the_area_says_why_it_is_missing():
    few = recorded(MIN_FRAMES - 1)
    by_name = measured(few, few, GROUPS[: len(few)])
    assert np.isnan(by_name["c2st"].value) and by_name["c2st"].note == f"fewer than {MIN_FRAMES} frames in a set"
    assert by_name["active_pixel_share"].difference == 0


def test_every_frame_needs_its_recorded_one():
    with pytest.raises(ValueError, match=r"one processed frame a recorded one, \(80, .*got \(79, "):
        measured(recorded()[:-1], recorded())


def test_rows_fit_the_table():
    columns = {column.name for column in tables.REALISM_CHAIN.columns}
    for one in measured(recorded(), recorded()).values():
        assert set(one.row()) | {"link", "amount", "evaluations"} == columns
