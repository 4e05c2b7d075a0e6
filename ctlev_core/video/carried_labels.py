"""Labels of a video as they hold for its events: on the sensor, and at any time between two labelled frames.

Boxes and keypoints of an instance go straight from one labelled frame to the next, if it is in both. Nothing is
guessed across a gap: where an instance is missing in a labelled frame, or where labels are farther apart than usual.
A mask is that of the nearer frame.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.labels.interpolation import MAX_SPACING
from ctlev_core.video import coco_masks
from ctlev_core.video.frames import Cover, Frames, Shown, covering_part
from ctlev_core.video.label_files import Label, Track, VideoLabels, check_frames
from data_contracts.events import SensorSize


class CarriedLabels:
    """Labels of the frames that a sensor saw.

    Args:
        labels: of the video.
        frames: the video, after it was gone through: `frames.shown` says which frame was seen when.
        size: (width, height) px of the sensor.
    Raises:
        DataError: labels of a frame that the video turned out not to have.
    """

    def __init__(self, labels: VideoLabels, frames: Frames, size: SensorSize) -> None:
        self._labels, self._size = labels, size
        self._stored = frames.stored_size()
        self._part = covering_part(self._stored, size)
        if frames.num_seen_to_end:
            check_frames(labels, frames.num_seen_to_end, max(max(one.labels, default=0) for one in labels.tracks))
        labelled = set(labels.frames)
        places = [place for place, one in enumerate(frames.shown) if one.number in labelled]
        self._moments = [frames.shown[place] for place in places]
        self._times = np.array([one.t_us for one in self._moments], np.int64)
        self._last: dict[int, tuple[int, Label | None, Label | None]] = {}
        # Annotations without an instance are a track each: a moment looks at none but those of its frame.
        self._in_frame: dict[int, list[Track]] = {}
        for track in labels.tracks:
            for frame in track.labels:
                self._in_frame.setdefault(frame, []).append(track)
        spacing = np.diff(places)
        self._joined = spacing <= MAX_SPACING * (np.median(spacing) if len(spacing) else 0)

    def coco(self, t_us: np.ndarray, name: str) -> dict[str, Any]:
        """COCO's table (CocoVID) of the labels at times [N] int64 us: an image each, with `t_us`, of that file name."""
        width, height = self._size
        images, annotations = [], []
        for number, time_us in enumerate(t_us.tolist()):
            images.append(
                {"id": number, "video_id": 1, "frame_id": number, "file_name": name, "width": width, "height": height}
                | {"t_us": time_us}
            )
            before = int(np.searchsorted(self._times, time_us, "right")) - 1
            for track in self._in_frame.get(self._moments[before].number, ()) if before >= 0 else ():
                found = self._at(track, time_us, before)
                if found:
                    ids = {"id": len(annotations), "image_id": number, "video_id": 1, "category_id": track.category_id}
                    instance = {} if track.instance is None else {"instance_id": track.instance}
                    annotations.append(ids | instance | {"t_us": time_us} | found)
        videos = [{"id": 1, "name": name, "width": width, "height": height}]
        return {
            "info": {"description": f"labels of {self._labels.path.name}, times in us of the events in {name}"},
            "videos": videos, "images": images, "annotations": annotations, "categories": self._labels.categories,
        }  # fmt: skip

    def _at(self, track: Track, time_us: int, before: int) -> dict[str, Any] | None:
        """What is seen of an instance after the labelled moment `before`; None = nothing, or nobody knows."""
        if self._last.get(id(track), (-1,))[0] != before:
            self._last[id(track)] = before, *self._ends(track, before)
        _, start, stop = self._last[id(track)]
        first_us = int(self._times[before])
        if start is None or time_us == first_us:
            return None if start is None else self._seen(start)
        if stop is None:
            return None
        return self._seen(_between(start, stop, (time_us - first_us) / (int(self._times[before + 1]) - first_us)))

    def _ends(self, track: Track, before: int) -> tuple[Label | None, Label | None]:
        """An instance on the sensor at a labelled moment and at the next one; None where it is not or is another."""
        first = self._moments[before]
        start = self._place(track.labels[first.number], first) if first.number in track.labels else None
        if before + 1 == len(self._moments) or not self._joined[before]:
            return start, None
        second = self._moments[before + 1]
        is_same = track.instance is not None or first.number == second.number
        return start, self._place(
            track.labels[second.number], second
        ) if is_same and second.number in track.labels else None

    def _place(self, label: Label, shown: Shown) -> Label:
        """A label on the sensor, not cut at its edges."""
        part, size = self._part, self._size
        scale = np.array([size[0] / part.width, size[1] / part.height])
        move = np.array([shown.right, shown.down])

        def place(points: np.ndarray) -> np.ndarray:
            return (points - (part.left, part.top)) * scale + move

        box = points = None
        if label.box is not None:
            box = np.concatenate([place(label.box[:2]), label.box[2:] * scale])
        if label.keypoints is not None:
            points = np.column_stack([place(label.keypoints[:, :2]), label.keypoints[:, 2]])
        mask = label.mask
        if isinstance(mask, dict):
            mask = coco_masks.write_runs(_scaled(coco_masks.read_runs(mask, self._stored), part, size, move))
        elif mask is not None:
            mask = [place(polygon) for polygon in mask]
        return Label(box, points, mask, label.is_crowd)

    def _seen(self, label: Label) -> dict[str, Any] | None:
        """As COCO has it, of what lies on the sensor; None = nothing."""
        edge = np.array(self._size, float)
        found: dict[str, Any] = {}
        if label.box is not None:
            corners = np.clip([label.box[:2], label.box[:2] + label.box[2:]], 0, edge)
            extent = corners[1] - corners[0]
            if (extent > 0).all():
                found |= {"bbox": _rounded([*corners[0], *extent]), "area": round(float(extent.prod()), 3)}
        if label.keypoints is not None:
            points = label.keypoints.copy()
            outside = ~((points[:, :2] >= 0) & (points[:, :2] < edge)).all(axis=1)
            points[outside | (points[:, 2] == 0)] = 0
            if points[:, 2].any():
                flat = [value for x, y, flag in points.tolist() for value in (*_rounded([x, y]), int(flag))]
                found |= {"keypoints": flat, "num_keypoints": int((points[:, 2] > 0).sum())}
        if isinstance(label.mask, dict):
            if area := sum(label.mask["counts"][1::2]):
                found |= {"segmentation": label.mask, "area": area}
        elif label.mask is not None:
            inside = [cut for one in label.mask if len(cut := _cut_off(one, edge)) >= 3]
            if inside:
                area = round(sum(map(_polygon_area, inside)), 3)
                found |= {"segmentation": [_rounded(one.ravel()) for one in inside], "area": area}
        return found | {"iscrowd": int(label.is_crowd)} if found else None


