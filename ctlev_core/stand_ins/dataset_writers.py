"""Files in the published layouts of event datasets, written with NumPy and SciPy."""

from __future__ import annotations

import io
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.dataset_files import cdehp_files, dhp19_files

AEDAT2_HEADER = b"#!AER-DAT2.0\r\n# This is a raw AE data file - do not edit\r\n# AEChip: eu.seebetter.Davis346blue\r\n"
_Numbers = Sequence[int] | np.ndarray
DHP19_SPECIAL = 0x400
"""Address of a trigger of the motion capture."""


def dhp19_projection(camera: int) -> np.ndarray:
    """A projection matrix [3, 4] of DHP19's kind, mm to px, rows from the bottom up, 3 m from the person."""
    angle = 0.4 * camera
    right, forward = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    rotation = np.stack([right, [0, 0, 1], forward])
    translation = np.array([0, -1000.0, 3000.0])
    K = np.array([[330, 2, 170], [0, 335, 128], [0, 0, 1.0]])
    return 0.0003 * K @ np.column_stack([rotation, translation])


def dhp19_address(channel: Any, x: Any, y: Any, p: Any = 1) -> Any:
    """Address of the pixel (x, y) of the upright picture: the camera counts from the other corner."""
    return (259 - y) << 22 | (345 - x) << 12 | p << 11 | channel


def write_aedat2(path: Path, records: Any) -> Path:
    """An AEDAT 2.0 file of records [N, 2], address and time in us."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(AEDAT2_HEADER + np.asarray(records, np.int64).reshape(-1, 2).astype(">u4").tobytes())
    return path


def write_dhp19_vicon(path: Path, joints: dict[str, np.ndarray | None]) -> Path:
    """DHP19's motion capture: positions [N, 3] mm by joint; a joint that is None is left out."""
    import scipy.io

    path.parent.mkdir(parents=True, exist_ok=True)
    scipy.io.savemat(path, {"XYZPOS": {name: rows for name, rows in joints.items() if rows is not None}})
    return path


def dhp19_joints(positions: np.ndarray) -> dict[str, np.ndarray | None]:
    """Positions [N, 13, 3] by DHP19's names."""
    return {name: positions[:, number] for number, name in enumerate(dhp19_files.VICON_JOINTS)}


def write_cdehp_label(path: Path, joints: np.ndarray, partner: str = "color_name:000000") -> None:
    """A label file of CDEHP: joints [13, 2] px, and the picture of the other camera."""
    path.parent.mkdir(parents=True, exist_ok=True)
    width, height = cdehp_files.SENSOR_SIZE
    lines = [f"{x / width} {y / height}" for x, y in joints]
    path.write_text("\n".join([str(len(lines)), partner, *lines]) + "\n")


def write_atis(path: Path, t: _Numbers, x: _Numbers, y: _Numbers, p: _Numbers) -> Path:
    """N-Caltech101's 40 bits an event, as its paper describes them: x, y, polarity and 23 bits of time, high first."""
    columns, times, signs = np.array([x, y], np.int64), np.array(t, np.int64), np.array(p, np.int64)
    if np.any(columns >> 8) or np.any(times >> 23) or np.any(signs >> 1):
        raise ValueError("x and y must have 8 bits, t 23 and p one")
    path.parent.mkdir(parents=True, exist_ok=True)
    rest = np.array([signs << 7 | times >> 16, times >> 8 & 0xFF, times & 0xFF])
    path.write_bytes(np.concatenate([columns, rest]).astype(np.uint8).T.tobytes())
    return path


def write_n_imagenet_lists(root: Path) -> None:
    """N-ImageNet's lists of files as downloaded: with the paths of the authors' machine."""
    for folder, name in (("extracted_train", "train_list.txt"), ("extracted_val", "val_list.txt")):
        files = sorted((root / folder).glob("*/*.npz"))
        lines = [f"/home/jhkim/Datasets/N_Imagenet/{file.relative_to(root).as_posix()}\n" for file in files]
        (root / name).write_text("".join(lines))


def write_picture(path: Path, picture: np.ndarray) -> Path:
    """An image file of the kind that its name says."""
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), picture):
        raise OSError(f"{path}: cannot be written")
    return path


def smpl_pickle(arrays: dict[str, Any], protocol: int = 2) -> bytes:
    """The bytes of an SMPL body file; sparse matrices under the module names that scipy had when it was published."""
    buffer = io.BytesIO()
    pickle.dump(arrays, buffer, protocol)
    content = buffer.getvalue()
    if protocol > 2:  # there a length stands before each name
        return content
    for form in (b"csc", b"csr", b"coo"):
        content = content.replace(b"scipy.sparse._" + form, b"scipy.sparse." + form)
    return content
