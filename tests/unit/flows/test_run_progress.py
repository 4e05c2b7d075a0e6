"""What a run tells: plain lines as stages end, one picture on a terminal, and how long it will take."""

from __future__ import annotations

import io
import math
import re

import pytest
from rich.console import Console

from ctlev_core.duration_text import duration_text
from ctlev_core.progress import Progress
from flows import run_progress
from flows.amounts_of_work import inputs_of
from flows.run_progress import RunProgress
from flows.stage_costs import Measured, StageCost, _at, time_left
from tasks.stage import PlannedStage


def planned(key: str, *inputs: str, cached: bool = False) -> PlannedStage:
    return PlannedStage("encode", f"encode: {key}", key, cached, {"of": [{"manifest": one} for one in inputs]})


def cost(seconds: float) -> StageCost:
    return StageCost(seconds, 100.0, 1000)


@pytest.fixture
def clock(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(run_progress.time, "monotonic", lambda: now[0])
    return now


def test_off_a_terminal_each_stage_that_ends_is_a_plain_line(clock):
    rows = [planned("a", cached=True), planned("b", "a"), planned("c", "b"), planned("b", "a")]
    stream = io.StringIO()
    progress = RunProgress(rows, {"b": cost(10), "c": cost(20)}, stream=stream)
    progress.begin()
    progress.progressed("b", Progress())
    clock[0] = 12.5
    progress.progressed("b", Progress("steps", 5, 10, "step"))
    progress.ended("b", 1200, cached=False)
    progress.ended("b", 1200, cached=True)  # whoever else asked for it finds it
    progress.progressed("c", Progress())
    clock[0] = 40.0
    progress.ended("c", 7, cached=False)
    assert stream.getvalue().splitlines() == [
        "3 stages, 1 of them cached; about 30 s",
        "[2/3] encode: b  1,200 rows  12.5 s  about 20 s left",
        "[3/3] encode: c  7 rows  27.5 s",
    ]


def test_on_a_terminal_there_is_a_line_for_the_run_and_one_for_each_running_stage(clock):
    rows = [planned("a"), planned("b", "a"), planned("c", "a"), planned("d", "b", "c")]
    progress = RunProgress(rows, {key: cost(60) for key in "abcd"}, workers=2, stream=io.StringIO())
    progress.progressed("a", Progress())
    clock[0] = 60.0
    progress.ended("a", 3, cached=False)
    progress.progressed("b", Progress())
    progress.progressed("b", Progress("train", 0, 600, "step"))
    clock[0] = 90.0
    progress.progressed("b", Progress("train", 300, 600, "step", "loss 0.25"))
    stream = io.StringIO()
    Console(file=stream, force_terminal=True, width=140, color_system=None).print(progress)
    whole, stage = stream.getvalue().splitlines()[:2]
    assert re.search(r"stage 2 of 4 .* 1 min 30 s .* about 2 min left", whole)  # of c all, then d
    assert re.search(r"encode: b .* 30 s +300 of 600 steps 10/s +loss 0.25", stage)


def test_a_stage_of_which_nobody_heard_when_it_began_has_no_time(clock):
    progress = RunProgress([planned("a"), planned("b")], {}, stream=(stream := io.StringIO()))
    progress.ended("a", 5, cached=False)
    progress.ended("b", 5, cached=True)
    assert stream.getvalue() == "[1/2] encode: a  5 rows\n[2/2] encode: b  5 rows  cached\n"


def test_nothing_is_foretold_where_nothing_is_known():
    progress = RunProgress([planned("a")], {"a": None}, stream=(stream := io.StringIO()))
    progress.begin()
    assert stream.getvalue() == "1 stages\n" and progress.seconds_left() is None


def test_stages_that_are_slower_than_expected_lengthen_what_is_left(clock):
    rows = [planned(key) for key in "abcd"]
    progress = RunProgress(rows, {key: cost(10) for key in "abcd"}, stream=io.StringIO())
    for key in "abc":
        progress.progressed(key, Progress())
        clock[0] += 20
        progress.ended(key, 1, cached=False)
    assert progress.seconds_left() == pytest.approx(20)


def test_time_left_is_the_work_shared_out_or_the_longest_chain():
    rows = [planned("a"), planned("b", "a"), *(planned(f"c{n}", "a") for n in range(6)), planned("d", "b")]
    costs = {"a": cost(1), "b": cost(5), "d": cost(5), **{f"c{n}": cost(1) for n in range(6)}}
    assert time_left(rows, costs, {}, 1) == 17
    assert time_left(rows, costs, {}, 2) == 11  # a, b, d
    assert time_left(rows, costs, {"a": math.inf, "b": 2.0}, 8) == 8
    assert time_left(rows, {**costs, "d": None}, {}, 1) == 13  # unknown: the median, 1 s
    assert inputs_of(rows[1].arguments) == ["a"]


def test_costs_lie_on_a_line_through_what_was_measured():
    group = [Measured("train x", 100, cost(12)), Measured("train x", 1100, cost(112))]
    assert _at(group, 600).seconds == pytest.approx(62)
    assert _at(group, 2100).seconds == pytest.approx(212)
    assert _at(group, 101).seconds == 12
    assert _at(group[1:], 2200).seconds == pytest.approx(224)
    assert _at(group, 1).seconds >= 0.2 * 12


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (59.2, "59 s"), (60, "1 min"), (200, "3 min 20 s"), (1190, "19 min"), (7500, "2 h 5 min")],
)
def test_durations(seconds, text):
    assert duration_text(seconds) == text


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_whether_it_is_drawn_depends_on_the_stream_alone(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    assert RunProgress([], {}, stream=Terminal()).is_drawn
    assert not RunProgress([], {}, stream=io.StringIO()).is_drawn
