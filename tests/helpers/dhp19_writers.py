"""Small files in the layout of DHP19, written with struct and SciPy for the tests."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import scipy.io

from ctlev_core.dataset_files import dhp19_files

SPECIAL = 0x400
START = 5_000_000
NAMES = dhp19_files.VICON_JOINTS


def matrix(number: int) -> np.ndarray:
    """A camera 3 m from the person, of the authors' kind: rows from the bottom up."""
    angle = 0.4 * number
    right, forward = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    rotation = np.stack([right, [0, 0, 1], forward])
    translation = np.array([0, -1000.0, 3000.0])
    K = np.array([[330, 2, 170], [0, 335, 128], [0, 0, 1.0]])
    return 0.0003 * K @ np.column_stack([rotation, translation])


def address(channel: int, x: int, y: int, p: int = 1) -> int:
    """Address of the pixel (x, y) of the upright picture: the camera counts from the other corner."""
    return (259 - y) << 22 | (345 - x) << 12 | p << 11 | channel


def write_aedat(path: Path, records: list[tuple[int, int]]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    header = b"#!AER-DAT2.0\r\n# This is a raw AE data file - do not edit\r\n# AEChip: eu.seebetter.Davis346blue\r\n"
    path.write_bytes(header + b"".join(struct.pack(">II", *record) for record in records))
    return path


def write_vicon(path: Path, rows: int = 100, **joints: np.ndarray) -> np.ndarray:
    """Joint j at x = 10 j + row; returns [rows, 13, 3] mm."""
    values = np.zeros((rows, 13, 3))
    values[..., 0] = 10.0 * np.arange(13) + np.arange(rows)[:, None]
    values[..., 2] = 1000.0
    fields = {name: values[:, j] for j, name in enumerate(NAMES)} | joints
    path.parent.mkdir(parents=True, exist_ok=True)
    scipy.io.savemat(path, {"XYZPOS": {name: rows for name, rows in fields.items() if rows is not None}})
    return values


def busy(count: int, channels=(0, 1, 2, 3), start: int = START, step: int = 10) -> list[tuple[int, int]]:
    """Events that take turns in the channels, each in one pixel of its own row."""
    return [(address(channels[i % len(channels)], 200, 50), start + 1 + step * i) for i in range(count)]
