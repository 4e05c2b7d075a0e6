"""Biovision hierarchy (.bvh), of any skeleton of a person whose joints have usual names.

Read are the HIERARCHY (ROOT, JOINT, End Site, OFFSET, CHANNELS in any number and order) and the MOTION. Rotation
channels are degrees and turn one after the other, each about an axis that the ones before have turned: R = R_1 R_2 R_3.
Position channels replace the OFFSET of their joint, axis by axis, which is how MotionBuilder and Blender write them.

No BVH says its unit: CMU's conversions have 0.45 inches, others centimetres or metres. None is needed, for the motion
is scaled to the legs of the body (`ctlev_core.body.motion.retargeting`). Up is the axis along which the rest pose
stands, or the one along which the person stands while it moves, where that is plainly another one. A rest pose that is
none, all bones along one axis as LAFAN1 has it, gives way to the frame in which the person stands straightest.

Converters put the pose in which they calibrate, mostly a T, before the first frame (those of CMU's data do). It is no
part of the motion and is left out: it is known by a joint that turns faster than any living one from it to the next
frame, and never nearly as fast afterwards.

Source: Meredith and Maddock, "Motion capture file formats explained", University of Sheffield, CS-01-11.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ctlev_core.body.motion.clip import MotionClip, take
from ctlev_core.body.motion.landmarks import find_landmarks
from ctlev_core.body.motion.retargeting import retarget
from ctlev_core.body.motion.source_skeleton import SkeletonMotion
from data_contracts.errors import DataError

VERSION = 1
HAS_SIGNATURE = True
SUFFIXES = (".bvh",)

MAX_BYTES = 2**30
MAX_JOINTS = 10_000
_CHANNEL = re.compile(r"([XYZ])(position|rotation)", re.IGNORECASE)
_MOTION_LINE = re.compile(r"^\s*MOTION\s*$", re.MULTILINE)
_TIMING = re.compile(r"\s*Frames\s*:\s*(\S+)\s+Frame\s+Time\s*:\s*(\S+)", re.IGNORECASE)
_END_SITE = -2
MAX_SPEED_DEG_S = 8000.0
"""The fastest turn of a human joint is that of a pitcher's shoulder, about 7,000 (Fleisig et al., AJSM 1995)."""
CALIBRATION_FACTOR = 3.0
"""How much faster than all later turns the one after a calibration pose is."""


@dataclass
class _Joint:
    name: str
    parent: int
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    channels: list[str] = field(default_factory=list)
    tip: np.ndarray | None = None
    """OFFSET of its End Site."""


def sniff(path: Path) -> bool:
    """Is HIERARCHY the first word?"""
    with path.open("rb") as file:
        return file.read(64).removeprefix(b"\xef\xbb\xbf").lstrip()[:9].upper() == b"HIERARCHY"


def read(path: Path) -> MotionClip:
    """The motion on SMPL's joints: metres, y up, every frame but a calibration pose at the start.

    Raises:
        DataError: the file cannot be read or is cut, a word is not where it belongs, a number is none or not finite,
            there are no frames, the joints have unknown names, or see `retarget`.
    """
    motion = read_skeleton_motion(path)
    return _without_calibration(retarget(motion, find_landmarks(motion.names, str(path)), str(path)))


