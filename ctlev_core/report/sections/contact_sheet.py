"""Conditions over event frames, so that a wrong camera, a mirrored body or a shifted joint is seen at once."""

from __future__ import annotations

import numpy as np

from ctlev_core.events.windows import spread
from ctlev_core.report.page.html import ImageGrid, Section, Table
from data_contracts.array_rows import Images
from data_contracts.labels import Labels
from data_contracts.manifest import Manifest

COLUMNS = 10
MAX_ROWS = 24
SMALLEST_SIDE = 192
"""Pictures are enlarged to at least this, so that the mark of a joint does not hide what lies under it."""
EVENT_LEVEL = 40
"""Value from which a pixel of an event image hides the condition under it."""
MARK, RIM = (255, 0, 160), (255, 255, 255)
"""Colours of a joint's mark: one that neither events nor conditions are full of."""
FEW = 3
PER_ROW = COLUMNS // (FEW - 1)
MAX_PROMPTS = 40


def contact_sheet_sections(frames: Manifest, frame_conditions: Manifest, sample_conditions: Manifest) -> list[Section]:
    """Some training frames with their conditions, and some of the conditions to sample from, evenly spread."""
    return [_training_section(frames, frame_conditions), _sampling_section(sample_conditions)]


def training_grid(frames: np.ndarray, conditions: np.ndarray | None, labels: Labels, names: list[str]) -> ImageGrid:
    """Event frames, their conditions, both together, and the joints: one column a frame.

    Args:
        frames: [N, H, W, 3] uint8 event images.
        conditions: [N, H, W, 3] uint8, or None for prompts alone.
        labels: N rows in image pixels.
        names: N column labels.
    """
    rows: list[tuple[str, list[np.ndarray]]] = [("events", [_shown(frame) for frame in frames])]
    if conditions is not None:
        rows.append(("condition", [_shown(condition) for condition in conditions]))
        rows.append(("both", [_shown(overlay(f, c)) for f, c in zip(frames, conditions, strict=True)]))
    if labels.joints2d is not None:
        rows.append(("joints", [_shown(frame, labels, row) for row, frame in enumerate(frames)]))
    return ImageGrid(
        "Training frames and their conditions",
        rows,
        names,
        "Events must lie on the outline of the condition and on the joints. If they lie beside, mirrored or at another "
        "scale, the camera of the labels is wrong.",
    )


def sampling_grid(conditions: Images, labels: Labels, classes: list[str]) -> ImageGrid:
    """Conditions to sample from with their joints, one row a class, evenly spread; only what is shown is read.

    Args:
        conditions: [N, H, W, 3] uint8.
        labels: N rows in image pixels.
        classes: the class of each, empty where there is none.
    """
    members = {name: rows[spread(len(rows), COLUMNS)].tolist() for name, rows in _by_class(classes).items()}
    if max(map(len, members.values()), default=0) < FEW:
        # Many classes of one picture each would make a column: several share a row.
        names = list(members)
        groups = [names[start : start + PER_ROW] for start in range(0, len(names), PER_ROW)]
        members = {", ".join(group): [row for name in group for row in members[name]] for group in groups}
    rows = [
        (name or "pose", [_shown(np.asarray(conditions[row]), labels, row) for row in of_name[:COLUMNS]])
        for name, of_name in list(members.items())[:MAX_ROWS]
    ]
    more = f" {len(members) - MAX_ROWS} more rows are not shown." if len(members) > MAX_ROWS else ""
    return ImageGrid("Conditions to sample from", rows, caption="Marks are the labelled joints." + more)


def overlay(frame: np.ndarray, condition: np.ndarray) -> np.ndarray:
    """An event image [H, W, 3] over its dimmed condition [H, W, 3], both uint8."""
    strength = frame.max(axis=-1, keepdims=True)
    return np.where(strength >= EVENT_LEVEL, frame, condition // 2).astype(np.uint8)


def _shown(image: np.ndarray, labels: Labels | None = None, row: int = 0) -> np.ndarray:
    """The image, enlarged by repeating pixels; with marks at the visible joints of a row of labels where given."""
    factor = max(1, -(-SMALLEST_SIDE // min(image.shape[:2])))
    shown = image.repeat(factor, axis=0).repeat(factor, axis=1)
    if labels is None or labels.joints2d is None or labels.visible is None:
        return shown
    import cv2

    for joint in labels.joints2d[row][labels.visible[row]]:
        centre = int(joint[0] * factor), int(joint[1] * factor)
        cv2.circle(shown, centre, 3, RIM, -1, cv2.LINE_AA)
        cv2.circle(shown, centre, 2, MARK, -1, cv2.LINE_AA)
    return shown


def _training_section(frames: Manifest, conditions: Manifest) -> Section:
    rows = {name: row for row, name in enumerate(frames.column("sample_id"))}
    chosen = _in_turns(conditions.column("class_name"))
    members = [rows[conditions.column("sample_id")[row]] for row in chosen]
    names = [frames.column("class_name")[row] or frames.column("subject")[row] for row in members]
    images = np.asarray(conditions.array("images")[chosen]) if conditions.has_array("images") else None
    return training_grid(np.asarray(frames.array("frames")[members]), images, frames.labels.take(members), names)


def _sampling_section(conditions: Manifest) -> Section:
    classes = conditions.column("class_name")
    if not conditions.has_array("images"):
        prompts = sorted(set(zip(classes, conditions.column("prompt"), strict=True)))
        rows = [list(pair) for pair in prompts[:MAX_PROMPTS]]
        more = f" The first {MAX_PROMPTS} of {len(prompts)}." if len(prompts) > MAX_PROMPTS else ""
        return Table("Prompts to sample from", ["class", "prompt"], rows, caption="Each prompt once." + more)
    return sampling_grid(conditions.array("images"), conditions.labels, classes)


def _in_turns(classes: list[str]) -> np.ndarray:
    """Rows for the columns: classes take turns, and the rows of each are evenly spread."""
    by_class = _by_class(classes)
    share = -(-COLUMNS // len(by_class))
    queues = [rows[spread(len(rows), share)] for rows in by_class.values()]
    turns = [rows[turn] for turn in range(share) for rows in queues if turn < len(rows)]
    return np.array(turns[:COLUMNS], np.int64)


def _by_class(classes: list[str]) -> dict[str, np.ndarray]:
    """Rows of each class, in the order in which classes come."""
    rows: dict[str, list[int]] = {}
    for row, name in enumerate(classes):
        rows.setdefault(name, []).append(row)
    return {name: np.array(of_class, np.int64) for name, of_class in rows.items()}
