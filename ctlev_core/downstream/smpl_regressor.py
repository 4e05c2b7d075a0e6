"""3D body from one event image: SMPL pose, shape and place in the camera frame.

Source: Event-HPE (Zou et al., ICCV 2021), the model of the paper's Table 3: residual features, 6D rotations, losses on
rotations, joints in 3D and 2D and translation. Here one image at a time, without its recurrent unit and optical flow,
and the shape is predicted rather than given. The default is a small network that two CPU cores train in minutes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from ctlev_core.image_shifts import shift_images
from ctlev_core.networks.resnet_files import ARCHITECTURES, check_batch, check_resnet_folder
from ctlev_core.skeletons import JOINT_SETS, joint_indices
from ctlev_core.supervised_options import SupervisedOptions
from data_contracts.config import RUN_SETTING, cache_material
from data_contracts.errors import DataError
from data_contracts.labels import History, Labels, check_labels

if TYPE_CHECKING:
    import torch

VERSION = 1
NAME = "smpl_regressor"


class Options(SupervisedOptions):
    """Network, loss weights and training budget."""

    architecture: Literal["resnet10-quarter", "resnet10-half", "resnet18", "resnet34"] = Field(
        default="resnet10-quarter", description="Event-HPE's is a ResNet-50"
    )
    weights: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="local folder (config.json, model.safetensors) of a published ResNet of this architecture to start "
        "from; null = random weights",
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


class _TrainingSet(NamedTuple):
    """Frames and bodies as arrays: rotations [N, 24, 3, 3], betas [N, 10], transl [N, 3] m, intrinsics [N, 4] px."""

    frames: np.ndarray
    rotations: np.ndarray
    betas: np.ndarray
    transl: np.ndarray
    intrinsics: np.ndarray


def input_files(options: Options) -> list[Path]:
    """The files of the published ResNet to start from, if any.

    Raises:
        DataError: one is missing, or they are of another network.
    """
    return check_resnet_folder(options.weights, options.architecture) if options.weights else []


def train(
    frames: np.ndarray,
    labels: Labels,
    options: Options,
    *,
    seed: int,
    out: Path,
    work: Path,
    parts: Sequence[int] = (),
    groups: Sequence[str] = (),
) -> History:
    """Train on frames with SMPL labels and write `model.safetensors` and `config.json` to `out`.

    Args:
        frames: [N, H, W, 3] uint8.
        labels: N rows with SMPL parameters, intrinsics and a joint set.
        options: see `Options`.
        seed: of the initial weights, the order of the samples and the augmentation.
        out: model folder.
        work: folder of the resumable state.
        parts: rows of each training set, in order; empty = one set.
        groups: N subjects or recordings, held back whole for validation; empty = each row is its own.
    Returns:
        The training loss per logged step, and the loss of rows held back.
    Raises:
        DataError: numbers of rows disagree, the labels have no SMPL parameters or no intrinsics, or the weights do not
            fit.
    """
    import torch

    from ctlev_core import supervised
    from ctlev_core.body.layer import load_body
    from ctlev_core.body.torch_layer import BodyLayer
    from ctlev_core.networks.resnet import load_backbone
    from ctlev_core.supervised_training import train_model
    from ctlev_core.training_rows import plan_rows

    data = _check_training_set(frames, labels)
    check_batch(options.batch_size, frames.shape[1], frames.shape[2], f"train {NAME}")
    weights = supervised.file_digests(input_files(options))
    rows = plan_rows(len(frames), options, seed=seed, parts=parts, groups=groups)
    device = supervised.resolve_device(options.device)
    model: Any = supervised.build_seeded(lambda: _build(options), seed)
    if options.weights:
        load_backbone(model.network, options.weights)
    model.start_from(*(torch.from_numpy(array).float() for array in (data.rotations, data.betas, data.transl)))
    model.to(device)
    body = BodyLayer(load_body()).to(device)

    def compute_loss(rows: np.ndarray, generator: np.random.Generator | None) -> torch.Tensor:
        batch = _TrainingSet(*(array[rows] for array in data))
        if generator is not None:
            batch = _shift(batch, options.shift_px, generator)
            if options.flip:
                batch = _flip_half(batch, generator)
        images = _to_input(torch.from_numpy(np.ascontiguousarray(batch.frames)).to(device))
        wanted = [torch.from_numpy(array).float().to(device) for array in batch[1:]]
        with supervised.mixed_precision(options, device):
            found = model(images)
        return _loss(found, wanted, body, frames.shape[2], options)

    history, record = train_model(
        model,
        compute_loss,
        rows,
        options,
        seed=seed,
        work=work,
        run_digest=supervised.digest(NAME, VERSION, cache_material(options), weights, seed, *data),
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
    supervised.write_model(out, model, config)
    return history


def predict(model: Path, frames: np.ndarray) -> Mapping[str, np.ndarray]:
    """The body of each frame.

    Args:
        model: folder written by `train`.
        frames: [N, H, W, 3] uint8, of the size the model was trained on.
    Returns:
        `smpl_pose` [N, 72] rad, `smpl_betas` [N, 10], `smpl_transl` [N, 3] m, `joints3d` [N, J, 3] mm, all float32 and
        in the camera frame, and `joints2d` [N, J, 2] px as the mean training camera sees them.
    """
    import torch

    from ctlev_core import supervised
    from ctlev_core.body.layer import load_body
    from ctlev_core.body.torch_layer import BodyLayer
    from ctlev_core.body.torch_rotations import axis_angle_from_matrix

    supervised.check_frames(frames, f"predict {NAME}")
    config = supervised.read_config(model, NAME)
    network = _build(Options(**config["options"]))
    supervised.read_weights(model, network)
    device = supervised.resolve_device("auto")
    network.to(device)
    body = BodyLayer(load_body()).to(device)
    indices = joint_indices("smpl", config["joint_set"])
    intrinsics = torch.tensor(config["intrinsics_px"], device=device)

    def bodies(images: torch.Tensor) -> list[torch.Tensor]:
        found = network(_to_input(images))
        joints = body.pose_joints(*found)[:, indices]
        pose = axis_angle_from_matrix(found.rotations).flatten(1)
        return [pose, found.betas, found.transl, 1000 * joints, _project(joints, intrinsics)]

    batches = supervised.predict_in_batches(network, bodies, frames)
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


def _check_training_set(frames: np.ndarray, labels: Labels) -> _TrainingSet:
    from ctlev_core.body.rotations import matrix_from_axis_angle
    from ctlev_core.supervised import check_frames

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
    return _TrainingSet(frames, rotations, labels.smpl_betas, labels.smpl_transl, labels.intrinsics)


def _build(options: Options) -> Any:
    from ctlev_core.networks.smpl_regressor import SmplRegressor

    return SmplRegressor(ARCHITECTURES[options.architecture], options.pool_grid, options.head_width)


def _to_input(images: torch.Tensor) -> torch.Tensor:
    """[N, H, W, 3] uint8 -> [N, 3, H, W] float32 in [0, 1]."""
    return images.permute(0, 3, 1, 2).float() / 255


def _flip_half(batch: _TrainingSet, generator: np.random.Generator) -> _TrainingSet:
    """Mirror each image and its body with probability one half: x changes sign, left and right change places.

    The pelvis of the rest pose lies on the mirror plane, so translations are mirrored like points.
    """
    flip = generator.random(len(batch.frames)) < 0.5
    mirror = np.diag([-1.0, 1.0, 1.0]).astype(np.float32)
    rotations = mirror @ batch.rotations[:, JOINT_SETS["smpl"].mirror] @ mirror
    intrinsics = batch.intrinsics * np.array([1, 1, -1, 1], np.float32)
    intrinsics[:, 2] += batch.frames.shape[2]
    return _TrainingSet(
        np.where(flip[:, None, None, None], batch.frames[:, :, ::-1], batch.frames),
        np.where(flip[:, None, None, None], rotations, batch.rotations),
        batch.betas,
        np.where(flip[:, None], batch.transl * np.array([-1, 1, 1], np.float32), batch.transl),
        np.where(flip[:, None], intrinsics, batch.intrinsics),
    )


def _shift(batch: _TrainingSet, shift_px: int, generator: np.random.Generator) -> _TrainingSet:
    """Shift each image and its body, at its own depth, by its own whole number of px.

    A body that moves aside is also seen from a little further round: shift_px / focal length, 2.4 degrees at 4 of
    96 px, which the label does not follow.
    """
    if not shift_px:
        return batch
    shifts = generator.integers(-shift_px, shift_px + 1, size=(len(batch.frames), 2))
    transl = batch.transl.copy()
    transl[:, :2] += batch.transl[:, 2:] * shifts.astype(np.float32) / batch.intrinsics[:, :2]
    return batch._replace(frames=shift_images(batch.frames, shifts), transl=transl)


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
