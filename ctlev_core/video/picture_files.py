"""Pictures on disk: those of a folder in the order of their names, with their times."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from data_contracts.errors import DataError, shortened

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff", ".hdr")
TIMES_FILE = "timestamps.txt"


def list_folder(path: Path, fps: float | None) -> tuple[list[Path], list[float]]:
    """Pictures of a folder, or of its folder `imgs`, in the order of their names, and their times in s."""
    found = _pictures_of(path) or _pictures_of(path / "imgs")
    if not found:
        raise DataError(f"{path}: holds no pictures ({', '.join(PICTURE_SUFFIXES)})")
    if fps:
        return found, [number / fps for number in range(len(found))]
    times = next((one for one in (path / TIMES_FILE, path.parent / TIMES_FILE) if one.is_file()), None)
    if times is None:
        raise DataError(f"{path}: has no {TIMES_FILE} (seconds, a line for each picture); give fps")
    lines = [line.split()[-1] for line in times.read_text("utf-8", errors="replace").splitlines() if line.split()]
    try:
        seconds = [float(line) for line in lines]
    except ValueError as error:
        raise DataError(f"{times}: expected seconds, {shortened(str(error), 100)}") from None
    if len(seconds) != len(found):
        raise DataError(f"{times}: expected a time for each of {len(found)} pictures, got {len(seconds)}")
    if not all(math.isfinite(one) and one >= 0 for one in seconds):
        raise DataError(f"{times}: expected finite seconds from 0 on")
    return found, seconds


def _pictures_of(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    found = [one for one in folder.iterdir() if one.suffix.lower() in PICTURE_SUFFIXES and one.is_file()]
    # Numbers count as such: frame 10 comes after frame 9.
    return sorted(found, key=lambda one: [(int(part) if part.isdigit() else 0, part) for part in _parts(one.name)])


def _parts(name: str) -> list[str]:
    return re.split(r"([0-9]+)", name)


def read_picture(path: Path) -> np.ndarray:
    """[H, W, 3] as it is stored, in blue, green, red; `DataError` if OpenCV reads no picture there."""
    import cv2

    encoded = np.fromfile(path, np.uint8)
    stored = cv2.imdecode(encoded, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR) if len(encoded) else None
    if stored is None and len(encoded):
        stored = cv2.imdecode(encoded, cv2.IMREAD_UNCHANGED)  # OpenCV makes no colours of grey TIFFs in floating point
    if stored is None:
        raise DataError(f"{path}: not a picture that OpenCV can read ({path.stat().st_size} bytes)")
    return np.repeat(stored[..., None], 3, axis=2) if stored.ndim == 2 else stored[..., :3]
