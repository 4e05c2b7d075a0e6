"""As many processes as fit into memory together; a plan that cannot fit is refused."""

from __future__ import annotations

import os

import pytest

from data_contracts.errors import DataError
from flows import deployments, memory_use
from flows.stage_costs import StageCost
from tasks.stage import PlannedStage
from tasks.workers import num_workers

GIB = 1024.0


def run_with(monkeypatch, tmp_path, needs, *, free, whole=64, cached=()):
    rows = [PlannedStage("stage", f"stage {key}", key, cached=key in cached) for key in needs]
    costs = {key: None if gib is None else StageCost(1.0, gib * GIB, 0) for key, gib in needs.items()}
    monkeypatch.setattr(memory_use, "estimate_stages", lambda rows, home: costs)
    monkeypatch.setattr(memory_use, "memory_mib", lambda: (whole * GIB, free * GIB))
    monkeypatch.setattr("tasks.workers.num_cores", lambda: 4)
    memory_use.use_memory(rows, tmp_path)
    return num_workers()


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch):
    monkeypatch.setenv("CTLEV_WORKERS", "")


@pytest.mark.parametrize(
    ("needs", "free", "workers"),
    [
        ({"a": 15, "b": 10, "c": 1}, 20, 1),
        ({"a": 9, "b": 9, "c": 9, "d": 9}, 20, 2),
        ({"a": 1, "b": 1, "c": 1, "d": 1, "e": 1}, 20, 4),
        ({"a": 15, "b": None}, 20, 4),
        ({"a": 21}, 20, 1),
        ({}, 20, 4),
    ],
)
def test_processes_are_as_many_as_fit(monkeypatch, tmp_path, capsys, needs, free, workers):
    assert run_with(monkeypatch, tmp_path, needs, free=free) == workers
    assert ("processes: the largest stages do not fit" in capsys.readouterr().err) == (workers < 4)


def test_deployed_runs_are_checked_before_any_stage(monkeypatch, tmp_path):
    def refuse(rows, home):
        assert home == tmp_path and rows[0].stage == "ingest"
        raise DataError("too large")

    monkeypatch.setattr(deployments, "publish_plan", lambda *_: None)
    monkeypatch.setattr(deployments, "use_memory", refuse)
    with pytest.raises(DataError, match="too large"):
        deployments.full_experiment.fn("smoke", home=str(tmp_path))
    assert not (tmp_path / "artefacts").exists()


def test_what_has_been_done_needs_nothing(monkeypatch, tmp_path):
    assert run_with(monkeypatch, tmp_path, {"a": 15, "b": 10, "c": 1}, free=20, cached=("a",)) == 4


def test_a_stage_that_no_memory_suffices_for_is_refused_before_anything_runs(monkeypatch, tmp_path):
    with pytest.raises(DataError, match=r"stage a: needs about 70.0 GiB of memory, this machine has 64.0; generator"):
        run_with(monkeypatch, tmp_path, {"a": 70, "b": 1}, free=60)
    monkeypatch.setenv("CTLEV_WORKERS", "3")
    assert run_with(monkeypatch, tmp_path, {"a": 70, "b": 1}, free=60) == 3
    assert os.environ["CTLEV_WORKERS"] == "3"
