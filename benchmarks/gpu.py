"""Training and sampling at the size of Stable Diffusion v1 on a GPU: beside diffusers, and beside the card's own limit.

    python benchmarks/gpu.py                                    # random weights, nothing is downloaded; bf16
    python benchmarks/gpu.py --device cpu --size tiny --image-size 64 --batch-size 2 --sampling-batch-size 2 \
        --rounds 1 --ddpm-steps 20

Both sides have the same networks, batch, precision and image size and take turns in one process: fine-tuning beside
the loops of diffusers' examples (`diffusers_loop.py`), sampling beside `StableDiffusionControlNetPipeline` called
plainly, with the same solver and 20 steps, and with 1000 steps of DDPM, the paper's. Wall time. The card's limit is a
bf16 matrix product of 8192 x 8192, measured here; operations are counted by torch.

With the defaults, 512 px and batches of 8 for training and 32 for sampling, expect some 80 GB for the text route, whose
two loops hold weights, gradients, moments and averages of a U-Net in float32 each, and half of that for the others;
what it took is printed. A part that fails, for want of memory perhaps, is reported, and the others go on.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import gc
import statistics
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import sampling
import torch
import training
from interleaved import Comparison, describe_machine, matmul_flops, print_comparisons, print_targets
from torch.utils.flop_counter import FlopCounterMode

from ctlev_core.diffusion.denoising import Batch, Denoiser, denoising_loss, noise_schedule
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, choose_device
from ctlev_core.diffusion.pretrained.model_kinds import FLOW_SCHEDULER
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL
from ctlev_core.diffusion.pretrained.prompts import T5_TOKENS
from ctlev_core.diffusion.sampling.options import SamplingOptions
from ctlev_core.diffusion.sampling.sampling import compile_for_sampling
from ctlev_core.stand_ins.networks import Size, build_network, stable_diffusion_configs

MATMUL_SIDE = {"cuda": 8192, "cpu": 512}
STABLE_DIFFUSION_3 = {
    "patch_size": 2, "in_channels": 16, "out_channels": 16, "num_layers": 24, "attention_head_dim": 64,
    "num_attention_heads": 24, "joint_attention_dim": 4096, "caption_projection_dim": 1536,
    "pooled_projection_dim": 2048, "pos_embed_max_size": 192,
}  # fmt: skip
"""The config of Stable Diffusion 3 Medium's transformer."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the parts one after the other; exit status 1 where one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1 ..., or cpu, which makes sense with --size tiny")
    parser.add_argument("--size", choices=("full", "tiny"), default="full")
    parser.add_argument("--parts", nargs="*", default=list(PARTS), choices=tuple(PARTS))
    parser.add_argument("--precision", choices=("float32", "bfloat16"), default="bfloat16")
    parser.add_argument("--image-size", type=int, default=512, help="px, a multiple of 64")
    parser.add_argument("--batch-size", type=int, default=8, help="of training")
    parser.add_argument("--sampling-batch-size", type=int, default=32)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=4, help="of training a round")
    parser.add_argument("--inference-steps", type=int, default=20)
    parser.add_argument("--ddpm-steps", type=int, default=1000, help="of the paper's sampler")
    chosen = parser.parse_args(arguments)
    if chosen.device.startswith("cuda") and not torch.cuda.is_available():
        print("No CUDA device here: nothing was measured. `--device cpu --size tiny` runs all of it in small.")
        return
    device, dtype = choose_device(chosen.device), getattr(torch, chosen.precision)
    print(describe_machine(device))
    limit = matmul_flops(device, dtype, MATMUL_SIDE[device.type])
    print(f"a matrix product of {MATMUL_SIDE[device.type]} in {chosen.precision}: {limit / 1e12:,.3g} TFLOP/s")
    found: list[Comparison] = []
    failed = [name for name in chosen.parts if not _run_part(name, chosen, device, limit, found)]
    if found:
        print_comparisons(
            f"batches of {chosen.batch_size}, for sampling {chosen.sampling_batch_size}, {chosen.image_size} px",
            "diffusers",
            found,
        )
    print_targets(found)
    if failed:
        sys.exit(f"parts that failed: {', '.join(failed)}")


