"""How fast fine-tuning is beside diffusers' own example loops, and where the time goes on both sides.

    python benchmarks/training.py                                   # bundled base model, both routes, two precisions
    python benchmarks/training.py --batch-size 32 --set compile_networks=true --precisions float32

Both loops train the same networks on the same frames in one process and take turns; each turn is a few steps, and the
ratio is the median over the turns. Ours is all of `fine_tune`'s loop, with averaged weights and the guard against
values that are not finite; the peer's is `train_controlnet`, or `train_text_to_image` with averaged weights
(`diffusers_loop.py` says what was left out in its favour). CPU seconds of one thread; set OMP_NUM_THREADS=1.

What we compute before the first step, latents and prompt embeddings, is printed beside it. The parts say what could be
gained: the networks cost both loops the same, so that the ratio cannot exceed their share of the peer's step.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import statistics
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args
from unittest import mock

import numpy as np
import torch
from diffusers_loop import STAGES, ExampleLoop
from interleaved import Comparison, describe_machine, matmul_flops, measure, now_s, print_comparisons, print_targets
from torch.utils.flop_counter import FlopCounterMode

from ctlev_core.diffusion.denoising import Batch, Denoiser, NoiseSchedule, denoising_loss, generator_for
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, load_base_model
from ctlev_core.diffusion.training import finetuning
from ctlev_core.diffusion.training import loop as training
from ctlev_core.diffusion.training.acceleration import accelerated, autocast
from ctlev_core.diffusion.training.options import FineTuningOptions
from data_contracts.labels import Conditions

Route = Literal["controlnet", "text"]
WANTED = 1.5
FRAMES = 64
WARM_UP_STEPS = 2
PROMPTS = ("A photo of a cup", "A photo of a ball", "A photo of a chair", "A moving human")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the comparison, the parts, and which targets were missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--base_model", type=Path, help="diffusers folder; the bundled base model without")
    parser.add_argument("--routes", nargs="*", default=["controlnet", "text"], choices=("controlnet", "text"))
    parser.add_argument("--precisions", nargs="*", default=["float32", "bfloat16"], choices=("float32", "bfloat16"))
    parser.add_argument("--batch-size", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--steps", type=int, default=4, help="of each loop a round")
    parser.add_argument("--set", nargs="*", default=[], metavar="OPTION=VALUE", help="options of our fine-tuning")
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    device = torch.device("cpu")
    print(describe_machine(device))
    found = []
    for precision in chosen.precisions:
        for route in chosen.routes:
            options = make_options(chosen.batch_size, precision, chosen.set)
            base_models = [load_base_model(chosen.base_model, with_controlnet=route == "controlnet") for _ in range(2)]
            found.append(compare(base_models[0], base_models[1], options, route, chosen.rounds, chosen.steps))
    found += beside_default(found)
    print_comparisons(f"fine-tuning, batches of {chosen.batch_size}", "diffusers", found)
    print_targets(found)


def beside_default(found: Sequence[Comparison]) -> list[Comparison]:
    """Ours in bfloat16 beside the example in its default, float32, of each route that was trained in both."""
    by_name = {comparison.name: comparison for comparison in found}
    pairs = [(route, by_name.get(f"{route}, bfloat16"), by_name.get(f"{route}, float32")) for route in get_args(Route)]
    return [
        Comparison(f"{route}, bfloat16 beside float32", half.images, WANTED, ours=half.ours, peer=whole.peer)
        for route, half, whole in pairs
        if half is not None and whole is not None
    ]


def make_options(batch_size: int, precision: str, changed: Sequence[str] = ()) -> FineTuningOptions:
    """Options of a run without end, without validation and without saving; `changed` are texts NAME=VALUE."""
    fixed = {"batch_size": batch_size, "precision": precision, "num_validation": 0, "num_steps": 10**9}
    further = dict(text.split("=", 1) for text in changed)
    return FineTuningOptions.model_validate({**fixed, "checkpoint_every_s": 1e9, **further})


def make_rows(base_model: PretrainedModel, count: int, *, with_images: bool) -> tuple[np.ndarray, Conditions]:
    """Frames of scattered events and, as conditions, a few bright boxes on black; time does not depend on either."""
    random = np.random.default_rng(0)
    width, height = base_model.image_size
    frames = np.where(random.random((count, height, width, 1)) < 0.1, random.integers(0, 256, (count, 1, 1, 3)), 0)
    images = np.zeros((count, height, width, 3), np.uint8)
    for image in images:
        for left, top in random.integers(0, max(1, width - 4), (6, 2)):
            image[top : top + 4, left : left + 4] = random.integers(0, 256, 3)
    prompts = tuple("A moving human" if with_images else PROMPTS[row % len(PROMPTS)] for row in range(count))
    return frames.astype(np.uint8), Conditions(prompts, images if with_images else None)


# Our loop -------------------------------------------------------------------------------------------------------------


class _Stopped(Exception):
    """Ends a training from within."""


class FineTuningLoop:
    """What `fine_tune` runs, a few steps at a time: the loop is stopped where it asks for its next batch.

    Attributes:
        preparation_s: seconds from frames to the first step: latents, embeddings, optimiser.
        data_s: seconds that making batches has taken.
    """

    def __init__(
        self,
        base_model: PretrainedModel,
        frames: np.ndarray,
        conditions: Conditions,
        options: FineTuningOptions,
        *,
        tune: finetuning.Tune,
        work: Path,
    ) -> None:
        """Let `fine_tune` prepare everything, and keep what it hands to the loop."""
        handed_over: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

        def keep(*positional: Any, **named: Any) -> None:
            handed_over.append((positional, named))
            raise _Stopped

        self._device = base_model.unet.device
        start = now_s(self._device)
        with mock.patch.object(finetuning, "run_training", keep), contextlib.suppress(_Stopped):
            finetuning.fine_tune(base_model, frames, conditions, options, tune=tune, seed=0, work=work)
        self.preparation_s = now_s(self._device) - start
        (self._trainer, self.denoiser, self.schedule, self.fetch), self._further = handed_over[0]
        self.data_s = 0.0

    def run(self, num_steps: int, rounds: int, between: Callable[[], object]) -> list[float]:
        """Seconds of each round of steps after a warm-up; `between` is called before every round, its time not counted.

        The whole is one call of the loop: what it compiles it compiles once, in the warm-up.
        """
        seconds: list[float] = []
        started, first = math.nan, WARM_UP_STEPS

        def fetch(number: int) -> Batch:
            nonlocal started
            now = now_s(self._device)
            done = self._trainer.step - begin - first
            if done >= 0 and done % num_steps == 0:
                if done:
                    seconds.append(now - started)
                if len(seconds) == rounds:
                    raise _Stopped
                between()
                self.data_s = 0.0 if not done else self.data_s
                started = now = now_s(self._device)
            batch = self.fetch(number)
            self.data_s += now_s(self._device) - now
            return batch

        begin = self._trainer.step
        with contextlib.suppress(_Stopped):
            training.run_training(self._trainer, self.denoiser, self.schedule, fetch, **self._further)
        return seconds


def compare(
    base_model: PretrainedModel,
    same: PretrainedModel,
    options: FineTuningOptions,
    route: Route,
    rounds: int,
    steps: int,
    name: str = "",
) -> Comparison:
    """Train `base_model` by our loop and `same`, an equal one, by the example's, in turns; print parts of a step."""
    device = base_model.unet.device
    frames, conditions = make_rows(base_model, max(FRAMES, options.batch_size), with_images=route == "controlnet")
    peer = ExampleLoop(
        same, frames, conditions, batch_size=options.batch_size, precision=_peer_precision(options),
        use_ema=route == "text",
    )  # fmt: skip
    peer.run(WARM_UP_STEPS)
    found = Comparison(name or f"{route}, {options.precision}", steps * options.batch_size, WANTED)
    tune: finetuning.Tune = "controlnet" if route == "controlnet" else "unet"
    with tempfile.TemporaryDirectory() as work:
        ours = FineTuningLoop(base_model, frames, conditions, options, tune=tune, work=Path(work))
        found.ours = ours.run(steps, rounds, lambda: found.peer.append(measure(partial(peer.run, steps), device)))
    print_parts(ours, peer, options, found, steps)
    print(f"  ours before the first step: {1e3 * ours.preparation_s / len(frames):.1f} ms a frame")
    return found


