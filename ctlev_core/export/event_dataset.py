"""Event images with their conditions and labels as a PyTorch `Dataset`.

    dataset = EventDataset("mine")                                  # a folder that flows/synthesize.py exported
    dataset = EventDataset(".ctlev/artefacts/encode/KEY", split="train")        # real frames of the store
    loader = DataLoader(dataset, batch_size=32, shuffle=True, num_workers=2)

A sample is a dictionary, of which PyTorch's own collation makes batches. All samples of a dataset have the same keys:

    image          [3, H, W] float32, red, green and blue, 0 to 1
    condition      [3, H, W] float32, the image it was sampled from, where there is one
    prompt         its text, of generated images
    sample_id      names it
    seed           of generated images
    class_name     class or motion, where there are such, and
    class_index    its place in `class_names`
    joints2d_px    [J, 2] float32, x right, y down, pixel centres at integer + 0.5; NaN = unknown; with
    visible        [J] bool; False = outside the image, occluded or unknown
    joints3d_mm    [J, 3] float32, camera frame (x right, y down, z forward); NaN = unknown
    smpl_pose_rad  [72] float32, axis-angle of the 24 SMPL joints, the root's first; with
    smpl_betas     [10] float32, and
    smpl_transl_m  [3] float32, camera frame
    intrinsics_px  [4] float32, fx, fy, cx, cy

Which labels there are depends on the data; `joint_set` names the order of the joints (ctlev_core.geometry.joint_sets).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import torch
from torch.utils.data import Dataset

from ctlev_core.events import files as event_files
from ctlev_core.provenance.records import read_records
from data_contracts import tables
from data_contracts.array_rows import Images
from data_contracts.arrays import load_array
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.image_folder import read_image_table
from data_contracts.manifest import (
    LABEL_COLUMNS,
    MANIFEST_FILE,
    Manifest,
    ManifestRef,
    labels_of,
    read_manifest,
)
from data_contracts.run_record import read_run_record

Sample = dict[str, Any]
_TEXTS = ("sample_id", "prompt")


class EventDataset(Dataset[Sample]):
    """Event images of an exported folder, or of an artefact of the store; see the head of this file.

    The order is that of the table. A sample depends on its index alone, whatever process asks for it, so that workers
    change nothing; a dataset may be handed to forked and to spawned ones. Images are read when they are asked for.

    Args:
        place: a folder that `flows/synthesize.py` exported, the folder of an artefact of generated or of encoded
            frames, or a reference to one, such as `data_contracts.published.latest_frames` gives.
        split: the rows of this split alone.
        conditions: also read condition images, where there are any: beside an exported image, or in the artefact that
            generated frames were sampled from. Encoded frames have none.
        rejected: of an artefact, also the frames that the quality filter rejected to the last; an exported folder has
            none.
        class_names: what `class_index` counts; default: all classes of the table, sorted. Where datasets are used
            together, give one the `class_names` of the other.
        transform: from the whole sample to what is returned for it, so that labels can move with the image.

    Attributes:
        table: the rows, with where they come from.
        labels: their labels as arrays.
        class_names: see above; empty without classes.
        joint_set: order of the joints; empty without joints.

    Raises:
        DataError: no such folder, a damaged one, no such split, an unknown class, or conditions that are not in
            the store any more.
        ValueError: a class is named twice in `class_names`.
    """

    def __init__(
        self,
        place: Path | str | ManifestRef,
        *,
        split: str | None = None,
        conditions: bool = True,
        rejected: bool = False,
        class_names: Sequence[str] | None = None,
        transform: Callable[[Sample], Any] | None = None,
    ) -> None:
        self.place = place.path if isinstance(place, ManifestRef) else Path(place).expanduser().absolute()
        if not isinstance(place, ManifestRef) and (self.place / MANIFEST_FILE).is_file():
            place = _reference(self.place)
        if isinstance(place, ManifestRef):
            table, self._images, self._conditions = _open_artefact(place, conditions)
        else:
            table, self._images, self._conditions = _open_folder(self.place, conditions)
        self.class_names = _class_names(table, class_names, self.place)
        rows = _chosen(table, split, rejected, self.place)
        self.table = table.take(pa.array(rows))
        self.labels = labels_of(self.table.select(["class_name", "joint_set", *LABEL_COLUMNS.values()]))
        self.joint_set = self.labels.joint_set
        self.transform = transform
        self._rows = rows
        numbers = {name: number for number, name in enumerate(self.class_names)}
        self._class_index = np.array([numbers.get(name, -1) for name in self.labels.class_names])

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> Any:
        index = range(len(self))[index]  # IndexError past the end, by which `for` knows where to stop
        row = int(self._rows[index])
        sample: Sample = {"image": _to_tensor(self._images.read(row))}
        if self._conditions is not None:
            sample["condition"] = _to_tensor(self._conditions.read(row))
        for name in _TEXTS:
            if name in self.table.column_names:
                sample[name] = self.table[name][index].as_py()
        if "seed" in self.table.column_names:
            sample["seed"] = self.table["seed"][index].as_py()
        if self.class_names:
            sample["class_name"] = self.labels.class_names[index]
            sample["class_index"] = int(self._class_index[index])
        for name, array in self.labels.arrays.items():
            sample[LABEL_COLUMNS[name]] = torch.from_numpy(array[index].copy())
        return sample if self.transform is None else self.transform(sample)

    def read_events(self, index: int) -> Events:
        """The event stream of an image of an exported folder; times from the start of its window.

        Raises:
            DataError: it was exported without events, or the file is missing or damaged.
        """
        row = self.table.slice(range(len(self))[index], 1).to_pylist()[0]
        if row.get("events_file") is None:
            raise DataError(f"{self.place}: holds no event streams; export it with --set 'export={{format: parquet}}'")
        path, start, stop = self.place / row["events_file"], row["event_start"], row["event_start"] + row["num_events"]
        if path.suffix == ".parquet":
            events = event_files.read_events_range(path, start, stop)
        else:
            events = event_files.read_events_file(path).slice(start, stop)
        return replace(events, t=events.t - row["t_start_us"])


class _Array:
    """Images of an array of the store, opened by each process for itself; `rows`: that of each sample."""

    def __init__(self, path: Path, rows: np.ndarray | None = None) -> None:
        self.path, self.rows = path, rows
        self._images: Images | None = None

    def read(self, row: int) -> np.ndarray:
        images = self._images
        if images is None:
            images = self._images = load_array(self.path)
        return images[row if self.rows is None else self.rows[row]]

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "rows": self.rows, "_images": None}  # a map would be sent as a copy of the images


class _Files:
    """Images in files of their own, by their names within a folder; all of the size of the first."""

    def __init__(self, folder: Path, names: pa.ChunkedArray) -> None:
        self.folder, self.names = folder, names
        self.shape: tuple[int, ...] = self._read(0).shape

    def read(self, row: int) -> np.ndarray:
        image = self._read(row)
        if image.shape != self.shape:
            (expected_height, expected_width), (height, width) = self.shape[:2], image.shape[:2]
            raise DataError(
                f"{self.folder / self.names[row].as_py()}: expected {expected_width} x {expected_height} px, "
                f"got {width} x {height}"
            )
        return image

    def _read(self, row: int) -> np.ndarray:
        path = self.folder / self.names[row].as_py()
        image = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB) if path.is_file() else None
        if image is None:
            raise DataError(f"{path}: {'is not an image that can be read' if path.is_file() else 'file is missing'}")
        return image


_Images = _Array | _Files


def _open_folder(folder: Path, conditions: bool) -> tuple[pa.Table, _Images, _Images | None]:
    """Table, images and condition images of an exported folder."""
    table = read_image_table(folder)
    if not table.num_rows:
        raise DataError(f"{folder}: holds no image, its table has no rows")
    has_conditions = conditions and not table["condition_file_name"].null_count
    asked = _Files(folder, table["condition_file_name"]) if has_conditions else None
    return table, _Files(folder, table["file_name"]), asked


def _open_artefact(ref: ManifestRef, conditions: bool) -> tuple[pa.Table, _Images, _Images | None]:
    """Table, images and condition images of an artefact."""
    manifest, folder = read_manifest(ref), ref.path
    if manifest.schema not in (tables.SYNTHETIC, tables.FRAMES):
        raise DataError(f"{folder}: holds {manifest.schema.name}; expected synthetic or frames")
    images, asked = manifest.array("frames"), None
    if images.shape[0] != len(manifest) or images.ndim != 4 or images.dtype != np.uint8:
        raise DataError(f"{folder}: frames must be [{len(manifest)}, H, W, 3] uint8, got {images.shape} {images.dtype}")
    if conditions and manifest.schema is tables.SYNTHETIC:
        asked = _conditions_of(manifest)
    return manifest.table, _Array(manifest.array_path("frames")), asked


def _reference(folder: Path) -> ManifestRef:
    return ManifestRef(key=folder.name, path=folder, digest=read_run_record(folder).digest)


def _conditions_of(generated: Manifest) -> _Array | None:
    """The condition images that frames were sampled from, found by the records of the store."""
    folder = generated.ref.path
    try:
        records = read_records([("images", folder)])
        record = next(record for record in records if record.stage == "condition_samples")
        conditions = read_manifest(_reference(folder.parent.parent / record.stage / record.key))
    except (DataError, StopIteration) as error:
        raise DataError(f"{folder}: its conditions are not in the store; set conditions=False ({error})") from error
    if not conditions.has_array("images"):
        return None
    numbers = {sample_id: number for number, sample_id in enumerate(conditions.column("sample_id"))}
    unknown = [name for name in generated.column("condition_id") if name not in numbers]
    if unknown:
        raise DataError(f"{folder}: condition {unknown[0]!r} is not in {conditions.ref.path}; set conditions=False")
    rows = np.array([numbers[name] for name in generated.column("condition_id")], np.int64)
    return _Array(conditions.array_path("images"), rows)


def _class_names(table: pa.Table, given: Sequence[str] | None, place: Path) -> tuple[str, ...]:
    found = sorted(set(table["class_name"].to_pylist()) - {""})
    if given is None:
        return tuple(found)
    if isinstance(given, str) or len(set(given)) < len(given):
        raise ValueError(f"class_names must be different names, got {given!r}")
    unknown = [name for name in found if name not in given]
    if unknown:
        raise DataError(f"{place}: class {unknown[0]!r} is not one of the given class_names {list(given)}")
    return tuple(given) if found else ()


def _chosen(table: pa.Table, split: str | None, rejected: bool, place: Path) -> np.ndarray:
    """Numbers of the rows that are asked for, ascending."""
    keep = np.ones(table.num_rows, bool)
    if not rejected and "rejected" in table.column_names:
        keep &= np.array([cause == "" for cause in table["rejected"].to_pylist()], bool)
    if split is not None:
        splits = table["split"].to_pylist()
        keep &= np.array([name == split for name in splits], bool)
        if not keep.any():
            raise DataError(f"{place}: no image is in split {split!r}; splits are {dict(Counter(splits))}")
    if not keep.any():
        raise DataError(f"{place}: holds no image; the quality filter rejected all {table.num_rows}")
    return np.flatnonzero(keep)


def _to_tensor(image: np.ndarray) -> torch.Tensor:
    """[H, W, 3] uint8 to [3, H, W] float32, 0 to 1."""
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))).to(torch.float32) / 255