def _run_part(name: str, chosen: Any, device: torch.device, limit: float, found: list[Comparison]) -> bool:
    """Run one part and say what it took; False where it raised."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    start = time.perf_counter()
    print(f"\n== {name}", flush=True)
    try:
        PARTS[name](chosen, device, limit, found)
    except Exception:  # the other parts are still worth measuring
        traceback.print_exc()
        return False
    finally:
        gc.collect()
        peak = ""
        if device.type == "cuda":
            peak = f", {torch.cuda.max_memory_allocated(device) / 2**30:.1f} GiB at most"
            torch.cuda.empty_cache()
        print(f"  {time.perf_counter() - start:.0f} s{peak}", flush=True)
    return True


# Networks -------------------------------------------------------------------------------------------------------------


def build_base_model(
    size: Size, image_size: int, *, with_controlnet: bool, dtype: torch.dtype, device: torch.device, seed: int = 0
) -> PretrainedModel:
    """Stable Diffusion v1 by its configs, with random weights; the tokenizer, which takes no time, is the bundled one.

    Args:
        size: of the networks.
        image_size: px.
        with_controlnet: a ControlNet, too.
        dtype: of all weights.
        device: where they are made.
        seed: equal seeds give equal weights.
    """
    from transformers import CLIPTokenizer

    configs = stable_diffusion_configs(size, image_size)
    tokenizer = CLIPTokenizer.from_pretrained(str(BUNDLED_BASE_MODEL / "tokenizer"), local_files_only=True)
    tokenizer.model_max_length = configs["text_encoder"]["max_position_embeddings"]
    torch.manual_seed(seed)
    parts = ("text_encoder", "vae", "unet", *(["controlnet"] if with_controlnet else []))
    with torch.device(device):
        networks: dict[str, Any] = {part: build_network(part, configs[part]) for part in parts}
    networks.setdefault("controlnet", None)
    for network in networks.values():
        if network is not None:
            network.to(device, dtype).eval().requires_grad_(False)
    return PretrainedModel(
        tokenizer=tokenizer, scheduler_config=configs["scheduler"], image_size=(image_size, image_size), **networks
    )


def count_parameters(base_model: PretrainedModel) -> str:
    """Millions of weights, network by network."""
    counts = []
    for name in ("unet", "controlnet", "vae", "text_encoder"):
        network = getattr(base_model, name)
        if network is not None:
            counts.append(f"{name} {sum(weight.numel() for weight in network.parameters()) / 1e6:,.1f} M")
    return ", ".join(counts)


# Parts ----------------------------------------------------------------------------------------------------------------


def measure_sampling(compiled: bool, chosen: Any, device: torch.device, limit: float, found: list[Comparison]) -> None:
    """The ControlNet route with few steps; uncompiled, beside the paper's thousand, too."""
    base_model = build_base_model(
        chosen.size, chosen.image_size, with_controlnet=True, dtype=getattr(torch, chosen.precision), device=device
    )
    print(f"  {count_parameters(base_model)}")
    options = SamplingOptions(num_inference_steps=chosen.inference_steps, precision=chosen.precision)
    options = options.model_copy(update={"batch_size": chosen.sampling_batch_size})
    _, conditions = training.make_rows(base_model, chosen.sampling_batch_size, with_images=True)
    with FlopCounterMode(display=False) as counter:
        sampling.sample_ours(base_model, conditions, options)
    flops = counter.get_total_flops()
    compare = partial(sampling.compare, base_model, options, count=chosen.sampling_batch_size, rounds=chosen.rounds)
    if compiled:
        copies = {part: copy.deepcopy(getattr(base_model, part)) for part in ("unet", "controlnet")}
        ours = dataclasses.replace(base_model, **copies)
        compile_for_sampling(ours)
        of_part = compare("sampling, compile_networks=true", ours=ours, paper_steps=0)
    else:
        of_part = compare("sampling", paper_steps=chosen.ddpm_steps, in_full=True)
    found += of_part
    rate = flops / statistics.median(of_part[0].ours)
    print(f"  {flops / 1e12:.3g} TFLOP, {rate / 1e12:.3g} TFLOP/s, {rate / limit:.0%} of the matrix product")


