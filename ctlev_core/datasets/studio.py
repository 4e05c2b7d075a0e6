"""The dataset the project makes itself: a procedural body moves, a camera watches, a DVS pixel model sends events.

It stands in for recordings of real people, which users must download under their own licences. Training recordings
show four subjects and the SEEN motions; tests show two other subjects and all motions; `condition` recordings carry
labels only: poses of the UNSEEN motions by random people, from which synthetic data is sampled. The HELD_OUT motions
appear in tests alone.

Layout of the splits: the trial of ControlEvents' DHP19 protocol, with motions in the place of sessions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from ctlev_core.body.keyframes import HELD_OUT, SEEN, UNSEEN
from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import Labels, Part, Recording, check_labels

if TYPE_CHECKING:
    from ctlev_core.body.motions import MotionStyle
    from ctlev_core.camera import Camera
    from ctlev_core.render.scene import Subject

VERSION = 2
SPLIT_NAMES = ("train", "test", "condition")
MOTIONS_OF_SPLIT = {"train": SEEN, "test": SEEN + UNSEEN + HELD_OUT, "condition": UNSEEN}
# Streams of random numbers, each with its own seed, so that any recording can be made alone.
SUBJECT_STREAM, SENSOR_STREAM, SCENE_STREAM, NOISE_STREAM = 10, 11, 12, 13


class Options(Frozen):
    """Options of the studio. The defaults are a small set that is made in about a minute on one core."""

    seed: int = Field(default=0, ge=0, description="Everything in the studio follows from it.")
    sensor_size: tuple[int, int] = Field(default=(64, 64), description="(width, height) px.")
    num_train_recordings: int = Field(default=600, ge=0, description="Recordings of subjects 0 to 3, SEEN motions.")
    num_test_recordings: int = Field(
        default=300, ge=0, description="Recordings of subjects 4 and 5, all motions in turn."
    )
    num_condition_recordings: int = Field(
        default=1200, ge=0, description="Label-only poses of random people, UNSEEN motions."
    )
    recording_duration_us: int = Field(default=250_000, ge=10_000, description="Length of a recording.")
    render_rate_hz: float = Field(
        default=250.0, gt=0, le=10_000, description="Pictures a second the sensor model sees."
    )
    label_rate_hz: float = Field(
        default=200.0, gt=0, le=10_000, description="Labels a second; DHP19's motion capture has 100."
    )
    num_train_subjects: int = Field(default=4, ge=1, description="Subjects 0 .. n - 1.")
    num_test_subjects: int = Field(default=2, ge=1, description="The subjects after those.")
    num_sensors: int = Field(
        default=2, ge=1, description="Individual sensors, each with its own mismatch and hot pixels."
    )
    sensor_preset: Literal["noisy", "ideal"] = Field(
        default="noisy", description="A key of `ctlev_core.sensor.PRESETS`."
    )
    joint_set: Literal["dhp19", "smpl"] = Field(
        default="dhp19", description="13 markers as DHP19 labels them, or the 24 joints of SMPL as Event-HPE does"
    )
    occlusion: bool = Field(
        default=False, description="joints that the body itself hides are not visible; markers' labels do not say"
    )
    yaw_range_deg: tuple[float, float] = Field(
        default=(0.0, 360.0), description="from where the camera looks at people who face +z; 0 = from the front"
    )
    textured: bool = Field(default=True, description="False: grey people before a plain wall, as in naive simulations.")


def list_recordings(options: Options) -> list[Recording]:
    """Every recording, split by split; motions and subjects take turns."""
    counts = (options.num_train_recordings, options.num_test_recordings, options.num_condition_recordings)
    return [
        _recording(split, index, options)
        for split, count in zip(SPLIT_NAMES, counts, strict=True)
        for index in range(count)
    ]


def _recording(split: str, index: int, options: Options) -> Recording:
    motions = MOTIONS_OF_SPLIT[split]
    motion, turn = motions[index % len(motions)], index // len(motions)
    if split == "train":
        subject = f"subject{turn % options.num_train_subjects}"
    elif split == "test":
        subject = f"subject{options.num_train_subjects + turn % options.num_test_subjects}"
    else:
        subject = f"stranger{index}"
    return Recording(
        recording_id=f"{split}/{subject}_{motion}_{index:05d}",
        subject=subject,
        parts=(Part(split),),
        class_name=motion,
        sensor_size=options.sensor_size,
        has_events=split != "condition",
    )


@dataclass(frozen=True, eq=False)
class _Performance:
    """Who does what before which camera: all that labels and pictures of a recording have in common."""

    style: MotionStyle
    betas: np.ndarray
    camera: Camera


def read_labels(recording: Recording, options: Options) -> Labels:
    """Joints in 2D and 3D and the SMPL body at `label_rate_hz` from time 0 on; a label-only recording has one moment.

    Raises:
        DataError: the recording is not one of the studio with these options.
    """
    from ctlev_core.body.motions import pose_at
    from ctlev_core.body_views import labels_in_camera, with_joints

    performance = _perform(recording, options)
    t_us = _times_us(options.label_rate_hz, options) if recording.has_events else np.zeros(1, dtype=np.int64)
    rotations, transl = pose_at(recording.class_name, 1e-6 * t_us, performance.style)
    labels = labels_in_camera(
        rotations, transl, performance.betas, performance.camera, class_name=recording.class_name, t_us=t_us
    )
    seen = with_joints(labels, options.sensor_size, options.joint_set, options.occlusion)
    return check_labels(seen, recording.recording_id)


def read_events(recording: Recording, options: Options) -> Events:
    """Render the recording and send it through the sensor; time 0 is the first picture.

    Raises:
        DataError: the recording is not one of the studio with these options, or carries labels only.
    """
    from ctlev_core.sensor import PRESETS, simulate_events

    intensity, t_us = read_frames(recording, options)
    entropy = _entropy(recording, options)
    sensor = int(np.random.default_rng([*entropy, SENSOR_STREAM]).integers(options.num_sensors))
    return simulate_events(
        intensity,
        t_us,
        PRESETS[options.sensor_preset],
        sensor_seed=[options.seed, SENSOR_STREAM, sensor],
        seed=[*entropy, NOISE_STREAM],
    )


def read_frames(recording: Recording, options: Options) -> tuple[np.ndarray, np.ndarray]:
    """The pictures the sensor watches: linear intensity [T, H, W] float32 in (0, 1] and their times [T] int64, us.

    Raises:
        DataError: the recording is not one of the studio with these options, or carries labels only.
    """
    from ctlev_core.body.motions import pose_at
    from ctlev_core.render.scene import render_body_frames, sample_background, sample_light

    if not recording.has_events:
        raise DataError(f"studio recording {recording.recording_id!r} carries labels only; there is nothing to see")
    performance = _perform(recording, options)
    rng = np.random.default_rng([*_entropy(recording, options), SCENE_STREAM])
    subject = _subject(recording, options)
    background = sample_background(rng, options.sensor_size, colour=False)
    light = sample_light(rng)
    if not options.textured:
        subject = replace(subject, albedo=np.full_like(subject.albedo, 0.5))
        background = np.full_like(background, background.mean())
    t_us = _times_us(options.render_rate_hz, options)
    rotations, transl = pose_at(recording.class_name, 1e-6 * t_us, performance.style)
    frames = render_body_frames(subject, rotations, transl, performance.camera, background, light)
    return frames[..., 0], t_us


def _perform(recording: Recording, options: Options) -> _Performance:
    from ctlev_core.body.layer import joint_transforms, load_body
    from ctlev_core.body.motions import pose_at, sample_style
    from ctlev_core.render.scene import sample_betas
    from ctlev_core.virtual_camera import CameraRange, sample_camera

    rng = np.random.default_rng(_entropy(recording, options))
    style = sample_style(recording.class_name, rng)
    betas = _subject(recording, options).betas if recording.has_events else sample_betas(rng)
    # The camera looks at the middle of all that happens; a label-only recording is its first moment.
    framed_s = 1e-6 * options.recording_duration_us * np.array([0.0, 0.5, 1.0] if recording.has_events else [0.0])
    rotations, transl = pose_at(recording.class_name, framed_s, style)
    _, joints = joint_transforms(load_body(), rotations, betas, transl)
    low, high = np.deg2rad(options.yaw_range_deg)
    camera = sample_camera(rng, joints, options.sensor_size, CameraRange(yaw_rad=(low, high)))
    return _Performance(style, betas, camera)


def _subject(recording: Recording, options: Options) -> Subject:
    """The person, who looks the same in all recordings."""
    from ctlev_core.render.scene import sample_subject

    number = int(recording.subject.removeprefix("subject"))
    return sample_subject(np.random.default_rng([options.seed, SUBJECT_STREAM, number]), colour=False)


def _times_us(rate_hz: float, options: Options) -> np.ndarray:
    """Times [T] int64 from 0 to the end of a recording."""
    count = int(1e-6 * options.recording_duration_us * rate_hz) + 1
    return np.rint(np.arange(count) * (1e6 / rate_hz)).astype(np.int64)


def _entropy(recording: Recording, options: Options) -> list[int]:
    """What seeds a recording: the studio's seed, the split and the index within it.

    Raises:
        DataError: the studio with these options has no such recording.
    """
    split, _, name = recording.recording_id.partition("/")
    index = name.rpartition("_")[2]
    known = split in SPLIT_NAMES and index.isdecimal()
    if not known or recording != _recording(split, int(index), options):
        raise DataError(f"the studio with these options has no recording {recording.recording_id!r}")
    return [options.seed, SPLIT_NAMES.index(split), int(index)]
