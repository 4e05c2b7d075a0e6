"""Everything that takes a device, on a simulated GPU: nothing is left on the CPU, and the numbers are the CPU's."""

import copy

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from simulated_gpu import simulated_gpu
from test_downstream_hard_cases import bodies, frames_of, points
from test_event_gan import TINY as TINY_GAN
from test_event_gan import moving_squares
from tiny_base_model import make_base_model, make_data

from ctlev_core.diffusion.pretrained.loading import save_base_model
from ctlev_core.diffusion.sampling.options import OF_STUDENTS, SPACINGS, SamplingOptions
from ctlev_core.diffusion.sampling.sampling import sample_checkpoint
from ctlev_core.diffusion.training import trainer
from ctlev_core.diffusion.training.entry import train_checkpoint
from ctlev_core.diffusion.training.options import FineTuningOptions
from ctlev_core.downstream import classifier, pose2d, smpl_regressor
from ctlev_core.generators import event_gan
from data_contracts.labels import Labels

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def base_model_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("base_model")
    save_base_model(make_base_model(), folder)
    return folder


# The simulation itself ------------------------------------------------------------------------------------------------

MISTAKES = {
    "sum": lambda here, there: here + there,
    "layer": lambda here, there: torch.nn.functional.linear(there, here),
    "list": lambda here, there: torch.cat([there, here]),
    "index": lambda here, there: here[there[0].long()],
    "numpy": lambda here, there: there.numpy(),
    "array": lambda here, there: np.asarray(there),
    "generator": lambda here, there: torch.randn(3, device="cuda", generator=torch.Generator()),
    "in place": lambda here, there: there.mul_(here),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_what_a_gpu_refuses_is_refused(name):
    with simulated_gpu(), pytest.raises((RuntimeError, TypeError), match="device"):
        MISTAKES[name](torch.zeros(2, 2), torch.zeros(2, 2, device="cuda"))


def test_tensors_stay_where_they_were_put():
    with simulated_gpu() as gpu:
        layer = torch.nn.Linear(2, 3).to("cuda")
        inputs = torch.ones(4, 2).to("cuda", torch.float64).float()
        layer(inputs).mean().backward()
        assert gpu.num_operations > 3
        for tensor in (layer.weight, layer.weight.grad, copy.deepcopy(layer).bias, inputs.max(dim=1).values, inputs[0]):
            assert tensor.is_cuda and tensor.device == torch.device("cuda:0")
        assert inputs.to("cuda:0") is inputs and inputs.new_zeros(1).is_cuda and torch.zeros_like(inputs).is_cuda
        assert not inputs.cpu().is_cuda and not torch.zeros_like(inputs, device="cpu").is_cuda
        assert isinstance(layer.cpu().weight, torch.nn.Parameter) and not layer.weight.is_cuda
        inputs.copy_(torch.zeros(4, 2))
        assert inputs.is_cuda and inputs.sum() == 0


# What is computed there -----------------------------------------------------------------------------------------------

TRAINED = {
    "both": {},
    "controlnet": {"tune": "controlnet", "gradient_checkpointing": True},
    "unet": {"tune": "unet", "snr_gamma": 5.0},
    "muon": {"optimizer": "muon", "gradient_accumulation": 2, "rot90_probability": 0.5},
    "random": {"random_init": True},
    "bfloat16": {"precision": "bfloat16"},
    "float16": {"precision": "float16"},
}


def fine_tuned(folder, base_model, device, changed, num_steps=2):
    changed = dict(changed)
    tune = changed.pop("tune", "both")
    frames, conditions = make_data(24, with_images=tune != "unet")
    options = FineTuningOptions.model_validate(
        {
            "num_steps": num_steps, "batch_size": 2, "num_validation": 4, "validation_every": num_steps // 2,
            "keep": "best", "log_every": 2, "sample_every": num_steps - 1, "ema_decay": 0.5,
            "checkpoint_every_s": 1e-9, "device": device, "base_model": base_model, **changed,
        }
    )  # fmt: skip
    history = train_checkpoint(
        frames, conditions, options, tune=tune, with_controlnet=tune != "unet", seed=0, out=folder / "out",
        work=folder / "work",
    )  # fmt: skip
    network = "unet" if tune == "unet" else "controlnet"
    return history, load_file(folder / "out" / network / "diffusion_pytorch_model.safetensors")


@pytest.mark.usefixtures("native_bfloat16")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in ("both", "float16") else pytest.mark.slow) for name in TRAINED]
)
def test_fine_tuning(tmp_path, base_model_folder, name):
    with simulated_gpu() as gpu:
        history, weights = fine_tuned(tmp_path / "gpu", base_model_folder, "cuda", TRAINED[name])
    assert gpu.num_operations > 5_000 and np.isfinite(history.loss).all()
    if name == "float16":  # a CPU takes none
        return
    again, expected = fine_tuned(tmp_path / "cpu", base_model_folder, "cpu", TRAINED[name])
    exact = name != "bfloat16"  # of which CPUs do attention in float32
    np.testing.assert_allclose(history.loss, again.loss, rtol=0 if exact else 1e-2)
    if exact:
        assert all(torch.equal(weights[key], expected[key]) for key in expected)


