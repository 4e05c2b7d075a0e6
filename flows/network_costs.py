"""Time, memory and disk of the stages that run networks of Stable Diffusion's size, by calculation.

Operations are those of `flows.network_operations`; how fast they are done is measured here, by a product of two
matrices in the precision of the stage. Memory is that of the process: the weights, gradients and moments, and the
activations of a batch; where a GPU holds them, what passes through on the way to it.
"""

from __future__ import annotations

import functools
import math
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from ctlev_core import plugins
from ctlev_core.cpu_precision import computed_in
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.training.options import FineTuningOptions, LatentOptions, StudentOptions, TrainingOptions
from ctlev_core.processes import few_threads, use_cores_for
from data_contracts.config import Choice
from flows.network_operations import Networks, learning, read_networks

LARGE = 400e6
"""Weights of a U-Net or transformer from which on stages are calculated."""
ITEM_BYTES = {"float32": 4, "bfloat16": 2, "float16": 2}
EFFICIENCY = {"encoding": 0.85, "sampling": 0.7, "training": 0.45}
GPU_EFFICIENCY = {"encoding": 0.85, "sampling": 0.43, "training": 0.22}
"""Of the rate of a matrix product, what whole networks reach: on an AMD EPYC in float32, bfloat16 and bfloat16, on an
H200 in bfloat16 (`benchmarks/RESULTS.md`), where encoding was not measured."""
DISK_BYTES_A_S = 500e6
LATENT_SCALE = 8
PROCESS_BYTES = 0.7e9
"""Of Python with torch, diffusers and transformers."""
# Bytes of activations for an image of 512 px; as many times more as it has pixels. Counted for Stable Diffusion v1; the
# transformer of 3 takes 2.75, 0.15 and 0.06 GB in place of the second line (H200, `benchmarks/RESULTS.md`).
_ENCODING, _DECODING = 0.7e9, 1.2e9
_TRAINING, _CHECKPOINTED, _FORWARD = 3.0e9, 0.9e9, 0.4e9
_SQUARE = 512**2


@dataclass(frozen=True)
class NetworkCost:
    """What a stage takes.

    Attributes:
        operations: by precision.
        efficiency: of the rate of a matrix product.
        devices: that share the work.
        io_bytes: read and written.
        memory_bytes: peak of its processes.
        disk_bytes: of its artefact.
    """

    operations: dict[str, float]
    efficiency: float
    devices: int
    io_bytes: float
    memory_bytes: float
    disk_bytes: float

    def seconds(self) -> float:
        """Alone on this machine's GPU, or else its cores."""
        device = "cuda" if num_gpus("auto") else "cpu"
        work = sum(count / operations_a_second(computed_in(name, device)) for name, count in self.operations.items())
        return work / (self.efficiency * self.devices) + self.io_bytes / DISK_BYTES_A_S


def network_cost(
    stage: str, given: Mapping[str, Any], trained: Mapping[str, Any], rows: float, size: tuple[int, int] | None
) -> NetworkCost | None:
    """The cost of a stage; None where it runs no network of that size, or its files cannot be read.

    Args:
        stage: its name.
        given: its arguments.
        trained: those of the fine-tuning whose checkpoint it samples from.
        rows: frames that it makes or learns from.
        size: (width, height) px of the images.
    """
    if size is None:
        return None
    if stage == "encode_latents":
        return _encoding(given["latents"], rows, size)
    options = _options(given.get("generator") if stage == "finetune" else trained.get("generator"))
    if not isinstance(options, FineTuningOptions) or options.base_model is None:
        return None
    networks = read_networks(options.base_model, getattr(options, "controlnet", None), hasattr(options, "controlnet"))
    if networks is None or networks.weights["unet"] < LARGE:
        return None
    if stage == "finetune":
        return _fine_tuning(options, networks, size)
    sampling = _options(given.get("sampling"))
    if stage == "distill" and isinstance(sampling, SamplingOptions):
        return _distilling(given["options"], sampling, options, networks, size)
    if stage == "sample" and isinstance(sampling, SamplingOptions):
        return _sampling(sampling, networks, rows, size)
    return None


