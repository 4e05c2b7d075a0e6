"""The benchmarks of the generator run, at toy size, and compare the same work on both sides."""

import importlib
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tiny_base_model import make_base_model, make_data

from ctlev_core.diffusion.denoising import Batch, Denoiser, NoiseSchedule
from ctlev_core.diffusion.pretrained.loading import (
    conditions_to_tensor,
    images_to_tensor,
    load_base_model,
    save_base_model,
)
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.sampling import sample_latents
from data_contracts.labels import Conditions

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"
SEED = 5


@pytest.fixture(scope="module")
def benchmarks():
    """The modules, which import one another by their bare names."""
    names = ("interleaved", "diffusers_loop", "training", "sampling", "gpu", "time_to_loss")
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        yield SimpleNamespace(**{name: importlib.import_module(name) for name in names})
    from accelerate.state import AcceleratorState

    AcceleratorState._reset_state(reset_partial_state=True)
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def base_model_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("base_model")
    save_base_model(make_base_model(), folder)
    return folder


def make_example(benchmarks, base_model, **further):
    """A loop over two equal frames, one at a time, so that their order does not matter."""
    frames, conditions = make_data(1, with_images=base_model.controlnet is not None)
    images = conditions.images
    twice = Conditions(2 * conditions.prompts, None if images is None else np.repeat(images, 2, axis=0))
    loop = benchmarks.diffusers_loop.ExampleLoop(
        base_model, np.repeat(frames, 2, axis=0), twice, batch_size=1, **further
    )
    return loop, frames, conditions


@pytest.mark.parametrize("with_controlnet", [True, False])
def test_the_examples_loss_is_ours_on_the_same_noise(benchmarks, base_model_folder, with_controlnet):
    """Written down twice, by diffusers' functions there and by ours here; a step that changes nothing goes before,
    because the loader draws from the same stream of random numbers when it starts."""
    base_model = load_base_model(base_model_folder, with_controlnet=with_controlnet)
    loop, frames, conditions = make_example(benchmarks, base_model, learning_rate=0.0)
    loop.run(1)
    torch.manual_seed(SEED)
    (loss,) = loop.run(1)

    plain = load_base_model(base_model_folder, with_controlnet=with_controlnet)
    with torch.no_grad():
        latents = plain.vae.encode(images_to_tensor(frames)).latent_dist.mean * plain.scaling_factor
        torch.manual_seed(SEED)
        noise = torch.randn_like(latents)
        timesteps = torch.randint(0, 1000, (1,))
        noisy, target = NoiseSchedule(plain.scheduler_config).noised(latents, noise, timesteps)
        images = None if conditions.images is None else conditions_to_tensor(conditions.images)
        denoiser = Denoiser(plain.unet, plain.controlnet)
        predicted = denoiser.predict(noisy, timesteps, encode_prompts(plain, list(conditions.prompts)), images)
    # The same sums in float32.
    assert loss == pytest.approx(float((predicted - target).square().mean()), rel=1e-5)


@pytest.mark.parametrize(("with_controlnet", "learns"), [(True, "controlnet"), (False, "unet")])
def test_the_example_trains_what_ours_does(benchmarks, base_model_folder, with_controlnet, learns):
    base_model, before = (load_base_model(base_model_folder, with_controlnet=with_controlnet) for _ in range(2))
    loop, *_ = make_example(benchmarks, base_model, learning_rate=1e-3, use_ema=not with_controlnet)
    losses = loop.run(2)
    assert len(losses) == 2 and np.isfinite(losses).all()
    for name in ("unet", "controlnet", "text_encoder"):
        if getattr(base_model, name) is not None:
            old, new = (getattr(each, name).state_dict() for each in (before, base_model))
            assert any(not torch.equal(old[key], new[key]) for key in old) == (name == learns), name


def test_the_stages_of_a_step_add_up(benchmarks, base_model_folder):
    loop, *_ = make_example(benchmarks, load_base_model(base_model_folder, with_controlnet=False), use_ema=True)
    ticks = iter(range(1000))
    loop.clock = lambda: next(ticks)
    loop.run(2)
    assert loop.seconds == dict.fromkeys(benchmarks.diffusers_loop.STAGES, 2)