@pytest.mark.slow
def test_a_killed_fine_tuning_goes_on(tmp_path, base_model_folder, monkeypatch):
    update, calls = trainer.Trainer.update, []

    def stop_once(self, progress):
        calls.append(self.step)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return update(self, progress)

    monkeypatch.setattr(trainer.Trainer, "update", stop_once)
    with simulated_gpu():
        with pytest.raises(KeyboardInterrupt):
            fine_tuned(tmp_path, base_model_folder, "cuda", {}, num_steps=4)
        _, weights = fine_tuned(tmp_path, base_model_folder, "auto", {}, num_steps=4)
    assert calls == [0, 1, 2, 2, 3]
    _, expected = fine_tuned(tmp_path / "whole", base_model_folder, "cpu", {}, num_steps=4)
    assert all(torch.equal(weights[key], expected[key]) for key in expected)


SAMPLED = [
    {"scheduler": solver, "timestep_spacing": spacings[-1]}
    for solver, spacings in SPACINGS.items()
    if solver != OF_STUDENTS
]
SAMPLED += [
    {"guidance_scale": 3.0, "guidance_interval": (0.2, 0.6)}, {"controlnet_every": 2}, {"noise": "shared"},
    {"palette": "red_blue"}, {"precision": "float16"}, {"precision": "bfloat16"},
]  # fmt: skip


@pytest.mark.usefixtures("native_bfloat16")
@pytest.mark.parametrize("changed", SAMPLED, ids=lambda changed: "-".join(map(str, changed.values())))
def test_sampling(tmp_path, base_model_folder, changed):
    def sample(device):
        options = SamplingOptions.model_validate(
            {"num_inference_steps": 4, "batch_size": 3, **changed, "device": device}
        )
        return sample_checkpoint(
            base_model_folder, make_data(4)[1], options, with_controlnet=True, seeds=range(4), work=tmp_path / device
        )

    with simulated_gpu() as gpu:
        frames = sample("all")
    assert gpu.num_operations > 500
    np.testing.assert_array_equal(frames, sample("cpu"))


DOWNSTREAM = {
    "pose2d": (pose2d, {"width": 0.25, "batch_norm": True, "shift_px": 2, "flip": False}, points(12)),
    "smpl_regressor": (smpl_regressor, {"flip": False}, bodies(12)),
    "classifier": (classifier, {}, Labels(("a", "b") * 6, np.arange(12))),
}


@pytest.mark.parametrize("name", DOWNSTREAM)
def test_downstream_models(tmp_path, name):
    module, changed, labels = DOWNSTREAM[name]

    def run(device):
        options = module.Options(num_steps=3, batch_size=4, validation_share=0.25, device=device, **changed)
        module.train(
            frames_of(12), labels, options, seed=0, out=tmp_path / device / "model", work=tmp_path / device / "work"
        )
        return module.predict(tmp_path / device / "model", frames_of(5))

    with simulated_gpu() as gpu:
        found = run("auto")
    assert gpu.num_operations > 300
    expected = run("cpu")
    assert found.keys() == expected.keys()
    for key, values in expected.items():
        if values.dtype.kind == "f":  # weights lie in memory as suits the device, which changes the order of sums
            np.testing.assert_allclose(found[key], values, rtol=1e-4, atol=1e-5)
        else:
            np.testing.assert_array_equal(found[key], values)


def test_event_gan(tmp_path):
    frames, conditions = moving_squares(12)

    def run(device):
        folder, options = tmp_path / device, event_gan.Options(**{**TINY_GAN, "device": device})
        event_gan.train(frames, conditions, options, seed=0, out=folder / "model", work=folder / "work")
        asked = event_gan.SampleOptions(device=device)
        return event_gan.sample(folder / "model", conditions, asked, seeds=range(12), work=folder / "samples")

    with simulated_gpu() as gpu:
        made = run("auto")
    assert gpu.num_operations > 1_000
    np.testing.assert_array_equal(made, run("cpu"))
