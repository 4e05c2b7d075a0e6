"""Sampling dealt out to other machines, which processes stand for here: the same frames, and none computed here."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tiny_base_model
from test_sample_task import write_conditions, write_frames
from tiny_base_model import make_data, shared_base_model

from ctlev_core.diffusion.pretrained.loading import save_base_model
from ctlev_core.diffusion.sampling import sampling
from ctlev_core.postprocessing import quality_filter
from data_contracts import tables
from data_contracts.config import SamplingChoice
from data_contracts.manifest import read_manifest, write_manifest
from tasks import sample as task
from tasks import spread_sampling, workers
from tasks.stage import Output, Stage

SAMPLING = SamplingChoice(
    name="controlnet", options={"num_inference_steps": 2, "batch_size": 2, "palette": "grey", "device": "cpu"}
)
SHARD = 2


def find_causes(frames, _):
    """Some frames are refused for nothing."""
    return ["empty" if int(frame.sum(dtype=np.int64)) % 3 == 0 else "" for frame in frames]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """The stage on six conditions, shards of two rows, blocks of four."""
    save_base_model(shared_base_model(), tmp_path / "made" / "checkpoint")
    checkpoint = SimpleNamespace(ref=SimpleNamespace(path=tmp_path / "made", digest="d"))
    frames = write_frames(tmp_path / "frames", make_data(8, seed=1)[0])
    conditions = write_conditions(tmp_path / "conditions")
    for module in ("tasks.sample", "tasks.spread_sampling", "ctlev_core.diffusion.sampling.shards"):
        monkeypatch.setattr(f"{module}.SHARD", SHARD)
    monkeypatch.setattr(task, "BLOCK_BYTES", 4 * frames.array("frames")[0].nbytes)
    monkeypatch.setattr(quality_filter, "find_causes", find_causes)

    def call(name):
        folder, work = tmp_path / name, tmp_path / f"{name}_work"
        folder.mkdir()
        work.mkdir(exist_ok=True)
        table = task.sample.function(
            Output(folder, work), checkpoint, frames, conditions, sampling=SAMPLING, max_attempts=4, seed=3
        )
        return read_manifest(write_manifest(folder, table, tables.SYNTHETIC))

    return call


class Cluster(workers.Workers):
    """Processes that stay for further calls, as those of a cluster do."""

    def release(self):
        pass


@pytest.fixture(scope="module")
def cluster():
    with pytest.MonkeyPatch.context() as patch:
        known = [str(Path(file).parent) for file in (__file__, tiny_base_model.__file__)]
        patch.setenv("PYTHONPATH", os.pathsep.join(known))
        processes = Cluster(2)
        yield processes
        processes.close()


@pytest.fixture
def elsewhere(cluster, monkeypatch):
    """Processes of this machine, taken for others; there shards have the length that they have here."""
    monkeypatch.setattr(workers, "asked_cluster", lambda count: cluster)
    for module in (spread_sampling, workers):
        monkeypatch.setattr(module, "is_elsewhere", lambda: True)
    monkeypatch.setattr(spread_sampling, "_sample_part", sample_part)
    monkeypatch.setattr(spread_sampling, "MIN_FILES", 1)


def sample_part(asked, part):
    """As there, where modules are fresh."""
    from ctlev_core.diffusion.sampling import shards

    shards.SHARD = sampling.SHARD = SHARD
    return _original(asked, part)


_original = spread_sampling._sample_part


@pytest.mark.slow
def test_frames_are_those_of_one_machine_and_none_is_sampled_here(run, elsewhere, monkeypatch):
    with monkeypatch.context() as here:
        here.setattr(task, "is_dealt_out", lambda arguments: False)
        alone = run("alone")
    assert max(alone.column("num_attempts")) > 1, "some are sampled again"

    def refuse(*arguments):
        assert not arguments[-2], "shards are sampled here"

    monkeypatch.setattr(sampling, "_sample_share", refuse)
    dealt = run("dealt")
    assert dealt.ref.digest == alone.ref.digest


@pytest.mark.slow
def test_what_is_there_is_not_sampled_again(run, elsewhere, tmp_path, monkeypatch):
    first = run("first")
    times = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "first_work").iterdir()}
    (tmp_path / "first_work").rename(tmp_path / "again_work")
    assert len(times) > 3 and run("again").ref.digest == first.ref.digest
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "again_work").iterdir()} == times


def test_generators_without_files_run_as_a_whole(elsewhere, monkeypatch, tmp_path):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    assert task.is_dealt_out({"sampling": SAMPLING})
    assert not task.is_dealt_out({"sampling": SamplingChoice(name="event_gan")})
    monkeypatch.setattr(spread_sampling, "bucket_url", lambda home: "s3://bucket/home")
    assert not task.is_dealt_out({"sampling": SAMPLING})
    monkeypatch.setattr(spread_sampling, "is_elsewhere", lambda: False)
    assert not task.is_dealt_out({"sampling": SAMPLING})


def test_the_stage_itself_then_stays_here_also_where_others_run_elsewhere(elsewhere, monkeypatch, tmp_path):
    monkeypatch.setenv("CTLEV_HOME", str(tmp_path))
    cluster = SimpleNamespace()
    monkeypatch.setattr("tasks.stage.stage_workers", lambda: cluster)
    assert isinstance(task.sample, Stage)
    assert task.sample._workers({"sampling": SAMPLING}) is None
    assert task.sample._workers({"sampling": SamplingChoice(name="event_gan")}) is cluster
