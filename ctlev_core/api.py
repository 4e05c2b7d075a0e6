"""The functions of the public interface, `import ctlev_core as ctlev`: short ways to what the packages do.

Paths may be texts, arrays lists, and seeds have defaults. Options beyond these are those of the functions named here.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from ctlev_core.seeds import check_seed
from data_contracts.config import Windows
from data_contracts.errors import DataError
from data_contracts.events import Events, check_events
from data_contracts.labels import Labels

if TYPE_CHECKING:
    from ctlev_core.body.layer import BodyModel
    from ctlev_core.events.camera_streams import CameraFrame, ImuSamples
    from ctlev_core.scoring.pose import Alignment

JOINT_SETS_BY_COUNT = {13: "dhp19", 24: "smpl"}
"""The joint set that is meant where none is named."""


def read_events(path: str | os.PathLike[str]) -> Events:
    """All events of a recording of any known format, told by its content and checked.

    Returns:
        Columns `t` (us), `x`, `y` (px), `p` (1 = brighter), and `sensor_size` (width, height).
    Raises:
        DataError: no such file, an unknown format, or broken content.
    """
    from ctlev_core.events.files import read_events_file

    return read_events_file(Path(path).expanduser())


def read_frames(path: str | os.PathLike[str]) -> Iterator[CameraFrame]:
    """The frames that a camera took beside its events, one after the other (AEDAT 4 files).

    Returns:
        Each with `t` (us, as of the events), `exposure_us` and `pixels`, [H, W] or [H, W, 3] uint8.
    Raises:
        DataError: no AEDAT 4 file, a cut or corrupt one, or not one stream of frames; when the first is asked for.
    """
    from ctlev_core.events.camera_streams import read_camera_frames

    return read_camera_frames(Path(path).expanduser())


def read_imu(path: str | os.PathLike[str]) -> ImuSamples:
    """The inertial measurements that a camera took beside its events (AEDAT 4 files).

    Returns:
        Columns `t` (us, as of the events), `temperature`, and [N, 3] `acceleration` (g), `rotation` (degrees a second)
        and `magnetic_field` (uT).
    Raises:
        DataError: no AEDAT 4 file, a cut or corrupt one, or not one stream of measurements.
    """
    from ctlev_core.events import camera_streams

    return camera_streams.read_imu(Path(path).expanduser())


def histogram(
    events: Events,
    *,
    num_events: int | None = None,
    duration_us: int | None = None,
    polarity: bool = True,
    image_size: tuple[int, int] | None = None,
) -> np.ndarray:
    """How often each pixel fired, window by window (`ctlev_core.encodings.event_histogram`).

    Args:
        events: of one recording.
        num_events: of each window, or
        duration_us: length of each window; those without events are left out. With neither, the recording is one
            window. An incomplete last is dropped.
        polarity: count positive and negative events apart.
        image_size: (width, height) px to count in; None = the sensor's own.
    Returns:
        [N, C, H, W] uint16; channels (positive, negative), or one.
    Raises:
        DataError: the events are not what `read_events` promises.
        ValueError: both kinds of windows were asked for, or a number is not positive.
    """
    from ctlev_core.encodings import event_histogram
    from ctlev_core.events.windows import cut

    if num_events is not None and duration_us is not None:
        raise ValueError("histogram: give num_events or duration_us, not both")
    for name, value in (("num_events", num_events), ("duration_us", duration_us)):
        if value is not None and not 0 < value < 1 << 62:
            raise ValueError(f"histogram: {name} must be above 0, got {value}")
    check_events(events, "histogram")
    if num_events is None and duration_us is None:
        windows = np.array([[0, len(events)]], np.int64)
    elif num_events is not None:
        windows = cut(events, Windows(method="count", num_events=num_events))
    else:
        windows = cut(events, Windows.model_validate({"method": "duration", "duration_us": duration_us}))
    options = event_histogram.Options(polarity=polarity, image_size=image_size, resampling="events")
    return event_histogram.encode(events, windows, options)


def simulate(
    frames: npt.ArrayLike, times: npt.ArrayLike, sensor: str = "noisy", *, noise: float = 1.0, seed: int = 0
) -> Events:
    """The events of a simulated event camera that watches a video (`ctlev_core.sensor.dvs_pixel`).

    Args:
        frames: [T, H, W] linear intensity, white = 1; whole numbers are read as shares of 255.
        times: [T] whole us, or NumPy's timedelta64, increasing; brightness changes linearly between frames.
        sensor: `ideal`, `noisy` or another key of `ctlev_core.sensor.options.PRESETS`, or the path of a YAML file.
        noise: factor on the sensor's faults; 0 = none.
        seed: of the sensor's mismatch and of noise, 0 or more.
    Raises:
        DataError: shapes disagree, times are not whole or do not increase, or an intensity is negative or not finite.
        ValueError: an unknown sensor, or a seed or factor that cannot be.
    """
    from ctlev_core.sensor.choice import read_sensor
    from ctlev_core.sensor.dvs_pixel import simulate_events

    intensity = np.asarray(frames)
    if np.issubdtype(intensity.dtype, np.integer):
        intensity = intensity.astype(np.float32) / 255
    options, seed = read_sensor(str(sensor), noise), check_seed(seed, "simulate")
    return simulate_events(intensity, _whole_us(times, "simulate"), options, sensor_seed=seed, seed=seed)


def simulate_video(
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    sensor: str = "noisy",
    noise: float = 1.0,
    fps: float | None = None,
    slow_motion: float = 1.0,
    seed: int = 0,
    marks: bool = False,
) -> Events:
    """The events of a simulated event camera that watches a video file, a folder of pictures or one picture.

    What lies between two frames is drawn by optical flow (`ctlev_core.video.interpolation`); a picture is moved in
    saccades. `ctlev simulate` has more options and writes files.

    Args:
        path: the file or folder.
        size: (width, height) px of the camera; None = of the pictures.
        sensor: as `simulate`.
        noise: as `simulate`.
        fps: frames a second, in the place of the file's times.
        slow_motion: so many times slower than life the video plays.
        seed: as `simulate`.
        marks: say of each event whether it is signal or noise, in `signal` of the result.
    Returns:
        Times in us from the first frame on.
    Raises:
        DataError: nothing there, nothing that can be read, no times, or a video that ends too early.
        ValueError: an unknown sensor, or a number that cannot be.
    """
    from ctlev_core.sensor.choice import read_sensor
    from ctlev_core.sensor.dvs_pixel import join
    from ctlev_core.video.frames import FrameOptions, open_frames
    from ctlev_core.video.simulation import VideoSimulation

    frames = open_frames(Path(path), FrameOptions(size=size, fps=fps, slow_motion=slow_motion))
    seed = check_seed(seed, "simulate_video")
    simulation = VideoSimulation(frames, read_sensor(str(sensor), noise), seed=seed, marks=marks)
    chunks = list(simulation)
    assert simulation.size is not None
    return join(chunks, simulation.size)


def normal_map(
    body: BodyModel | str | os.PathLike[str] | None = None,
    *,
    pose: npt.ArrayLike | None = None,
    betas: npt.ArrayLike | None = None,
    image_size: tuple[int, int] = (256, 256),
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    distance_m: float = 3.6,
    convention: str = "controlnet",
) -> np.ndarray:
    """A picture of the surface normals of a body before a camera that looks at its middle.

    Args:
        body: a body, an SMPL file, or None for the bundled one.
        pose: [72] axis-angle of SMPL's joints, rad, or [T, 72]; None = the rest pose, facing the camera.
        betas: [10] shape; None = the mean.
        image_size: (width, height) px; the focal length is 1.5 times the shorter side.
        yaw_deg: turn of the camera around the body.
        pitch_deg: positive looks down.
        distance_m: of the camera from the middle of the body, above 0.
        convention: one of `ctlev_core.render.normals.CONVENTIONS`.
    Returns:
        [H, W, 3] uint8, or [T, H, W, 3].
    Raises:
        DataError: the file is no body, or a number is not finite.
        ValueError: a shape is another, or the convention is unknown.
    """
    from ctlev_core.body.layer import BodyModel, load_body, pose_vertices
    from ctlev_core.body.rotations import matrix_from_axis_angle
    from ctlev_core.geometry.camera import orbit_rotation
    from ctlev_core.render.normals import render_normal_maps

    if not np.isfinite([yaw_deg, pitch_deg, distance_m]).all() or distance_m <= 0:
        told = f"{yaw_deg} degrees, {pitch_deg} degrees and {distance_m} m"
        raise DataError(f"normal_map: yaw, pitch and a distance above 0 m must be finite, got {told}")
    if not isinstance(body, BodyModel):
        body = load_body(None if body is None else Path(body))
    angles = np.zeros(72) if pose is None else np.asarray(pose, np.float64)
    if angles.ndim not in (1, 2) or angles.shape[-1] != 72:
        raise ValueError(f"normal_map: pose must be [72] or [T, 72], got {angles.shape}")
    if not angles.size:
        return np.zeros((0, image_size[1], image_size[0], 3), np.uint8)
    rotations = matrix_from_axis_angle(angles.reshape(-1, 24, 3))
    shape = np.zeros(10) if betas is None else np.asarray(betas, np.float64)
    vertices, _ = pose_vertices(body, rotations, shape, np.zeros((len(rotations), 3)))
    middle = (vertices.min(axis=(0, 1)) + vertices.max(axis=(0, 1))) / 2
    turn = orbit_rotation(np.radians(yaw_deg), np.radians(pitch_deg))
    seen = (vertices - middle) @ turn.T.astype(np.float32) + np.array([0, 0, distance_m], np.float32)
    focal = 1.5 * min(image_size)
    intrinsics = np.tile([focal, focal, image_size[0] / 2, image_size[1] / 2], (len(seen), 1))
    images = render_normal_maps(np.ascontiguousarray(seen, np.float32), body.faces, intrinsics, image_size, convention)
    return images[0] if angles.ndim == 1 else images


def skeleton_map(
    joints2d: npt.ArrayLike,
    *,
    visible: npt.ArrayLike | None = None,
    image_size: tuple[int, int] = (256, 256),
    joint_set: str | None = None,
    drawing: Literal["smooth", "openpose"] = "smooth",
) -> np.ndarray:
    """A coloured drawing of a skeleton on black, as ControlNets are conditioned on (`ctlev_core.render.skeleton`).

    Args:
        joints2d: [J, 2] px of the image, or [N, J, 2]; NaN = unknown.
        visible: [J] or [N, J]; None = all that are known.
        image_size: (width, height) px.
        joint_set: a key of `ctlev_core.geometry.joint_sets.JOINT_SETS`; None = `dhp19` of 13 joints, `smpl` of 24.
        drawing: anti-aliased, or ControlNet v1.0's.
    Returns:
        [H, W, 3] uint8, or [N, H, W, 3].
    Raises:
        DataError: another number of joints than the set has.
        ValueError: a shape is another, or no joint set is named and none is meant.
    """
    from ctlev_core.render.skeleton import draw_skeleton

    joints = _joints(joints2d, 2, "skeleton_map")
    seen = _visible(joints, visible, "skeleton_map")
    rows = joints.reshape(-1, *joints.shape[-2:])
    known = joint_set or _joint_set(rows.shape[1])
    if not len(rows):
        return np.zeros((0, image_size[1], image_size[0], 3), np.uint8)
    images = [
        draw_skeleton(row, of_row, known, image_size, drawing)
        for row, of_row in zip(rows, seen.reshape(rows.shape[:2]), strict=True)
    ]
    return images[0] if joints.ndim == 2 else np.stack(images)


def frechet(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Squared Frechet distance between the Gaussians fitted to two sets of features (`ctlev_core.scoring.frechet`).

    Args:
        a: [N, D] features, N >= 2; of Inception it is FID.
        b: [M, D] features.
    Raises:
        ValueError: shapes do not fit, a set has fewer than two rows, or a value is not finite.
    """
    from ctlev_core.scoring.frechet import frechet_distance

    return frechet_distance(np.asarray(a), np.asarray(b))


