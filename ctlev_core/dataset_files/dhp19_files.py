"""The files of DHP19: four cameras in one AEDAT 2.0 file, motion capture, projection matrices.

Source: SensorsINI/DHP19 @12a3fe6: read_aedat/ImportAedatDataVersion1or2.m (bits of an address),
generate_DHP19/Generate_DHP19.m (start and stop of a recording), extract_from_aedat.m (orientation of the pictures),
heatmap_generation_example.ipynb (which matrix belongs to which channel, projection).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctlev_core.events.decoding.array_files import read_array_header
from ctlev_core.safe_files import hdf5_files
from ctlev_core.safe_files.mat_files import read_struct
from ctlev_core.safe_files.numpy_files import read_numbers
from data_contracts.errors import DataError

if TYPE_CHECKING:
    import h5py

    from ctlev_core.geometry.camera import Camera

NUM_CAMERAS = 4
SENSOR_SIZE = (346, 260)
CHANNEL_OF_CAMERA = {1: 1, 2: 3, 3: 2, 4: 0}
"""Camera N has projection matrix PN; its events and pictures are in this channel of the files."""
VICON_PERIOD_US = 10_000
VICON_JOINTS = (
    "head", "shoulderR", "shoulderL", "elbowR", "elbowL", "hipR", "hipL", "handR", "handL", "kneeR", "kneeL", "footR",
    "footL",
)  # fmt: skip
"""The motion capture's names, in the order of `JOINT_SETS["dhp19"]`."""
MAX_SPECIAL_EVENTS = 5
FRAME_WIDTHS = (344, 346)
FRAMES_A_BLOCK = 16
MAX_LABEL_BYTES = 2**30


@dataclass(frozen=True, eq=False)
class Stream:
    """N events of all four cameras between the triggers that start and stop the motion capture, in the file's order.

    Attributes:
        t: [N] int64, us after the start trigger, which is the time of the motion capture's first row.
        channel: [N] uint8, 0 .. 3.
        x: [N] uint16, px, of the upright picture (the addresses run from right to left and from bottom to top).
        y: [N] uint16, px.
        p: [N] uint8, 1 = ON.
    """

    t: np.ndarray
    channel: np.ndarray
    x: np.ndarray
    y: np.ndarray
    p: np.ndarray


def read_stream(path: Path, num_vicon_rows: int, filters: bool) -> Stream:
    """Events of an .aedat file, cut to the motion capture and, if wanted, filtered as `dhp19_filters` says.

    Addresses outside the sensor are dropped: the published files have some.

    Args:
        path: one movement.
        num_vicon_rows: rows of its motion capture, whose length stands in for a missing trigger.
        filters: drop hot pixels, background activity and the infra-red lights.
    Raises:
        DataError: no AEDAT 2.0 file, no events, or triggers of no known pattern.
    Source: extract_from_aedat.m. Its reader loses the first record of a file; that one precedes the start trigger.
    """
    from ctlev_core.events.decoding.aedat2 import read_records

    address, stamp = read_records(path)
    # Bit 31: picture samples and IMU. Bit 10: special events, here the triggers of the motion capture.
    is_event = (address & 0x80000400) == 0
    is_special = (address & 0x80000400) == 0x400
    special = stamp[is_special]
    address, stamp = address[is_event], stamp[is_event]
    if len(stamp) == 0:
        raise DataError(f"{path}: expected events of four cameras, got {len(special)} special events and no others")
    start, stop = recorded_span(stamp, special, num_vicon_rows, str(path))
    first, last = _index_range(stamp, start, stop)
    address, stamp = address[first:last], stamp[first:last]

    channel = address & 0xF
    x, y = (address >> 12) & 0x3FF, (address >> 22) & 0x1FF
    width, height = SENSOR_SIZE
    inside = (channel < NUM_CAMERAS) & (x < width) & (y < height)
    address, stamp, channel, x, y = (a[inside] for a in (address, stamp, channel, x, y))
    x, y = width - 1 - x.astype(np.int64), height - 1 - y.astype(np.int64)
    keep = np.ones(len(stamp), np.bool_)
    if filters:
        from ctlev_core.dataset_files.dhp19_filters import keep_events

        keep = keep_events(width * channel.astype(np.int64) + x, y, stamp)
    return Stream(
        t=stamp[keep] - start,
        channel=channel[keep].astype(np.uint8),
        x=x[keep].astype(np.uint16),
        y=y[keep].astype(np.uint16),
        p=((address[keep] >> 11) & 1).astype(np.uint8),
    )