def _peer_precision(options: FineTuningOptions) -> Literal["float32", "bfloat16"]:
    if options.precision == "float16":
        raise ValueError("the examples are written out for float32 and bfloat16, got float16")
    return options.precision


# Parts of a step ------------------------------------------------------------------------------------------------------


def print_parts(
    ours: FineTuningLoop, peer: ExampleLoop, options: FineTuningOptions, found: Comparison, steps: int
) -> None:
    """Milliseconds of a step by what they are spent on, and how near the networks are to the machine's limit."""
    networks = Networks(ours, options)
    one, many, device = networks.batch(1), networks.batch(options.batch_size), networks.device
    flops = networks.count_flops(one) * options.batch_size
    times: dict[int, list[float]] = {1: [], options.batch_size: []}
    peer.clock = partial(now_s, device)
    for _ in range(3):
        times[1].append(measure(partial(networks.run, one), device))
        times[options.batch_size].append(measure(partial(networks.run, many), device))
        peer.run(1)
    for_one, for_many = (1e3 * statistics.median(values) for values in (times[1], times[options.batch_size]))
    step, its_step = (1e3 * statistics.median(values) / steps for values in (found.ours, found.peer))
    data = 1e3 * ours.data_s / (steps * len(found.ours))
    print(f"\n{found.name}: ms of a step of {options.batch_size}\n  ctlev {step:.1f}: data {data:.1f}, "
          f"networks forward and backward {for_many:.1f}, clip, AdamW, averages and checks "
          f"{max(0.0, step - data - for_many):.1f}")  # fmt: skip
    parts = ", ".join(f"{name} {1e3 * peer.seconds[name] / 3:.1f}" for name in STAGES if peer.seconds[name])
    print(f"  diffusers {its_step:.1f}: {parts}")
    slope = (for_many - for_one) / max(1, options.batch_size - 1)
    rate = flops / for_many * 1e3
    side = 1024 if device.type == "cpu" else 8192
    limit = matmul_flops(device, networks.dtype, side)
    print(
        f"  networks: {flops / 1e9:.1f} GFLOP, {rate / 1e9:,.0f} GFLOP/s, {rate / limit:.0%} of the {limit / 1e9:,.0f} "
        f"of a matrix product of {side} in {options.precision}; {max(0.0, for_one - slope):.0f} ms of a step do not "
        f"depend on the batch; the whole step: {flops / step * 1e3 / limit:.0%}\n"
        f"  ratio were everything but the networks free: {its_step / for_many:.2f}",
        flush=True,
    )


