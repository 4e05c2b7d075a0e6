"""Shards: runs of rows whose frames are written to a file as soon as they are done, so that a killed run goes on.

A shard's name is a digest of everything its frames depend on. Which process sampled it, and in which run, is not.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctlev_core.supervised.frame_sequences import stretch_lengths
from data_contracts.arrays import load_array, save_compressed
from data_contracts.compressed_arrays import SUFFIX
from data_contracts.labels import Conditions

SHARD = 128


@dataclass(frozen=True, eq=False)
class Shard:
    """Consecutive rows.

    Attributes:
        path: of its frames, once they are sampled.
        conditions: n prompts, and n condition images where there are any.
        seeds: n seeds of noise.
    """

    path: Path
    conditions: Conditions
    seeds: list[int]

    def __len__(self) -> int:
        return len(self.seeds)

    def read(self) -> np.ndarray:
        """The frames [n, H, W, 3] uint8."""
        return load_array(self.path)[:]

    def write(self, frames: np.ndarray) -> None:
        """Write the frames so that the file is there whole or not at all."""
        temporary = self.path.with_suffix(f".{os.getpid()}.tmp")
        save_compressed(temporary, frames)
        os.replace(temporary, self.path)


def plan_shards(conditions: Conditions, seeds: Sequence[int], settings: str, work: Path) -> list[Shard]:
    """All rows as shards of `SHARD` rows, or of whole stretches with as many.

    Args:
        conditions: N prompts, with N condition images or none.
        seeds: N seeds of noise.
        settings: names what else the frames depend on: the checkpoint and the options.
        work: folder of the files; is created.
    """
    work.mkdir(parents=True, exist_ok=True)
    shards = []
    for rows in whole_stretches(conditions, SHARD):
        part, own = conditions.take(rows), [int(seed) for seed in seeds[rows]]
        shards.append(Shard(work / f"shard_{_digest(settings, part, own)}{SUFFIX}", part, own))
    return shards


def whole_stretches(conditions: Conditions, count: int) -> list[slice]:
    """Consecutive rows, `count` at a time; where rows have stretches whole ones, up to `count` rows or one stretch."""
    if conditions.stretches is None:
        return [slice(start, start + count) for start in range(0, len(conditions), count)]
    found, start, stop = [], 0, 0
    for length in stretch_lengths(conditions.stretches):
        if stop > start and stop + length - start > count:
            found.append(slice(start, stop))
            start = stop
        stop += length
    return [*found, slice(start, stop)] if stop > start else found


def _digest(settings: str, conditions: Conditions, seeds: list[int]) -> str:
    digest = hashlib.sha256(settings.encode())
    digest.update(json.dumps([list(conditions.prompts), seeds]).encode())
    if conditions.images is not None:
        digest.update(np.ascontiguousarray(conditions.images).data)
    if conditions.stretches is not None:
        digest.update(json.dumps(stretch_lengths(conditions.stretches)).encode())
    return digest.hexdigest()[:24]
