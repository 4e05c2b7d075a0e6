"""How soon fine-tuning reaches the validation loss that diffusers' example loops end with, on the same frames.

    python benchmarks/time_to_loss.py                             # both routes, about an hour of one core
    python benchmarks/time_to_loss.py --routes text --steps 400   # a shorter example

Frames are those of the presets `pose` (route controlnet) and `objects` (route text). Every seventh recording is held
back for the loss, which is the plain denoising loss of both loops, at the same noise and time steps. The example
(`diffusers_loop.py`) is trained for `--steps` batches at the learning rate that its documentation names, 1e-5, and,
since that alone would flatter us, at three others, of which the best counts. Ours are runs of growing length with the
options of the preset; the shortest that ends below the example counts, since the learning rate falls towards a run's
end. Then single options are changed, most of them to what the example does.

Times are CPU seconds of one thread, with latents and embeddings, without validation; set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from diffusers_loop import ExampleLoop
from interleaved import describe_machine, say_met
from many_samples import run_stage

from ctlev_core.diffusion.denoising import Denoiser, generator_for, noise_schedule, validation_losses
from ctlev_core.diffusion.pretrained.loading import PretrainedModel, control_input, load_base_model
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL, BUNDLED_OBJECT_MODEL
from ctlev_core.diffusion.training import finetuning
from ctlev_core.diffusion.training.latent_cache import cache_latents
from ctlev_core.diffusion.training.options import FineTuningOptions
from data_contracts.experiment import Experiment
from data_contracts.image_rows import Images
from data_contracts.labels import Conditions
from data_contracts.manifest import conditions_of, matching_rows, read_manifest
from flows.command_line import load_experiment
from tasks.condition import condition_frames
from tasks.encode import encode
from tasks.ingest import ingest

Route = Literal["controlnet", "text"]
PRESETS: Mapping[Route, tuple[str, list[str]]] = {
    "controlnet": ("pose", ["dataset.options.num_test_recordings=1", "dataset.options.num_condition_recordings=1"]),
    "text": ("objects", ["dataset.options.num_test_per_class=1"]),
}
WANTED = 3.0
HELD_BACK = 7
"""Every so many-th recording."""
RATES = (1e-5, 1e-4, 3e-4, 1e-3)
"""Of the example; the first is the documented one."""
BATCH_SIZE = 8
BUDGETS = (25, 50, 100, 200, 400, 800, 1600, 3200)
CHANGED: Mapping[str, dict[str, Any]] = {
    "rate 1e-3": {"learning_rate": 1e-3},
    "AdamW, rate 1e-3": {"optimizer": "adamw", "learning_rate": 1e-3},
    "float32": {"precision": "float32"},
    "batches of 8, twice as many": {"batch_size": 8},
    "constant rate": {"final_learning_rate": 1.0},
    "no averaged weights": {"ema_decay": 0.0},
    "plain loss weights": {"max_loss_weight": 1.0},
}


@dataclass(frozen=True, eq=False)
class Rows:
    """Frames with their conditions."""

    frames: Images
    conditions: Conditions


@dataclass(frozen=True)
class Run:
    """What a training came to."""

    name: str
    steps: int
    seconds: float
    loss: float

    def __str__(self) -> str:
        return f"  {self.name:44}{self.steps:7,}{self.seconds:10.1f}{self.loss:11.5f}"


def main() -> None:
    """Print a table for each route."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--routes", nargs="+", default=["controlnet", "text"], choices=list(PRESETS))
    parser.add_argument("--steps", type=int, default=1000, help="of the example")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    print(describe_machine(torch.device("cpu")))
    missed: list[str] = []
    for route in chosen.routes:
        with tempfile.TemporaryDirectory() as folder:
            os.environ["CTLEV_HOME"] = folder
            missed += compare(route, chosen.steps)
    print("\nTargets missed: " + ("; ".join(filter(None, missed)) or "none"))


def compare(route: Route, steps: int) -> list[str]:
    """One route; returns what was missed."""
    preset, changed = PRESETS[route]
    experiment = load_experiment(preset, changed)
    learnt, held_back = read_rows(experiment)
    options = FineTuningOptions.model_validate(
        {
            name: value
            for name, value in experiment.generator.options.items()
            if name in FineTuningOptions.model_fields and name != "base_model"
        }
        | {"num_validation": 0, "checkpoint_every_s": 1e9}
    )
    tune = experiment.generator.options["tune"]
    print(f"\n{route} (preset {preset}): {len(learnt.frames)} frames, {len(held_back.frames)} held back")
    print(f"  {'':44}{'steps':>7}{'CPU s':>10}{'loss':>11}", flush=True)
    untrained = loss_of(load(route), held_back)
    print(Run("base model", 0, 0.0, untrained), flush=True)
    peers = [run_example(route, learnt, held_back, rate, steps) for rate in RATES]
    best = min(peers, key=lambda run: run.loss)
    ours: list[Run] = []
    while ours[-1:] == [] or (ours[-1].loss > best.loss and ours[-1].seconds < best.seconds):
        ours.append(run_ours("ctlev", route, learnt, held_back, options, tune, BUDGETS[len(ours)]))
    for name, update in CHANGED.items():
        changed_options = FineTuningOptions.model_validate(options.model_dump() | update)
        factor = options.batch_size // changed_options.batch_size
        run_ours(f"  {name}", route, learnt, held_back, changed_options, tune, factor * ours[-1].steps)
    if tune == "both":
        run_ours("  the ControlNet alone", route, learnt, held_back, options, "controlnet", ours[-1].steps)
    return [judge(route, "as documented", peers[0], ours), judge(route, "at its best rate", best, ours)]


