"""Labels of frames in a CSV: see `ctlev_core.video.label_files`."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ctlev_core.video.label_files import Label, Track, VideoLabels, add_label, check_box, numbers
from data_contracts.errors import DataError

BOX = ("x", "y", "width", "height")
OTHERS = ("frame", "instance", "category", *BOX)
MOT_CATEGORY = 7
"""Column of MOTChallenge's annotations; lists of detections have ten columns and no category."""


def read_table(path: Path, text: str) -> VideoLabels:
    """The labels of a CSV.

    Raises:
        DataError: an unknown or missing column, or a row that cannot be; it is named by its line.
    """
    rows = list(csv.reader(text.splitlines()))
    header = [name.strip() for name in rows[0]] if rows else []
    is_mot = bool(header) and _is_number(header[0])
    names = () if is_mot else _keypoint_names(path, header)
    tracks: dict[str, Track] = {}
    ids: dict[str, int] = {}
    for line, row in enumerate(rows[0 if is_mot else 1 :], 1 if is_mot else 2):
        if not any(cell.strip() for cell in row):
            continue
        where = f"{path}: line {line}"
        cells = _mot_cells(row, where) if is_mot else _cells(row, header, where)
        if cells is None:
            continue
        frame = _frame(cells, where)
        category = ids.setdefault(cells.get("category") or "object", len(ids) + 1)
        instance = cells["instance"]
        track = tracks.setdefault(instance, Track(category, int(instance) if instance.isdecimal() else instance))
        if track.labels and frame < next(reversed(track.labels)):  # the last that was added
            raise DataError(f"{where}: frames of instance {track.instance} must ascend, got {frame} late")
        add_label(track, frame, category, _label(cells, names, where), where)
    categories = [
        {"id": number, "name": name} | ({"keypoints": list(names)} if names else {}) for name, number in ids.items()
    ]
    return VideoLabels(
        path, sorted({frame for one in tracks.values() for frame in one.labels}), [*tracks.values()], categories
    )


def _keypoint_names(path: Path, header: list[str]) -> tuple[str, ...]:
    missing = [name for name in ("frame", "instance") if name not in header]
    if missing or len(set(header)) < len(header):
        problem = f"no column {missing[0]!r}" if missing else "a column twice"
        raise DataError(
            f"{path}: {problem}: expected frame, instance, and category, x, y, width, height or NAME_x, NAME_y"
        )
    if 0 < sum(name in header for name in BOX) < len(BOX):
        raise DataError(f"{path}: a box needs the columns {', '.join(BOX)}, got {', '.join(header)[:200]}")
    rest = [name for name in header if name not in OTHERS]
    names = tuple(name.removesuffix("_x") for name in rest if name.endswith("_x"))
    if sorted(rest) != sorted(f"{name}_{axis}" for name in names for axis in "xy"):
        odd = next((name for name in rest if name[-2:] not in ("_x", "_y")), rest[0])
        raise DataError(f"{path}: column {odd!r} is unknown, or its NAME_x or NAME_y is missing")
    return names


def _cells(row: list[str], header: list[str], where: str) -> dict[str, str]:
    if len(row) != len(header):
        raise DataError(f"{where}: expected {len(header)} fields, got {len(row)}")
    return dict(zip(header, (cell.strip() for cell in row), strict=True))


def _mot_cells(row: list[str], where: str) -> dict[str, str] | None:
    """None for a row that is marked as to be ignored."""
    if len(row) < 6 or not _is_number(row[0]):
        raise DataError(
            f"{where}: expected MOTChallenge's frame, id, left, top, width, height, ..., got {len(row)} fields"
        )
    if len(row) > 6 and _is_number(row[6]) and float(row[6]) == 0:
        return None
    cells: dict[str, str] = dict(zip(("frame", "instance", *BOX), (cell.strip() for cell in row), strict=False))
    if len(row) == MOT_CATEGORY + 2:
        cells["category"] = row[MOT_CATEGORY].strip()
    # Frames and the corner of a box count from 1.
    first = {name: repr(float(cells[name]) - 1) for name in ("frame", "x", "y") if _is_number(cells[name])}
    return cells | first


def _frame(cells: dict[str, str], where: str) -> int:
    text = cells["frame"]
    if not _is_number(text) or not float(text).is_integer() or float(text) < 0:
        raise DataError(f"{where}: frame must be a whole number from the first frame on, got {text[:40]!r}")
    if not cells["instance"]:
        raise DataError(f"{where}: instance is empty")
    return int(float(text))


def _label(cells: dict[str, str], names: tuple[str, ...], where: str) -> Label:
    box = points = None
    if any(cells.get(name) for name in BOX):
        box = check_box(numbers([_number(cells[name], name, where) for name in BOX], 4, f"{where}: box"), where)
    if names:
        points = np.zeros((len(names), 3))
        for row, name in enumerate(names):
            given = [cells[f"{name}_{axis}"] for axis in "xy"]
            if any(given):
                found = [_number(text, name, where) for text in given]
                points[row] = [*numbers(found, 2, f"{where}: {name}"), 2]
    if box is None and (points is None or not points[:, 2].any()):
        raise DataError(f"{where}: expected a box or a keypoint, got none")
    return Label(box, points)


def _number(text: str, name: str, where: str) -> float:
    if not _is_number(text):
        raise DataError(f"{where}: {name} must be a number, got {text[:40]!r}")
    return float(text)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
