"""The public interface: each line of the quick start runs, and says what the packages behind it say."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from davis_recording import SIZE, write_davis

import ctlev_core as ctlev
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL, BUNDLED_OBJECT_MODEL
from data_contracts.errors import DataError

REPOSITORY = Path(__file__).resolve().parents[2]
KEY = "0" * 32


def made_run(home: Path, name: str, generator: str = "controlnet", base_model: Path = BUNDLED_BASE_MODEL) -> Path:
    """A home whose run `name` has a bundled base model as its generator."""
    artefact = home / "artefacts" / "finetune" / KEY
    artefact.mkdir(parents=True)
    (artefact / "checkpoint").symlink_to(base_model)
    arguments = {"generator": {"plugin": f"generators/{generator}", "version": 3, "options": {}}}
    (artefact / "run.json").write_text(json.dumps({"stage": "finetune", "arguments": arguments}))
    record = dict.fromkeys(("started", "digest"), "") | {
        "role": "checkpoint of synthetic", "stage": "finetune", "key": KEY, "arguments": arguments, "versions": {},
        "upstream": {}, **dict.fromkeys(("stage_version", "rows", "wall_seconds", "cpu_seconds"), 1),
        "process_peak_memory_mib": 1.0,
    }  # fmt: skip
    report = home / "reports" / name
    report.mkdir(parents=True)
    (report / "provenance.json").write_text(json.dumps({"stages": [record]}))
    return artefact


@pytest.mark.slow
def test_each_line_of_the_quick_start_runs(tmp_path, monkeypatch, random_events):
    from ctlev_core.formats import evt2

    text = (REPOSITORY / "docs" / "quick_start.md").read_text()
    (block,) = re.findall(r"## From Python\n\n```python\n(.*?)```", text, re.DOTALL)
    assert {name for name in ctlev.__all__ if f"ctlev.{name}(" in block} == set(ctlev.__all__) - {"TrainedGenerator"}
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CTLEV_HOME", raising=False)
    evt2.write(Path("recording.raw"), random_events)
    write_davis(Path("davis.aedat4"))
    made_run(Path(".ctlev").absolute(), "pose")
    opened = []
    monkeypatch.setattr(ctlev, "EventDataset", opened.append)  # a folder is made in tests/flows/test_export_folder.py
    random = np.random.default_rng(0)
    joints = random.uniform(5, 60, (13, 2))
    given = {
        "frames": random.uniform(0, 1, (3, 8, 8)),
        "times": [0, 1000, 2000],
        "pose": np.zeros(72),
        "joints": joints,
        "predicted": joints + np.array([3, 4]),
        "features": random.normal(size=(20, 4)),
        "other_features": random.normal(size=(20, 4)),
    }
    writer = cv2.VideoWriter("video.mp4", cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (64, 48))
    for number in range(3):
        writer.write(np.roll(random.integers(0, 255, (48, 64, 3), np.uint8), number, axis=1))
    writer.release()
    exec(block, given)
    assert given["filmed"].sensor_size == (346, 260) and len(given["filmed"]) > 0
    assert len(given["events"]) == len(random_events) and opened == ["mine"]
    assert next(given["pictures"]).pixels.shape == SIZE[::-1] and len(given["imu"]) == 700
    assert given["counts"].shape == (4, 2, 24, 32) and given["counts"].sum() == 2000
    assert given["error"] == 5.0 and 0 <= given["share"] <= 1
    assert given["normals"].shape == given["skeleton"].shape == (64, 64, 3)
    assert given["images"].shape == (1, 64, 64, 3) and given["images"].any()


def test_each_line_of_the_readme_runs(tmp_path, monkeypatch, random_events):
    from ctlev_core.formats import evt2

    (block,) = re.findall(r"```python\n(.*?)```", (REPOSITORY / "README.md").read_text(), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CTLEV_HOME", raising=False)
    evt2.write(Path("recording.raw"), random_events)
    made_run(Path(".ctlev").absolute(), "demo/objects", "stable_diffusion", BUNDLED_OBJECT_MODEL)
    monkeypatch.setattr(ctlev, "EventDataset", lambda folder: [folder])
    given = {}
    exec(block, given)
    assert given["counts"].sum() == 2000 and given["sample"] == "mine"
    assert given["images"].shape == (1, 64, 64, 3) and given["images"].any()


def test_importing_it_imports_nothing_else():
    code = "import sys, ctlev_core; print(sorted({'numpy', 'torch', 'pydantic'} & set(sys.modules)), dir(ctlev_core))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=REPOSITORY)
    assert done.stdout.startswith("[] ") and "load_generator" in done.stdout, done.stderr
    with pytest.raises(AttributeError, match="no attribute 'nonesuch'"):
        ctlev.nonesuch  # noqa: B018


def test_histogram_counts_as_numpy_does(random_events):
    counts = ctlev.histogram(random_events)
    expected = np.zeros((1, 2, 24, 32), np.uint16)
    np.add.at(expected, (0, 1 - random_events.p, random_events.y, random_events.x), 1)
    np.testing.assert_array_equal(counts, expected)
    assert ctlev.histogram(random_events, duration_us=20_000, polarity=False).shape[1:] == (1, 24, 32)
    with pytest.raises(ValueError, match="not both"):
        ctlev.histogram(random_events, num_events=1, duration_us=1)


def test_simulated_events_are_those_of_the_contrast_threshold():
    """An ideal pixel that brightens sends an event for each threshold that the logarithm of its intensity rises by."""
    from ctlev_core.sensor.options import PRESETS

    frames = np.exp([[[0.0]], [[1.0]]]) / 10
    events = ctlev.simulate(frames, [0, 100_000], sensor="ideal")
    ideal = PRESETS["ideal"]
    steps = np.log((np.e / 10 + ideal.log_floor) / (1 / 10 + ideal.log_floor)) / ideal.threshold
    assert abs(len(events) - steps) <= 1 and set(events.p) == {1}  # the first level lies anywhere within a step
    bytes_in = ctlev.simulate(np.array([[[10]], [[200]]], np.uint8), [0, 100_000], sensor="ideal")
    floats_in = ctlev.simulate(np.array([[[10]], [[200]]], np.float32) / 255, [0, 100_000], sensor="ideal")
    np.testing.assert_array_equal(bytes_in.t, floats_in.t)


def test_normal_map_faces_the_camera():
    front, back = ctlev.normal_map(image_size=(64, 64)), ctlev.normal_map(image_size=(64, 64), yaw_deg=180)
    body = (front != front[0, 0]).any(axis=-1)
    assert 0.05 < body.mean() < 0.5 and body[:, :4].sum() == 0 == body[-1].sum()
    rows, columns = np.nonzero(body)
    assert abs(rows.mean() - 32) < 8 and abs(columns.mean() - 32) < 2
    assert not np.array_equal(front, back)
    # Of `rgb` blue is towards the camera: what is seen is.
    colours = ctlev.normal_map(image_size=(64, 64), convention="rgb")
    assert (colours[body][:, 2] >= 127).mean() > 0.99
    np.testing.assert_array_equal(ctlev.normal_map(pose=np.zeros((2, 72)), image_size=(64, 64))[1], front)
    with pytest.raises(ValueError, match=r"pose must be \[72\]"):
        ctlev.normal_map(pose=np.zeros(3))


def test_scores_are_those_of_the_definitions():
    random = np.random.default_rng(1)
    joints, predicted = random.uniform(0, 64, (2, 5, 13, 2))
    expected = np.linalg.norm(predicted - joints, axis=-1)
    assert ctlev.mpjpe(predicted, joints) == pytest.approx(expected.mean())
    seen = random.uniform(size=(5, 13)) < 0.7
    assert ctlev.mpjpe(predicted, joints, visible=seen) == pytest.approx(expected[seen].mean())
    assert ctlev.pck(predicted, joints, 10, normaliser="px") == pytest.approx((expected <= 10).mean())
    target, moved = random.normal(size=(2, 4, 24, 3)) * 100
    errors = np.linalg.norm(moved - target, axis=-1)
    assert ctlev.mpjpe(moved, target, alignment="none") == pytest.approx(errors.mean())
    assert ctlev.mpjpe(target + 50, target) == pytest.approx(0, abs=1e-9)
    with pytest.raises(ValueError, match="alignment must be one of none, pelvis, procrustes, got 'Procrustes'"):
        ctlev.mpjpe(moved, target, alignment="Procrustes")
    assert ctlev.frechet(joints[:, 0], joints[:, 0]) == 0


def test_a_generator_is_found_by_run_artefact_or_folder(tmp_path):
    artefact = made_run(tmp_path, "pose")
    places = ["pose", str(artefact), artefact / "checkpoint", BUNDLED_BASE_MODEL]
    assert {ctlev.load_generator(place, home=tmp_path).name for place in places} == {"controlnet"}
    with pytest.raises(DataError, match=r"neither a folder nor a report .* which has pose"):
        ctlev.load_generator("nonesuch", home=tmp_path)
    with pytest.raises(DataError, match=r"no model_index\.json"):
        ctlev.load_generator(tmp_path)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({}, "expected prompts, or images"),
        ({"prompts": ["a", "b"], "images": np.zeros((1, 64, 64, 3), np.uint8)}, "2 prompts for 1 images"),
        ({"images": np.zeros((1, 64, 64))}, "must be"),
        ({"images": np.zeros((64, 64, 3), np.uint8), "num_step": 3}, "unknown option 'num_step'"),
    ],
)
def test_what_a_generator_cannot_do_is_refused(asked, message):
    with pytest.raises(ValueError, match=message):
        ctlev.load_generator(BUNDLED_BASE_MODEL).sample(**asked)