class Networks:
    """The networks of our loop alone: one forward and backward pass over a batch that lies ready, eager."""

    def __init__(self, loop: FineTuningLoop, options: FineTuningOptions) -> None:
        """Take a batch of the loop's."""
        self._denoiser: Denoiser = loop.denoiser
        self._schedule: NoiseSchedule = loop.schedule
        self._batch: Batch = loop.fetch(0)
        self.device = self._batch.latents.device
        self.dtype = getattr(torch, options.precision)
        self._options = options.model_copy(update={"compile_networks": False})

    def batch(self, count: int) -> Batch:
        """Its first rows."""
        whole = self._batch
        conditions = None if whole.conditions is None else whole.conditions[:count]
        return Batch(whole.latents[:count], whole.embeddings[:count], conditions)

    def run(self, batch: Batch) -> None:
        """Loss and gradients."""
        for network in (self._denoiser.unet, self._denoiser.controlnet):
            if network is not None:
                network.zero_grad(set_to_none=True)
        with accelerated(self._denoiser, self._options, self.device), autocast(self._options, self.device):
            loss = denoising_loss(self._denoiser, self._schedule, batch, generator_for(0, 1))
        loss.backward()

    def count_flops(self, batch: Batch) -> int:
        """Of matrix products, convolutions and attention, forward and backward."""
        with FlopCounterMode(display=False) as counter:
            self.run(batch)
        return counter.get_total_flops()


if __name__ == "__main__":
    main()
