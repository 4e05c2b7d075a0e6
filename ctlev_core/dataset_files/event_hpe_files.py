"""The files of Event-HPE: poses in joblib files, event images, raw events. Sources as in `datasets/event_hpe.py`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctlev_core.dataset_files.picture_files import read_stored
from data_contracts.errors import DataError
from data_contracts.events import Events

RAW_SIZE = (800, 1280)
"""(width, height) px: the camera stood upright."""
PADDED_SIZE = 1280
"""The authors pad the width with 240 px on each side and scale the square down."""
PADDING = (PADDED_SIZE - RAW_SIZE[0]) // 2
POSE_IMAGE_SIZE = 256
"""joints2d of a pose file are px of the square image at this size."""
FOCAL_LENGTH, CENTRE = 1679.3, 641.0
"""px of the padded square, both axes alike, from the authors' dataloader.py; it gives no distortion."""
NUM_JOINTS = 24
MAX_BAD_ROWS = 0.01
"""A file with a larger part of its rows incomplete or outside the sensor is refused."""


@dataclass(frozen=True, eq=False)
class Pose:
    """One pose file.

    Attributes:
        betas: [10] float64.
        theta: [72] float64, rad, axis-angle of the 24 SMPL joints.
        transl: [3] float64, m, camera frame.
        joints3d: [24, 3] float64, m, camera frame, with the translation added.
        joints2d: [24, 2] float64, px of the square image at 256.
    """

    betas: np.ndarray
    theta: np.ndarray
    transl: np.ndarray
    joints3d: np.ndarray
    joints2d: np.ndarray


@dataclass(frozen=True, eq=False)
class RawEvents:
    """The events of consecutive .csv files, one for each event frame.

    Attributes:
        events: all of them, in the order of their times.
        bounds: [F + 1] int64; events bounds[i] .. bounds[i + 1] - 1 are those of file i, but for events whose times
            overlap with a neighbouring file.
        numbers: [F] int64, ascending, numbers of the files.
    """

    events: Events
    bounds: np.ndarray
    numbers: np.ndarray


def numbered(folder: Path, prefix: str, suffix: str) -> dict[int, Path]:
    """Files `<prefix>NNNN<suffix>` of a folder by number; a missing folder has none."""
    found = folder.iterdir() if folder.is_dir() else ()
    matches = ((re.fullmatch(rf"{prefix}(\d{{4,}}){re.escape(suffix)}", path.name), path) for path in found)
    return dict(sorted((int(match[1]), path) for match, path in matches if match))


def read_pose(path: Path) -> Pose:
    """A pose file: (beta [1, 10], theta [1, 72], tran [1, 3], joints3d [24, 3], joints2d [24, 3]: u, v, depth).

    Raises:
        DataError: not these five arrays, or an SMPL parameter is not finite.
    """
    from ctlev_core.safe_files.safe_pickle import load_joblib

    values = load_joblib(path)
    if not isinstance(values, (list, tuple)) or len(values) != 5:
        got = f"{type(values).__name__} of {len(values)}" if hasattr(values, "__len__") else type(values).__name__
        raise DataError(f"{path}: expected beta, theta, tran, joints3d and joints2d, got {got}")
    arrays = []
    shapes = {"beta": (10,), "theta": (72,), "tran": (3,), "joints3d": (NUM_JOINTS, 3), "joints2d": (NUM_JOINTS, 3)}
    for (name, shape), value in zip(shapes.items(), values, strict=True):
        array = np.asarray(value)
        array = array[0] if array.ndim == len(shape) + 1 and len(array) == 1 else array
        known = array.shape == shape or (name == "joints2d" and array.shape == (NUM_JOINTS, 2))
        if not known or array.dtype.kind not in "fiu":
            raise DataError(f"{path}: {name} must be {list(shape)} numbers, got {list(array.shape)} {array.dtype}")
        if len(shape) == 1 and not np.isfinite(array).all():
            raise DataError(f"{path}: {name} is not finite")
        arrays.append(array.astype(np.float64))
    return Pose(*arrays[:4], joints2d=arrays[4][:, :2])


def read_event_images(paths: Sequence[Path], size: int) -> np.ndarray:
    """Event images [N, size, size] uint8: 255 where an event fell in any of the four time slices of a file, else 0.

    Raises:
        DataError: a file is no picture of four channels and that size.
    Source: event_pose_estimation/dataloader.py, which joins slices by `sum > 0`.
    """
    import cv2

    images = np.empty((len(paths), size, size), np.uint8)
    for image, path in zip(images, paths, strict=True):
        # UNCHANGED: the fourth slice lies in the alpha channel.
        slices = read_stored(path, cv2.IMREAD_UNCHANGED)
        if slices is None or slices.shape != (size, size, 4) or slices.dtype != np.uint8:
            got = "no picture" if slices is None else f"{list(slices.shape)} {slices.dtype}"
            raise DataError(f"{path}: expected four time slices [{size}, {size}, 4] of 8 bits, got {got}")
        image[:] = 255 * slices.any(axis=2)
    return images