def judge(route: Route, kind: str, peer: Run, ours: list[Run]) -> str:
    """How many times sooner the shortest of our runs is below the example."""
    below = [run.seconds for run in ours if run.loss <= peer.loss]
    told = f"{peer.seconds / min(below):.1f} x sooner" if below else "not below"
    is_met = bool(below) and peer.seconds / min(below) >= WANTED
    print(f"  {route}, the example {kind}: {told}, wanted {WANTED:g} x: {say_met(is_met)}")
    return "" if is_met else f"{route}, {kind}: {told}, wanted {WANTED:g} x"


def read_rows(experiment: Experiment) -> tuple[Rows, Rows]:
    """Training frames of a preset: those to learn from, and those of the recordings that are held back."""
    recordings = run_stage(ingest, dataset=experiment.dataset)
    encoded = run_stage(
        encode, recordings=recordings, encoding=experiment.encoding, windows=experiment.windows, held_out=None
    )
    conditions = run_stage(
        condition_frames,
        recordings=recordings,
        frames=encoded,
        condition=experiment.condition,
        encoding=experiment.encoding,
        seed=experiment.seed,
        part=None,
    )
    frames, conditions = read_manifest(encoded), read_manifest(conditions)
    rows = matching_rows(frames, conditions)
    images, asked = frames.images(rows), conditions_of(conditions)
    names = np.array(frames.column("recording_id"))[rows]
    is_held_back = np.isin(names, sorted(set(names))[::HELD_BACK])
    return choose(images, asked, np.flatnonzero(~is_held_back)), choose(images, asked, np.flatnonzero(is_held_back))


def choose(images: Images, asked: Conditions, rows: np.ndarray) -> Rows:
    """Some rows, in memory."""
    taken = asked.take(rows)
    shown = None if taken.images is None else np.asarray(taken.images)
    return Rows(np.asarray(images[rows]), replace(taken, images=shown))


def load(route: Route) -> PretrainedModel:
    """The base model of the route, anew."""
    place = BUNDLED_BASE_MODEL if route == "controlnet" else BUNDLED_OBJECT_MODEL
    return load_base_model(place, with_controlnet=route == "controlnet")


def loss_of(model: PretrainedModel, rows: Rows) -> float:
    """The plain denoising loss of these rows, always at the same latents, noise and time steps."""
    encoders = load("controlnet" if model.controlnet is not None else "text")
    batch = cache_latents(encoders, rows.frames, rows.conditions).batch(
        np.arange(len(rows.frames)), generator_for(0, 1), 0.0, torch.device("cpu")
    )
    if batch.conditions is not None:
        batch = type(batch)(batch.latents, batch.embeddings, control_input(encoders, batch.conditions))
    networks = [network for network in (model.unet, model.controlnet) if network is not None]
    modes = [network.training for network in networks]
    for network in networks:
        network.eval()
    schedule = noise_schedule(model.scheduler_config)
    losses = [
        validation_losses(Denoiser(model.unet, model.controlnet), schedule, batch, seed=seed, batch_size=64)[0]
        for seed in range(4)
    ]
    for network, mode in zip(networks, modes, strict=True):
        network.train(mode)
    return float(np.mean(losses))


def run_example(route: Route, learnt: Rows, held_back: Rows, rate: float, steps: int) -> Run:
    """The example at one learning rate, its lowest loss at any quarter of the way."""
    model = load(route)
    start = time.process_time()
    loop = ExampleLoop(model, learnt.frames, learnt.conditions, batch_size=BATCH_SIZE, learning_rate=rate)
    seconds = time.process_time() - start
    runs = []
    for quarter in range(1, 5):
        start = time.process_time()
        loop.run(steps // 4)
        seconds += time.process_time() - start
        loss = loss_of(model, held_back)
        runs.append(Run(f"diffusers' example, rate {rate:g}", quarter * (steps // 4), seconds, loss))
    best = min(runs, key=lambda run: run.loss)
    print(best, flush=True)
    return best


def run_ours(
    name: str, route: Route, learnt: Rows, held_back: Rows, options: FineTuningOptions, tune: Any, steps: int
) -> Run:
    """Our fine-tuning for so many steps, from the base model to the weights that it ends with."""
    model = load(route)
    changed = options.model_copy(update={"num_steps": steps, "warmup_steps": min(options.warmup_steps, steps // 4)})
    with tempfile.TemporaryDirectory() as work:
        start = time.process_time()
        finetuning.fine_tune(
            model,
            learnt.frames,
            learnt.conditions,
            changed,
            tune=tune,
            seed=0,
            work=Path(work),
            class_names=learnt.conditions.class_names,
        )
        seconds = time.process_time() - start
    run = Run(name, steps, seconds, loss_of(model, held_back))
    print(run, flush=True)
    return run


if __name__ == "__main__":
    main()
