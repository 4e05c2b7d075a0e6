"""Loops report to the one that watches, from threads and from other processes; else tqdm draws them."""

from __future__ import annotations

from functools import partial

from ctlev_core.progress import Progress, ProgressBar, reporting_to
from tasks.workers import Workers, map_shards


def count(number: int) -> int:
    return sum(ProgressBar(range(number), "count", unit="step"))


def test_a_loop_reports_where_it_is():
    reports: list[Progress] = []
    with reporting_to(reports.append):
        assert count(5) == 10
        with ProgressBar(desc="train", total=8, initial=6, unit="step") as bar:
            bar.note("loss 1")
            bar.update()
            bar.update()
        list(ProgressBar(range(3), "inner", delay=5))  # of a loop within loops
    assert [(one.what, one.done, one.total) for one in (reports[0], reports[-1])] == [("count", 0, 5), ("train", 8, 8)]
    assert reports[-1].note == "loss 1" and Progress("count", 5, 5, "step") in reports
    assert not [one for one in reports if one.what == "inner"]


def test_without_a_watcher_nothing_is_drawn_off_a_terminal(capsys):
    assert count(5) == 10
    assert capsys.readouterr() == ("", "")


def test_reports_come_back_from_other_processes():
    workers, reports = Workers(1), []
    try:
        with reporting_to(reports.append):
            assert workers.call(sum, [1, 2]) == 3 and not reports
            assert (
                workers.call(eval, "sum(__import__('ctlev_core.progress').progress.ProgressBar(range(4), 'far'))") == 6
            )
        assert [(one.what, one.done, one.total) for one in reports] == [("far", 0, 4), ("far", 4, 4)]
        assert workers.call(sum, [3, 4]) == 7
    finally:
        workers.close()


def test_reports_of_shards_reach_the_watcher_of_their_stage(monkeypatch):
    monkeypatch.setenv("CTLEV_WORKERS", "2")
    reports: list[Progress] = []
    with reporting_to(reports.append):
        assert list(map_shards(partial(count), [1, 2, 3])) == [0, 1, 3]
    assert {one.total for one in reports} == {1, 2, 3}
