"""Recordings of the studio with all that is known of them, in folders that other tools read.

    labels.json                     COCO (CocoVID): boxes, masks and joints of the person at each moment, `t_us` in us
    NAME/events.parquet             the events, with whether each is signal or noise; or another format
    NAME/maps.npz                   `t_us` [T], `depth` [T, H, W] m, `flow` [T, H, W, 2] px/s, `instance` [T, H, W]
    NAME/event_labels.npz           of each event `instance`, `depth`, `flow`, `signal`
    NAME/boxes.npy                  rows as of detection benchmarks: t, x, y, w, h, class_id, class_confidence, track_id
    NAME/camera.json                `K`, the camera's matrix, px, and `size`

Boxes and masks are those of what is seen: of the pixels of `instance`. Sources: cocodataset.org, "Data format"; the
rows of DSEC-Detection's `tracks.npy` (Gehrig & Scaramuzza, Nature 2024), which are those of Prophesee's detection sets.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.datasets import studio
from ctlev_core.events.files import write_event_chunks
from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.studio.ground_truth import PERSON, GroundTruth, ground_truth, label_events
from ctlev_core.video.coco_masks import write_runs
from data_contracts.labels import Labels, Recording

LABELS_FILE, MAPS_FILE, EVENT_LABELS_FILE, BOXES_FILE, CAMERA_FILE = (
    "labels.json", "maps.npz", "event_labels.npz", "boxes.npy", "camera.json",
)  # fmt: skip
BOX = np.dtype(
    [
        *(("t", "<u8"), ("x", "<f4"), ("y", "<f4"), ("w", "<f4"), ("h", "<f4")),
        *(("class_id", "u1"), ("class_confidence", "<f4"), ("track_id", "<u4")),
    ]
)
_UNSEEN, _HIDDEN, _SEEN = 0, 1, 2
"""What COCO says of a joint: outside or unknown; in the image but covered; visible."""


class CocoTable:
    """The labels of all recordings, put together one after the other."""

    def __init__(self, joint_set: str) -> None:
        self._person = {"id": PERSON, "name": "person", "keypoints": list(JOINT_SETS[joint_set].joints), "skeleton": []}
        self._videos: list[dict[str, Any]] = []
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []

    def add(self, name: str, labels: Labels, truth: GroundTruth, boxes: Sequence[list[int] | None]) -> None:
        """The labels of a recording of a name at the moments of its maps, and the boxes of these (`boxes_of`)."""
        _, height, width = truth.depth.shape
        video = {"id": len(self._videos) + 1, "name": name, "width": width, "height": height}
        self._videos.append(video)
        for row, (mask, box) in enumerate(zip(truth.instance > 0, boxes, strict=True)):
            image, time = {"id": len(self._images) + 1}, {"t_us": int(truth.t_us[row])}
            place = {"video_id": video["id"], "frame_id": row, "width": width, "height": height, "file_name": name}
            self._images.append(image | place | time)
            if box is None:
                continue
            about = {"image_id": image["id"], "video_id": video["id"], "category_id": PERSON, "instance_id": PERSON}
            area = {"bbox": box, "area": int(mask.sum()), "segmentation": write_runs(mask), "iscrowd": 0}
            points = _keypoints(labels, row, (width, height))
            self._annotations.append({"id": len(self._annotations) + 1} | about | time | area | points)

    def write(self, path: Path) -> None:
        """As JSON."""
        table = {
            "info": {"description": "people simulated by ctlev; times in us of the events"},
            "videos": self._videos, "images": self._images, "annotations": self._annotations,
            "categories": [self._person],
        }  # fmt: skip
        path.write_text(json.dumps(table, separators=(",", ":"), allow_nan=False) + "\n", encoding="utf-8")


def boxes_of(truth: GroundTruth) -> Iterator[list[int] | None]:
    """Left, top, width and height, px, of what is seen of the person at each moment; None = nothing is."""
    for mask in truth.instance > 0:
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        if not len(rows):
            yield None
            continue
        left, top = int(columns[0]), int(rows[0])
        yield [left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1]


def write_labelled(
    folder: Path, recording: Recording, options: studio.Options, *, suffix: str, format_name: str, table: CocoTable
) -> int:
    """Write a recording and its labels into a new folder.

    Args:
        folder: of the recording.
        recording: of the studio.
        options: of the studio; maps and labels are at `label_rate_hz`.
        suffix: of the file of events.
        format_name: of the events.
        table: to which its labels are added.
    Returns:
        The number of events.
    Raises:
        DataError: the maps would not fit into memory, or the format cannot hold the events.
    """
    scene, labels = studio.read_scene(recording, options), studio.read_labels(recording, options)
    truth = ground_truth(scene, labels.t_us)
    events = studio.read_marked_events(recording, options)
    of_events = label_events(events, truth)
    folder.mkdir(parents=True)
    write_event_chunks(folder / f"events{suffix}", [events], format_name)
    np.savez_compressed(
        folder / MAPS_FILE, t_us=truth.t_us, depth=truth.depth, flow=truth.flow, instance=truth.instance
    )
    assert events.signal is not None
    np.savez_compressed(
        folder / EVENT_LABELS_FILE,
        instance=of_events.instance,
        depth=of_events.depth,
        flow=of_events.flow,
        signal=events.signal,
    )
    boxes = list(boxes_of(truth))
    rows = [(time, *box, 0, 1.0, PERSON) for time, box in zip(truth.t_us.tolist(), boxes, strict=True) if box]
    np.save(folder / BOXES_FILE, np.array(rows, BOX))
    camera = {"K": scene.camera.K.tolist(), "size": list(scene.camera.image_size)}
    (folder / CAMERA_FILE).write_text(json.dumps(camera) + "\n", encoding="utf-8")
    table.add(folder.name, labels, truth, boxes)
    return len(events)


def _keypoints(labels: Labels, row: int, size: tuple[int, int]) -> dict[str, Any]:
    """Joints as COCO has them: x, y and how they are seen."""
    assert labels.joints2d is not None and labels.visible is not None
    flat: list[float] = []
    count = 0
    for (x, y), seen in zip(labels.joints2d[row].tolist(), labels.visible[row].tolist(), strict=True):
        inside = 0 <= x < size[0] and 0 <= y < size[1]
        flag = _UNSEEN if not inside else _SEEN if seen else _HIDDEN
        count += flag != _UNSEEN
        flat += [round(x, 3), round(y, 3), flag] if flag else [0, 0, 0]
    return {"keypoints": flat, "num_keypoints": count}
