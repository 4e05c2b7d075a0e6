"""The dataset the project makes itself: a procedural body moves, cameras watch, a DVS pixel model sends events.

It stands in for recordings of real people, which users must download under their own licences. Training recordings
show four subjects and the SEEN motions; tests show two other subjects and all motions, or the same ones in other
performances (`in_distribution_tests`); `condition` recordings carry labels, and grey pictures where asked for, but no
events: random people in UNSEEN motions, from whose poses synthetic data is sampled; `record_conditions` records the
very same people as training recordings, which is what synthetic data stands in for. The HELD_OUT motions appear in
tests alone; `validation` recordings show further subjects in all other motions.

Recordings like those of a real dataset are options: DHP19 is 346 x 260 px, `dhp19`, 4 cameras; CDEHP is 1280 x 800 px,
`cdehp`, Event-HPE a square sensor, `smpl`, both with intensity frames.

Layout of the splits: the trial of ControlEvents' DHP19 protocol, with motions in the place of sessions.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ctlev_core.body.motion.keyframes import HELD_OUT, SEEN, UNSEEN
from ctlev_core.sensor.choice import read_sensor, sensor_preset_files
from ctlev_core.studio.options import Options
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import HELD_OUT_SPLITS, ImageTrack, Labels, Part, Recording, check_labels

if TYPE_CHECKING:
    from ctlev_core.body.motion.procedural import MotionStyle
    from ctlev_core.geometry.camera import Camera
    from ctlev_core.studio.moving_body import MovingBody
    from ctlev_core.studio.scene import Subject

__all__ = [
    "MOTIONS_OF_SPLIT", "SPLIT_NAMES", "VERSION", "Options", "list_recordings", "read_events", "read_intensity_frames",
    "read_labels", "read_marked_events", "read_scene",
]  # fmt: skip

VERSION = 3
SPLIT_NAMES = ("train", "test", "condition", "validation")
"""Their order seeds recordings."""
MOTIONS_OF_SPLIT = {
    "train": SEEN,
    "test": SEEN + UNSEEN + HELD_OUT,
    "condition": UNSEEN,
    "validation": SEEN + UNSEEN,
}
# Streams of random numbers, each with its own seed, so that any recording can be made alone.
SUBJECT_STREAM, SENSOR_STREAM, SCENE_STREAM, NOISE_STREAM, CAMERA_STREAM = 10, 11, 12, 13, 14
AGAIN = "_again"
"""Ends the name of a training subject in tests."""
KEY_POSE_RATE_HZ = 200.0
"""Between key poses joints turn at constant speed: no joint is ever 1 mm off the path that the labels follow."""
RECORDING_ID = re.compile(r"(?P<split>\w+)/.+_(?P<index>\d{5,})(_cam(?P<camera>\d+))?")


def list_recordings(options: Options) -> list[Recording]:
    """Every recording, split by split; motions and subjects take turns, and within a performance the cameras.

    Raises:
        DataError: the sensor preset is a file that cannot be read, or is no preset.
    """
    read_sensor(options.sensor_preset, options.noise)
    counts = (
        options.num_train_recordings,
        options.num_test_recordings,
        options.num_condition_recordings,
        options.num_validation_recordings,
    )
    return [
        _recording(split, index, camera, options)
        for split, count in zip(SPLIT_NAMES, counts, strict=True)
        for index in range(count)
        for camera in range(options.num_cameras if split != "condition" else 1)
    ]


def _recording(split: str, index: int, camera: int, options: Options) -> Recording:
    like_training = split == "train" or (split == "test" and options.in_distribution_tests)
    motions = MOTIONS_OF_SPLIT["train" if like_training else split]
    motion, turn = motions[index % len(motions)], index // len(motions)
    has_events = split != "condition" or options.record_conditions
    if like_training:
        # Another name, for people who are both learnt from and tested on are otherwise refused.
        subject = f"subject{turn % options.num_train_subjects}{AGAIN if split == 'test' else ''}"
    elif split in HELD_OUT_SPLITS:
        first = options.num_train_subjects + options.num_test_subjects * HELD_OUT_SPLITS.index(split)
        subject = f"subject{first + turn % options.num_test_subjects}"
    else:
        subject = f"stranger{index}"
    suffix = f"_cam{camera}" if split != "condition" and options.num_cameras > 1 else ""
    return Recording(
        recording_id=f"{split}/{subject}_{motion}_{index:05d}{suffix}",
        subject=subject,
        parts=(Part("train" if split == "condition" and has_events else split),),
        class_name=motion,
        sensor_size=options.sensor_size,
        has_events=has_events,
        has_intensity=options.intensity_rate_hz is not None,
        files=sensor_preset_files(options.sensor_preset) if has_events else (),
    )


def read_labels(recording: Recording, options: Options) -> Labels:
    """Joints in 2D and 3D and the SMPL body from time 0 on, at `label_rate_hz`.

    A label-only recording has them at about `condition_rate_hz`, evenly spread, at both of its ends too.

    Raises:
        DataError: the recording is not one of the studio with these options.
    """
    from ctlev_core.body.motion.procedural import pose_at
    from ctlev_core.labels.body_views import labels_in_camera, with_joints

    performance = _perform(recording, options)
    if recording.has_events:
        t_us = _times_us(options.label_rate_hz, options)
    else:
        spans = max(round(1e-6 * options.recording_duration_us * options.condition_rate_hz), 1)
        t_us = np.rint(np.linspace(0, options.recording_duration_us, spans + 1)).astype(np.int64)
    rotations, transl = pose_at(recording.class_name, 1e-6 * t_us, performance.style)
    labels = labels_in_camera(
        rotations, transl, performance.subject.betas, performance.camera, class_name=recording.class_name, t_us=t_us
    )
    seen = with_joints(labels, options.sensor_size, options.joint_set, options.occlusion)
    return check_labels(seen, recording.recording_id)


def read_events(recording: Recording, options: Options) -> Events:
    """Record the recording, as densely in time as its motion asks for, and send it through the sensor.

    Raises:
        DataError: the recording is not one of the studio with these options, carries labels only, or has more than
            `max_events`.
    """
    return _record(recording, options, marks=False)


def read_marked_events(recording: Recording, options: Options) -> Events:
    """The events of `read_events`, each marked as signal or noise (`Events.signal`)."""
    return _record(recording, options, marks=True)


def _record(recording: Recording, options: Options, *, marks: bool) -> Events:
    from ctlev_core.sensor.adaptive_rendering import RenderingOptions, simulate_rendered
    from ctlev_core.sensor.dvs_pixel import EventBudgetError

    if not recording.has_events:
        raise DataError(f"studio recording {recording.recording_id!r} has no events")
    *entropy, camera = _entropy(recording, options)
    record = read_scene(recording, options)
    sensor = int(np.random.default_rng([*entropy, camera, SENSOR_STREAM]).integers(options.num_sensors))
    try:
        events, _ = simulate_rendered(
            record,
            0,
            options.recording_duration_us,
            read_sensor(options.sensor_preset, options.noise),
            RenderingOptions(max_displacement_px=options.max_displacement_px),
            sensor_seed=[options.seed, SENSOR_STREAM, camera, sensor],
            seed=[*entropy, camera, NOISE_STREAM],
            speed_bound=record.speed_bound,
            background=record.background,
            max_events=options.max_events,
            marks=marks,
        )
    except EventBudgetError as error:
        raise EventBudgetError(f"studio recording {recording.recording_id!r}: {error}", error.events) from None
    return events


def read_intensity_frames(recording: Recording, options: Options) -> ImageTrack:
    """Grey pictures at `intensity_rate_hz` from time 0 on: 255 times the linear intensity, without noise or blur.

    Raises:
        DataError: the recording is not one of the studio with these options, or has no pictures.
    """
    if options.intensity_rate_hz is None:
        raise DataError(f"studio recording {recording.recording_id!r} has no pictures without intensity_rate_hz")
    t_us = _times_us(options.intensity_rate_hz, options)
    frames = read_scene(recording, options).render_frames(1e-6 * t_us)
    return ImageTrack(np.rint(255.0 * frames).astype(np.uint8), t_us)


@dataclass(frozen=True, eq=False)
class _Performance:
    """Who does what before which camera: all that labels and pictures of a recording have in common."""

    style: MotionStyle
    subject: Subject
    camera: Camera
    first_camera: Camera
    """The one whose frame the lamp is drawn in, for one lamp lights the performance for all of them."""


def _perform(recording: Recording, options: Options) -> _Performance:
    from ctlev_core.body.layer import joint_transforms, load_body
    from ctlev_core.body.motion.procedural import pose_at, sample_style

    *entropy, number = _entropy(recording, options)
    style = sample_style(recording.class_name, np.random.default_rng(entropy))
    subject = _subject(recording, entropy, options)
    # Cameras look at the middle of all that happens.
    framed_s = 1e-6 * options.recording_duration_us * np.array([0.0, 0.5, 1.0])
    rotations, transl = pose_at(recording.class_name, framed_s, style)
    _, joints = joint_transforms(load_body(), rotations, subject.betas, transl)
    count = 1 if recording.recording_id.startswith("condition/") else options.num_cameras
    cameras = [_camera(entropy, camera, count, joints, options) for camera in dict.fromkeys((0, number))]
    return _Performance(style, subject, cameras[-1], cameras[0])


def _camera(entropy: list[int], number: int, count: int, joints: np.ndarray, options: Options) -> Camera:
    """One of `count` cameras; each has its own part of the range of yaw, so that they stand around the person."""
    from ctlev_core.geometry.random_cameras import CameraRange, sample_camera

    low, high = np.deg2rad(options.yaw_range_deg)
    part = (high - low) / count
    ranges = CameraRange(
        distance_m=options.distance_m,
        yaw_rad=(low + number * part, low + (number + 1) * part),
        focal_per_side=options.focal_per_side,
    )
    rng = np.random.default_rng([*entropy, number, CAMERA_STREAM])
    return sample_camera(rng, joints, options.sensor_size, ranges)


def _subject(recording: Recording, entropy: list[int], options: Options) -> Subject:
    """The person; a subject looks the same in all recordings, and a stranger is seen once."""
    from ctlev_core.studio.scene import sample_subject

    is_stranger = recording.subject.startswith("stranger")
    number = entropy[1:] if is_stranger else [int(recording.subject.removeprefix("subject").removesuffix(AGAIN))]
    return sample_subject(np.random.default_rng([options.seed, SUBJECT_STREAM, *number]), colour=False)


def read_scene(recording: Recording, options: Options) -> MovingBody:
    """The person in motion, under a light and before a wall drawn at random.

    Raises:
        DataError: the recording is not one of the studio with these options.
    """
    from ctlev_core.body.motion.procedural import pose_at
    from ctlev_core.studio.moving_body import MovingBody
    from ctlev_core.studio.scene import sample_background, sample_light

    performance = _perform(recording, options)
    *entropy, number = _entropy(recording, options)
    rng = np.random.default_rng([*entropy, SCENE_STREAM])
    light, brightness = sample_light(rng), rng.uniform(*options.brightness)
    light = replace(light, direction=performance.camera.R @ performance.first_camera.R.T @ light.direction)
    wall = np.random.default_rng([*entropy, number, SCENE_STREAM])
    background, albedo = sample_background(wall, options.sensor_size, colour=False), performance.subject.albedo
    if not options.textured:
        background, albedo = np.full_like(background, background.mean()), np.full_like(albedo, 0.5)
    subject = replace(performance.subject, albedo=np.float32(brightness) * albedo)
    spans = int(np.ceil(1e-6 * options.recording_duration_us * KEY_POSE_RATE_HZ))
    t_s = np.arange(spans + 1) / KEY_POSE_RATE_HZ
    poses = pose_at(recording.class_name, t_s, performance.style)
    return MovingBody(subject, t_s, *poses, performance.camera, np.float32(brightness) * background, light)


def _times_us(rate_hz: float, options: Options) -> np.ndarray:
    """Times [T] int64 from 0 to the end of a recording."""
    # A time that is the end but for rounding belongs to the recording.
    count = int(1e-6 * options.recording_duration_us * rate_hz + 1e-6) + 1
    return np.rint(np.arange(count) * (1e6 / rate_hz)).astype(np.int64)


def _entropy(recording: Recording, options: Options) -> list[int]:
    """What seeds a recording: the studio's seed, the split, the index within it, and the camera.

    Raises:
        DataError: the studio with these options has no such recording.
    """
    name = RECORDING_ID.fullmatch(recording.recording_id)
    if name and name["split"] in SPLIT_NAMES:
        split, index, camera = name["split"], int(name["index"]), int(name["camera"] or 0)
        if camera < options.num_cameras and recording == _recording(split, index, camera, options):
            return [options.seed, SPLIT_NAMES.index(split), index, camera]
    raise DataError(f"the studio with these options has no recording {recording.recording_id!r}")
