"""Which stage gets which GPU, on a machine that only says it has some."""

import contextlib
import os
import threading
import time
from types import SimpleNamespace

import pytest
import torch

from data_contracts.config import DownstreamChoice, EncodingChoice, GeneratorChoice, SamplingChoice
from data_contracts.errors import DataError
from tasks.gpus import PER_GPU, GpuNeed, gpu_need, gpus_held, stages_per_gpu


@pytest.fixture
def four(monkeypatch, tmp_path):
    """Four GPUs; what each thread made its own is kept."""
    current = threading.local()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    for name, value in {
        "is_available": lambda: True,
        "device_count": lambda: 4,
        "get_device_properties": lambda number: SimpleNamespace(uuid=f"GPU-{number}"),
        "init": lambda: None,
        "empty_cache": lambda: None,
        "current_device": lambda: getattr(current, "number", 0),
        "set_device": lambda number: setattr(current, "number", number),
    }.items():
        monkeypatch.setattr(torch.cuda, name, value)


@pytest.mark.parametrize(
    ("arguments", "need"),
    [
        ({"downstream": DownstreamChoice(name="pose2d")}, GpuNeed(1)),
        ({"downstream": DownstreamChoice(name="pose2d", options={"device": "cpu"})}, GpuNeed()),
        (
            {"generator": GeneratorChoice(name="controlnet", options={"num_processes": 4, "gradient_accumulation": 4})},
            GpuNeed(4),
        ),
        ({"sampling": SamplingChoice(name="controlnet", options={"device": "all"})}, GpuNeed(-1)),
        ({"sampling": SamplingChoice(name="controlnet", options={"device": "cuda:2,cuda:3"})}, GpuNeed(named=(2, 3))),
        ({"encoding": EncodingChoice(name="event_histogram"), "seed": 3}, GpuNeed()),
        ({}, GpuNeed()),
    ],
)
def test_what_a_stage_needs_is_in_its_options(arguments, need):
    assert gpu_need(arguments) == need


def test_processes_that_a_launcher_started_take_a_gpu_each(monkeypatch):
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    assert gpu_need({"generator": GeneratorChoice(name="controlnet")}) == GpuNeed(4)
    assert gpu_need({"downstream": DownstreamChoice(name="pose2d")}) == GpuNeed(1)


def test_nothing_happens_without_a_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with gpus_held(GpuNeed(4), "stage") as held:
        assert held == () and "CUDA_VISIBLE_DEVICES" not in os.environ


def test_stages_get_gpus_of_their_own_until_there_are_none(four):
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(gpus_held(GpuNeed(1), "stage")) for _ in range(4)]
        assert sorted(held) == [(0,), (1,), (2,), (3,)] and torch.cuda.current_device() == held[-1][0]
        waited, began = [], threading.Event()

        def wait():
            began.set()
            with gpus_held(GpuNeed(1), "late") as late:
                waited.append(late)

        thread = threading.Thread(target=wait)
        thread.start()
        assert began.wait(10)
        time.sleep(0.5)
        assert not waited
    thread.join(10)
    assert len(waited) == 1 and torch.cuda.current_device() == 0


def test_processes_of_a_training_see_their_gpus_alone(four, monkeypatch):
    with gpus_held(GpuNeed(named=(1,)), "other"), gpus_held(GpuNeed(2), "training") as held:
        assert held == (0, 2) and os.environ["CUDA_VISIBLE_DEVICES"] == "0,2"
    assert "CUDA_VISIBLE_DEVICES" not in os.environ
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,5,6,7")
    with gpus_held(GpuNeed(named=(1,)), "other"), gpus_held(GpuNeed(2), "training"):
        assert os.environ["CUDA_VISIBLE_DEVICES"] == "4,6"
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "4,5,6,7"


def test_one_that_needs_all_is_not_passed_by_those_that_need_one(four):
    order, threads, all_asked = [], [], threading.Event()

    def use(need, name, wait_s):
        with gpus_held(need, name) as held:
            order.append((name, held))
            time.sleep(wait_s)

    def start(need, name, wait_s=0.05):
        threads.append(threading.Thread(target=use, args=(need, name, wait_s)))
        threads[-1].start()

    with gpus_held(GpuNeed(1), "first"):
        start(GpuNeed(-1), "all")
        time.sleep(0.5)
        for number in range(5):
            start(GpuNeed(1), f"small {number}")
        time.sleep(0.5)
        assert not order, "three GPUs are free, and kept for the one that asked before"
        all_asked.set()
    for thread in threads:
        thread.join(20)
    assert order[0] == ("all", (0, 1, 2, 3)) and len(order) == 6


def test_several_stages_share_a_gpu_where_that_is_asked_for(four, monkeypatch):
    monkeypatch.setenv(PER_GPU, "2")
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(gpus_held(GpuNeed(1), "stage"))[0] for _ in range(8)]
        assert held == [0, 1, 2, 3, 0, 1, 2, 3], "the least used first"


def test_what_is_not_there_is_refused(four, monkeypatch):
    refused = pytest.raises(DataError, match="training: asks for 8 GPUs, one a process; this machine shows 4")
    with refused, gpus_held(GpuNeed(8), "training"):
        pass
    refused = pytest.raises(DataError, match="sample: asks for cuda:5; this machine shows 4")
    with refused, gpus_held(GpuNeed(named=(5,)), "sample"):
        pass
    monkeypatch.setenv(PER_GPU, "0")
    with pytest.raises(DataError, match="CTLEV_STAGES_PER_GPU must be a number above 0, got '0'"):
        stages_per_gpu()


def test_a_failed_stage_gives_its_gpu_back(four):
    with pytest.raises(RuntimeError), gpus_held(GpuNeed(-1), "stage"):
        raise RuntimeError
    with gpus_held(GpuNeed(-1), "again") as held:
        assert held == (0, 1, 2, 3)