def _cut_off(polygon: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """The part of a polygon [N, 2] that lies in 0 to `edge` [2], [M, 2]; M = 0 where none does.

    Source: Sutherland & Hodgman, Reentrant Polygon Clipping, CACM 17, 1974: one side after the other.
    """
    for axis, bound, sign in ((0, 0.0, 1), (1, 0.0, 1), (0, edge[0], -1), (1, edge[1], -1)):
        distance = sign * (polygon[:, axis] - bound)
        kept: list[np.ndarray] = []
        for number, (point, inside) in enumerate(zip(polygon, distance, strict=True)):
            before, outside = polygon[number - 1], distance[number - 1]
            if (inside > 0) != (outside > 0):
                kept.append(before + (point - before) * outside / (outside - inside))
            if inside > 0:
                kept.append(point)
        polygon = np.array(kept, float).reshape(-1, 2)
    return np.clip(polygon, 0, edge)


def label_times(shown_us: Sequence[int], rate_hz: float | None) -> np.ndarray:
    """[N] int64 us: times of the frames that the sensor saw, or as often as a rate says.

    Raises:
        ValueError: a rate that is not from above 0 to 1 MHz.
    """
    if rate_hz is None:
        return np.array(shown_us, np.int64)
    if not 0 < rate_hz <= 1e6:
        raise ValueError(f"label_rate_hz must be above 0 and at most 1e6, got {rate_hz}")
    return np.rint(np.arange(0, shown_us[-1] + 1e-6, 1e6 / rate_hz)).astype(np.int64)


def write_labels(
    path: Path, labels: VideoLabels, frames: Frames, size: SensorSize, name: str, rate_hz: float | None = None
) -> None:
    """Write the labels of a video whose events are in the file of a name; see `CarriedLabels` and `label_times`."""
    times = label_times([one.t_us for one in frames.shown], rate_hz)
    table = CarriedLabels(labels, frames, size).coco(times, name)
    path.write_text(json.dumps(table, separators=(",", ":"), allow_nan=False) + "\n", encoding="utf-8")


def _between(start: Label, stop: Label, share: float) -> Label:
    box = points = None
    if start.box is not None and stop.box is not None:
        box = start.box + share * (stop.box - start.box)
    if start.keypoints is not None and stop.keypoints is not None and len(start.keypoints) == len(stop.keypoints):
        points = start.keypoints + share * (stop.keypoints - start.keypoints)
        points[:, 2] = np.minimum(start.keypoints[:, 2], stop.keypoints[:, 2])
    nearer = start if share <= 0.5 else stop
    return Label(box, points, nearer.mask, nearer.is_crowd)


def _scaled(mask: np.ndarray, part: Cover, size: SensorSize, move: np.ndarray) -> np.ndarray:
    """[H, W] bool: what the sensor's pixels have in their middle."""
    places = []
    for axis, (length, first, extent, moved) in enumerate(
        zip(size, (part.left, part.top), (part.width, part.height), move.tolist(), strict=True)
    ):
        source = np.floor((np.arange(length) + 0.5 - moved) * extent / length + first).astype(np.int64)
        places.append((source.clip(0, mask.shape[1 - axis] - 1), (source >= 0) & (source < mask.shape[1 - axis])))
    (x, x_known), (y, y_known) = places
    return mask[np.ix_(y, x)] & np.outer(y_known, x_known)


def _polygon_area(polygon: np.ndarray) -> float:
    x, y = polygon.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)


def _rounded(values: Any) -> list[float]:
    return [round(float(value), 3) for value in values]
