"""What torch is told before a training on a GPU, and that two trainings there end in the same weights."""

import os

import pytest
import torch

from ctlev_core.determinism import CUBLAS, deterministic


def settings():
    import torch._inductor.config as inductor

    cudnn = torch.backends.cudnn
    return (
        torch.are_deterministic_algorithms_enabled(),
        torch.is_deterministic_algorithms_warn_only_enabled(),
        torch.utils.deterministic.fill_uninitialized_memory,
        cudnn.benchmark,
        cudnn.deterministic,
        inductor.deterministic,
    )


@pytest.mark.parametrize("strict", [True, False])
def test_a_gpu_is_told_and_everything_is_as_it_was_afterwards(monkeypatch, strict):
    monkeypatch.delenv(CUBLAS, raising=False)
    monkeypatch.setattr(torch.backends.cudnn, "benchmark", True)
    before = settings()
    with pytest.raises(KeyError), deterministic(torch.device("cuda"), strict=strict):
        assert settings() == (True, not strict, False, False, True, True)
        assert os.environ[CUBLAS] == ":4096:8"
        raise KeyError
    assert settings() == before


def test_what_the_user_says_of_cublas_stands(monkeypatch):
    monkeypatch.setenv(CUBLAS, ":16:8")
    with deterministic(torch.device("cuda")):
        assert os.environ[CUBLAS] == ":16:8"


def test_a_cpu_is_told_nothing():
    before = settings()
    with deterministic(torch.device("cpu"), strict=True):
        assert settings() == before


@pytest.mark.gpu
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_fine_tuning_twice_on_a_gpu_ends_in_the_same_weights(tmp_path, precision):
    import numpy as np
    from safetensors.torch import load_file

    from ctlev_core.diffusion.training.entry import train_checkpoint
    from ctlev_core.diffusion.training.options import FineTuningOptions
    from data_contracts.labels import Conditions

    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (32, 64, 64, 3), np.uint8)
    conditions = Conditions(["A moving human"] * 32, rng.integers(0, 256, (32, 64, 64, 3), np.uint8))
    options = FineTuningOptions(num_steps=20, batch_size=8, device="cuda", precision=precision)
    found = []
    for name in "ab":
        out, work = tmp_path / name, tmp_path / "work" / name
        train_checkpoint(
            frames, conditions, options, tune="controlnet", with_controlnet=True, seed=0, out=out, work=work
        )
        found.append(load_file(out / "controlnet" / "diffusion_pytorch_model.safetensors"))
    assert all(torch.equal(weights, found[1][key]) for key, weights in found[0].items())
