"""How fast sampling is beside diffusers' pipeline called plainly, and what rounding costs along one trajectory.

    python benchmarks/sampling.py                        # bundled base model, CPU seconds of one thread,
    OMP_NUM_THREADS=1 python benchmarks/sampling.py --part precision --ddpm-steps 1000

Speed: the same networks, prompts, condition images and initial noise, in turns; first that both give the same pictures.
`StableDiffusionControlNetPipeline` and `StableDiffusionPipeline` are called with all images at once, without guidance,
as ours is; their default, 7.5, would take them twice as long. A thousand steps of DDPM, the paper's sampler, take too
long here: their time is that of a line through two shorter runs, which differ in nothing but the number of steps.

Precision: one trajectory of each image with networks and solver state in the given types against float64 throughout,
where the noise schedule's float32 numbers are taken as exact. Embeddings of the time step are float32 everywhere, as
diffusers makes them. Frames are compared before they are rounded, in grey levels, cut to 0 .. 255 as frames are.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from interleaved import Comparison, describe_machine, measure, now_s, print_comparisons, print_targets
from torch import Tensor
from training import make_rows

from ctlev_core.diffusion.denoising import Denoiser
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, conditions_to_tensor, load_base_model
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.sampling import make_scheduler, sample_frames
from ctlev_core.diffusion.solver_studies.trajectory_precision import PRECISIONS
from data_contracts.labels import Conditions

WANTED = 1.3
PAPER_STEPS, EXTRAPOLATED_FROM = 1000, (10, 40)
DOUBLE = torch.float64


def main(arguments: Sequence[str] | None = None) -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=("all", "speed", "precision"), default="all")
    parser.add_argument("--base_model", type=Path, help="diffusers folder; the bundled base model without")
    parser.add_argument("--images", type=int, default=8)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--ddpm-steps", type=int, default=100, help="of the trajectories; the paper's 1000 take minutes"
    )
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    device = torch.device("cpu")
    print(describe_machine(device))
    if chosen.part != "precision":
        found = []
        for name in ("controlnet", "text"):
            base_model = load_base_model(chosen.base_model, with_controlnet=name == "controlnet")
            found += compare(
                base_model, SamplingOptions(num_inference_steps=chosen.steps), name, chosen.images, chosen.rounds
            )
        print_comparisons(f"sampling, {chosen.images} images at a time", "diffusers", found)
        print_targets(found)
    if chosen.part != "speed":
        print_precisions(chosen.base_model, chosen.steps, chosen.ddpm_steps)


# Speed ----------------------------------------------------------------------------------------------------------------


def compare(
    base_model: PretrainedModel,
    options: SamplingOptions,
    name: str,
    count: int,
    rounds: int,
    *,
    ours: PretrainedModel | None = None,
    paper_steps: int = PAPER_STEPS,
    in_full: bool = False,
) -> list[Comparison]:
    """Our sampling beside the pipeline with the same solver and steps, and beside the pipeline with the paper's DDPM.

    Args:
        base_model: the networks of the pipeline.
        options: solver and steps.
        name: of the work.
        count: images at a time.
        rounds: turns of each.
        ours: the same networks made faster, no target then; None = those of `base_model`.
        paper_steps: of DDPM; 0 = none of it.
        in_full: run all of them, once, in place of two shorter runs a round.
    """
    device, config, steps = base_model.unet.device, base_model.scheduler_config, options.num_inference_steps
    _, conditions = make_rows(base_model, count, with_images=base_model.controlnet is not None)
    options = options.model_copy(update={"batch_size": count, "black_threshold": 0})
    sample = partial(sample_ours, ours or base_model, conditions, options)
    call = partial(
        call_pipeline,
        make_pipeline(base_model, make_scheduler(options.scheduler, config, steps)),
        base_model,
        conditions,
        steps,
    )
    difference = np.abs(sample().astype(int) - call().astype(int))
    print(
        f"{name}: our frames and the pipeline's with the same noise differ by {difference.max()} grey levels at most, "
        f"{difference.mean():.2g} on average"
    )
    same = Comparison(f"{name}, {steps} steps", count, None if ours else WANTED)
    for _ in range(rounds):
        same.ours.append(measure(sample, device))
        same.peer.append(measure(call, device))
    if not paper_steps:
        return [same]
    paper = make_pipeline(base_model, make_scheduler("ddpm", config, paper_steps))
    further = Comparison(f"{name}, {steps} steps beside DDPM-{paper_steps}", count, paper_steps / steps)
    for seconds in same.ours[:1] if in_full else same.ours:
        further.ours.append(seconds)
        further.peer.append(_time_ddpm(paper, base_model, conditions, paper_steps, in_full))
    return [same, further]


def _time_ddpm(
    pipeline: Any, base_model: PretrainedModel, conditions: Conditions, num_steps: int, in_full: bool
) -> float:
    """Seconds of the pipeline with DDPM, in full or on the line through two shorter runs."""
    lengths = (num_steps,) if in_full else EXTRAPOLATED_FROM
    times = [
        measure(partial(call_pipeline, pipeline, base_model, conditions, n), base_model.unet.device) for n in lengths
    ]
    if in_full:
        return times[0]
    slope = (times[1] - times[0]) / (lengths[1] - lengths[0])
    return times[1] + slope * (num_steps - lengths[1])


def sample_ours(base_model: PretrainedModel, conditions: Conditions, options: SamplingOptions) -> np.ndarray:
    """Frames, sampled anew: the folder of finished shards is a fresh one."""
    with tempfile.TemporaryDirectory() as work:
        return sample_frames(base_model, conditions, options, seeds=range(len(conditions)), work=Path(work))


def make_pipeline(base_model: PretrainedModel, scheduler: Any) -> Any:
    """The pipeline of diffusers around the same networks."""
    from diffusers.pipelines.controlnet.pipeline_controlnet import StableDiffusionControlNetPipeline
    from diffusers.pipelines.stable_diffusion.pipeline_stable_diffusion import StableDiffusionPipeline

    parts: dict[str, Any] = {
        "vae": base_model.vae,
        "text_encoder": base_model.text_encoder,
        "tokenizer": base_model.tokenizer,
        "unet": base_model.unet,
        "scheduler": scheduler,
        "safety_checker": None,
        "feature_extractor": None,
        "requires_safety_checker": False,
    }
    with warnings.catch_warnings(action="ignore"):
        if base_model.controlnet is None:
            pipeline: Any = StableDiffusionPipeline(**parts)
        else:
            pipeline = StableDiffusionControlNetPipeline(**parts, controlnet=base_model.controlnet)
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def call_pipeline(
    pipeline: Any, base_model: PretrainedModel, conditions: Conditions, num_inference_steps: int
) -> np.ndarray:
    """Frames [N, H, W, 3] uint8 of one plain call, from the noise that ours starts with."""
    from PIL import Image

    inputs: dict[str, Any] = {"prompt": list(conditions.prompts)}
    if conditions.images is not None:
        inputs["image"] = [Image.fromarray(image) for image in conditions.images]
    noise = make_noise(base_model, len(conditions), 0)[0].to(base_model.unet.device, base_model.unet.dtype)
    pictures = pipeline(**inputs, latents=noise, num_inference_steps=num_inference_steps, guidance_scale=1.0).images
    return np.stack([np.asarray(picture) for picture in pictures])


def make_noise(base_model: PretrainedModel, count: int, num_further: int) -> list[Tensor]:
    """What images with the seeds 0, 1, ... draw from their own streams: the start, and a number of further steps."""
    side = base_model.unet.config.sample_size
    shape = (base_model.unet.config.in_channels, side, side)
    streams = [torch.Generator().manual_seed(seed) for seed in range(count)]
    return [torch.stack([torch.randn(shape, generator=stream) for stream in streams]) for _ in range(1 + num_further)]


# Precision ------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class PrecisionError:
    """How far a trajectory ends from that in float64.

    Attributes:
        latents: largest and root mean square difference of the scaled latents, whose deviation is about 1.
        levels: the same of the frames, in grey levels.
        seconds: of the trajectory.
    """

    latents: tuple[float, float]
    levels: tuple[float, float]
    seconds: float


def print_precisions(base_model_folder: Path | None, steps: int, ddpm_steps: int, count: int = 1) -> None:
    """One line a solver and precision."""
    device = torch.device("cpu")
    for scheduler, num_steps in (("unipc", steps), ("ddpm", ddpm_steps)):
        found = compute_precision_errors(
            partial(load_base_model, base_model_folder), scheduler, num_steps, count, device
        )
        print(
            f"\n{scheduler}, {num_steps} steps, {count} images, against float64: largest, root mean square difference"
        )
        print(f"  {'networks':10} {'state':10} {'latents':>20} {'grey levels':>20} {'s':>8}")
        for (network, state), error in found.items():
            cells = "".join(f"{f'{most:.2g}, {rms:.2g}':>21}" for most, rms in (error.latents, error.levels))
            print(f"  {_name(network):10} {_name(state):10}{cells} {error.seconds:8.1f}", flush=True)


def compute_precision_errors(
    load: Any, scheduler: str, num_steps: int, count: int, device: torch.device
) -> dict[tuple[torch.dtype, torch.dtype], PrecisionError]:
    """Errors of each of `PRECISIONS` (ours keeps the state in float32); `load(dtype=, device=)` gives the model."""
    exact = load(dtype=DOUBLE, device=device)
    reference = run_trajectory(exact, scheduler, num_steps, count, DOUBLE)
    picture = _decode(exact, reference)
    found = {}
    for network, state in PRECISIONS:
        base_model = load(dtype=network, device=device)
        start = now_s(device)
        latents = run_trajectory(base_model, scheduler, num_steps, count, state).double()
        seconds = now_s(device) - start
        off, levels = (latents - reference).abs(), (_decode(exact, latents) - picture).abs()
        found[network, state] = PrecisionError(_most_and_rms(off), _most_and_rms(levels), seconds)
    return found


@torch.no_grad()
def run_trajectory(
    base_model: PretrainedModel, scheduler: str, num_steps: int, count: int, of_state: torch.dtype
) -> Tensor:
    """Latents at the end, from the noise of the seeds 0, 1, ..., with the state of the solver in `of_state`."""
    network, device = base_model.unet.dtype, base_model.unet.device
    _, conditions = make_rows(base_model, count, with_images=base_model.controlnet is not None)
    embeddings = encode_prompts(base_model, list(conditions.prompts)).to(network)
    images = None
    if conditions.images is not None:
        images = conditions_to_tensor(conditions.images).to(device, network)
    denoiser = Denoiser(base_model.unet, base_model.controlnet)

    def predict(state: Tensor, timestep: Tensor) -> Tensor:
        times = timestep.expand(len(state)).to(device)
        return denoiser.predict(state.to(network), times, embeddings, images).to(of_state)

    noise = [each.to(device) for each in make_noise(base_model, count, num_steps if scheduler == "ddpm" else 0)]
    if scheduler == "ddpm":
        return _run_ddpm(base_model, predict, noise, num_steps, of_state)
    with _exact_constants(of_state):
        solver = make_scheduler(scheduler, base_model.scheduler_config, num_steps)
        if of_state == DOUBLE:
            _widen(solver)
        state = noise[0].to(of_state)
        for timestep in solver.timesteps:
            state = solver.step(predict(state, timestep), timestep, state).prev_sample.to(of_state)
    return state


def _run_ddpm(
    base_model: PretrainedModel, predict: Any, noise: list[Tensor], num_steps: int, of_state: torch.dtype
) -> Tensor:
    """Ancestral sampling, written out: Ho et al., DDPM, 2020, eq. 6 and 7, with the posterior's variance."""
    solver = make_scheduler("ddpm", base_model.scheduler_config, num_steps)
    # Single numbers do not widen a state of fewer digits, and diffusers keeps them in float32, too.
    constants = DOUBLE if of_state == DOUBLE else torch.float32
    kind, alphas = solver.config["prediction_type"], solver.alphas_cumprod.to(constants)
    times = solver.timesteps.tolist()
    state = noise[0].to(of_state)
    for number, timestep in enumerate(times):
        previous = times[number + 1] if number + 1 < len(times) else -1
        alpha_bar = alphas[timestep]
        alpha_bar_previous = alphas[previous] if previous >= 0 else torch.ones((), dtype=constants)
        alpha = alpha_bar / alpha_bar_previous
        output = predict(state, solver.timesteps[number])
        signal, spread = alpha_bar.sqrt(), (1 - alpha_bar).sqrt()
        clean = {
            "epsilon": lambda x, s, n, e: (x - n * e) / s,
            "v_prediction": lambda x, s, n, e: s * x - n * e,
            "sample": lambda x, s, n, e: e,
        }[kind](state, signal, spread, output)
        mean = (
            alpha_bar_previous.sqrt() * (1 - alpha) / (1 - alpha_bar) * clean
            + alpha.sqrt() * (1 - alpha_bar_previous) / (1 - alpha_bar) * state
        )
        if timestep == 0:
            return mean
        variance = ((1 - alpha_bar_previous) / (1 - alpha_bar) * (1 - alpha)).clamp(min=1e-20)
        state = mean + variance.sqrt() * noise[1 + number].to(of_state)
    return state


@contextlib.contextmanager
def _exact_constants(of_state: torch.dtype) -> Iterator[None]:
    """Solvers make small tensors of Python numbers in torch's default type."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(DOUBLE if of_state == DOUBLE else before)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def _widen(solver: Any) -> None:
    """The solver's numbers in float64, so that it computes with them in float64."""
    for name, value in vars(solver).items():
        if isinstance(value, Tensor) and value.is_floating_point():
            setattr(solver, name, value.double())


@torch.no_grad()
def _decode(base_model: PretrainedModel, latents: Tensor) -> Tensor:
    images = base_model.vae.decode((latents / base_model.scaling_factor).to(base_model.vae.dtype)).sample.double()
    return ((images + 1) * 127.5).clamp(0, 255)


def _most_and_rms(difference: Tensor) -> tuple[float, float]:
    return float(difference.max()), float(difference.square().mean().sqrt())


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


if __name__ == "__main__":
    main()