def mpjpe(
    predicted: npt.ArrayLike,
    target: npt.ArrayLike,
    *,
    visible: npt.ArrayLike | None = None,
    alignment: Alignment | None = None,
    joint_set: str | None = None,
) -> float:
    """Mean distance between predicted and true joints: px in the image, mm in space (`ctlev_core.scoring.pose`).

    Args:
        predicted: [N, J, 2] px or [N, J, 3] mm; one person may leave N out.
        target: the same; NaN = unknown, which does not count.
        visible: [N, J], in the image alone; None = all that are known.
        alignment: in space alone, of each person before distances are taken: `pelvis`, `procrustes` or `none`; None =
            `pelvis`.
        joint_set: as of `skeleton_map`; needed for `pelvis`.
    Raises:
        ValueError: shapes differ, no joint counts, a prediction is not finite, or an option is not of these joints.
    """
    from ctlev_core.scoring.pose import compute_joint_errors_mm, compute_joint_errors_px

    size = np.shape(target)[-1:]
    if size == (3,):
        if visible is not None:
            raise ValueError("mpjpe: visible is of joints in the image; in space unknown ones are NaN")
        labels = _labels("joints3d", target, None, joint_set)
        errors = compute_joint_errors_mm({"joints3d": _rows(predicted)}, labels, alignment or "pelvis")
    else:
        if alignment is not None:
            raise ValueError(f"mpjpe: alignment is of joints in space, got {alignment!r} for joints in the image")
        labels = _labels("joints2d", target, visible, joint_set)
        errors = compute_joint_errors_px({"joints2d": _rows(predicted)}, labels)
    return float(np.nanmean(errors))


