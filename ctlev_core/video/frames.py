"""Frames of a video, of a folder of pictures, or of one still picture, as a camera would see them: linear light.

    a video file          anything that OpenCV reads; its own times, so that frame rates may vary
    a folder of pictures  in the order of their names; `timestamps.txt` (seconds, a line each) in it or beside it, or a
                          rate
    an AEDAT 4 file       the frames that a camera took beside its events; they are light
    a picture             moved before the camera as N-MNIST's pictures were (`ctlev_core.render.saccades`)

Stored pixels of 8 and 16 bits are light to the power of 1 / gamma; floating-point ones (.hdr, .tiff) are light.
Pictures are scaled to cover the sensor and cut to its shape about their middle. Colours become luminance (ITU-R
BT.709).
"""

from __future__ import annotations

import abc
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ctlev_core.events.camera_streams import read_camera_frames
from ctlev_core.formats import aedat4
from ctlev_core.render.saccades import NMNIST_PATH_PX, NMNIST_PATH_US, path_frames
from ctlev_core.video.picture_files import PICTURE_SUFFIXES, list_folder, read_picture
from data_contracts.errors import DataError
from data_contracts.events import SensorSize, check_sensor_size

GAMMA = 2.2
NMNIST_SIDE_PX = 34
"""Side of the sensor on which the path of N-MNIST was measured."""
_LUMINANCE_BGR = np.array([[0.0722, 0.7152, 0.2126]], np.float32)
_ROWS = 16
_WITHOUT_COUNT = (".mkv", ".webm")
_NOT_SHOWN = 0.01
"""A container may count so many frames more than it has; with fewer, the file was cut."""
_LATEST_US = 2.0**53
"""The sensor's clock is float64, which has every whole us up to here: 285 years."""