def read_skeleton_motion(path: Path) -> SkeletonMotion:
    """The motion of the file's own skeleton.

    Raises:
        DataError: as `read`, but joints may have any names.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DataError(f"{path}: {path.stat().st_size} bytes, more than the limit of {MAX_BYTES}")
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
    parts = _MOTION_LINE.split(text, maxsplit=1)
    if len(parts) < 2:
        raise DataError(f"{path}: expected a line MOTION after the hierarchy, got none; the file may be cut")
    joints = _Hierarchy(parts[0], str(path)).joints
    time_s, values = _parse_motion(parts[1], sum(len(joint.channels) for joint in joints), str(path))
    return _solve(joints, time_s, values)


def _without_calibration(clip: MotionClip) -> MotionClip:
    from ctlev_core.body.rotations import matrix_from_axis_angle

    if len(clip) < 3:
        return clip
    rotations = matrix_from_axis_angle(clip.pose.reshape(-1, 24, 3))
    # Rotations that are an angle apart have a Frobenius distance of sqrt(8) sin(angle / 2).
    distances = np.linalg.norm(np.diff(rotations, axis=0), axis=(-2, -1)).max(axis=1)
    speeds = np.rad2deg(2 * np.arcsin(np.minimum(distances / np.sqrt(8), 1))) / np.diff(clip.time_s)
    if speeds[0] < max(MAX_SPEED_DEG_S, CALIBRATION_FACTOR * speeds[1:].max()):
        return clip
    return take(clip, np.arange(1, len(clip)))


class _Hierarchy:
    """Reads the words of a hierarchy into `joints`, in the order of the file, which is that of their channels."""

    def __init__(self, text: str, where: str) -> None:
        self.joints: list[_Joint] = []
        self._words = text.split()
        self._next = 0
        self._where = where
        self._open: list[int] = []
        """Joints whose braces are open; _END_SITE stands for an End Site."""
        self._take(1)  # HIERARCHY
        while self._next < len(self._words):
            self._read_entry()
        if self._open or not self.joints:
            raise DataError(f"{where}: the hierarchy ends before its last closing brace")

    def _read_entry(self) -> None:
        word = self._take(1)[0]
        in_joint = bool(self._open) and self._open[-1] != _END_SITE
        if (word == "ROOT" and not self.joints) or (word == "JOINT" and in_joint):
            self._open_joint()
        elif word == "End" and in_joint and self._take(2) == ["Site", "{"]:
            self._open.append(_END_SITE)
        elif word == "OFFSET" and in_joint:
            self.joints[self._open[-1]].offset = _numbers(self._take(3), "an OFFSET", self._where)
        elif word == "OFFSET" and self._open:
            self.joints[self._open[-2]].tip = _numbers(self._take(3), "an OFFSET", self._where)
        elif word == "CHANNELS" and in_joint:
            count = int(_numbers(self._take(1), "the number of CHANNELS", self._where)[0])
            self.joints[self._open[-1]].channels = _channels(self._take(count), self._where)
        elif word == "}" and self._open:
            self._open.pop()
        else:
            hint = "; only files of one skeleton are read" if word == "ROOT" else ""
            raise DataError(f"{self._where}: {word!r} is not where it belongs in the hierarchy{hint}")

    def _open_joint(self) -> None:
        # A name may have spaces, as 3ds Max writes them.
        name = []
        while (word := self._take(1)[0]) != "{":
            name.append(word)
        if len(self.joints) == MAX_JOINTS:
            raise DataError(f"{self._where}: more than {MAX_JOINTS} joints")
        self.joints.append(_Joint(" ".join(name), self._open[-1] if self._open else -1))
        self._open.append(len(self.joints) - 1)

    def _take(self, count: int) -> list[str]:
        taken = self._words[self._next : self._next + max(count, 0)]
        if len(taken) < count:
            raise DataError(f"{self._where}: the hierarchy ends early")
        self._next += len(taken)
        return taken


def _numbers(words: list[str], what: str, where: str) -> np.ndarray:
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise DataError(f"{where}: {what} must be numbers, got {' '.join(words)!r}") from error
    if not np.isfinite(values).all() or (np.abs(values) > 1e9).any():
        raise DataError(f"{where}: {what} must be finite, got {' '.join(words)!r}")
    return values


def _channels(words: list[str], where: str) -> list[str]:
    """Channels such as `Xr` or `Zp`."""
    matches = [_CHANNEL.fullmatch(word) for word in words]
    channels = [f"{match[1].upper()}{match[2][0].lower()}" for match in matches if match]
    if len(channels) < len(words) or len(set(channels)) < len(channels):
        raise DataError(f"{where}: CHANNELS must be different ones of Xposition .. Zrotation, got {' '.join(words)!r}")
    return channels


def _parse_motion(text: str, num_channels: int, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Times [T] s and values [T, num_channels] of the part after MOTION."""
    match = _TIMING.match(text)
    if match is None:
        raise DataError(f"{where}: expected 'Frames:' and 'Frame Time:' after MOTION, got {text[:60].strip()!r}")
    count, step_s = (_numbers([match[i]], name, where)[0] for i, name in ((1, "Frames"), (2, "Frame Time")))
    if count < 1 or count != int(count):
        raise DataError(f"{where}: expected a motion, got one of {match[1]} frames")
    if step_s <= 0 and count > 1:
        raise DataError(f"{where}: Frame Time must be positive, got {match[2]}")
    words = text[match.end() :].split()
    if len(words) != count * num_channels:
        raise DataError(
            f"{where}: {int(count)} frames of {num_channels} channels take {int(count) * num_channels} numbers, got "
            f"{len(words)}; the file may be cut"
        )
    try:
        values = np.array(words, dtype=np.float64).reshape(int(count), num_channels)
    except ValueError as error:
        raise DataError(f"{where}: the motion holds something that is no number: {error}") from error
    wrong = ~np.isfinite(values).all(axis=1)
    if wrong.any():
        raise DataError(f"{where}: frame {int(np.argmax(wrong))} holds a number that is not finite")
    return np.arange(int(count)) * step_s, values


def _solve(joints: list[_Joint], time_s: np.ndarray, values: np.ndarray) -> SkeletonMotion:
    """Forward kinematics."""
    from ctlev_core.body.rotations import matrix_from_euler

    count, num_frames = len(joints), len(time_s)
    rest, tips = np.zeros((count, 3)), np.zeros((count, 3))
    orientation = np.zeros((count, num_frames, 3, 3))
    positions = np.zeros((count, num_frames, 3))
    column = 0
    for number, joint in enumerate(joints):
        own = values[:, column : column + len(joint.channels)]
        column += len(joint.channels)
        turning = [i for i, channel in enumerate(joint.channels) if channel[1] == "r"]
        local = np.broadcast_to(np.eye(3), (num_frames, 3, 3))
        if turning:
            local = matrix_from_euler("".join(joint.channels[i][0] for i in turning), own[:, turning])
        offset = np.tile(joint.offset, (num_frames, 1))
        for i, channel in enumerate(joint.channels):
            if channel[1] == "p":
                offset[:, "XYZ".index(channel[0])] = own[:, i]
        if joint.parent < 0:
            rest[number], orientation[number], positions[number] = joint.offset, local, offset
        else:
            above = orientation[joint.parent]
            rest[number] = rest[joint.parent] + joint.offset
            orientation[number] = above @ local
            positions[number] = positions[joint.parent] + (above @ offset[..., None])[..., 0]
    # Children come after their parents, so that from the end each joint learns the tip of its first child.
    tips[:] = rest + [joint.tip if joint.tip is not None else np.zeros(3) for joint in joints]
    for number in range(count - 1, 0, -1):
        tips[joints[number].parent] = tips[number]
    names, parents = zip(*((joint.name, joint.parent) for joint in joints), strict=True)
    return SkeletonMotion(names, parents, rest, tips, orientation, positions, time_s)