def pck(
    predicted: npt.ArrayLike,
    target: npt.ArrayLike,
    threshold: float = 0.2,
    *,
    normaliser: Literal["px", "torso", "bbox", "head"] = "torso",
    visible: npt.ArrayLike | None = None,
    joint_set: str | None = None,
) -> float:
    """Share of joints predicted within a threshold, 0 to 1 (`ctlev_core.metrics.pck2d`).

    Args:
        predicted: [N, J, 2] px; one person may leave N out.
        target: the same; NaN = unknown, which does not count.
        threshold: in units of the normaliser.
        normaliser: px; or a length of each person: torso, longer side of the box around the joints, or head.
        visible: [N, J]; None = all that are known.
        joint_set: as of `skeleton_map`.
    Raises:
        ValueError: shapes differ, no joint counts, or nobody has such a length.
    """
    from ctlev_core.metrics import pck2d
    from ctlev_core.plugins import validate_options

    labels = _labels("joints2d", target, visible, joint_set)
    options = validate_options(pck2d.Options, {"threshold": threshold, "normaliser": normaliser}, "pck")
    (score,) = pck2d.compute({"joints2d": _rows(predicted)}, labels, options).values()
    return score


def _labels(name: str, joints: npt.ArrayLike, visible: npt.ArrayLike | None, joint_set: str | None) -> Labels:
    found = _joints(joints, 2 if name == "joints2d" else 3, "target")
    seen, rows = np.atleast_2d(_visible(found, visible, "target")), _rows(found)
    given: dict[str, Any] = {name: rows} | ({"visible": seen} if name == "joints2d" else {})
    known = joint_set or JOINT_SETS_BY_COUNT.get(rows.shape[1], "")
    return Labels(("",) * len(rows), np.zeros(len(rows), np.int64), joint_set=known, **given)