@dataclass(frozen=True)
class FrameOptions:
    """How frames are read.

    Attributes:
        size: (width, height) px of the sensor; None = of the pictures.
        fps: frames a second, in the place of the file's times; needed for a folder without times.
        slow_motion: so many times slower than life the video plays.
        start_s, stop_s: the stretch of the video that is read, s of its own time; None = to its end.
        gamma: light is a stored value to this power; 1 = values are light, None = 2.2, and 1 of an AEDAT 4 file.
    """

    size: SensorSize | None = None
    fps: float | None = None
    slow_motion: float = 1.0
    start_s: float = 0.0
    stop_s: float | None = None
    gamma: float | None = None

    def __post_init__(self) -> None:
        for name in ("fps", "slow_motion", "gamma"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be a number above 0, got {value}")
        if not self.start_s >= 0 or (self.stop_s is not None and not self.stop_s > self.start_s):
            raise ValueError(f"start and stop must be ascending seconds from 0, got {self.start_s} and {self.stop_s}")
        if self.size is not None:
            if not all(isinstance(side, int | np.integer) for side in self.size):
                raise ValueError(f"size must be two whole numbers of px, got {self.size}")
            try:
                check_sensor_size(self.size, "size")
            except DataError as error:
                raise ValueError(str(error)) from None


class Shown(NamedTuple):
    """A frame as the sensor saw it: its time, its number in the source from 0 on, and how far it was moved, px."""

    t_us: int
    number: int
    right: float = 0.0
    down: float = 0.0


class Frames(abc.ABC):
    """Frames one after the other, in memory of one; iterating again reads them again.

    Attributes:
        expected: number of frames as the source says; 0 = it does not.
        is_dense: so close together that nothing need be drawn between two.
        num_skipped: frames whose time is not after that of the frame before; counted while iterating.
        num_stored: frames in the source as it says, of all its time; 0 = it does not.
        names: of the files, where frames are pictures.
        num_seen_to_end: frames in the source, once it was read to its end; 0 = it was not.
        shown: frames given so far; filled while iterating.
    """

    expected = 0
    is_dense = False
    num_skipped = 0
    num_stored = 0
    num_seen_to_end = 0
    names: tuple[str, ...] = ()
    shown: Sequence[Shown] = ()

    @abc.abstractmethod
    def __iter__(self) -> Iterator[tuple[int, np.ndarray]]:
        """Times in us of life from the first frame on, and linear light [H, W] float32, white = 1.

        Raises:
            DataError: a frame that cannot be read, frames of different sizes, or fewer than two of them.
        """

    def stored_size(self) -> SensorSize:
        """(width, height) px of the frames in the source, which a sensor of another size sees scaled and cut."""
        _, light = next(iter(self))
        return light.shape[1], light.shape[0]


class _Light:
    """From pixels as they are stored to light on the sensor."""

    def __init__(self, path: Path, options: FrameOptions, usual_gamma: float = GAMMA) -> None:
        self._path, self._size = path, options.size
        self._gamma = np.float32(usual_gamma if options.gamma is None else options.gamma)
        self._of_bytes = (np.arange(256) / 255).astype(np.float32) ** self._gamma
        self._stored: tuple[int, int] | None = None

    def of(self, stored: np.ndarray, number: int) -> np.ndarray:
        """Light [height, width] float32 of the frame of a number, [H, W, 3] in blue, green, red."""
        import cv2

        shape = stored.shape[:2]
        if self._stored is not None and shape != self._stored:
            raise DataError(
                f"{self._path}: frames must have one size, got {shape[1]} x {shape[0]} px at frame {number} after "
                f"{self._stored[1]} x {self._stored[0]}"
            )
        self._stored = shape
        if self._size is None:
            self._size = check_sensor_size((shape[1], shape[0]), str(self._path))
        # Light first: a pixel of the camera has the mean of the light that falls on it, not that of display levels.
        # Some rows at a time, which stay in the cache: of 1080p that takes half as long.
        light = np.empty(shape, np.float32)
        for top in range(0, shape[0], _ROWS):
            rows = slice(top, top + _ROWS)
            light[rows] = cv2.transform(self._linear(stored[rows], number), _LUMINANCE_BGR)
        return _cover(light, self._size)

    def _linear(self, stored: np.ndarray, number: int) -> np.ndarray:
        """Light [H, W, 3] of each colour."""
        import cv2

        if stored.dtype == np.uint8:
            return cv2.LUT(stored, self._of_bytes)
        if stored.dtype == np.uint16:
            return (stored.astype(np.float32) / 65535) ** self._gamma
        if stored.dtype.kind != "f":
            raise DataError(
                f"{self._path}: expected pixels of 8 or 16 bits without a sign, or floating-point ones, got "
                f"{stored.dtype} in frame {number}"
            )
        light = stored.astype(np.float32)
        if not np.isfinite(light).all() or light.min() < 0:
            raise DataError(f"{self._path}: light must be finite and not negative, it is not in frame {number}")
        return light


class _StoredFrames(Frames):
    """Frames with a time each."""

    usual_gamma = GAMMA

    def __init__(self, path: Path, options: FrameOptions, expected: int) -> None:
        self.path, self.options, self.expected = path, options, expected

    def __iter__(self) -> Iterator[tuple[int, np.ndarray]]:
        options, first_s, last_us, count = self.options, None, -1, 0
        self.num_skipped, light = 0, _Light(self.path, options, self.usual_gamma)
        self.shown = shown = list[Shown]()
        self.num_seen_to_end = num_read = 0
        for number, (time_s, stored) in enumerate(self._read()):
            num_read = number + 1
            if time_s < options.start_s:
                continue
            if options.stop_s is not None and time_s > options.stop_s:
                break
            first_s = time_s if first_s is None else first_s
            t_us = self._life_us(time_s - first_s, number)
            if t_us <= last_us:
                self.num_skipped += 1
                continue
            last_us, count = t_us, count + 1
            shown.append(Shown(t_us, number))
            yield t_us, light.of(stored, number)
        else:
            self.num_seen_to_end = num_read
        if count < 2:
            stretch = "" if options.stop_s is None and not options.start_s else " in this stretch"
            raise DataError(f"{self.path}: expected two frames or more at different times{stretch}, got {count}")

    def _life_us(self, shown_s: float, number: int) -> int:
        life_us = shown_s / self.options.slow_motion * 1e6
        if not life_us <= _LATEST_US:
            raise DataError(
                f"{self.path}: frame {number} is {life_us / 1e6:.3g} s after the first, expected at most "
                f"{_LATEST_US / 1e6:.3g} s (285 years); look at the times, fps and slow_motion"
            )
        return round(life_us)

    def stored_size(self) -> SensorSize:
        """See `Frames`; reads one frame."""
        for _, stored in self._read():
            return stored.shape[1], stored.shape[0]
        raise DataError(f"{self.path}: expected two frames or more at different times, got 0")

    @abc.abstractmethod
    def _read(self) -> Iterator[tuple[float, np.ndarray]]:
        """Times in s, and frames as they are stored, [H, W, 3]."""


def _in_stretch(count: int, fps: float, options: FrameOptions) -> int:
    """How many of the frames of a video, about, lie in the stretch that is asked for; 0 = nobody knows."""
    if not options.start_s and options.stop_s is None:
        return count
    if not fps:
        return 0
    # Cut to the count before they become whole numbers: seconds may be as many as a float can say.
    stop = count if options.stop_s is None else min(count, round(min(options.stop_s * fps, count)) + 1)
    return max(stop - math.ceil(min(options.start_s * fps, count)), 0)


class _VideoFile(_StoredFrames):
    def __init__(self, path: Path, options: FrameOptions) -> None:
        import cv2

        capture = _open(path)
        counted, stated_fps = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
        capture.release()
        self._counted = int(counted) if math.isfinite(counted) and counted > 0 else 0
        # Matroska has a duration alone, of which OpenCV makes a number by a rate that it guesses.
        self.num_stored = 0 if path.suffix.lower() in _WITHOUT_COUNT else self._counted
        fps = options.fps or (stated_fps if math.isfinite(stated_fps) and stated_fps > 0 else 0.0)
        super().__init__(path, options, _in_stretch(self._counted, fps, options))

    def _read(self) -> Iterator[tuple[float, np.ndarray]]:
        import cv2

        capture = _open(self.path)
        try:
            fps = self.options.fps or 0.0
            stated_fps = capture.get(cv2.CAP_PROP_FPS)
            count, before_s, has_times = 0, -1.0, True
            while True:
                is_there, frame = capture.read()
                if not is_there:
                    break
                time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                if count == 1 and time_s <= before_s:
                    has_times = False  # the container knows nothing but a rate
                if not has_times and not fps:
                    fps = stated_fps if math.isfinite(stated_fps) and stated_fps > 0 else 0.0
                    if not fps:
                        raise DataError(f"{self.path}: the file says nothing of the times of its frames; give fps")
                if has_times and count and time_s == 0:
                    # OpenCV has no time of this frame, as of the last one of MPEG-1 and MPEG-2, which comes late.
                    time_s = before_s + (1 / stated_fps if math.isfinite(stated_fps) and stated_fps > 0 else 0.0)
                before_s = time_s
                yield (count / fps if fps else time_s), frame
                count += 1
        finally:
            capture.release()
        seen = count
        if count and has_times and math.isfinite(stated_fps) and stated_fps > 0:
            seen = round(before_s * stated_fps) + 1  # rates vary: what counts is how far the frames reach
        if seen < self._counted - max(2, _NOT_SHOWN * self._counted):
            raise DataError(
                f"{self.path}: ends after frame {seen} of {self._counted}; the file is cut or damaged. What is before "
                f"can be read with an earlier stop"
            )


class _PictureFolder(_StoredFrames):
    def __init__(self, path: Path, options: FrameOptions) -> None:
        self._paths, self._times_s = list_folder(path, options.fps)
        self.names, self.num_stored = tuple(one.name for one in self._paths), len(self._paths)
        last_s = math.inf if options.stop_s is None else options.stop_s
        super().__init__(path, options, sum(options.start_s <= time_s <= last_s for time_s in self._times_s))

    def _read(self) -> Iterator[tuple[float, np.ndarray]]:
        for path, time_s in zip(self._paths, self._times_s, strict=True):
            yield time_s, read_picture(path)


class _RecordedFrames(_StoredFrames):
    """Those that an event camera took beside its events."""

    usual_gamma = 1.0  # a sensor's pixels as they are, where videos are made for screens

    def __init__(self, path: Path, options: FrameOptions) -> None:
        super().__init__(path, options, 0)

    def _read(self) -> Iterator[tuple[float, np.ndarray]]:
        first_us: int | None = None
        for number, frame in enumerate(read_camera_frames(self.path)):
            first_us = frame.t if first_us is None else first_us
            grey = frame.pixels.ndim == 2
            stored = frame.pixels[..., None].repeat(3, axis=2) if grey else frame.pixels[..., ::-1]
            fps = self.options.fps
            yield number / fps if fps else (frame.t - first_us) / 1e6, np.ascontiguousarray(stored)


class _StillPicture(Frames):
    """One picture that the camera looks at in saccades."""

    is_dense = True

    def __init__(self, path: Path, options: FrameOptions, max_displacement_px: float) -> None:
        given = {"fps": options.fps, "start": options.start_s, "stop": options.stop_s}
        if named := [name for name, value in given.items() if value] + ["slow_motion"] * (options.slow_motion != 1):
            raise DataError(f"{path}: a still picture is seen in saccades of their own times; leave out {named[0]}")
        stored = read_picture(path)
        self._stored_size = stored.shape[1], stored.shape[0]
        self.names, self.num_stored = (path.name,), 1
        self._light = _Light(path, options).of(stored, 0)
        scale = min(self._light.shape) / NMNIST_SIDE_PX
        path_px = tuple((scale * x, scale * y) for x, y in NMNIST_PATH_PX)
        self._times_us, self._moved_px = path_frames(NMNIST_PATH_US, path_px, max_displacement_px)
        self.expected = len(self._times_us)

    def __iter__(self) -> Iterator[tuple[int, np.ndarray]]:
        import cv2

        size = self._light.shape[::-1]
        self.shown = shown = list[Shown]()
        for t_us, (right, down) in zip(self._times_us.tolist(), self._moved_px.tolist(), strict=True):
            moved = np.array([[1, 0, right], [0, 1, down]], np.float64)
            light = cv2.warpAffine(self._light, moved, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            shown.append(Shown(t_us, 0, right, down))
            yield t_us, light

    def stored_size(self) -> SensorSize:
        """See `Frames`."""
        return self._stored_size


def grey_levels(light: np.ndarray) -> np.ndarray:
    """uint8 as a picture of that light would be stored: what people see."""
    return np.rint(255 * np.clip(light, 0, 1) ** (1 / GAMMA)).astype(np.uint8)


def open_frames(path: Path, options: FrameOptions, max_displacement_px: float = 1.0) -> Frames:
    """The frames of a video file, of a folder of pictures, of an AEDAT 4 recording, or of one picture.

    Args:
        path: the file or folder.
        options: see `FrameOptions`.
        max_displacement_px: movement of a still picture between two frames.
    Raises:
        DataError: nothing there, nothing that can be read, or no times.
    """
    if path.is_dir():
        return _PictureFolder(path, options)
    if not path.is_file():
        raise DataError(f"{path}: expected a video, a folder of pictures or a picture, got nothing there")
    if path.suffix.lower() in PICTURE_SUFFIXES:
        return _StillPicture(path, options, max_displacement_px)
    return _RecordedFrames(path, options) if aedat4.sniff(path) else _VideoFile(path, options)


def _open(path: Path):
    import cv2

    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise DataError(f"{path}: not a video that OpenCV can read ({path.stat().st_size} bytes)")
    return capture


class Cover(NamedTuple):
    """The part of a picture that a sensor sees, px of the picture; it is scaled to the sensor's size."""

    left: int
    top: int
    width: int
    height: int


def covering_part(stored: SensorSize, size: SensorSize) -> Cover:
    """Of a picture that is scaled so that it covers a size, and cut to it about its middle."""
    width, height = stored
    if stored == size:
        return Cover(0, 0, width, height)
    scale = max(size[0] / width, size[1] / height)
    # What will be cut is not scaled first: of a wide video that is a third.
    keep = min(width, math.ceil(size[0] / scale)), min(height, math.ceil(size[1] / scale))
    return Cover((width - keep[0]) // 2, (height - keep[1]) // 2, *keep)


def _cover(stored: np.ndarray, size: SensorSize) -> np.ndarray:
    """The picture scaled so that it covers a size, and cut to it about its middle."""
    import cv2

    height, width = stored.shape[:2]
    if (width, height) == size:
        return stored
    left, top, wide, high = covering_part((width, height), size)
    is_smaller = max(size[0] / width, size[1] / height) < 1
    part = stored[top : top + high, left : left + wide]
    return cv2.resize(part, size, interpolation=cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR)
