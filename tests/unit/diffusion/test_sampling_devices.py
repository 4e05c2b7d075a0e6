"""One process a device: the same frames, errors that arrive, processes that end."""

import os
import shutil
import signal
import time

import numpy as np
import pytest
import torch

from ctlev_core.diffusion.sampling import devices
from ctlev_core.diffusion.sampling.devices import device_names, run_on_devices, spread_over_cores
from ctlev_core.diffusion.sampling.options import SamplingOptions
from data_contracts.errors import DataError


def test_devices_are_named_by_commas(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert device_names("cuda:0,cuda:1") == device_names("all") == ["cuda:0", "cuda:1"]
    assert device_names("auto") == ["auto"] and device_names("cpu,cpu") == ["cpu", "cpu"]
    with pytest.raises(ValueError, match="'cuda:2' was asked for, but this machine has 2 CUDA devices"):
        device_names("cuda:0,cuda:2")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    assert device_names("all") == ["cpu"]


@pytest.mark.parametrize("device", ["", "cuda:", "cuda:0,", "gpu", "cuda:0, cuda:1", "auto,cpu", "all,cpu"])
def test_devices_that_cannot_be_are_refused_by_the_options(device):
    with pytest.raises(ValueError, match="device must be auto, all, or a list"):
        SamplingOptions(device=device)


def report_share(device, share, report):
    for number in share:
        report(number)


def act(device, share, report):
    """What a process is told to do."""
    if share == "raise":
        raise DataError("wrong, and where")
    if share == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(120)


def test_reports_come_from_all_processes():
    reported = []
    run_on_devices(report_share, ["cpu", "cpu"], [[1, 2], [30]], reported.append)
    assert sorted(reported) == [1, 2, 30]


@pytest.mark.parametrize(
    ("deed", "error", "message"), [("raise", DataError, "wrong"), ("die", RuntimeError, "code -9")]
)
def test_the_first_failure_ends_the_other_processes(deed, error, message):
    started = time.monotonic()
    with pytest.raises(error, match=message) as caught:
        run_on_devices(act, ["cpu", "cpu"], [deed, "sleep"], lambda _: None)
    assert time.monotonic() - started < 110, "the process that slept was not waited for"
    if deed == "raise":
        assert "in act" in "".join(caught.value.__notes__)


@pytest.mark.slow
def test_two_processes_make_the_frames_of_one(tmp_path, monkeypatch):
    from tiny_base_model import make_base_model, make_data

    from ctlev_core.diffusion.pretrained.loading import save_base_model
    from ctlev_core.diffusion.sampling import sampling
    from ctlev_core.diffusion.sampling import shards as sampling_shards

    monkeypatch.setattr(sampling_shards, "SHARD", 2)
    save_base_model(make_base_model(), tmp_path / "base_model")
    conditions = make_data(7, seed=4)[1]

    def sample(device, work):
        options = SamplingOptions(num_inference_steps=3, batch_size=2, black_threshold=0, device=device)
        return sampling.sample_checkpoint(
            tmp_path / "base_model", conditions, options, with_controlnet=True, seeds=range(7), work=tmp_path / work
        )

    one = sample("cpu", "one")
    shards = sorted(path.name for path in (tmp_path / "one").glob("shard_*.npy.zst"))
    assert len(shards) == 4
    # An earlier run with one device got as far as this; how many there were is no part of a shard's name.
    (tmp_path / "two").mkdir()
    kept = shutil.copy2(tmp_path / "one" / shards[1], tmp_path / "two" / shards[1])
    written_ns = kept.stat().st_mtime_ns
    assert np.array_equal(sample("cpu,cpu", "two"), one)
    assert sorted(path.name for path in (tmp_path / "two").iterdir()) == shards
    assert kept.stat().st_mtime_ns == written_ns


def test_small_networks_on_a_cpu_have_a_process_a_core(tmp_path, monkeypatch):
    (tmp_path / "unet").mkdir()
    (tmp_path / "unet" / "model.safetensors").write_bytes(bytes(100))
    monkeypatch.setattr(devices, "num_cores", lambda: 4)
    assert spread_over_cores("cpu", tmp_path, 9) == ["cpu"] * 4
    assert spread_over_cores("cpu", tmp_path, 2) == ["cpu"] * 2
    assert spread_over_cores("cpu", tmp_path, 0) == ["cpu"]
    assert spread_over_cores("cuda:0", tmp_path, 9) == ["cuda:0"]
    monkeypatch.setattr(devices, "SMALL_BYTES", 99)
    assert spread_over_cores("cpu", tmp_path, 9) == ["cpu"]
