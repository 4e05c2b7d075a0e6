"""2D human pose from event images: DHP19's heatmap network, which sees one, or several with `sequence_length`.

Source: Calabrese et al., DHP19, CVPR Workshops 2019 (network, targets, mean square loss, argmax decoding). The
defaults are DHP19's. Batch normalisation, the cross-entropy loss and sub-pixel decoding are ours and train far faster
from scratch; AdamW takes the place of RMSprop, and targets sit at the joint rather than at its pixel.

With `sequence_length` a convolutional gated recurrent unit (Ballas et al., ICLR 2016) lies where the feature maps are
smallest. Sequences are what `smpl_regressor` makes of frames: in training every frame is the last of one, and the loss
is the mean over all frames of the sequences; in prediction every frame is again the last of its own sequence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.supervised.augmentation import draw_flips, draw_shifts
from ctlev_core.supervised.frame_sequences import ages_in, find_sequences, find_training_sequences
from ctlev_core.supervised.image_shifts import shift_images
from ctlev_core.supervised.options import SequenceOptions
from data_contracts.config import RUN_SETTING, cache_material
from data_contracts.errors import DataError
from data_contracts.image_rows import Images
from data_contracts.labels import History, Labels, check_labels

if TYPE_CHECKING:
    import torch

VERSION = 1
NAME = "pose2d"
PREDICTS = ("joints2d",)


class Options(SequenceOptions):
    """Network, loss, decoding and training budget."""

    width: float = Field(default=1.0, gt=0, description="factor on the channel counts; 1 = DHP19, 218,592 parameters")
    weights: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="DHP19's published network (DHP_CNN.model, a Keras file) to start from; null = random weights",
    )
    batch_norm: bool = Field(default=False, description="normalise after each convolution; DHP19 does not")
    output_stride: Literal[1, 2] = Field(
        default=1, description="2 = heatmaps of half the size, about 40 % faster; DHP19: 1"
    )
    loss: Literal["mse", "cross_entropy"] = Field(
        default="mse",
        description="mse against a Gaussian of height 1 (DHP19), or cross-entropy of a softmax over all pixels "
        "against a Gaussian of sum 1",
    )
    sigma_px: float = Field(
        default=4.0, gt=0, description="standard deviation of the target, image px; DHP19: 4 at 344 x 260"
    )
    decoding: Literal["argmax", "soft_argmax", "mean"] = Field(
        default="argmax",
        description="centre of the highest pixel (DHP19), centroid of the heatmap around it, or centroid of all of it",
    )
    num_steps: int = Field(default=20_000, ge=1, description="optimiser steps; the paper does not state them")
    flip: bool = Field(
        default=False, description="mirror half of the training images, with left and right joints exchanged"
    )
    shift_px: int = Field(
        default=0, ge=0, description="move training images by up to so many px in x and y; black moves in"
    )


def input_files(options: Options) -> list[Path]:
    """The published weights to start from, if any.

    Raises:
        DataError: the file is missing, or the options are not those of the published network.
    """
    if options.weights is None:
        return []
    got = options.width, options.batch_norm, options.output_stride
    if got != (1.0, False, 1):
        raise DataError(
            f"{options.weights}: DHP19's weights need width 1, batch_norm false and output_stride 1, got {got[0]:g}, "
            f"{str(got[1]).lower()} and {got[2]}"
        )
    if not options.weights.is_file():
        raise DataError(f"weights {options.weights}: expected a Keras file, found none")
    return [options.weights]


def train(
    frames: Images,
    labels: Labels,
    options: Options,
    *,
    seed: int,
    out: Path,
    work: Path,
    parts: Sequence[int] = (),
    groups: Sequence[str] = (),
) -> History:
    """`train_sequences` on frames that follow from no others: each is a recording of its own."""
    return train_sequences(
        frames, labels, options, seed=seed, out=out, work=work, parts=parts, groups=groups, recordings=()
    )


def train_sequences(
    frames: Images,
    labels: Labels,
    options: Options,
    *,
    seed: int,
    out: Path,
    work: Path,
    parts: Sequence[int],
    groups: Sequence[str],
    recordings: Sequence[str],
) -> History:
    """Train on labelled frames and write `model.safetensors` and `config.json` to `out`.

    Args:
        frames: [N, H, W, 3] uint8, those of a recording in time order; the network sees the largest of the three
            channels.
        labels: N rows with `joints2d` in image px; joints that are not visible or outside the image carry no loss.
        options: see `Options`.
        seed: of the initial weights, the order of the samples and the augmentation.
        out: model folder.
        work: folder of the resumable state.
        parts: rows of each training set, in order; empty = one set.
        groups: N subjects or recordings, held back whole for validation; empty = the recordings.
        recordings: N names; no sequence crosses from one recording, group or training set to the next. Empty = each
            frame is a recording of its own.
    Returns:
        The training loss per logged step, and the loss of rows held back.
    Raises:
        DataError: shapes disagree, no joint of any row is visible inside the image, or the weights do not fit.
        ValueError: `parts`, `groups` or `recordings` do not fit the number of rows.
    """
    from ctlev_core.networks.dhp19 import load_published
    from ctlev_core.supervised import models
    from ctlev_core.supervised.batches import plan_rows
    from ctlev_core.supervised.loop import train_model

    joints2d, visible = _check_training_set(frames, labels, options)
    weights = models.file_digests(input_files(options))
    rows = plan_rows(len(frames), options, seed=seed, parts=parts, groups=groups or recordings)
    sequences = find_training_sequences(
        len(frames), options.sequence_length, recordings=recordings, groups=groups, parts=parts
    )
    device = models.resolve_device(options.device)
    model: Any = models.build_seeded(lambda: _build(joints2d.shape[1], options), seed)
    if options.weights:
        load_published(model, options.weights)
    model.to(device)
    mirror = JOINT_SETS[labels.joint_set].mirror if options.flip else None

    def compute_loss(rows: np.ndarray, generator: np.random.Generator | None) -> torch.Tensor:
        import torch

        chosen, lengths = sequences.ending_at(rows, single=len(rows) > options.batch_size)
        images, points, seen = _grey(frames[chosen]), joints2d[chosen], visible[chosen]
        if generator is not None:
            sequence = np.repeat(np.arange(len(rows)), lengths)
            images, points = _shift(images, points, options.shift_px, sequence, generator)
            if mirror is not None:
                images, points, seen = _flip_half(images, points, seen, mirror, sequence, generator)
        inside = seen & _inside(points, frames.shape[1:3])
        with models.mixed_precision(options, device):
            heatmaps = model(_to_input(torch.from_numpy(images).to(device)), torch.from_numpy(ages_in(lengths)))
        points_tensor = torch.from_numpy(np.where(inside[..., None], points, 0).astype(np.float32)).to(device)
        return _heatmap_loss(heatmaps.float(), points_tensor, torch.from_numpy(inside).to(device), options)

    identity = [NAME, VERSION, cache_material(options), weights, seed, frames, joints2d, visible]
    if options.sequence_length > 1:
        identity.append(sequences.starts)
    history, record = train_model(
        model,
        compute_loss,
        rows,
        options,
        seed=seed,
        work=work,
        run_digest=models.digest(*identity),
        description="train pose2d",
    )
    models.write_model(
        out,
        model,
        {
            "model": NAME,
            "version": VERSION,
            "joint_set": labels.joint_set,
            "num_joints": joints2d.shape[1],
            "options": cache_material(options),
            "weights": weights,
            "training": record,
        },
    )
    return history


def predict(model: Path, frames: Images) -> Mapping[str, np.ndarray]:
    """`predict_sequences` of frames that follow from no others: each is a recording of its own."""
    return predict_sequences(model, frames, ())


def predict_sequences(model: Path, frames: Images, recordings: Sequence[str]) -> Mapping[str, np.ndarray]:
    """Joints of each frame, from it and, with `sequence_length`, the frames of its recording just before it.

    Args:
        model: folder written by `train`.
        frames: [N, H, W, 3] uint8, of the scale the model was trained on, those of a recording in time order.
        recordings: N names; empty = each frame is a recording of its own.
    Returns:
        `joints2d` [N, J, 2] float32, px, pixel centres at integer + 0.5, and `confidence` [N, J] float32, the highest
        value of the heatmap (of its softmax with the cross-entropy loss).
    Raises:
        DataError: the folder has no such model, or frames are no images.
        ValueError: `recordings` do not fit the number of frames.
    """
    import torch

    from ctlev_core.supervised import models

    models.check_frames(frames, "predict pose2d")
    config = models.read_config(model, NAME)
    options = Options(**config["options"])
    network = _build(config["num_joints"], options)
    models.read_weights(model, network)
    network.to(models.resolve_device("auto"))
    sequences = find_sequences(len(frames), options.sequence_length, recordings)

    def joints(rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        chosen, lengths = (torch.from_numpy(array) for array in sequences.ending_at(rows.cpu().numpy()))
        # Sequences of rows that follow one another overlap: their frames are one stretch.
        start, stop = int(chosen.min()), int(chosen.max()) + 1
        images = torch.from_numpy(frames[start:stop]).to(rows.device)
        features = network.features(_to_input(images.amax(dim=-1)))
        firsts = rows.cpu() - lengths + 1 - start
        return _decode(network.heatmaps(network.over_time(features, firsts, lengths), frames.shape[1:3]), options)

    batches = models.predict_in_batches(network, joints, np.arange(len(frames)))
    joints2d = [points.cpu().numpy() for points, _ in batches] or [np.zeros((0, config["num_joints"], 2), np.float32)]
    confidence = [values.cpu().numpy() for _, values in batches] or [np.zeros((0, config["num_joints"]), np.float32)]
    return {"joints2d": np.concatenate(joints2d), "confidence": np.concatenate(confidence)}


def _check_training_set(frames: Images, labels: Labels, options: Options) -> tuple[np.ndarray, np.ndarray]:
    from ctlev_core.supervised.models import check_frames

    where = "train pose2d"
    check_frames(frames, where)
    check_labels(labels, where)
    if labels.joints2d is None or labels.visible is None:
        raise DataError(f"{where}: the labels have no joints2d")
    if len(labels) != len(frames):
        raise DataError(f"{where}: {len(frames)} frames but {len(labels)} labels")
    if options.flip and labels.joint_set not in JOINT_SETS:
        raise DataError(f"{where}: flip needs a joint set of {', '.join(JOINT_SETS)}, got {labels.joint_set!r}")
    usable = labels.visible & _inside(labels.joints2d, frames.shape[1:3])
    if not usable.any():
        raise DataError(f"{where}: no joint of any of the {len(labels)} rows is visible inside the image")
    return labels.joints2d, labels.visible


def _build(num_joints: int, options: Options) -> Any:
    from ctlev_core.networks.dhp19 import DHP19Network

    recurrent = options.sequence_length > 1
    return DHP19Network(num_joints, options.width, options.batch_norm, options.output_stride, recurrent)


def _grey(frames: np.ndarray) -> np.ndarray:
    """[N, H, W, 3] -> [N, H, W]: the largest channel is the brightness of grey and of red/blue event images alike."""
    return frames.max(axis=-1)


def _to_input(images: torch.Tensor) -> torch.Tensor:
    """[N, H, W] uint8 -> [N, 1, H, W] float32 in [0, 1]."""
    return images[:, None].float() / 255


def _inside(points: np.ndarray, image_shape: tuple[int, ...]) -> np.ndarray:
    """Which points [..., 2] lie in the image of shape (H, W); NaN does not."""
    height, width = image_shape
    return (points >= 0).all(axis=-1) & (points[..., 0] < width) & (points[..., 1] < height)


def _shift(
    images: np.ndarray, points: np.ndarray, shift_px: int, sequence: np.ndarray, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Shift the images [B, H, W] and points [B, J, 2] of each sequence by its own whole number of px."""
    if not shift_px:
        return images, points
    shifts = draw_shifts(shift_px, sequence, generator)
    return shift_images(images, shifts), points + shifts[:, None].astype(points.dtype)


