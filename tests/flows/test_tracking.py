"""A finished run in the trackers that people use; each is asked by its own API what it was told."""

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request

import numpy as np
import pytest
from flow_scripts import plan_script, run_script

from data_contracts.manifest import ManifestRef
from data_contracts.run_record import read_run_record
from flows import command_line, local_server, tracking
from flows.command_line import load_experiment
from flows.settings import flow
from flows.tracking import KINDS, track, tracked_run


@pytest.fixture
def finished(smoke_home):
    """Folder of the report's artefact, and what was asked for."""
    (folder,) = (smoke_home / "artefacts" / "report").iterdir()
    return folder, load_experiment("smoke", [])


def test_a_run_has_options_mean_scores_frames_and_its_report(finished, smoke_home):
    folder, experiment = finished
    run = tracked_run(folder, experiment, smoke_home, "smoke")
    assert run.options["generator.options.num_steps"] == experiment.generator.options["num_steps"]
    assert {"mpjpe2d_px/recorded", "mpjpe2d_px/recorded_and_synthetic"} <= set(run.scores)
    assert all(np.isfinite(value) for value in run.scores.values())
    assert run.frames.shape == (8, 64, 64, 3) and run.frames.any()
    assert [file.name for file in run.files] == ["report.html", "tables.md", "provenance.json"]
    assert run.verdict and read_run_record(folder).stage == "report"


def test_tensorboard(finished, smoke_home):
    from tensorboardX.proto.event_pb2 import Event

    folder, experiment = finished
    assert track("tensorboard", folder, experiment, smoke_home).endswith(str(smoke_home / "tensorboard"))
    (file,) = (smoke_home / "tensorboard" / "smoke").iterdir()
    content, found, images = file.read_bytes(), {}, 0
    while content:  # length, its checksum, the record, its checksum
        length = int.from_bytes(content[:8], "little")
        event = Event.FromString(content[12 : 12 + length])
        for value in event.summary.value:
            found[value.tag] = value.simple_value
            images += value.HasField("image")
        content = content[16 + length :]
    expected = tracked_run(folder, experiment, smoke_home, "smoke").scores
    assert {score: found[score] for score in expected} == pytest.approx(dict(expected), rel=1e-6) and images == 1


def test_a_tracker_that_fails_hides_no_verdict(tmp_path, monkeypatch, capsys):
    def fail(*_):
        raise RuntimeError("no route to the tracker")

    monkeypatch.setitem(tracking._TRACKERS, "tensorboard", fail)
    monkeypatch.setattr(tracking, "tracked_run", lambda *_: None)
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    monkeypatch.setattr(local_server, "start", lambda home: None)
    monkeypatch.setattr(local_server, "connected", contextlib.nullcontext)
    monkeypatch.setattr(command_line, "with_plan", lambda flow, *_: flow.fn)
    reports = flow(name="reports")(lambda _: ManifestRef(key="0", path=tmp_path))
    command = command_line.Command(reports, lambda *_: "verdict: helped", load=load_experiment)
    assert command_line.run_command(command, command_line.Asked("smoke", [], track="tensorboard")) == 2
    output, errors = capsys.readouterr()
    assert output == "verdict: helped\n"
    assert errors.startswith(
        "error: --track tensorboard: RuntimeError: no route to the tracker; the report is finished"
    )


@pytest.mark.slow
def test_mlflow_with_its_own_server(finished, smoke_home, tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    with socket.create_server(("127.0.0.1", 0)) as held:
        port = held.getsockname()[1]
    command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(port), "--workers", "1"]
    store = ["--backend-store-uri", f"sqlite:///{tmp_path / 'store.db'}", "--artifacts-destination", str(tmp_path)]
    server = subprocess.Popen([*command, *store], env={**os.environ, "MLFLOW_DISABLE_TELEMETRY": "true"})
    try:
        url, deadline = f"http://127.0.0.1:{port}", time.monotonic() + 120
        while True:
            try:
                urllib.request.urlopen(f"{url}/health", timeout=5)
                break
            except OSError:
                assert server.poll() is None and time.monotonic() < deadline
                time.sleep(0.5)
        monkeypatch.setenv("MLFLOW_TRACKING_URI", url)
        folder, experiment = finished
        assert track("mlflow", folder, experiment, smoke_home) == f"tracked: mlflow experiment 'smoke' at {url}"
        client = mlflow.MlflowClient(url)
        (run,) = client.search_runs([client.get_experiment_by_name("smoke").experiment_id])
        expected = tracked_run(folder, experiment, smoke_home, "smoke")
        assert run.data.metrics == pytest.approx(dict(expected.scores)) and run.info.run_name == "smoke"
        assert run.data.params["generator.options.num_steps"] == str(expected.options["generator.options.num_steps"])
        assert {file.path for file in client.list_artifacts(run.info.run_id)} >= {"report.html", "synthetic_frames"}
        assert len(client.list_artifacts(run.info.run_id, "synthetic_frames")) == 8
    finally:
        server.terminate()
        server.wait(30)


@pytest.mark.slow
def test_wandb_offline(finished, smoke_home, monkeypatch):
    pytest.importorskip("wandb")
    for name in ("WANDB_MODE", "WANDB_API_KEY", "WANDB_BASE_URL"):
        monkeypatch.delenv(name, raising=False)
    folder, experiment = finished
    told = track("wandb", folder, experiment, smoke_home)
    assert told == f"tracked: wandb project 'ctlev', offline, in {smoke_home / 'wandb'}"
    assert list((smoke_home / "wandb").glob("offline-run-*/*.wandb"))


@pytest.mark.slow
def test_the_command_tells_a_tracker(smoke_home):
    finished = run_script("full_experiment", "--preset", "smoke", "--track", "tensorboard", home=smoke_home)
    assert finished.status == 0, finished.errors
    assert f"tracked: tensorboard --logdir {smoke_home / 'tensorboard'}" in finished.output
    shutil.rmtree(smoke_home / "tensorboard")


@pytest.mark.parametrize("kind", ["comet", "mlflow"])
def test_trackers_that_are_not_there_are_refused_before_anything_runs(kind, tmp_path, monkeypatch):
    if kind == "mlflow":
        from flows import tracking

        monkeypatch.setattr(tracking.importlib.util, "find_spec", lambda package: None)
        with pytest.raises(tracking.PluginError, match=r"--track mlflow needs the package 'mlflow': pip install"):
            tracking.check_tracker(kind)
        return
    finished = plan_script("full_experiment", "--preset", "smoke", "--track", kind, home=tmp_path)
    assert finished.status == 2 and f"--track: expected {', '.join(KINDS)}, got 'comet'" in finished.errors
    assert not (tmp_path / "artefacts").exists()
