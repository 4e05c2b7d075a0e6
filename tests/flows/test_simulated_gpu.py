"""A whole experiment on a simulated GPU: every stage of it, in this process and without Prefect."""

import pyarrow.parquet as pq
import pytest
from simulated_gpu import simulated_gpu

from tasks.stage import in_one_run

COMPUTES = {"finetune", "sample", "train_downstream", "score_model", "score_distance", "take_label_consistent"}
"""Stages with a network in them."""


@pytest.mark.slow
def test_every_stage_with_a_network_uses_the_gpu(tmp_path, monkeypatch):
    used = {}

    def run(name, label, work):
        before = gpu.num_operations
        ref, _ = work()
        used[name] = used.get(name, 0) + gpu.num_operations - before
        return ref

    monkeypatch.setattr("tasks.stage.run_as_task", run)
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    from flows import full_experiment  # here, because flows take the home from the environment
    from flows.studies import load_study

    with simulated_gpu() as gpu, in_one_run():
        made = full_experiment.full_experiment.fn(load_study("smoke", []))
    assert {stage for stage, count in used.items() if count} >= COMPUTES
    scores = pq.read_table(made.path / "scores.parquet").to_pylist()
    assert {row["subject"] for row in scores} >= {
        "recorded",
        "synthetic",
        "recorded+synthetic",
        "event_gan",
        "smpl_esim",
    }