def recorded_span(stamp: np.ndarray, special: np.ndarray, num_vicon_rows: int, where: str) -> tuple[int, int]:
    """Start and stop of the motion capture, us on the clock of the file.

    Three or five special events: the first and the last. One, two or four (nearly) at once: only one trigger was
    recorded; it is the start or the stop, whichever end of the events is nearer, and the other follows from the length
    of the motion capture. None: the first and the last event.

    Args:
        stamp: [N] int64, us, of the events of all cameras.
        special: [S] int64, us, of the special events.
        num_vicon_rows: rows of the motion capture, one each 10 ms.
        where: names the file in the message.
    Raises:
        DataError: more than five special events, as in the two recordings the authors removed.
    Source: Generate_DHP19.m, cases a to g, and its case of a clock that overflows (S14/session1/mov1), where events
        count only up to the overflow.
    """
    duration = num_vicon_rows * VICON_PERIOD_US
    count = len(special)
    if count > MAX_SPECIAL_EVENTS:
        raise DataError(
            f"{where}: expected at most {MAX_SPECIAL_EVENTS} special events, got {count}: damaged recording"
        )
    if count == 0:
        return int(stamp[0]), int(stamp[-1])
    trigger = int(special[0])
    if count in (3, 5):
        return trigger, int(special[-1])
    if count == 1:
        before, after = trigger - int(stamp.min()), int(stamp.max()) - trigger
    elif stamp[-1] < stamp[0]:
        return trigger, int(stamp.max())
    else:
        before, after = trigger - int(stamp[0]), int(stamp[-1]) - trigger
    return (trigger - duration, trigger) if before > after else (trigger, trigger + duration)


def _index_range(stamp: np.ndarray, start: int, stop: int) -> tuple[int, int]:
    """Events after `start` and before `stop`; where the clock overflows, with both of them and up to the overflow."""
    if stamp[-1] < stamp[0]:
        stamp = stamp[: int(np.argmax(stamp)) + 1]
        later, earlier = np.flatnonzero(stamp >= start), np.flatnonzero(stamp <= stop)
    else:
        later, earlier = np.flatnonzero(stamp > start), np.flatnonzero(stamp < stop)
    if len(later) == 0 or len(earlier) == 0:
        return 0, 0
    return int(later[0]), int(earlier[-1]) + 1