def test_our_loop_is_stopped_between_steps(benchmarks, base_model_folder, tmp_path):
    """Three rounds of two steps, after the warm-up, of the loop that `fine_tune` would have run."""
    base_model, before = load_base_model(base_model_folder), load_base_model(base_model_folder)
    options = benchmarks.training.make_options(4, "float32", ["learning_rate=0.001"])
    frames, conditions = make_data()
    loop = benchmarks.training.FineTuningLoop(base_model, frames, conditions, options, tune="controlnet", work=tmp_path)
    fetched, at = [], []
    fetch = loop.fetch
    loop.fetch = lambda number: fetched.append(number) or fetch(number)
    seconds = loop.run(2, 3, between=lambda: at.append(len(fetched)))
    assert len(seconds) == 3 and min(seconds) > 0
    assert fetched == list(range(2 + 6))
    assert at == [2, 4, 6]
    assert not list(tmp_path.rglob("state.pt")), "nothing is saved while the clock runs"
    old, new = (each.controlnet.state_dict() for each in (before, base_model))
    assert any(not torch.equal(old[key], new[key]) for key in old)


def test_ratio_is_the_median_over_the_rounds(benchmarks):
    comparison = benchmarks.interleaved.Comparison("work", 8, 1.5, ours=[1.0, 2.0, 1.0], peer=[2.0, 2.0, 1.6])
    assert comparison.ratios == [2.0, 1.0, 1.6]
    assert comparison.ratio == 1.6 and comparison.is_met
    comparison.wanted = 1.7
    assert not comparison.is_met


@pytest.mark.parametrize(("scheduler", "steps"), [("unipc", 5), ("ddpm", 10)])
def test_trajectory_is_that_of_our_sampler(benchmarks, base_model_folder, scheduler, steps):
    base_model = load_base_model(base_model_folder)
    got = benchmarks.sampling.run_trajectory(base_model, scheduler, steps, 2, torch.float32)
    _, conditions = benchmarks.training.make_rows(base_model, 2, with_images=True)
    options = SamplingOptions(scheduler=scheduler, num_inference_steps=steps)
    embeddings = encode_prompts(base_model, list(conditions.prompts))
    expected = sample_latents(
        base_model, embeddings, embeddings[:1], conditions_to_tensor(conditions.images), [0, 1], options
    )
    # The ancestral update is written out there and diffusers' here: rounding in float32.
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("scheduler", ["unipc", "ddpm"])
def test_errors_grow_as_digits_are_lost(benchmarks, base_model_folder, scheduler):
    def load(**where):
        return load_base_model(base_model_folder, **where)

    found = benchmarks.sampling.compute_precision_errors(load, scheduler, 5, 1, torch.device("cpu"))
    rms = {key: error.latents[1] for key, error in found.items()}
    single, half, brain = torch.float32, torch.float16, torch.bfloat16
    assert 0 < rms[single, single] < 1e-5 < rms[half, single] < rms[brain, single] < 0.1
    assert rms[half, single] < rms[half, half] < rms[brain, brain]
    assert all(error.latents[0] >= error.latents[1] for error in found.values())


@pytest.mark.slow
def test_training_benchmark(benchmarks, base_model_folder, capsys):
    benchmarks.training.main(
        ["--base_model", str(base_model_folder), "--batch-size", "2", "--rounds", "2", "--steps", "1"]
    )
    printed = capsys.readouterr().out
    assert re.findall(r"^(\w+), bfloat16 beside float32 ", printed, re.M) == ["controlnet", "text"]
    for route in ("controlnet, float32", "text, float32"):
        assert re.search(rf"^{route} .* \d+\.\d\d +\d+\.\d\d \.\. \d+\.\d\d +1\.5: (met|missed)$", printed, re.M), (
            printed
        )
    assert "ratio were everything but the networks free" in printed
    assert "Targets missed: " in printed


@pytest.mark.slow
def test_sampling_benchmark(benchmarks, base_model_folder, capsys, monkeypatch):
    monkeypatch.setattr(benchmarks.sampling, "EXTRAPOLATED_FROM", (1, 2))
    benchmarks.sampling.main(
        ["--base_model", str(base_model_folder), "--images", "2", "--rounds", "1", "--steps", "3", "--ddpm-steps", "4"]
    )
    printed = capsys.readouterr().out
    for differences in re.findall(r"differ by (\d+) grey levels at most", printed):
        # Sums in another order may round the other way.
        assert int(differences) <= 1
    assert printed.count("grey levels at most") == 2
    assert re.findall(r"^(\w+), 3 steps beside DDPM-1000 ", printed, re.M) == ["controlnet", "text"]
    assert printed.count("bfloat16   float32") == printed.count("float16    float16") == 2


