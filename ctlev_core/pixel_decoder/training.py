"""Train a pixel decoder on recorded frames, beside what the generator makes of them when they are noised and denoised.

Everything random is a function of (seed, step), so that a run that is killed and resumed ends in the same weights.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ctlev_core import plugins
from ctlev_core.cpu_precision import computed_in
from ctlev_core.determinism import deterministic
from ctlev_core.diffusion.pretrained.loading import choose_device
from ctlev_core.diffusion.training.loop import sample_rows
from ctlev_core.diffusion.training.options import TrainingOptions
from ctlev_core.diffusion.training.trainer import Trainer
from ctlev_core.pixel_decoder.drawing import as_input, condition_planes, image_planes
from ctlev_core.pixel_decoder.network import TRAINED_NOISE, TRAINED_SPREAD, PixelNetwork
from ctlev_core.pixel_decoder.options import PixelDecoderOptions
from ctlev_core.pixel_decoder.value_classes import ValueClasses, fit_classes
from ctlev_core.plugin_contracts import ConditionThatTurns
from ctlev_core.progress import ProgressBar
from data_contracts.config import ConditionChoice
from data_contracts.errors import TrainingError
from data_contracts.image_rows import Images, as_image_rows
from data_contracts.labels import History

logger = logging.getLogger(__name__)

FEW_FRAMES = 50
MAX_VALIDATION = 64
"""Frames held back for the validation curve, a tenth of all at most."""
HIDDEN_PREVIOUS = 0.1
"""Share of the frames whose previous one is not shown: the first of a stretch has none."""
_ORDER_STREAM, _CROP_STREAM, _NOISE_STREAM, _WEIGHT_STREAM, _SPLIT_STREAM = 1, 2, 3, 4, 5


class Places(NamedTuple):
    """Where, among the rows of values [M, P, H, W], those of N frames lie.

    Attributes:
        own: [N] rows.
        previous: [N] rows of the frame before each; -1 where it is not known.
    """

    own: np.ndarray
    previous: np.ndarray


class Crops(NamedTuple):
    """What a step learns from.

    Attributes:
        values: [B, P, h, w].
        images: [B, P, h, w] in [-1, 1].
        conditions: [B, 3, h, w] in [0, 1], or None.
        previous: [B, P, h, w] int64 values of the frame before, -1 where it is not shown; None = it never is.
    """

    values: np.ndarray
    images: Tensor
    conditions: Tensor | None
    previous: np.ndarray | None


class TrainingPairs:
    """Recorded pixel values, and for each the images that the generator makes of the frame.

    Args:
        values: [N, P, H, W] uint8 or uint16, such as counts by polarity.
        images: one or more [N, H, W, 3] uint8, such as of several noise levels.
        conditions: [N, H, W, 3] uint8, or None.
        places: where values of frames lie, of a decoder that sees the frame before; None = values are [N, P, H, W].
        made_by: the plug-in of the conditions, where known: colours that are directions turn with the image, and are
            not mirrored.
    Raises:
        ValueError: numbers or sizes differ.
    """

    def __init__(
        self,
        values: Images,
        images: Sequence[Images],
        conditions: Images | None,
        places: Places | None = None,
        made_by: ConditionChoice | None = None,
    ) -> None:
        shape = (len(values) if places is None else len(places.own), *values.shape[2:], 3)
        given = [*images, *([] if conditions is None else [conditions])]
        if not images or not len(values) or any(tuple(each.shape) != shape for each in given):
            raise ValueError(f"expected images and conditions of shape {shape}, got {[each.shape for each in given]}")
        self.values, self.images, self.conditions, self.places = values, images, conditions, places
        plugin = None if made_by is None or conditions is None else plugins.load_options(made_by)
        self._turning = plugin if plugin is not None and isinstance(plugin.module, ConditionThatTurns) else None

    def __len__(self) -> int:
        return len(self.images[0])

    def digest(self) -> str:
        """Of the pixels, and of what is the frame before what."""
        arrays = [self.values, *self.images, *([] if self.conditions is None else [self.conditions])]
        told = [as_image_rows(array).digest() for array in arrays]
        if self.places is not None:
            told.append(hashlib.sha256(np.stack(self.places).astype(np.int64).tobytes()).hexdigest())
        if self._turning is not None:
            told.append(self._turning.name)
        return " ".join(told)

    def crops(self, rows: np.ndarray, crop_px: int, num_planes: int, rng: np.random.Generator) -> Crops:
        """Square crops, turned and mirrored, all of a frame together; which of the images of a frame is drawn."""
        values, images, conditions, previous = [], [], [], []
        height, width = self.values.shape[2:]
        side = min(crop_px, height, width) // 2 * 2
        for row in rows.tolist():
            top, left = (int(rng.integers(0, length - side + 1)) for length in (height, width))
            turns, mirrored = int(rng.integers(4)), bool(rng.integers(2)) and self._turning is None
            chosen = self.images[int(rng.integers(len(self.images)))]
            window = (slice(None), slice(top, top + side), slice(left, left + side))

            def moved(planes: np.ndarray, window=window, turns=turns, mirrored=mirrored) -> np.ndarray:
                planes = np.rot90(planes[0][window], turns, axes=(1, 2))
                return planes[..., ::-1] if mirrored else planes

            def values_of(row: int, moved=moved) -> np.ndarray:
                return moved(np.asarray(self.values[row : row + 1]))

            one = slice(row, row + 1)
            values.append(values_of(row if self.places is None else int(self.places.own[row])))
            images.append(moved(image_planes(np.asarray(chosen[one]), num_planes)))
            if self.conditions is not None:
                shown = np.asarray(self.conditions[one])
                if self._turning is None:
                    conditions.append(moved(condition_planes(shown)))
                else:
                    part = shown[:, window[1], window[2]]
                    turned = self._turning.module.turn(part, np.array([turns]), self._turning.options)
                    conditions.append(condition_planes(turned)[0])
            if self.places is not None:
                before = int(self.places.previous[row])
                hidden = before < 0 or rng.random() < HIDDEN_PREVIOUS
                previous.append(np.full(values[-1].shape, -1) if hidden else values_of(before).astype(np.int64))
        return Crops(
            np.stack(values),
            as_input(np.stack(images)),
            None if self.conditions is None else torch.from_numpy(np.stack(conditions)),
            None if self.places is None else np.stack(previous),
        )


def build_network(
    classes: ValueClasses, num_planes: int, conditioned: bool, width: int, depth: int, sees_previous: bool = False
) -> PixelNetwork:
    """A network with weights from torch's random stream."""
    embeddings = torch.from_numpy(classes.embeddings)
    return PixelNetwork(embeddings, num_planes, 3 if conditioned else 0, width, depth, sees_previous).to(
        memory_format=torch.channels_last  # pyright: ignore[reportCallIssue]
    )