def _joints(joints: npt.ArrayLike, size: int, where: str) -> np.ndarray:
    found = np.asarray(joints, np.float64)
    if found.ndim not in (2, 3) or found.shape[-1] != size:
        raise ValueError(f"{where}: joints must be [J, {size}] or [N, J, {size}], got {found.shape}")
    return found


def _rows(joints: npt.ArrayLike) -> np.ndarray:
    found = np.asarray(joints, np.float64)
    return found if found.ndim == 3 else found[None]


def _visible(joints: np.ndarray, visible: npt.ArrayLike | None, where: str) -> np.ndarray:
    known = np.asarray(np.isfinite(joints).all(axis=-1))
    if visible is None:
        return known
    given = np.asarray(visible, bool)
    if given.shape != known.shape:
        raise ValueError(f"{where}: visible must be {list(known.shape)}, as the joints are, got {list(given.shape)}")
    return known & given


def _whole_us(times: npt.ArrayLike, where: str) -> np.ndarray:
    """Times as int64 us; raises `DataError` where they are anything else than whole numbers or time differences."""
    given = np.asarray(times)
    if given.dtype.kind == "m":
        return given.astype("timedelta64[us]").astype(np.int64)
    is_whole = given.dtype.kind in "iuf" and bool((np.abs(given.astype(np.float64)) < 1 << 62).all())
    if not is_whole or (given.dtype.kind == "f" and (given != np.rint(given)).any()):
        raise DataError(
            f"{where}: times must be whole microseconds, got {given.dtype} {given.reshape(-1)[:3].tolist()}"
        )
    return given.astype(np.int64)


def _joint_set(count: int) -> str:
    if count not in JOINT_SETS_BY_COUNT:
        raise ValueError(f"skeleton_map: name the joint_set of {count} joints; 13 are dhp19's and 24 SMPL's")
    return JOINT_SETS_BY_COUNT[count]


__all__: Sequence[str] = [
    "frechet", "histogram", "mpjpe", "normal_map", "pck", "read_events", "read_frames", "read_imu", "simulate",
    "simulate_video", "skeleton_map",
]  # fmt: skip
