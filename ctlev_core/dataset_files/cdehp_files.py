"""The files of CDEHP: pictures, label files, raw events as columns of numbers. Sources as in `datasets/cdehp.py`."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctlev_core.events.decoding.array_files import read_array_header, read_items
from data_contracts.errors import DataError
from data_contracts.events import Events

SENSOR_SIZE = (1280, 800)
COLOUR_SIZE = (848, 480)
NUM_JOINTS = 13
WINDOW_US = 8_333
"""1/120 s, cut to whole microseconds as the authors do (FRAME_TIME, csv_spliter.py)."""
EVENT_FRAMES_A_COLOUR_FRAME = 2
RAW_FOLDER = "event_point_cloud"


@dataclass(frozen=True, eq=False)
class FrameLabel:
    """One label file.

    Attributes:
        joints2d: [13, 2] float64 px, order of `JOINT_SETS["cdehp"]`; NaN = unknown.
        partner: number of the picture of the other camera taken at the same time; None where the file names none.
    """

    joints2d: np.ndarray
    partner: int | None


def numbered(folder: Path, suffix: str) -> list[Path]:
    """Files `NNNNNN<suffix>` of a folder by number; other files are ignored, a missing folder has none."""
    if not folder.is_dir():
        return []
    found = [path for path in folder.iterdir() if path.suffix == suffix and path.stem.isdecimal()]
    return sorted(found, key=lambda path: int(path.stem))


def raw_files(folder: Path) -> list[Path]:
    """The .csv of a folder of raw events, or its .npy by number where there is none.

    Raises:
        DataError: more than one .csv.
    """
    tables = sorted(folder.glob("*.csv")) if folder.is_dir() else []
    if len(tables) > 1:
        raise DataError(f"{folder}: expected one .csv of raw events, got {len(tables)}")
    return tables or numbered(folder, ".npy")


def frame_end_us(number: np.ndarray) -> np.ndarray:
    """End of the windows of event frames [N] int64, us."""
    return (number + 1) * WINDOW_US


def window_numbers(t: np.ndarray) -> np.ndarray:
    """Number of the window of each event [N] int64; an event at the very end of the last window belongs to it.

    Source: csv_spliter.py, `np.digitize(t, np.arange(0, t[-1], 8333)) - 1`.
    """
    if len(t) == 0:
        return np.zeros(0, np.int64)
    return np.minimum(t // WINDOW_US, max(-(-int(t[-1]) // WINDOW_US) - 1, 0))


def read_label(path: Path) -> FrameLabel:
    """A label file of an event picture: `13`, `color_name:NNNNNN` (annotation.md says `event_name:`), 13 lines `x y`.

    x and y are fractions of width and height of the image, from its outer corner; `[x] [y]` in brackets, as in files
    before the authors' unification, are pixels.

    Raises:
        DataError: another number of joints or lines, or a line that is not two numbers.
    """
    lines = _lines(path)
    partner = _partner(path, lines)
    if len(lines) != NUM_JOINTS + 2 or lines[0] != str(NUM_JOINTS):
        first = lines[0] if lines else "nothing"
        raise DataError(
            f"{path}: expected {NUM_JOINTS}, a name and {NUM_JOINTS} joints, got {first!r} first and {len(lines)} lines"
        )
    joints = np.empty((NUM_JOINTS, 2))
    for row, line in enumerate(lines[2:]):
        bracketed = re.fullmatch(r"\[\s*(\S+?)\s*\]\s+\[\s*(\S+?)\s*\]", line)
        texts = bracketed.groups() if bracketed else line.split()
        try:
            x, y = (float(text) for text in texts)
        except ValueError:
            raise DataError(f"{path}: line {row + 3}: expected two numbers, got {line!r}") from None
        joints[row] = (x, y) if bracketed else (x * SENSOR_SIZE[0], y * SENSOR_SIZE[1])
    joints[~np.isfinite(joints).all(axis=1)] = np.nan
    return FrameLabel(joints, partner)


def read_pairs(paths: Sequence[Path]) -> list[tuple[int, int]]:
    """Pairs (colour picture, event picture) of the same moment, named by label files of either, by colour picture."""
    pairs: dict[int, int] = {}
    for path in paths:
        partner = _partner(path, _lines(path))
        if partner is None:
            continue
        own = int(path.stem)
        colour, event = (own, partner) if path.parent.name == "color_label" else (partner, own)
        pairs[colour] = min(event, pairs.get(colour, event))
    return sorted(pairs.items())


def colour_times_us(numbers: np.ndarray, pairs: Sequence[tuple[int, int]], where: str) -> np.ndarray:
    """Times [N] int64 us of colour pictures: the middle of the event frame each belongs to.

    Raises:
        DataError: no pair, or times that go back.
    """
    if not pairs:
        raise DataError(f"{where}: no label file names the colour picture of an event image, so none has a time")
    colour, event = np.array(pairs, np.int64).T
    nearest = np.abs(numbers[:, None] - colour).argmin(axis=1)
    frames = event[nearest] + EVENT_FRAMES_A_COLOUR_FRAME * (numbers - colour[nearest])
    back = np.flatnonzero(np.diff(frames) < 0)
    if len(back):
        at = int(back[0]) + 1
        raise DataError(
            f"{where}: colour pictures run backwards: {numbers[at]} belongs to event image {frames[at]}, "
            f"{numbers[at - 1]} to {frames[at - 1]}"
        )
    return frames * WINDOW_US + WINDOW_US // 2


def read_points(paths: Sequence[Path], coordinates: str) -> Events:
    """Raw events of one .csv or of consecutive .npy: two coordinates, the time in us, and perhaps the polarity.

    The authors' recorder writes row, column, time; their site speaks of (x, y, t, p). `auto` takes the column with a
    value of 800 or more for x. Events without polarity have p = 1.

    Raises:
        DataError: not three or four columns of whole numbers, a polarity other than -1, 0 and 1, or columns whose
            meaning cannot be told.
    """
    tables = [_table(path) for path in paths]
    widths = sorted({table.shape[1] for table in tables})
    where = str(paths[0] if len(paths) == 1 else paths[0].parent)
    if len(widths) != 1 or widths[0] not in (3, 4):
        raise DataError(f"{where}: expected 3 or 4 columns of events in every file, got {widths}")
    table = np.concatenate(tables)
    if len(table) == 0:
        raise DataError(f"{where}: expected events, got none")
    p = np.ones(len(table), np.uint8)
    if widths[0] == 4:
        if not np.isin(table[:, 3], (-1, 0, 1)).all():
            raise DataError(f"{where}: the fourth column must be the polarity, -1, 0 or 1, got {table[:, 3].max()}")
        p = (table[:, 3] > 0).astype(np.uint8)
    x_column = _x_column(table, coordinates, where)
    x, y = table[:, x_column], table[:, 1 - x_column]
    for name, column, limit in (("x", x, SENSOR_SIZE[0]), ("y", y, SENSOR_SIZE[1])):
        outside = np.flatnonzero((column < 0) | (column >= limit))
        if len(outside):
            raise DataError(f"{where}: {name} must be 0 .. {limit - 1}, got {column[outside[0]]} at event {outside[0]}")
    return Events(np.ascontiguousarray(table[:, 2]), x.astype(np.uint16), y.astype(np.uint16), p, SENSOR_SIZE)


def _x_column(table: np.ndarray, coordinates: str, where: str) -> int:
    if coordinates != "auto":
        return 0 if coordinates == "x_first" else 1
    wide = [bool((table[:, column] >= SENSOR_SIZE[1]).any()) for column in (0, 1)]
    if wide[0] == wide[1]:
        reason = "both columns have" if wide[0] else "neither of the first two columns has"
        raise DataError(
            f"{where}: {reason} a value of {SENSOR_SIZE[1]} or more, so which is x cannot be told; "
            "set dataset.options.coordinates to row_first or x_first"
        )
    return 0 if wide[0] else 1


def _table(path: Path) -> np.ndarray:
    """Columns of whole numbers [N, C] int64."""
    try:
        if path.suffix == ".npy":
            table = _array(path)
        else:
            import pandas

            table = pandas.read_csv(path, header=None).to_numpy() if path.stat().st_size else np.zeros((0, 3))
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{path}: expected columns of events: {error}") from error
    if table.ndim != 2 or table.dtype.kind not in "fiu":
        raise DataError(f"{path}: expected columns of numbers, got {table.dtype} {list(table.shape)}")
    with np.errstate(invalid="ignore"):
        whole = table.astype(np.int64)
    wrong = np.argwhere(whole != table)
    if len(wrong):
        row, column = wrong[0]
        raise DataError(f"{path}: expected whole numbers, got {table[row, column]} in row {row}, column {column}")
    return whole


def _array(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        header = read_array_header(file, path.name, path.stat().st_size)
        items = read_items(file, header.dtype, math.prod(header.shape), path.name)
    return items.reshape(header.shape, order="F" if header.fortran_order else "C")


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: expected a label file: {error}") from error


def _partner(path: Path, lines: Sequence[str]) -> int | None:
    """The number of the other camera's picture; a file may name its own picture instead, which must be right."""
    match = re.fullmatch(r"(event|color)_name:\s*(\d+)\s*", lines[1]) if len(lines) > 1 else None
    if not match:
        got = repr(lines[1]) if len(lines) > 1 else "nothing"
        raise DataError(f"{path}: line 2: expected color_name: or event_name: and a number, got {got}")
    if f"{match[1]}_label" != path.parent.name:
        return int(match[2])
    if int(match[2]) != int(path.stem):
        raise DataError(f"{path}: line 2: expected the picture's own number {path.stem}, got {match[2]}")
    return None