def measure_training(
    route: training.Route,
    changed: Sequence[str],
    chosen: Any,
    device: torch.device,
    _limit: float,
    found: list[Comparison],
) -> None:
    """One route with options of ours."""
    build = partial(
        build_base_model,
        chosen.size,
        chosen.image_size,
        with_controlnet=route == "controlnet",
        dtype=torch.float32,
        device=device,
    )
    base_model, same = build(), build()
    print(f"  {count_parameters(base_model)}")
    options = training.make_options(chosen.batch_size, chosen.precision, [f"device={chosen.device}", *changed])
    name = ", ".join([f"training, {route}", *changed])
    found.append(training.compare(base_model, same, options, route, chosen.rounds, chosen.steps, name))


def measure_transformer(chosen: Any, device: torch.device, limit: float, _found: list[Comparison]) -> None:
    """Stable Diffusion 3 Medium, random weights: gradients of a training step, and one evaluation of sampling."""
    from diffusers.models.transformers.transformer_sd3 import SD3Transformer2DModel

    side, precision = chosen.image_size // 8, getattr(torch, chosen.precision)
    small = {"num_layers": 2, "num_attention_heads": 2, "caption_projection_dim": 128} if chosen.size == "tiny" else {}
    torch.manual_seed(0)
    with torch.device(device):
        network = SD3Transformer2DModel.from_config({**STABLE_DIFFUSION_3, **small, "sample_size": side})
    schedule = noise_schedule({"_class_name": FLOW_SCHEDULER, "num_train_timesteps": 1000, "shift": 3.0})

    def batch(count: int, dtype: torch.dtype) -> Batch:
        rows = 77 + T5_TOKENS + 1
        embeddings = torch.randn((count, rows, network.config.joint_attention_dim), device=device, dtype=dtype)
        return Batch(
            torch.randn((count, network.config.in_channels, side, side), device=device, dtype=dtype), embeddings
        )

    def step(given: Batch) -> None:
        network.zero_grad(set_to_none=True)
        with torch.autocast(device.type, precision, enabled=precision != torch.float32):
            loss = denoising_loss(Denoiser(network), schedule, given, torch.Generator().manual_seed(0))
        loss.backward()

    def evaluate(given: Batch) -> None:
        times = torch.full((len(given.latents),), 500.0, device=device)
        with torch.no_grad():
            Denoiser(network).predict(given.latents, times, given.embeddings, None)

    network.train()
    for checkpointing in (False, True):
        (network.enable_gradient_checkpointing if checkpointing else network.disable_gradient_checkpointing)()
        name = "gradients, checkpointing" if checkpointing else "gradients"
        _report(name, partial(step, batch(chosen.batch_size, torch.float32)), chosen.batch_size, device, limit)
    network.zero_grad(set_to_none=True)
    network.to(precision).eval()
    count = chosen.sampling_batch_size
    _report("one evaluation", partial(evaluate, batch(count, precision)), count, device, limit)


def _report(name: str, work: Callable[[], None], count: int, device: torch.device, limit: float) -> None:
    """Time of the third run, of the operations that torch counts, and peak memory."""
    with FlopCounterMode(display=False) as counter:
        work()
    work()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
    start = time.perf_counter()
    work()
    peak = ""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        peak = f", {torch.cuda.max_memory_allocated(device) / 1e9:.1f} GB"
    seconds = time.perf_counter() - start
    rate = counter.get_total_flops() / seconds
    print(f"  {name}, batch of {count}: {1e3 * seconds:.1f} ms, {rate / limit:.0%} of the matrix product{peak}")


PARTS: dict[str, Callable[[Any, torch.device, float, list[Comparison]], None]] = {
    "sampling": partial(measure_sampling, False),
    "sampling_compiled": partial(measure_sampling, True),
    "controlnet": partial(measure_training, "controlnet", ()),
    "controlnet_compiled": partial(measure_training, "controlnet", ("compile_networks=true",)),
    "text": partial(measure_training, "text", ()),
    "text_compiled": partial(measure_training, "text", ("compile_networks=true",)),
    "transformer": measure_transformer,
}

if __name__ == "__main__":
    main()
