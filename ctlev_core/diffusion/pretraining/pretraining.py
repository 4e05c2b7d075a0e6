"""Pre-train the small base model on procedural or on a user's own pictures, and write it as a diffusers folder."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import math
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field, model_validator

from ctlev_core.diffusion.denoising import Batch, Denoiser, NoiseSchedule, validation_losses
from ctlev_core.diffusion.patch_autoencoder import PATCH_PX, PatchAutoencoder, fit_patch_autoencoder
from ctlev_core.diffusion.pretrained.loading import (
    PretrainedModel,
    conditions_to_tensor,
    images_to_tensor,
    load_base_model,
    save_base_model,
)
from ctlev_core.diffusion.pretrained.paths import BUNDLED_BASE_MODEL, find_controlnet, read_parts
from ctlev_core.diffusion.pretrained.prompts import encode_prompts
from ctlev_core.diffusion.pretraining import procedural_images
from ctlev_core.diffusion.pretraining.architecture import (
    IMAGE_SIZE,
    NORM_GROUPS,
    WIDTHS,
    PredictionType,
    build_base_model,
)
from ctlev_core.diffusion.pretraining.picture_scenes import picture_mixture, scene_of
from ctlev_core.diffusion.pretraining.picture_styles import DEFAULT_MIXTURE, DataMixture, Scene, apply_style
from ctlev_core.diffusion.training.distributed import SINGLE_PROCESS, DistributedContext
from ctlev_core.diffusion.training.launch import run_rank, train_in_processes
from ctlev_core.diffusion.training.loop import run_training, sample_rows
from ctlev_core.diffusion.training.options import TrainingOptions
from ctlev_core.diffusion.training.trainer import Trainer, TrainingHistory
from ctlev_core.pictures import labelled_pictures
from ctlev_core.pictures.labelled_pictures import PictureOptions
from ctlev_core.processes import die_with_parent
from data_contracts.config import RUN_SETTING, Frozen, cache_material
from data_contracts.errors import DataError
from data_contracts.labels import History

FIT_IMAGES = 384
VALIDATION_IMAGES = 128
VALIDATION_OFFSET = 2**31
VALIDATION_STREAM, STYLE_STREAM, PICTURE_STREAM = 1, 2, 3  # entropy that keeps the random streams apart
DrawScene = Callable[[np.random.Generator, int], Scene]

logger = logging.getLogger(__name__)


class PretrainingOptions(Frozen):
    """How the small base model is made."""

    training: TrainingOptions = Field(
        default=TrainingOptions(
            num_steps=20_000,
            ema_decay=0.999,
            warmup_steps=200,
            final_learning_rate=0.0,
            validation_every=500,
            log_every=100,
            checkpoint_every_s=120,
        ),
        description="the loop",
    )
    max_seconds: float | None = Field(
        default=None, gt=0, description="wall-clock budget; null = all steps, and only then is a run repeatable"
    )
    chunk_scenes: int = Field(default=768, gt=0, description="scenes drawn at a time by the worker process")
    chunk_passes: int = Field(
        default=3, gt=0, description="how often each scene is shown, every time in a random style"
    )
    text_dropout: float = Field(default=0.1, ge=0, le=1, description="share of empty prompts, for guidance")
    condition: procedural_images.ConditionKind = Field(
        default="skeleton", description="what the ControlNet is steered by: skeletons, or normal maps of bodies"
    )
    tune: Literal["both", "controlnet", "unet"] = Field(
        default="both",
        description="U-Net and ControlNet together, a ControlNet for the U-Net of `start` alone, or a U-Net without "
        "ControlNet",
    )
    data_mixture: DataMixture = Field(
        default=DEFAULT_MIXTURE,
        description="what procedural pictures are of",
    )
    pictures: PictureOptions = Field(
        default=PictureOptions(), description="pictures of one's own, with class names, in place of procedural ones"
    )
    condition_dropout: float = Field(default=0.2, ge=0, le=1, description="share of people without their condition")
    image_size: int = Field(default=IMAGE_SIZE, gt=0, multiple_of=16, description="px")
    widths: tuple[int, ...] = Field(default=WIDTHS, description="channels of the U-Net, from the top resolution down")
    patch_px: Literal[1, 2, 4] = Field(
        default=PATCH_PX, description="edge of the blocks of pixels that are the latents; 1 = the pixels themselves"
    )
    prediction_type: PredictionType = Field(
        default="v_prediction", description="what a U-Net that starts at random predicts; sample = the latents"
    )
    optimizer: Literal["adamw", "muon"] = Field(
        default="adamw", description="muon learns in half as many steps, each as long as eight images more"
    )
    start: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="diffusers folder of a small base model to go on from; when null random weights, or the bundled "
        "base model where the ControlNet alone is tuned",
    )
    seed: int = Field(default=0, ge=0, description="of weights, pictures, order and noise")
    workers: int = Field(
        default=1, ge=0, json_schema_extra=RUN_SETTING, description="processes that draw; 0 = in the same one"
    )
    num_processes: int = Field(
        default=1,
        gt=0,
        json_schema_extra=RUN_SETTING,
        description="processes that share the `gradient_accumulation` batches of a step evenly",
    )

    @model_validator(mode="after")
    def _check(self) -> PretrainingOptions:
        if self.num_processes > 1 and self.max_seconds is not None:
            raise ValueError("max_seconds must be null with several processes, which would not end together")
        if self.training.sample_every:
            raise ValueError("sample_every draws samples of a fine-tuning; pre-training has none, set it to 0")
        if self.pictures.root is not None and self.tune != "unet":
            raise ValueError(f"pictures of one's own have no condition images; set tune=unet, got {self.tune!r}")
        if not self.widths or any(width < 1 or width % NORM_GROUPS for width in self.widths):
            raise ValueError(f"widths must be one or more positive multiples of {NORM_GROUPS}, got {self.widths}")
        shown = self.chunk_scenes * self.chunk_passes
        if shown < self.training.batch_size:
            raise ValueError(
                f"chunk_scenes x chunk_passes must be a batch_size of {self.training.batch_size} at least, got {shown}"
            )
        DistributedContext(0, self.num_processes).batches(self.training.gradient_accumulation)
        return self


@dataclass(frozen=True, eq=False)
class Row:
    """One training picture: `condition` is None where it goes through the U-Net alone."""

    image: np.ndarray
    caption: str
    condition: np.ndarray | None


class ImageStream:
    """Micro-batches of the procedural stream; the chunks ahead are drawn in worker processes meanwhile."""

    def __init__(self, base_model: PretrainedModel, options: PretrainingOptions) -> None:
        self._base_model, self._options = base_model, options
        self._batches_per_chunk = options.chunk_scenes * options.chunk_passes // options.training.batch_size
        # Spawned, not forked: forking a process that runs torch threads can hang.
        self._pool = (
            ProcessPoolExecutor(options.workers, get_context("spawn"), die_with_parent) if options.workers else None
        )
        self._ahead: dict[int, Future] = {}
        self._chunk: tuple[int, list[Scene]] = (-1, [])

    def close(self) -> None:
        """Stop drawing."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)

    def fetch(self, number: int) -> Batch:
        """Batch `number`: people with a condition first, then everything that goes through the U-Net alone."""
        options = self._options
        chunk, position = divmod(number, self._batches_per_chunk)
        scenes = self._scenes(chunk)
        size = options.training.batch_size
        rows = sample_rows(options.seed + 1000 * (chunk + 1), position, size, len(scenes))
        rng = np.random.default_rng([options.seed, STYLE_STREAM, number])
        batch = []
        for row in rows:
            image, caption = apply_style(scenes[row], rng, mixture_of(options))
            condition = scenes[row].condition
            steered = condition is not None and rng.random() >= options.condition_dropout
            caption = "" if rng.random() < options.text_dropout else caption
            batch.append(Row(image, caption, condition if steered else None))
        return make_batch(self._base_model, batch)

    def _scenes(self, chunk: int) -> list[Scene]:
        if self._chunk[0] != chunk:
            options = self._options
            if self._pool is None:
                self._chunk = (chunk, draw_chunk(options, chunk))
            else:
                for ahead in range(chunk, chunk + 1 + options.workers):
                    if ahead not in self._ahead:
                        self._ahead[ahead] = self._pool.submit(draw_chunk, options, ahead)
                self._chunk = (chunk, self._ahead.pop(chunk).result())
        return self._chunk[1]