def _encoding(options: LatentOptions, rows: float, size: tuple[int, int]) -> NetworkCost | None:
    networks = read_networks(options.base_model, None, False)
    if networks is None or networks.weights["unet"] < LARGE:
        return None
    # Here, because they import torch, which plans of small networks need not wait for.
    from ctlev_core.diffusion.pretrained.loading import ENCODE_PIXELS
    from ctlev_core.diffusion.training.latent_files import ENCODE_BATCH

    pixels, autoencoder = size[0] * size[1], 4 * networks.weights["vae"]
    batch = min(rows, ENCODE_BATCH, max(1, ENCODE_PIXELS // pixels))
    latents = 2 * networks.latent_channels * pixels / LATENT_SCALE**2 * 4
    return NetworkCost(
        {"float32": rows * options.num_turns * networks.operations("encoding", *size)},
        _efficiency("encoding", num_gpus(options.device)),
        1,
        autoencoder,
        _memory(autoencoder, batch * _ENCODING * pixels / _SQUARE, num_gpus(options.device)),
        rows * options.num_turns * latents,
    )


def _fine_tuning(options: FineTuningOptions, networks: Networks, size: tuple[int, int]) -> NetworkCost:
    tune, weights = getattr(options, "tune", "unet"), networks.weights
    images = options.num_steps * options.batch_size * options.gradient_accumulation
    both = weights["unet"] + weights.get("controlnet", 0)
    trained = {"unet": weights["unet"], "controlnet": weights.get("controlnet", 0)}.get(tune, both)
    each = networks.operations(learning(tune), *size) * (4 / 3 if options.gradient_checkpointing else 1)
    moments, averages = 8 * trained, 4 * trained * bool(options.ema_decay)
    activations = _CHECKPOINTED if options.gradient_checkpointing else _TRAINING
    copies = 2 * both if options.precision != "float32" else 0
    everything = sum(weights.values())
    backward = copies + options.batch_size * activations * size[0] * size[1] / _SQUARE
    processes, gpus = options.num_processes or 1, num_gpus(options.device)
    # Moments are made by the first step of the optimiser, when activations have gone.
    peak = moments + (backward if options.num_steps > 1 else 0)
    return NetworkCost(
        {options.precision: images * each},
        _efficiency("training", gpus),
        min(processes, gpus) or 1,
        4 * everything + 4 * trained + moments + averages + 4 * everything,
        processes * _memory(4 * everything, 4 * trained + averages + max(peak, backward), gpus),
        4 * everything,
    )


def _distilling(
    student: StudentOptions,
    sampling: SamplingOptions,
    options: FineTuningOptions,
    networks: Networks,
    size: tuple[int, int],
) -> NetworkCost:
    """Training of a copy, and the teacher's forward passes for the states that it learns from."""
    weights = networks.weights
    tune = student.tune if "controlnet" in weights else "unet"
    learning = {name: getattr(student, name) for name in TrainingOptions.model_fields} | {"device": student.device}
    cost = _fine_tuning(options.model_copy(update={**learning, "tune": tune, "num_processes": None}), networks, size)
    forward = networks.operations("denoising", *size)
    each = math.ceil(student.teacher_evaluations / student.num_evaluations) * sampling.passes_a_step
    images = student.num_steps * student.batch_size * student.gradient_accumulation
    teacher = 4 * (weights["unet"] + weights.get("controlnet", 0))
    return replace(
        cost,
        operations={name: count + images * each * forward for name, count in cost.operations.items()},
        io_bytes=cost.io_bytes + 4 * sum(weights.values()),
        memory_bytes=cost.memory_bytes + (0 if num_gpus(student.device) else teacher),
    )


def _sampling(options: SamplingOptions, networks: Networks, rows: float, size: tuple[int, int]) -> NetworkCost:
    forward, weights = networks.operations("denoising", *size), networks.weights
    evaluations = options.num_inference_steps * options.passes_a_step
    pixels, item, everything = size[0] * size[1], ITEM_BYTES[options.precision], sum(weights.values())
    batch, gpus = min(rows, options.batch_size), num_gpus(options.device)
    return NetworkCost(
        {options.precision: rows * (evaluations * forward + networks.operations("decoding", *size))},
        _efficiency("sampling", gpus),
        max(gpus if options.device == "all" else 1, 1),
        4 * everything,
        _memory(item * everything, batch * max(_DECODING * item / 2, _FORWARD) * pixels / _SQUARE, gpus),
        rows * pixels * 3,
    )


def _efficiency(work: str, gpus: int) -> float:
    return (GPU_EFFICIENCY if gpus else EFFICIENCY)[work]


def _memory(weights: float, others: float, gpus: int) -> float:
    """Of a process, by the bytes of its weights and of all else that lies where they do."""
    return PROCESS_BYTES + weights + (0 if gpus else others)


def num_gpus(device: str) -> int:
    """GPUs of this machine, 0 where the CPU is asked for."""
    import torch

    return torch.cuda.device_count() if device != "cpu" and torch.cuda.is_available() else 0


def _options(choice: Any) -> Any:
    return plugins.load_options(choice).options if isinstance(choice, Choice) else None


@functools.cache
def operations_a_second(precision: str, side: int | None = None, rounds: int = 3) -> float:
    """Of a product of two matrices [side, side], the fastest of a few, on the GPU if there is one."""
    import torch

    device = torch.device("cuda" if num_gpus("auto") else "cpu")
    side = side or {"cuda": 8192, "cpu": 2048}[device.type]
    matrix = torch.ones(side, side, dtype=getattr(torch, precision), device=device)
    best = math.inf
    with few_threads():
        use_cores_for(sys.maxsize)  # as large networks do
        for _ in range(rounds + 1):
            started = time.perf_counter()
            product = matrix @ matrix
            float(product[0, 0])  # waits for a GPU
            best = min(best, time.perf_counter() - started)
    return 2 * side**3 / best
