"""Images that stay on disk: chosen rows of several arrays, read when they are indexed.

A million frames of 512 px are 790 GB. Stages hand `ImageRows` to whoever trains or predicts, which takes batches of
them as of an array; only `numpy.asarray` reads all.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from data_contracts.array_rows import ArrayRows, Images, image_chunks
from data_contracts.arrays import load_array
from data_contracts.compressed_arrays import CompressedArray

_NOTE_FILE = "arrays.json"


class ImageRows(ArrayRows):
    """Image i is row `row[i]` of array `part[i]`.

    Args:
        arrays: one or more [M, ...], usually on disk, of one dtype and row shape.
        part: [N] int, which array.
        row: [N] int, which row of it.
        identity: names the content of the arrays, such as the digests of their artefacts; with `part` and `row` it
            stands for the pixels where a digest is wanted. Empty where it is not known: then the pixels are read.
    Raises:
        ValueError: there is no array, or they are not alike.
    """

    def __init__(self, arrays: Sequence[Images], part: np.ndarray, row: np.ndarray, identity: str = "") -> None:
        shapes = {(array.dtype, array.shape[1:]) for array in arrays}
        if len(shapes) != 1:
            found = ", ".join(sorted(f"{list(shape)} {dtype}" for dtype, shape in shapes)) or "no array"
            raise ValueError(f"rows of several arrays must be alike, got {found}")
        (self.dtype, row_shape) = shapes.pop()
        self.shape = (len(row), *row_shape)
        self._arrays, self._part, self._row, self._identity = list(arrays), part, row, identity

    @classmethod
    def of(cls, parts: Sequence[tuple[Images, np.ndarray]], identity: str = "") -> ImageRows:
        """The chosen rows [K] of each array, one array after another."""
        rows = [np.asarray(rows, np.int64) for _, rows in parts]
        part = np.repeat(np.arange(len(parts)), [len(chosen) for chosen in rows])
        return cls([array for array, _ in parts], part, np.concatenate([*rows, np.zeros(0, np.int64)]), identity)

    def _read(self, rows: np.ndarray) -> np.ndarray:
        part, row = self._part[rows], self._row[rows]
        numbers = np.unique(part)
        if len(numbers) == 1:
            return np.asarray(self._arrays[numbers[0]][row])
        found = np.empty((len(rows), *self.shape[1:]), self.dtype)
        for number in numbers:
            members = part == number
            found[members] = self._arrays[number][row[members]]
        return found

    def take(self, chosen: np.ndarray) -> ImageRows:
        """The images of `chosen` [K] int, still on disk."""
        return ImageRows(self._arrays, self._part[chosen], self._row[chosen], self._identity)

    def digest(self) -> str:
        """SHA-256 of what was given as `identity` and of the chosen rows; without an identity, of the pixels."""
        total = hashlib.sha256(f"{self._identity} {self.shape} {self.dtype}".encode())
        if self._identity:
            total.update(self._part.astype(np.int64).tobytes())
            total.update(self._row.astype(np.int64).tobytes())
        else:
            for images in image_chunks(self):
                total.update(np.ascontiguousarray(images).data)
        return total.hexdigest()

    def save(self, folder: Path) -> None:
        """Note arrays and rows in a folder, from which `load_image_rows` opens them in another process.

        An array that is not a whole file is written there.
        """
        folder.mkdir(parents=True, exist_ok=True)
        paths = []
        for number, array in enumerate(self._arrays):
            path = _file_of(array)
            if path is None:
                path = folder / f"array_{number}.npy"
                np.save(path, array, allow_pickle=False)
            paths.append(str(path))
        np.save(folder / "part.npy", self._part, allow_pickle=False)
        np.save(folder / "row.npy", self._row, allow_pickle=False)
        (folder / _NOTE_FILE).write_text(json.dumps({"identity": self._identity, "paths": paths}), encoding="utf-8")


def load_image_rows(folder: Path) -> ImageRows:
    """What `ImageRows.save` noted, still on disk."""
    noted = json.loads((folder / _NOTE_FILE).read_text(encoding="utf-8"))
    arrays = [load_array(Path(path)) for path in noted["paths"]]
    part, row = (np.load(folder / name, allow_pickle=False) for name in ("part.npy", "row.npy"))
    return ImageRows(arrays, part, row, noted["identity"])


def _file_of(array: Images) -> Path | None:
    """The file whose whole content an array is read from."""
    if isinstance(array, CompressedArray):
        return array.path
    if not isinstance(array, np.memmap) or array.filename is None or Path(array.filename).suffix != ".npy":
        return None
    whole = np.load(array.filename, mmap_mode="r", allow_pickle=False)
    same = all(getattr(whole, name) == getattr(array, name) for name in ("shape", "dtype", "strides", "offset"))
    return Path(array.filename) if same else None


def as_image_rows(images: Images) -> ImageRows:
    """Images of an array as rows that `take` and `save` leave where they are."""
    return images if isinstance(images, ImageRows) else ImageRows.of([(images, np.arange(len(images)))])