def nearest_vicon_row(t_us: np.ndarray) -> np.ndarray:
    """Row of the motion capture nearest to times [N] int64 us after the start trigger.

    Source: ExtractEventsToFramesAndMeanLabels.m, `floor((timeStamp - startTime)*0.0001)+1`: the stamps are uint32, so
        MATLAB rounds the product to the nearest integer before `floor` sees it.
    """
    return (t_us + VICON_PERIOD_US // 2) // VICON_PERIOD_US


def read_vicon(path: Path) -> np.ndarray:
    """Joint positions [N, 13, 3] float64, mm, world frame of the motion capture, one row each 10 ms; NaN = not seen.

    Raises:
        DataError: not a .mat file of this kind, a joint is missing, or joints differ in length.
    """
    positions = read_struct(path, "XYZPOS")
    joints = []
    for name in VICON_JOINTS:
        rows = positions.get(name, np.zeros(0))
        if rows.ndim != 2 or rows.shape[1] != 3:
            found = ", ".join(positions)[:200] or "none"
            raise DataError(f"{path}: XYZPOS.{name} must be [N, 3] numbers, got {rows.shape}; fields: {found}")
        joints.append(rows.astype(np.float64))
    lengths = {name: len(rows) for name, rows in zip(VICON_JOINTS, joints, strict=True)}
    if len(set(lengths.values())) != 1 or 0 in lengths.values():
        raise DataError(f"{path}: joints must have the same number of rows, at least one, got {lengths}")
    return np.stack(joints, axis=1)


def read_projection(path: Path) -> np.ndarray:
    """A projection matrix [3, 4] float64 of the authors: mm of the motion capture to px, rows from the bottom up.

    Raises:
        DataError: not such a matrix.
    """
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            dtype = read_array_header(file, path.name, size).dtype
            file.seek(0)
            matrix = read_numbers(file, size, path.name)
    except (DataError, FileNotFoundError) as error:
        raise DataError(f"{path}: expected a projection matrix in a .npy file: {error}") from error
    if matrix.shape != (3, 4) or dtype.kind != "f" or not np.isfinite(matrix).all():
        raise DataError(f"{path}: expected a projection matrix [3, 4] of finite floats, got {matrix.shape} {dtype}")
    return matrix


def camera_of(matrix: np.ndarray, where: str) -> Camera:
    """The pinhole camera behind a projection matrix of the authors.

    The authors' pixel is (u, v) = (P0/P2, 260 - P1/P2) and lies in column floor(u), row floor(v); so their (u, v) are
    our pixel coordinates as they are, pixel centres at integer + 0.5. The flip of v goes into the matrix, which is
    then split into K (upper triangular, with skew), R and translation; the world frame is the motion capture's, in m.

    Args:
        matrix: [3, 4] float64, see `read_projection`.
        where: names the file in the message.
    Raises:
        DataError: the matrix has no inverse camera (its left 3 x 3 block is singular).
    """
    from ctlev_core.geometry.camera import from_projection_matrix

    flipped = np.array([[1, 0, 0], [0, -1, SENSOR_SIZE[1]], [0, 0, 1]]) @ matrix
    camera = from_projection_matrix(flipped, SENSOR_SIZE, where)
    return replace(camera, translation=camera.translation / 1000.0)


def read_frame_labels(path: Path, frames_path: Path | None = None) -> np.ndarray:
    """Joint positions [N, 13, 3] float64, mm, one row a frame, of `/XYZ` in a `_label.h5` file; NaN = not seen.

    The authors' loop leaves a last frame black and without label where the motion capture ends before the events;
    that one is not counted. With `frames_path`, the frames must be as many.

    Raises:
        DataError: not such a file, or it has not one label a frame.
    """

    def positions_of(data: h5py.Dataset) -> np.ndarray:
        if data.ndim != 3 or data.shape[1:] != (3, len(VICON_JOINTS)):
            raise DataError(f"{path}: /XYZ must be [N, 3, {len(VICON_JOINTS)}], got {data.shape}")
        return hdf5_files.check_dataset(data, f"{path}: /XYZ", MAX_LABEL_BYTES)[:]

    positions = _read_dataset(path, "XYZ", positions_of)
    num_frames = (
        len(positions) if frames_path is None else _read_dataset(frames_path, "DVS", lambda data: data.shape[0])
    )
    if num_frames != len(positions):
        raise DataError(f"{path}: expected one label for each of {num_frames} frames, got {len(positions)}")
    if len(positions) and np.isnan(positions[-1]).all():
        positions = positions[:-1]
    if len(positions) == 0:
        raise DataError(f"{path}: expected labelled frames, got none")
    return positions.astype(np.float64).transpose(0, 2, 1)


def read_frames(path: Path, channel: int, count: int) -> np.ndarray:
    """The first `count` frames [N, 260, W] uint8 of one channel of `/DVS`, W = 346, or 344 if cropped on the right.

    MATLAB's h5create makes float64 of them unless told otherwise; their values must still be those of 8 bits.

    Raises:
        DataError: not such a file, or a value no byte can hold.
    """
    height = SENSOR_SIZE[1]

    def of_channel(data: h5py.Dataset) -> np.ndarray:
        if (
            data.ndim != 4
            or data.shape[1] != height
            or data.shape[2] not in FRAME_WIDTHS
            or data.shape[3] != NUM_CAMERAS
        ):
            raise DataError(
                f"{path}: /DVS must be [N, {height}, {' or '.join(map(str, FRAME_WIDTHS))}, {NUM_CAMERAS}], "
                f"got {data.shape}"
            )
        images = np.empty((count, height, data.shape[2]), np.uint8)
        # All four channels lie side by side on disk; a block at a time keeps memory small.
        for first in range(0, count, FRAMES_A_BLOCK):
            block = data[first : min(first + FRAMES_A_BLOCK, count)][..., channel]
            images[first : first + len(block)] = block
            wrong = images[first : first + len(block)] != block
            if wrong.any():
                frame, y, x = np.argwhere(wrong)[0]
                raise DataError(
                    f"{path}: expected 8-bit values, got {block[frame, y, x]} in frame {first + frame}, "
                    f"row {y}, column {x}, channel {channel}"
                )
        return images

    with np.errstate(invalid="ignore"):
        return _read_dataset(path, "DVS", of_channel)


def _read_dataset(path: Path, name: str, read: Callable[[Any], Any]) -> Any:
    import h5py

    if not path.is_file():
        raise DataError(f"{path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            data = hdf5_files.find_object(file, name, str(path))
            if not isinstance(data, h5py.Dataset) or data.dtype.kind not in "fiu":
                held = ", ".join(file)[:200] or "nothing"
                raise DataError(f"{path}: expected numbers in /{name}, got {data!r}; it holds {held}")
            return read(hdf5_files.check_dataset(data, f"{path}: /{name}"))
    except (DataError, MemoryError):
        raise
    except Exception as error:  # h5py passes HDF5's errors on as half a dozen types
        raise DataError(f"{path}: expected an HDF5 file: {error}") from error
