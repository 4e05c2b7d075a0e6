"""Stages that spread their shards: the same artefacts on every runner, for every number of workers."""

import importlib.util
import json

import pytest

from data_contracts.config import ConditionChoice, DatasetChoice, EncodingChoice, SamplingChoice, Windows
from data_contracts.manifest import read_manifest
from tasks import encode as encode_stage
from tasks import runners
from tasks.condition import condition_frames, condition_samples
from tasks.encode import encode
from tasks.ingest import ingest
from tasks.sample import simulate
from tasks.store import Store

STUDIO = DatasetChoice(
    name="studio",
    options={"num_train_recordings": 4, "num_test_recordings": 2, "num_condition_recordings": 3},
)
COUNTED = EncodingChoice(name="event_histogram", options={"polarity": False})
WINDOWS = Windows(num_events=400, max_windows=3)
SPREAD = [
    "processes",
    *(
        pytest.param(
            kind,
            marks=[
                pytest.mark.skipif(importlib.util.find_spec(package) is None, reason=f"{package} is not installed"),
                pytest.mark.filterwarnings("default"),  # theirs
            ],
        )
        for kind, package in (("dask", "distributed"), ("ray", "ray"))
    ),
]


def make(patch, home, kind, workers):
    """Digests of what the stages make in a new home; every file was checked against them."""
    patch.setenv("CTLEV_HOME", str(home))
    patch.setenv("CTLEV_RUNNER", kind)
    patch.setenv("CTLEV_WORKERS", str(workers))
    recordings = run(ingest, dataset=STUDIO)
    given = {"recordings": recordings, "encoding": COUNTED, "windows": WINDOWS}
    given["frames"] = run(encode, **given)
    motions = {"condition": ConditionChoice(name="body_motion"), "order": "random", "views": "labelled"}
    asked = run(condition_samples, poses=recordings, count=5, seed=1, **motions, **given)
    run(simulate, conditions=asked, sampling=SamplingChoice(name="smpl_esim"), seed=2, **given)
    found = {}
    for record in sorted(home.glob("artefacts/*/*/run.json")):
        Store(home).check(record.parent)
        found[record.parent.parent.name] = json.loads(record.read_text())["digest"]
    return found


def run(stage, **arguments):
    return stage.run(stage.key(arguments, Store()), arguments)[0]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Of one worker, which does everything in turn."""
    with pytest.MonkeyPatch.context() as patch:
        return make(patch, tmp_path_factory.mktemp("alone") / "home", "threads", 1)


@pytest.mark.parametrize("workers", [2, 5])
def test_threads_make_the_same(alone, tmp_path, monkeypatch, workers):
    monkeypatch.setattr("tasks.sample.SHARD_ROWS", 2)
    found = make(monkeypatch, tmp_path, "threads", workers)
    assert found == alone and set(found) == {"ingest", "encode", "condition_samples", "simulate"}


def test_images_that_wait_in_files_are_the_same_and_leave_nothing(alone, tmp_path, monkeypatch):
    put_away = []
    original = encode_stage._put_away

    def watched(samples, path):
        put_away.append(path)
        return original(samples, path)

    monkeypatch.setattr(encode_stage, "_put_away", watched)
    monkeypatch.setattr(encode_stage, "HELD_BYTES", 0)
    monkeypatch.setattr("ctlev_core.recordings.encoding.MAX_WINDOWS", 2)
    assert make(monkeypatch, tmp_path, "threads", 2) == alone
    assert len(put_away) == 12, "three windows of six recordings, in twos"


@pytest.mark.parametrize("name", ["skeleton", "normals", "text"])
def test_conditions_rendered_some_rows_at_a_time_are_the_same(tmp_path, monkeypatch, name):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    recordings = run(ingest, dataset=STUDIO)
    frames = run(encode, recordings=recordings, encoding=COUNTED, windows=WINDOWS)
    given = {"condition": ConditionChoice(name=name), "encoding": COUNTED, "seed": 3}
    found = set()
    for rows in (1, 5, 1000):
        monkeypatch.setattr("tasks.condition.BLOCK_ROWS", rows)
        monkeypatch.setattr(condition_frames, "version", 1000 + rows)  # not the cached artefact
        made = read_manifest(run(condition_frames, recordings=recordings, frames=frames, **given), full=True)
        assert len(made) == 12 and made.has_array("images") == (name != "text")
        found.add(made.ref.digest)
    assert len(found) == 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", SPREAD)
def test_runners_make_the_same(alone, tmp_path, monkeypatch, kind):
    try:
        assert make(monkeypatch, tmp_path, kind, 2) == alone
    finally:
        for cluster in list(runners._running.values()):
            cluster.close()