def draw_chunk(options: PretrainingOptions, chunk: int) -> list[Scene]:
    """The scenes of a chunk: procedural ones, or pictures of the user's, each moved about anew."""
    if options.pictures.root is None:
        return procedural_images.draw_chunk(
            options.seed, chunk, options.chunk_scenes, options.image_size, options.condition, options.data_mixture
        )
    pictures = labelled_pictures.open_pictures(options.pictures)
    learnt, _ = split_pictures(len(pictures), options.seed)
    rows = learnt[sample_rows(options.seed, chunk, options.chunk_scenes, len(learnt))]
    first = chunk * options.chunk_scenes
    streams = [np.random.default_rng([options.seed, PICTURE_STREAM, first + number]) for number in range(len(rows))]
    wanted = options.pictures, options.image_size
    return [scene_of(pictures, int(row), *wanted, rng) for row, rng in zip(rows, streams, strict=True)]


def mixture_of(options: PretrainingOptions) -> DataMixture:
    """Styles and captions: those of the user's pictures where there are any."""
    return options.data_mixture if options.pictures.root is None else picture_mixture(options.pictures)


def split_pictures(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of pictures to learn from, and of those held back for validation: a tenth, `VALIDATION_IMAGES` at most."""
    order = np.random.default_rng([seed, VALIDATION_STREAM]).permutation(count)
    held_back = min(VALIDATION_IMAGES, count // 10)
    return order[held_back:], order[:held_back]


def make_batch(base_model: PretrainedModel, rows: list[Row]) -> Batch:
    """Latents, prompt embeddings and conditions, rows with a condition first."""
    rows = sorted(rows, key=lambda row: row.condition is None)
    images = images_to_tensor(np.stack([row.image for row in rows]))
    with torch.no_grad():
        latents = base_model.vae.encode(images)[0].mode() * base_model.scaling_factor
    embeddings = encode_prompts(base_model, [row.caption for row in rows])
    conditions = [row.condition for row in rows if row.condition is not None]
    return Batch(latents, embeddings, conditions_to_tensor(np.stack(conditions)) if conditions else None)


def draw_picture_rows(options: PretrainingOptions) -> list[Row]:
    """The user's pictures that were held back, in a random style each."""
    pictures = labelled_pictures.open_pictures(options.pictures)
    rows = []
    for number, row in enumerate(split_pictures(len(pictures), options.seed)[1]):
        rng = np.random.default_rng([options.seed, VALIDATION_STREAM, VALIDATION_OFFSET + number])
        scene = scene_of(pictures, int(row), options.pictures, options.image_size, rng)
        image, caption = apply_style(scene, rng, mixture_of(options))
        rows.append(Row(image, caption, None))
    return rows


def draw_validation_rows(options: PretrainingOptions, draw: DrawScene) -> list[Row]:
    """Held-back pictures from a stream of their own, with a condition where they show a person."""
    rows = []
    for index in range(VALIDATION_IMAGES):
        rng = np.random.default_rng([options.seed, VALIDATION_STREAM, VALIDATION_OFFSET + index])
        scene = draw(rng, options.image_size)
        image, caption = apply_style(scene, rng, options.data_mixture)
        rows.append(Row(image, caption, scene.condition))
    return rows


def start_folder(options: PretrainingOptions) -> Path | None:
    """The base model that training goes on from; None = random weights."""
    return options.start or (BUNDLED_BASE_MODEL if options.tune == "controlnet" else None)


def check_start(options: PretrainingOptions) -> None:
    """Raise `DataError` where the base model to go on from is not of the shape that the options ask for."""
    start = start_folder(options)
    if start is None:
        return
    files = read_parts(start)
    unet, vae = files.parts["unet"].config, files.parts["vae"].config
    patch_px = 2 ** (len(vae["block_out_channels"]) - 1)
    found = {
        "image_size": unet["sample_size"] * patch_px,
        "widths": tuple(unet["block_out_channels"]),
        "patch_px": patch_px,
        "prediction_type": files.scheduler_config.get("prediction_type", "epsilon"),
    }
    # What is left at its default is not asked for; but pictures are drawn in the size that the options say.
    for name in (options.model_fields_set | {"image_size"}) & found.keys():
        if getattr(options, name) != found[name]:
            raise DataError(f"{name}: {start} has {found[name]}, got {getattr(options, name)}")
    if options.tune != "unet" and find_controlnet(start, None) is None:
        raise DataError(f"tune={options.tune}: {start} has no subfolder 'controlnet'; set tune=unet")


def new_base_model(options: PretrainingOptions) -> PretrainedModel:
    """The base model before training: fitted patch code, trained tokenizer and random networks, or those of `start`."""
    start = start_folder(options)
    if start is not None:
        return load_base_model(start, with_controlnet=options.tune != "unet")
    rng = np.random.default_rng([options.seed, STYLE_STREAM])
    corpus = procedural_images.caption_corpus()
    if options.pictures.root is None:
        scenes = procedural_images.draw_chunk(options.seed, 0, FIT_IMAGES, options.image_size)
        images = np.stack([apply_style(scene, rng)[0] for scene in scenes])
    else:
        scenes = draw_chunk(options.model_copy(update={"chunk_scenes": FIT_IMAGES}), 0)
        images = np.stack([apply_style(scene, rng, mixture_of(options))[0] for scene in scenes])
        classes = labelled_pictures.open_pictures(options.pictures).classes
        # Often enough that every name becomes a word of its own.
        corpus = corpus + 40 * [name.replace("_", " ") for name in classes] + 40 * _synonyms(options)
    vae: PatchAutoencoder = fit_patch_autoencoder(images_to_tensor(images), options.patch_px)
    base_model = build_base_model(
        corpus,
        vae,
        seed=options.seed,
        widths=options.widths,
        image_size=options.image_size,
        prediction_type=options.prediction_type,
    )
    return dataclasses.replace(base_model, controlnet=None) if options.tune == "unet" else base_model


def _synonyms(options: PretrainingOptions) -> list[str]:
    return [name for names in options.pictures.synonyms.values() for name in names]


def prepare(options: PretrainingOptions) -> tuple[PretrainedModel, Trainer]:
    """The untrained base model and the trainer of what learns; patch code and text encoder stay as they are."""
    base_model = new_base_model(options)
    learning = {
        "both": (base_model.unet, base_model.controlnet),
        "controlnet": (base_model.controlnet,),
        "unet": (base_model.unet,),
    }
    parameters = []
    for model in learning[options.tune]:
        if model is not None:
            parameters += list(model.train().requires_grad_(True).parameters())
    identity = hashlib.sha256(json.dumps(cache_material(options), sort_keys=True).encode()).hexdigest()
    return base_model, Trainer(parameters, options.training, identity, options.optimizer)


def pretrain(options: PretrainingOptions, out: Path, work: Path) -> History:
    """Pre-train the networks; write the averaged weights, in half precision, to `out`.

    Args:
        options: size, length and mixture; `num_processes` changes nothing but the order of sums.
        out: becomes a diffusers folder.
        work: resumable state; a killed run goes on from there.
    Returns:
        Loss curves; the validation losses are of people with their own and with somebody else's condition, or, where
        no ControlNet learns, of objects with their own and with another's caption. Both pairs are logged: both gaps
        must grow, or the base model does not heed what it is asked for.
    Raises:
        TrainingError: the loss stayed not finite, or one of several processes failed.
        DataError: as `check_start`.
    """
    check_start(options)
    if options.num_processes == 1:
        return _pretrain(options, out, work, SINGLE_PROCESS)
    job = {"device": "cpu", "options": options.model_dump(mode="json"), "out": str(out), "work": str(work)}
    return train_in_processes(options.num_processes, __name__, work / "job", job)


def _pretrain(options: PretrainingOptions, out: Path, work: Path, distributed: DistributedContext) -> TrainingHistory:
    base_model, trainer = prepare(options)
    denoiser = Denoiser(base_model.unet, base_model.controlnet)
    schedule = NoiseSchedule(base_model.scheduler_config)
    if options.pictures.root is None:
        draw_thing = partial(procedural_images.draw_thing, data_mixture=options.data_mixture)
        captioned = draw_validation_rows(options, draw_thing)
    else:
        captioned = draw_picture_rows(options)
    validation = {"own caption": make_batch(base_model, captioned)}
    if base_model.controlnet is not None:
        draw_person = partial(procedural_images.draw_person, condition=options.condition)
        people = make_batch(base_model, draw_validation_rows(options, draw_person))
        validation = {"own condition": people, **validation}
    stream = ImageStream(base_model, options)

    def validate() -> tuple[float, float]:
        losses = {
            name: validation_losses(denoiser, schedule, batch, seed=options.seed, batch_size=32)
            for name, batch in validation.items()
        }
        images = trainer.step * options.training.batch_size * options.training.gradient_accumulation
        speed = images / max(trainer.seconds, 1e-9)
        loss = trainer.history.loss[-1] if trainer.history.loss else math.nan
        told = "; ".join(f"{name} {true:.4f}, another's {shuffled:.4f}" for name, (true, shuffled) in losses.items())
        logger.info(
            "step %d, %.0f s, %.1f img/s, loss %.4f, validation: %s", trainer.step, trainer.seconds, speed, loss, told
        )
        return next(iter(losses.values()))

    try:
        history = run_training(
            trainer,
            denoiser,
            schedule,
            stream.fetch,
            seed=options.seed,
            work=work,
            validate=validate,
            max_seconds=options.max_seconds or math.inf,
            description="pre-training",
            distributed=distributed,
        )
    finally:
        stream.close()
    if distributed.rank == 0:
        save_base_model(base_model, out, torch.float16)
    return history


def _pretrain_rank(
    job: dict[str, Any], folder: Path, distributed: DistributedContext, device: torch.device
) -> TrainingHistory:
    return _pretrain(PretrainingOptions(**job["options"]), Path(job["out"]), Path(job["work"]), distributed)


if __name__ == "__main__":
    run_rank(_pretrain_rank)
