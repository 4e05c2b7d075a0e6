"""3D bodies from event images: SMPL pose, shape and place in the camera frame.

Source: Event-HPE (Zou et al., ICCV 2021), the model of the paper's Table 3, and its published code: residual features,
a gated recurrent unit over 8 frames whose output is added to them, 6D rotations, losses on rotations, joints in 3D and
2D and translation. Here without its optical flow; shape and pose are predicted rather than given for the first frame
and followed from there. By default each image is seen alone, by a small network that two CPU cores train in minutes;
`sequence_length` adds the recurrent unit.

A sequence is up to `sequence_length` consecutive frames of one recording. In training every frame is the last of one,
and the loss is the mean over all frames of the sequences, as in Event-HPE's code, which draws 8 of the next 16 frames.
In prediction every frame is again the last of its own sequence, so that each but the first few of a recording knows
as much of the past as in training, whatever else is predicted with it; Event-HPE cuts recordings into chunks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from ctlev_core.body.smpl_files import given_body_file
from ctlev_core.geometry.joint_sets import joint_indices
from ctlev_core.networks.resnet_files import ARCHITECTURES, check_batch, check_resnet_folder
from ctlev_core.supervised.augmentation import BodySamples, mirror_half, shift
from ctlev_core.supervised.frame_sequences import find_sequences, find_training_sequences
from ctlev_core.supervised.options import SequenceOptions
from data_contracts.config import RUN_SETTING, cache_material
from data_contracts.errors import DataError
from data_contracts.image_rows import Images
from data_contracts.labels import History, Labels, check_labels

if TYPE_CHECKING:
    import torch

    from ctlev_core.body.torch_layer import BodyLayer

VERSION = 1
NAME = "smpl_regressor"
PREDICTS = ("joints2d", "joints3d", "smpl")
SKELETON = ("joints", "joint_shapedirs")
"""What joints are made of: those at rest [24, 3] m and how shape moves them [24, 3, 10]."""


class Options(SequenceOptions):
    """Network, loss weights and training budget."""

    architecture: Literal["resnet10-quarter", "resnet10-half", "resnet18", "resnet34", "resnet50"] = Field(
        default="resnet10-quarter", description="Event-HPE's is resnet50"
    )
    weights: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="local folder (config.json, model.safetensors) of a published ResNet of this architecture to start "
        "from; null = random weights",
    )
    body: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="SMPL file (.pkl, .npz) of the labels' body, whose joints are learnt; the bundled body when null",
    )
    pool_grid: int = Field(default=2, ge=1, description="features are averaged over so many cells a side; Event-HPE: 1")
    head_width: int = Field(default=256, ge=0, description="hidden units of the head, 0 = linear")
    learning_rate: float = Field(default=2e-3, gt=0, description="peak of AdamW's learning rate")
    rotation_loss: Literal["chordal", "geodesic"] = Field(
        default="chordal",
        description="mean over joints of the squared distance of the matrices, or of the angle between them, rad "
        "(Event-HPE)",
    )
    rotation_weight: float = Field(default=1.0, ge=0, description="on the rotation loss; Event-HPE: 10")
    joints3d_weight: float = Field(default=10.0, ge=0, description="on the distance of joints from the pelvis, m")
    joints2d_weight: float = Field(default=10.0, ge=0, description="on the distance in the image, of its width")
    transl_weight: float = Field(default=1.0, ge=0, description="on the distance of translations, m")
    betas_weight: float = Field(default=0.02, ge=0, description="on the squared distance of shapes")
    flip: bool = Field(default=True, description="mirror half of the training images together with their bodies")
    shift_px: int = Field(
        default=0, ge=0, description="move training images by up to so many px in x and y; black moves in"
    )


def input_files(options: Options) -> list[Path]:
    """The files of the published ResNet to start from, and of the body, if any.

    Raises:
        DataError: one is missing, or they are of another network.
    """
    files = check_resnet_folder(options.weights, options.architecture) if options.weights else []
    return [*files, *given_body_file(options.body, NAME)]


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
    """Train on frames with SMPL labels and write `model.safetensors` and `config.json` to `out`.

    Args:
        frames: [N, H, W, 3] uint8, those of a recording in time order.
        labels: N rows with SMPL parameters, intrinsics and a joint set.
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
        DataError: numbers of rows disagree, the labels have no SMPL parameters or no intrinsics, or the weights do not
            fit.
        ValueError: `parts`, `groups` or `recordings` do not fit the number of rows.
    """
    import torch

    from ctlev_core.networks.resnet import load_backbone
    from ctlev_core.supervised import models
    from ctlev_core.supervised.batches import plan_rows
    from ctlev_core.supervised.loop import train_model

    data = _check_training_set(frames, labels)
    check_batch(options.batch_size, frames.shape[1], frames.shape[2], f"train {NAME}")
    weights = models.file_digests(input_files(options))
    rows = plan_rows(len(frames), options, seed=seed, parts=parts, groups=groups or recordings)
    sequences = find_training_sequences(
        len(frames), options.sequence_length, recordings=recordings, groups=groups, parts=parts
    )
    device = models.resolve_device(options.device)
    model: Any = models.build_seeded(lambda: _build(options), seed)
    if options.weights:
        load_backbone(model.network, options.weights)
    model.start_from(*(torch.from_numpy(array).float() for array in (data.rotations, data.betas, data.transl)))
    model.to(device)
    body = _skeleton(options.body).to(device)

    def compute_loss(rows: np.ndarray, generator: np.random.Generator | None) -> torch.Tensor:
        chosen, lengths = sequences.ending_at(rows, single=len(rows) > options.batch_size)
        batch = BodySamples(*(array[chosen] for array in data))
        if generator is not None:
            sequence = np.repeat(np.arange(len(rows)), lengths)
            batch = shift(batch, options.shift_px, sequence, generator)
            if options.flip:
                batch = mirror_half(batch, sequence, generator)
        images = _to_input(torch.from_numpy(np.ascontiguousarray(batch.frames)).to(device))
        wanted = [torch.from_numpy(array).float().to(device) for array in batch[1:]]
        with models.mixed_precision(options, device):
            found = model(images, torch.from_numpy(lengths))
        return _loss(found, wanted, body, frames.shape[2], options)

    identity = [NAME, VERSION, cache_material(options), weights, seed, *data]
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
        description="train smpl_regressor",
    )
    config = {
        "model": NAME,
        "version": VERSION,
        "joint_set": labels.joint_set or "smpl",
        "intrinsics_px": np.mean(data.intrinsics, axis=0, dtype=np.float64).tolist(),
        "options": cache_material(options),
        "weights": weights,
        "training": record,
    }
    if options.body is not None:  # so that the model needs no licensed file to predict
        config["skeleton"] = {name: getattr(body, name).tolist() for name in SKELETON}
    models.write_model(out, model, config)
    return history


def predict(model: Path, frames: Images) -> Mapping[str, np.ndarray]:
    """`predict_sequences` of frames that follow from no others: each is a recording of its own."""
    return predict_sequences(model, frames, ())


def predict_sequences(model: Path, frames: Images, recordings: Sequence[str]) -> Mapping[str, np.ndarray]:
    """The body of each frame, from it and the frames of its recording just before it.

    Args:
        model: folder written by `train`.
        frames: [N, H, W, 3] uint8, of the size the model was trained on, those of a recording in time order.
        recordings: N names; empty = each frame is a recording of its own.
    Returns:
        `smpl_pose` [N, 72] rad, `smpl_betas` [N, 10], `smpl_transl` [N, 3] m, `joints3d` [N, J, 3] mm, all float32 and
        in the camera frame, and `joints2d` [N, J, 2] px as the mean training camera sees them.
    Raises:
        DataError: the folder has no such model, or frames are no images.
        ValueError: `recordings` do not fit the number of frames.
    """
    import torch

    from ctlev_core.body.torch_rotations import axis_angle_from_matrix
    from ctlev_core.supervised import models

    models.check_frames(frames, f"predict {NAME}")
    config = models.read_config(model, NAME)
    options = Options(**config["options"])
    network = _build(options)
    models.read_weights(model, network)
    device = models.resolve_device("auto")
    network.to(device)
    body = _skeleton()
    for name, values in config.get("skeleton", {}).items():
        setattr(body, name, torch.tensor(values))
    body.to(device)
    indices = joint_indices("smpl", config["joint_set"])
    intrinsics = torch.tensor(config["intrinsics_px"], device=device)
    sequences = find_sequences(len(frames), options.sequence_length, recordings)
    seen = models.predict_in_batches(network, lambda images: network.features(_to_input(images)).cpu(), frames)
    features = torch.cat(seen) if seen else torch.zeros(0)

    def bodies(rows: torch.Tensor) -> list[torch.Tensor]:
        chosen, lengths = (torch.from_numpy(array) for array in sequences.ending_at(rows.cpu().numpy()))
        known = network.over_time(features[chosen].to(device), lengths)
        found = network.bodies(known[lengths.cumsum(0).to(device) - 1])
        joints = body.pose_joints(*found)[:, indices]
        pose = axis_angle_from_matrix(found.rotations).flatten(1)
        return [pose, found.betas, found.transl, 1000 * joints, _project(joints, intrinsics)]

    batches = models.predict_in_batches(network, bodies, np.arange(len(frames)))
    count = len(indices)
    shapes = {
        "smpl_pose": (72,),
        "smpl_betas": (10,),
        "smpl_transl": (3,),
        "joints3d": (count, 3),
        "joints2d": (count, 2),
    }
    empty = {name: np.zeros((0, *shape), np.float32) for name, shape in shapes.items()}
    columns = zip(shapes, zip(*batches, strict=True), strict=True) if batches else ()
    return empty | {name: np.concatenate([part.cpu().numpy() for part in parts]) for name, parts in columns}


def _check_training_set(frames: Images, labels: Labels) -> BodySamples:
    from ctlev_core.body.rotations import matrix_from_axis_angle
    from ctlev_core.supervised.models import check_frames

    where = f"train {NAME}"
    check_frames(frames, where)
    check_labels(labels, where)
    if labels.smpl_pose is None or labels.smpl_betas is None or labels.smpl_transl is None:
        raise DataError(f"{where}: the labels have no SMPL parameters")
    if labels.intrinsics is None:
        raise DataError(f"{where}: the labels have no camera intrinsics")
    if len(labels) != len(frames) or len(frames) == 0:
        raise DataError(f"{where}: {len(frames)} frames but {len(labels)} labels")
    rotations = matrix_from_axis_angle(labels.smpl_pose.reshape(-1, 24, 3)).astype(np.float32)
    return BodySamples(frames, rotations, labels.smpl_betas, labels.smpl_transl, labels.intrinsics)


def _build(options: Options) -> Any:
    from ctlev_core.networks.smpl_regressor import SmplRegressor

    shape = ARCHITECTURES[options.architecture]
    return SmplRegressor(shape, options.pool_grid, options.head_width, recurrent=options.sequence_length > 1)


def _skeleton(body: Path | None = None) -> BodyLayer:
    """The body, of which joints alone are asked for here."""
    from ctlev_core.body.layer import load_body
    from ctlev_core.body.torch_layer import BodyLayer

    return BodyLayer(load_body(body))


def _to_input(images: torch.Tensor) -> torch.Tensor:
    """[N, H, W, 3] uint8 -> [N, 3, H, W] float32 in [0, 1]."""
    return images.permute(0, 3, 1, 2).float() / 255


def _project(joints: torch.Tensor, intrinsics: torch.Tensor) -> torch.Tensor:
    """Pixels [N, J, 2] of points [N, J, 3] m; nothing nearer than 10 cm, so that a wild guess keeps a gradient."""
    focal, centre = intrinsics[..., None, :2], intrinsics[..., None, 2:]
    return focal * joints[..., :2] / joints[..., 2:].clamp(min=0.1) + centre


def _angles(found: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
    """Angles [...] rad between rotations [..., 3, 3], by their logarithm: an arc cosine has no slope at 0 and pi."""
    from ctlev_core.body.torch_rotations import axis_angle_from_matrix

    return axis_angle_from_matrix(wanted.transpose(-1, -2) @ found).norm(dim=-1)


def _loss(found: Any, wanted: list[torch.Tensor], body: Any, width: int, options: Options) -> torch.Tensor:
    rotations, betas, transl, intrinsics = wanted
    joints, true_joints = body.pose_joints(*found), body.pose_joints(rotations, betas, transl)
    from_pelvis, true_from_pelvis = joints - joints[:, :1], true_joints - true_joints[:, :1]
    in_image = (_project(joints, intrinsics) - _project(true_joints, intrinsics)) / width
    if options.rotation_loss == "geodesic":
        rotation_loss = _angles(found.rotations, rotations).mean()
    else:
        rotation_loss = (found.rotations - rotations).square().sum(dim=(-2, -1)).mean()
    return (
        options.rotation_weight * rotation_loss
        + options.joints3d_weight * (from_pelvis - true_from_pelvis).norm(dim=-1).mean()
        + options.joints2d_weight * in_image.norm(dim=-1).mean()
        + options.transl_weight * (found.transl - transl).norm(dim=-1).mean()
        + options.betas_weight * (found.betas - betas).square().sum(dim=-1).mean()
    )
