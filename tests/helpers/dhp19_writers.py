"""Small files in the layout of DHP19 for the tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ctlev_core.dataset_files import dhp19_files
from ctlev_core.stand_ins.dataset_writers import DHP19_SPECIAL as SPECIAL
from ctlev_core.stand_ins.dataset_writers import dhp19_address as address
from ctlev_core.stand_ins.dataset_writers import dhp19_joints, write_dhp19_vicon
from ctlev_core.stand_ins.dataset_writers import dhp19_projection as matrix
from ctlev_core.stand_ins.dataset_writers import write_aedat2 as write_aedat

__all__ = ["NAMES", "SPECIAL", "START", "address", "busy", "matrix", "write_aedat", "write_vicon"]

START = 5_000_000
NAMES = dhp19_files.VICON_JOINTS


def write_vicon(path: Path, rows: int = 100, **joints: np.ndarray) -> np.ndarray:
    """Joint j at x = 10 j + row; returns [rows, 13, 3] mm."""
    values = np.zeros((rows, 13, 3))
    values[..., 0] = 10.0 * np.arange(13) + np.arange(rows)[:, None]
    values[..., 2] = 1000.0
    write_dhp19_vicon(path, dhp19_joints(values) | joints)
    return values


def busy(count: int, channels=(0, 1, 2, 3), start: int = START, step: int = 10) -> list[tuple[int, int]]:
    """Events that take turns in the channels, each in one pixel of its own row."""
    return [(address(channels[i % len(channels)], 200, 50), start + 1 + step * i) for i in range(count)]
