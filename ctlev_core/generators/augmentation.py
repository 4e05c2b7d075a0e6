"""Baseline: ordinary augmentation, what everybody tries first. New frames are the training frames, moved about.

Each new frame is a random training frame of the class that is asked for, shifted, turned and scaled at random
(`ctlev_core.pictures.image_moves`), with a share of its active pixels dropped (EventDrop, Gu et al., IJCAI 2021, drops
events; of an image pixels are left) and, where wanted, its polarities exchanged. Nothing is learnt.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import Field

from ctlev_core.pictures.image_moves import Moves, move_image
from data_contracts.arrays import load_array
from data_contracts.compressed_arrays import SUFFIX, CompressedArrayWriter
from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.image_rows import Images, image_chunks
from data_contracts.labels import Conditions, History

KEEPS_CLASSES_ALONE = True
"""Its frames are of the class that is asked for, and of no other label."""
VERSION = 2
FRAMES_NAME, CLASSES_NAME = f"frames{SUFFIX}", "classes.json"


class Options(Frozen):
    """No training options: nothing is trained."""


class SampleOptions(Moves):
    """How far frames are moved, and what is dropped of them."""

    shift: float = Field(default=0.08, ge=0, le=0.5, description="as a share of the side, along each axis")
    turn_deg: float = Field(default=10.0, ge=0, le=180, description="either way, about the centre")
    scale: float = Field(default=0.1, ge=0, lt=1, description="so much larger or smaller")
    drop: float = Field(default=0.1, ge=0, lt=1, description="at most this share of the active pixels is dropped")
    exchange_polarity: bool = Field(default=False, description="red and blue of half of the frames are exchanged")


def base_model_folders(options: Options) -> list[Path]:
    """None: nothing is learnt from weights."""
    return []


def train(frames: Images, conditions: Conditions, options: Options, *, seed: int, out: Path, work: Path) -> History:
    """Keep the training frames and their classes in `out`.

    Args:
        frames: [N, H, W, 3] uint8.
        conditions: N rows; their class names, or their prompts where there are none.
        options: none.
        seed: not used.
        out: the folder to write.
        work: not used.
    Raises:
        DataError: there is no frame.
    """
    if not len(frames):
        raise DataError("generator 'augmentation' needs at least one frame, got none")
    out.mkdir(parents=True, exist_ok=True)
    with CompressedArrayWriter(out / FRAMES_NAME) as written:
        for chunk in image_chunks(frames):
            written.append(chunk)
    (out / CLASSES_NAME).write_text(json.dumps(_classes(conditions)) + "\n", encoding="utf-8")
    return History()


def sample(
    checkpoint: Path, conditions: Conditions, options: SampleOptions, *, seeds: Sequence[int], work: Path
) -> np.ndarray:
    """Frames [N, H, W, 3] uint8, each of its row's class; row i depends on condition i and seed i alone.

    Raises:
        DataError: no training frame is of a class that is asked for.
    """
    frames = load_array(checkpoint / FRAMES_NAME)
    rows_of: dict[str, list[int]] = {}
    for number, name in enumerate(json.loads((checkpoint / CLASSES_NAME).read_text(encoding="utf-8"))):
        rows_of.setdefault(name, []).append(number)
    made = np.empty((len(conditions), *frames.shape[1:]), np.uint8)
    for row, (name, seed) in enumerate(zip(_classes(conditions), seeds, strict=True)):
        if name not in rows_of:
            raise DataError(f"generator 'augmentation': no training frame of class {name!r} to make another of")
        rng = np.random.default_rng(seed)
        made[row] = augment(np.asarray(frames[rng.choice(rows_of[name])]), options, rng)
    return made


def augment(frame: np.ndarray, options: SampleOptions, rng: np.random.Generator) -> np.ndarray:
    """One frame [H, W, 3] uint8, changed at random."""
    moved = move_image(frame, options, rng, interpolation="nearest")
    kept = rng.random(moved.shape[:2]) >= options.drop * rng.random()
    moved = np.where(kept[..., None], moved, 0).astype(np.uint8)
    return moved[..., ::-1] if options.exchange_polarity and rng.random() < 0.5 else moved


def _classes(conditions: Conditions) -> list[str]:
    return list(conditions.class_names or conditions.prompts)
