"""Sampling dealt out to the machines of a cluster, which write the files that the stage `sample` then puts together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ctlev_core import plugins
from ctlev_core.diffusion.sampling.shards import SHARD, whole_stretches
from ctlev_core.plugin_contracts import GeneratorInShards
from ctlev_core.processes import few_threads
from ctlev_core.progress import ProgressBar
from data_contracts.config import SamplingChoice
from data_contracts.home_folder import bucket_url, home_folder
from data_contracts.labels import Conditions
from data_contracts.manifest import ManifestRef, conditions_of, read_manifest
from tasks.gpus import gpu_need, gpus_held
from tasks.runners import is_elsewhere
from tasks.workers import map_shards, num_processes

MIN_FILES, MAX_FILES = 4, 64
"""That a call makes one after the other. It loads the checkpoint, which takes as long as tens of frames do."""


@dataclass(frozen=True)
class Sampling:
    """What every call needs, small enough to travel with each.

    Attributes:
        checkpoint: folder.
        conditions: their manifest.
        stretches: names, one a row of `conditions`, where rows are made from one another.
        sampling: plug-in and options.
        work: folder of the files, which all machines see.
    """

    checkpoint: Path
    conditions: ManifestRef
    stretches: tuple[str, ...] | None
    sampling: SamplingChoice
    work: Path

    def wanted(self, rows: np.ndarray) -> Conditions:
        """Some of the conditions."""
        every = _read_conditions(self.conditions.path, self.conditions.digest)
        return replace(every, stretches=self.stretches).take(rows)

    def files(self, rows: np.ndarray) -> list[slice]:
        """Those of `rows` that lie in each file; images, which do not matter for it, are not read."""
        every = _read_conditions(self.conditions.path, self.conditions.digest)
        return whole_stretches(replace(every, images=None, motions=None, stretches=self.stretches).take(rows), SHARD)


class Chunk(NamedTuple):
    """Rows of the conditions that are sampled by one call of `sample`, and a seed for each."""

    rows: np.ndarray
    seeds: Sequence[int]


class _Part(NamedTuple):
    """Some of the files of a chunk, by number, and how many frames they have."""

    chunk: Chunk
    files: slice
    num_frames: int


def is_dealt_out(arguments: Mapping[str, Any]) -> bool:
    """Do other machines see our folder of unfinished work, and does the generator keep its frames in files there?"""
    if not is_elsewhere() or bucket_url(home_folder()) is not None:
        return False
    return isinstance(plugins.load_options(arguments["sampling"]).module, GeneratorInShards)


def deal_out(asked: Sampling, chunks: Sequence[Chunk]) -> None:
    """Have the files of all chunks written; those that an interrupted run has left are kept."""
    total = sum(len(chunk.rows) for chunk in chunks)
    parts = list(_parts_of(asked, chunks, total // SHARD))
    with ProgressBar(total=total, desc="sampling", unit="image") as progress:
        for num_frames in map_shards(partial(_sample_part, asked), parts, max_group=1):
            progress.update(num_frames)


def _parts_of(asked: Sampling, chunks: Sequence[Chunk], left: int) -> Iterator[_Part]:
    """Fewer and fewer of the files that are left, so that all processes end at about the same time."""
    count = num_processes()
    for chunk in chunks:
        files, start = asked.files(chunk.rows), 0
        while start < len(files):
            part = files[start : start + min(max(left // (2 * count), MIN_FILES), MAX_FILES)]
            yield _Part(chunk, slice(start, start + len(part)), min(part[-1].stop, len(chunk.rows)) - part[0].start)
            start, left = start + len(part), left - len(part)


def _sample_part(asked: Sampling, part: _Part) -> int:
    """Its number of frames."""
    plugin, (rows, seeds) = plugins.load_options(asked.sampling), part.chunk
    with few_threads(), gpus_held(gpu_need({"sampling": asked.sampling}), "sample"):
        plugin.module.sample_shards(
            asked.checkpoint, asked.wanted(rows), plugin.options, seeds=seeds, work=asked.work, only=part.files
        )
    return part.num_frames


@lru_cache(maxsize=1)
def _read_conditions(folder: Path, digest: str) -> Conditions:
    """Once a process rather than once a call."""
    return conditions_of(read_manifest(ManifestRef(key=folder.name, path=folder, digest=digest)))