def test_gpu_benchmark_says_that_there_is_no_gpu(benchmarks, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    benchmarks.gpu.main([])
    assert capsys.readouterr().out.startswith("No CUDA device here: nothing was measured.")


TOY = ["--device", "cpu", "--size", "tiny", "--image-size", "64", "--batch-size", "1", "--rounds", "1", "--steps", "1"]
TOY += ["--sampling-batch-size", "1"]


@pytest.mark.slow
def test_gpu_benchmark_in_small(benchmarks, capsys):
    """Every function of it; compiling takes minutes and is switched off, the lines around it run."""
    parts = ["sampling", "sampling_compiled", "controlnet_compiled", "text", "transformer"]
    with torch._dynamo.config.patch(disable=True):  # monkeypatch would take the option away for good
        benchmarks.gpu.main([*TOY, "--ddpm-steps", "4", "--inference-steps", "2", "--parts", *parts])
    printed = capsys.readouterr().out
    for part in parts:
        assert f"== {part}\n" in printed
    assert "sampling, 2 steps beside DDPM-4" in printed
    assert "training, controlnet, compile_networks=true" in printed
    assert "sampling, compile_networks=true, 2 steps" in printed


def test_gpu_benchmark_goes_on_after_a_part_that_failed(benchmarks, capsys, monkeypatch):
    def fail(*_):
        raise torch.OutOfMemoryError("too large")

    monkeypatch.setattr(benchmarks.gpu, "PARTS", {"first": fail, "second": lambda *_: print("went on")})
    with pytest.raises(SystemExit, match="parts that failed: first"):
        benchmarks.gpu.main(TOY)
    captured = capsys.readouterr()
    assert "went on" in captured.out and "too large" in captured.err


def test_networks_have_the_size_of_stable_diffusion(benchmarks):
    """Published sizes of v1.4: 859.5 M, ControlNet 361.3 M, autoencoder 83.7 M, text encoder 123.1 M."""
    base_model = benchmarks.gpu.build_base_model(
        "full", 512, with_controlnet=True, dtype=torch.float32, device=torch.device("meta")
    )
    counts = benchmarks.gpu.count_parameters(base_model)
    assert counts == "unet 859.5 M, controlnet 361.3 M, vae 83.7 M, text_encoder 123.1 M"


def test_networks_alone_cost_what_their_layers_do(benchmarks, base_model_folder, tmp_path):
    """The counter sees forward and backward passes, and twice the images cost twice the operations."""
    options = benchmarks.training.make_options(4, "float32")
    frames, conditions = make_data()
    loop = benchmarks.training.FineTuningLoop(
        load_base_model(base_model_folder), frames, conditions, options, tune="controlnet", work=tmp_path
    )
    networks = benchmarks.training.Networks(loop, options)
    one, two = networks.batch(1), networks.batch(2)
    assert isinstance(two, Batch) and len(two.latents) == len(two.conditions) == 2
    assert networks.count_flops(two) == pytest.approx(2 * networks.count_flops(one), rel=0.05)


@pytest.mark.parametrize("route", ["controlnet", "text"])
def test_time_to_loss_compares_the_same_loss(benchmarks, monkeypatch, base_model_folder, route):
    """Both loops start from the same loss, which no training changes, and end with finite ones."""
    module = benchmarks.time_to_loss
    monkeypatch.setattr(
        module, "load", lambda route: load_base_model(base_model_folder, with_controlnet=route == "controlnet")
    )
    rows = module.Rows(*make_data(4, with_images=route == "controlnet"))
    untrained = module.loss_of(module.load(route), rows)
    options = benchmarks.training.make_options(2, "float32")
    runs = [
        module.run_example(route, rows, rows, 1e-3, 4),
        module.run_ours("ours", route, rows, rows, options, "unet" if route == "text" else "both", 3),
    ]
    assert module.loss_of(module.load(route), rows) == untrained
    assert all(np.isfinite(run.loss) and run.loss != untrained and run.seconds > 0 for run in runs)
