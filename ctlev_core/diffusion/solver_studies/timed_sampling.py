"""Sample frames and say what they cost: time and evaluations of the networks, counted rather than assumed."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.diffusion.sampling.devices import device_names
from ctlev_core.diffusion.sampling.options import SamplingOptions, noise_seeds
from ctlev_core.diffusion.sampling.sampling import load_for_sampling, sample_frames
from data_contracts.labels import Conditions


@dataclass(frozen=True, eq=False)
class TimedFrames:
    """Frames, and what each took: its share of its batch, prompts and decoding included, loading left out.

    Attributes:
        frames: [N, H, W, 3] uint8.
        wall_seconds: [N] float64.
        cpu_seconds: [N] float64, over all threads of the process.
        unet_evaluations: [N] float64, forward passes an image.
        controlnet_evaluations: [N] float64.
    """

    frames: np.ndarray
    wall_seconds: np.ndarray
    cpu_seconds: np.ndarray
    unet_evaluations: np.ndarray
    controlnet_evaluations: np.ndarray


def sample_timed(
    checkpoint: Path, conditions: Conditions, options: SamplingOptions, *, seeds: Sequence[int], work: Path
) -> TimedFrames:
    """The frames of `sample` of a diffusion generator, batch by batch under a stopwatch, after a batch to warm up.

    Args:
        checkpoint: a diffusers folder with what the conditions need.
        conditions: N prompts, with N condition images where the checkpoint has a ControlNet.
        options: solver, steps, precision, batch size; of several devices the first.
        seeds: N non-negative integers.
        work: for files that are deleted again: a time may not come from a shard of an earlier run.
    """
    base_model = load_for_sampling(checkpoint, options, device_names(options.device)[0], conditions.images is not None)
    seeds = noise_seeds(seeds, options)  # before batches are cut: shared noise is that of the first row of all
    made: list[np.ndarray] = []
    costs: list[list[float]] = []
    with tempfile.TemporaryDirectory(dir=work) as folder, _counted(base_model.unet, base_model.controlnet) as counts:

        def sample(rows: slice, name: str, chosen: SamplingOptions) -> np.ndarray:
            return sample_frames(base_model, conditions.take(rows), chosen, seeds=seeds[rows], work=Path(folder) / name)

        sample(slice(0, options.batch_size), "warm_up", options.model_copy(update={"num_inference_steps": 2}))
        for start in range(0, len(conditions), options.batch_size):
            counts[:] = [0, 0]
            wall, cpu = time.perf_counter(), time.process_time()
            frames = sample(slice(start, start + options.batch_size), f"batch_{start}", options)
            cost = [time.perf_counter() - wall, time.process_time() - cpu, *counts]
            made.append(frames)
            costs += [[value / len(frames) for value in cost]] * len(frames)
    return TimedFrames(np.concatenate(made), *np.array(costs, np.float64).T)


@contextmanager
def _counted(*networks: Any) -> Iterator[list[int]]:
    """Within the context the list holds how many rows went through each of the networks, which may be None."""
    counts = [0] * len(networks)

    def counter(number: int) -> Any:
        def count(_: Any, arguments: tuple, named: dict[str, Any]) -> None:
            counts[number] += len(arguments[0] if arguments else named["sample"])

        return count

    hooks = [
        network.register_forward_pre_hook(counter(number), with_kwargs=True)
        for number, network in enumerate(networks)
        if network is not None
    ]
    try:
        yield counts
    finally:
        for hook in hooks:
            hook.remove()
