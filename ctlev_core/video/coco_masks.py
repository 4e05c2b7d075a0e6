"""Masks as COCO has them: polygons, and run lengths, as numbers or as a text.

Run lengths count pixels column by column, zeros first. As a text each is written in groups of five bits, the lowest
first, as the difference to the run before the last one.

Source: cocodataset/cocoapi, the description of its formats in `mask.py` and `maskApi.h`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from data_contracts.events import SensorSize

_MORE, _SIGN, _FIRST = 0x20, 0x10, 48


def read_runs(mask: dict[str, Any], size: SensorSize) -> np.ndarray:
    """[H, W] bool of a mask in run lengths: `size` (height, width), and `counts`, a list or a text.

    Raises:
        ValueError: a key is missing, or the runs are not those of a mask of `size` (width, height).
    """
    width, height = size
    counts = mask.get("counts")
    if mask.get("size") != [height, width]:
        raise ValueError(f"size must be [{height}, {width}], that of the frames, got {str(mask.get('size'))[:40]}")
    if isinstance(counts, str):
        counts = _runs_of_text(counts)
    if not isinstance(counts, list) or not all(isinstance(one, int) and one >= 0 for one in counts):
        raise ValueError("counts must be run lengths, as numbers or as a text")
    if sum(counts) != height * width:
        raise ValueError(f"counts must add up to {height} x {width}, got {sum(counts)}")
    values = np.arange(len(counts)) % 2 == 1
    return np.repeat(values, counts).reshape(width, height).T


def write_runs(mask: np.ndarray) -> dict[str, Any]:
    """Run lengths as numbers, of [H, W] bool."""
    line = mask.T.reshape(-1)
    ends = np.append(np.flatnonzero(line[1:] != line[:-1]) + 1, line.size)
    counts = np.diff(ends, prepend=0).tolist()
    return {"size": list(mask.shape), "counts": [0, *counts] if line[0] else counts}


def is_polygons(mask: Any) -> bool:
    """Is it a list of polygons of three or more points each, x and y in turn?"""
    return (
        isinstance(mask, list)
        and len(mask) > 0
        and all(isinstance(one, list) and len(one) >= 6 and len(one) % 2 == 0 for one in mask)
    )


def _runs_of_text(text: str) -> list[int]:
    runs: list[int] = []
    value = shift = 0
    for letter in text:
        group = ord(letter) - _FIRST
        if not 0 <= group < 64 or shift > 60:
            raise ValueError("counts is no text of run lengths")
        value |= (group & (_MORE - 1)) << shift
        shift += 5
        if not group & _MORE:
            if group & _SIGN:
                value -= 1 << shift
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value = shift = 0
    if shift:
        raise ValueError("counts is no text of run lengths")
    return runs
