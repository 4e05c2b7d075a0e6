"""What a camera recorded beside its events: its frames and inertial measurements, of AEDAT 4 files.

Times are those of the events: the file's own, unix time in microseconds.

Source: iniVation, "AEDAT 4.0 file format"; decoded by the `aedat` package, in a process of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctlev_core.events.decoding import aedat4_process
from ctlev_core.formats import aedat4
from data_contracts.errors import DataError


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """A picture that an event camera took with the same pixels.

    Attributes:
        t: us, the middle of the exposure.
        exposure_us: how long it was exposed; 0 = the file does not say.
        pixels: [H, W] uint8 of a grey camera; [H, W, 3] red, green, blue of a colour one. Of a DAVIS they are
            proportional to light.
    """

    t: int
    exposure_us: int
    pixels: np.ndarray


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """N inertial measurements, in the camera's own axes.

    Attributes:
        t: [N] int64 us, non-decreasing.
        temperature: [N] float32 degrees Celsius.
        acceleration: [N, 3] float32 g, the earth's pull included.
        rotation: [N, 3] float32 degrees a second about each axis.
        magnetic_field: [N, 3] float32 uT; zeros where the camera does not measure it.
    """

    t: np.ndarray
    temperature: np.ndarray
    acceleration: np.ndarray
    rotation: np.ndarray
    magnetic_field: np.ndarray

    def __len__(self) -> int:
        return len(self.t)


def read_camera_frames(path: Path) -> Iterator[CameraFrame]:
    """The frames of an AEDAT 4 file, one after the other, in memory of one.

    Raises:
        DataError: no AEDAT 4 file, a cut or corrupt one, or not one stream of frames.
    """
    head = aedat4_process.FRAME_HEAD
    for packet in _packets(path, "frame", "frames"):
        begin, end, t, width, height, channels = head.unpack_from(packet)
        pixels = np.frombuffer(packet, np.uint8, offset=head.size).reshape(height, width, channels)
        exposure_us = max(end - begin, 0) if begin else 0
        seen = pixels[..., 0] if channels == 1 else pixels[..., :3]
        yield CameraFrame(begin + exposure_us // 2 if begin else t, exposure_us, seen)


def read_imu(path: Path) -> ImuSamples:
    """All inertial measurements of an AEDAT 4 file.

    Raises:
        DataError: no AEDAT 4 file, a cut or corrupt one, not one stream of them, or times that go back.
    """
    packets = [np.frombuffer(packet, aedat4_process.IMU) for packet in _packets(path, "imus", "inertial measurements")]
    rows = np.concatenate([np.empty(0, aedat4_process.IMU), *packets])
    t = rows["t"].astype(np.int64)
    if (back := np.flatnonzero(np.diff(t) < 0)).size:
        raise DataError(f"{path}: times of inertial measurements must not go back, they do at sample {back[0] + 1}")

    def axes(name: str) -> np.ndarray:
        return np.stack([rows[f"{name}_{axis}"] for axis in "xyz"], axis=1)

    return ImuSamples(t, rows["temperature"].copy(), axes("accelerometer"), axes("gyroscope"), axes("magnetometer"))


def _packets(path: Path, kind: str, what: str) -> Iterator[bytes]:
    if not path.is_file() or not aedat4.sniff(path):
        found = "another file" if path.is_file() else "a folder" if path.is_dir() else "nothing there"
        raise DataError(f"{path}: {what} are read from AEDAT 4 files, got {found}")
    with aedat4.one_stream(path, kind, f"stream of {what}") as (_, packets):
        yield from packets