def train_pixel_decoder(
    pairs: TrainingPairs, options: PixelDecoderOptions, *, seed: int, work: Path
) -> tuple[PixelNetwork, ValueClasses, History]:
    """Train the network; its weights are moving averages.

    Args:
        pairs: of training frames.
        options: length, rates, size.
        seed: of weights, order, crops and noise.
        work: folder of the resumable state.
    Returns:
        Network, classes and loss curves: the cross-entropy of the class of a pixel and plane, in nats.
    Raises:
        DataError: training frames have no events.
        TrainingError: losses or gradients stayed not finite.
    """
    if len(pairs) < FEW_FRAMES:
        logger.warning(
            "the pixel decoder learns from %d frames; fewer than %d are soon learnt by heart: compare the training and "
            "validation losses, or lower pixel_decoder.num_steps",
            len(pairs),
            FEW_FRAMES,
        )
    device, state = choose_device(options.device), work / "state.pt"
    classes, num_planes = fit_classes(pairs.values), pairs.values.shape[1]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(np.random.SeedSequence([seed, _WEIGHT_STREAM]).generate_state(1)[0]))
        network = build_network(
            classes,
            num_planes,
            pairs.conditions is not None,
            options.width,
            options.depth,
            sees_previous=pairs.places is not None,
        )
    network = network.to(device)
    learning = TrainingOptions(
        num_steps=options.num_steps,
        batch_size=options.batch_size,
        learning_rate=options.learning_rate,
        weight_decay=0.1,
        ema_decay=0.99,
        precision=options.precision,
        log_every=options.log_every,
    )
    material = [options.model_dump(mode="json", exclude={"device", "checkpoint_every_s"}), seed, pairs.digest()]
    trainer = Trainer(list(network.parameters()), learning, json.dumps(material), "muon")
    if state.is_file():
        trainer.restore(state)
    order = np.random.default_rng([seed, _SPLIT_STREAM]).permutation(len(pairs))
    held_back, learnt = np.split(order, [min(MAX_VALIDATION, len(pairs) // 10)])
    step = _Step(network, classes, pairs, options, seed, device)
    saved = time.monotonic()
    bar = ProgressBar(total=options.num_steps, initial=trainer.step, desc="pixel decoder", unit="step")
    with bar, deterministic(device):
        while trainer.step < options.num_steps:
            rows = learnt[sample_rows(seed, trainer.step, options.batch_size, len(learnt))]
            trainer.optimizer.zero_grad(set_to_none=True)
            loss = step.loss(rows, trainer.step)
            loss.backward()
            if math.isfinite(loss.item()) and trainer.update(trainer.step / options.num_steps):
                trainer.non_finite = 0
                trainer.losses.append(loss.item())
            else:
                trainer.count_skipped()
            trainer.step += 1
            bar.update()
            if trainer.step % options.log_every == 0:
                trainer.history.step.append(trainer.step)
                trainer.history.loss.append(float(np.mean(trainer.losses)) if trainer.losses else math.nan)
                trainer.losses = []
                bar.note(f"loss {trainer.history.loss[-1]:.4f}")
            if len(held_back) and (trainer.step % options.validation_every == 0 or trainer.step == options.num_steps):
                with trainer.using_average(), torch.no_grad():
                    found = float(step.loss(held_back, 0))
                trainer.history.validation_step.append(trainer.step)
                trainer.history.validation_loss.append(found)
            if time.monotonic() - saved > options.checkpoint_every_s:
                trainer.save(state)
                saved = time.monotonic()
    trainer.save(state)
    history = trainer.finish()
    _check_finite(network)
    return network.eval().requires_grad_(False), classes, history


class _Step:
    """The loss of some rows, with crops and noise that depend on the seed and the step alone."""

    def __init__(
        self,
        network: PixelNetwork,
        classes: ValueClasses,
        pairs: TrainingPairs,
        options: PixelDecoderOptions,
        seed: int,
        device: torch.device,
    ) -> None:
        self.network, self.classes, self.pairs = network, classes, pairs
        self.options, self.seed, self.device = options, seed, device

    def loss(self, rows: np.ndarray, number: int) -> Tensor:
        rng = np.random.default_rng([self.seed, _CROP_STREAM, number])
        crops = self.pairs.crops(rows, self.options.crop_px, self.network.num_planes, rng)
        classes, previous = torch.from_numpy(self.classes.classes_of(crops.values)).to(self.device), None
        if crops.previous is not None:
            shown = self.classes.classes_of(crops.previous.clip(min=0))
            previous = torch.from_numpy(np.where(crops.previous < 0, -1, shown)).to(self.device)
        levels = np.exp(np.log(TRAINED_NOISE) + TRAINED_SPREAD * rng.standard_normal(len(rows))).clip(0.1, 10)
        noise = torch.from_numpy(rng.standard_normal(crops.values.shape, np.float32)).to(self.device)
        level = torch.from_numpy((levels * self.classes.active_step).astype(np.float32)).to(self.device)
        noisy = self.network.embeddings[classes] + level[:, None, None, None] * noise
        enabled = computed_in(self.options.precision, self.device.type) != "float32"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=enabled):
            logits = self.network(
                noisy,
                level,
                crops.images.to(self.device),
                None if crops.conditions is None else crops.conditions.to(self.device),
                previous,
            )
        return torch.nn.functional.cross_entropy(logits.transpose(1, 2), classes)


def _check_finite(network: PixelNetwork) -> None:
    for name, value in network.state_dict().items():
        if not bool(torch.isfinite(value).all()):
            raise TrainingError(f"pixel decoder: weights {name} are not finite; lower the learning rate")