def read_raw(files: dict[int, Path], where: str) -> RawEvents:
    """Events of .csv files `v, u, in_pixel_time, off_pixel_time, polarity`, upright: x = 799 - u, y = 1279 - v.

    Times are the in-pixel times, which the authors use, taken as us and sorted: rows of a file are not in their order.
    Polarity above 0 is ON. Up to 1 % of the rows of a file may be incomplete or outside the sensor; they are dropped.

    Args:
        files: by number.
        where: names the recording in the message.
    Raises:
        DataError: a damaged file, a clock that starts anew from file to file, or no events.
    Source: flow_net/prepare_data.py, generate_events_frame.
    """
    tables, before = [], -1.0
    for path in files.values():
        table = _read_rows(path)
        if len(table):
            if table[:, 2].min() < before:
                raise DataError(
                    f"{path}: in_pixel_time starts at {table[:, 2].min()} us, before the middle of the file before "
                    f"({before:.0f} us): the clock starts anew"
                )
            before = float(np.median(table[:, 2]))
        tables.append(table)
    table = np.concatenate(tables) if tables else np.zeros((0, 4), np.int64)
    if len(table) == 0:
        raise DataError(f"{where}: expected events, got none in {len(files)} files")
    table = table[np.argsort(table[:, 2], kind="stable")]
    width, height = RAW_SIZE
    events = Events(
        t=np.ascontiguousarray(table[:, 2]),
        x=(width - 1 - table[:, 1]).astype(np.uint16),
        y=(height - 1 - table[:, 0]).astype(np.uint16),
        p=(table[:, 3] > 0).astype(np.uint8),
        sensor_size=RAW_SIZE,
    )
    bounds = np.cumsum([0, *map(len, tables)]).astype(np.int64)
    return RawEvents(events, bounds, np.array(list(files), np.int64))


def raw_times_us(raw: RawEvents, numbers: np.ndarray) -> np.ndarray:
    """Times [N] int64 us of the poses and grey pictures with these numbers; -1 where no events are near.

    Picture n was taken between the event files n - 1 and n: its time is that of the last event of file n - 1, so that
    it labels the window which it ends; where that file is missing, 1 us before the first event of file n.
    """
    t = raw.events.t
    has_events = raw.bounds[1:] > raw.bounds[:-1]
    first = {int(n): int(t[a]) for n, a, full in zip(raw.numbers, raw.bounds[:-1], has_events, strict=True) if full}
    last = {int(n): int(t[b - 1]) for n, b, full in zip(raw.numbers, raw.bounds[1:], has_events, strict=True) if full}
    before = {n: max(start - 1, 0) for n, start in first.items()}
    times = [last.get(n - 1, before.get(n, -1)) for n in numbers.tolist()]
    known = np.array(times, np.int64)
    return np.where(known < 0, -1, np.maximum.accumulate(known))


def _read_rows(path: Path) -> np.ndarray:
    """Rows [N, 4] int64 of v, u, time, polarity."""
    import pandas

    if path.stat().st_size == 0:
        return np.zeros((0, 4), np.int64)
    try:
        rows = pandas.read_csv(path, header=None, names=["v", "u", "t", "off", "p"], index_col=False).to_numpy()
    except ValueError as error:
        raise DataError(f"{path}: expected rows of five numbers: {error}") from error
    if rows.dtype.kind not in "fiu":
        raise DataError(f"{path}: expected rows of five numbers, got text")
    rows = rows[:, [0, 1, 2, 4]]
    width, height = RAW_SIZE
    inside = (rows[:, 0] >= 0) & (rows[:, 0] < height) & (rows[:, 1] >= 0) & (rows[:, 1] < width)
    good = inside & (np.isfinite(rows) & (rows == np.floor(rows))).all(axis=1)
    if (~good).sum() > MAX_BAD_ROWS * len(rows):
        at = int(np.argmin(good))
        raise DataError(
            f"{path}: {(~good).sum()} of {len(rows)} rows are incomplete or outside {height} x {width}, the first "
            f"is row {at}: v, u, time, polarity {rows[at].tolist()}"
        )
    return rows[good].astype(np.int64)