def _flip_half(
    images: np.ndarray,
    points: np.ndarray,
    visible: np.ndarray,
    mirror: tuple[int, ...],
    sequence: np.ndarray,
    generator: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mirror each sequence with probability one half; the left elbow of a mirrored person is their right one."""
    flip = draw_flips(sequence, generator)
    mirrored = points[:, mirror] * np.array([-1, 1], points.dtype) + np.array([images.shape[2], 0], points.dtype)
    return (
        np.where(flip[:, None, None], images[:, :, ::-1], images),
        np.where(flip[:, None, None], mirrored, points),
        np.where(flip[:, None], visible[:, mirror], visible),
    )


def _pixel_centres(heatmaps: torch.Tensor, stride: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Coordinates x [W] and y [H] of the heatmap's pixel centres, image px."""
    import torch

    height, width = heatmaps.shape[-2:]
    x = (torch.arange(width, device=heatmaps.device, dtype=torch.float32) + 0.5) * stride
    y = (torch.arange(height, device=heatmaps.device, dtype=torch.float32) + 0.5) * stride
    return x, y


def _heatmap_loss(heatmaps: torch.Tensor, points: torch.Tensor, inside: torch.Tensor, options: Options) -> torch.Tensor:
    """Mean over the joints inside the image; zero with a graph where there is none."""
    import torch

    x, y = _pixel_centres(heatmaps, options.output_stride)
    # The Gaussian is separable: two rows of exponentials a joint rather than one image.
    column = torch.exp(-((x - points[..., :1]) ** 2) / (2 * options.sigma_px**2))
    row = torch.exp(-((y - points[..., 1:]) ** 2) / (2 * options.sigma_px**2))
    if options.loss == "mse":
        per_joint = (heatmaps - row[..., :, None] * column[..., None, :]).square().mean(dim=(-2, -1))
    else:
        column = column / column.sum(dim=-1, keepdim=True)
        row = row / row.sum(dim=-1, keepdim=True)
        # Cross-entropy against a distribution: log of the normaliser minus the expected logit.
        expected = torch.einsum("njhw,njh,njw->nj", heatmaps, row, column)
        per_joint = heatmaps.flatten(2).logsumexp(dim=-1) - expected
    return (per_joint * inside).sum() / inside.sum().clamp(min=1)


def _decode(heatmaps: torch.Tensor, options: Options) -> tuple[torch.Tensor, torch.Tensor]:
    """Points [N, J, 2] in image px and confidence [N, J] of heatmaps [N, J, H, W]."""
    import torch

    flat = heatmaps.flatten(2)
    values = flat.softmax(dim=-1) if options.loss == "cross_entropy" else flat.clamp(min=0)
    confidence, index = values.max(dim=-1)
    width = heatmaps.shape[-1]
    x, y = _pixel_centres(heatmaps, options.output_stride)
    peak_x, peak_y = x[index % width], y[index // width]
    peak = torch.stack([peak_x, peak_y], dim=-1)
    if options.decoding == "argmax":
        return peak, confidence
    weights = values.view_as(heatmaps)
    if options.decoding == "soft_argmax":
        radius_px = options.output_stride * math.ceil(2 * options.sigma_px / options.output_stride)
        near_x = (x - peak_x[..., None]).abs() <= radius_px
        near_y = (y - peak_y[..., None]).abs() <= radius_px
        weights = weights * near_y[..., :, None] * near_x[..., None, :]
    columns, rows = weights.sum(dim=-2), weights.sum(dim=-1)
    total = columns.sum(dim=-1)
    centroid = torch.stack([(columns * x).sum(dim=-1), (rows * y).sum(dim=-1)], dim=-1)
    # A heatmap without any positive value has no centroid; its first pixel is as good as any.
    return torch.where(total[..., None] > 0, centroid / total.clamp(min=1e-30)[..., None], peak), confidence
