"""Small artefacts, published as a stage does it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from data_contracts import tables
from data_contracts.manifest import write_manifest
from tasks.store import Store

TABLE = pa.table(
    {
        "curve": pa.array(["training"] * 2),
        "step": pa.array([0, 1], pa.int64()),
        "loss": pa.array([1.0, 0.5], pa.float64()),
    }
)


def key(number: int) -> str:
    """A cache key."""
    return f"{number:032x}"


def put_together(store: Store, number: int, *, values: int = 50, content: int | None = None) -> Path:
    """The files of an artefact that is not published yet: an array of 8-byte values, and a file in a folder."""
    temporary = store.temporary_folder(key(number))
    (temporary / "checkpoint").mkdir(parents=True)
    np.save(temporary / "frames.npy", np.full(values, number if content is None else content))
    (temporary / "checkpoint" / "weights.bin").write_bytes(bytes([number % 256]) * 100)
    write_manifest(temporary, TABLE, tables.TRAINING)
    return temporary


def record_of(number: int, *, stage: str = "encode", inputs: tuple[int, ...] = ()) -> dict:
    """What its provenance record says."""
    return {
        "stage": stage, "stage_version": 1, "key": key(number), "arguments": {}, "versions": {},
        "upstream": {key(i): "0" * 64 for i in inputs}, "started": "2026-01-01T00:00:00Z", "wall_seconds": 0.0,
        "cpu_seconds": 0.0, "process_peak_memory_mib": 0.0,
    }  # fmt: skip


def publish(store: Store, number: int, *, inputs: tuple[int, ...] = (), **made: int) -> Path:
    """Its folder, published."""
    temporary = put_together(store, number, **made)
    return store.publish("encode", key(number), temporary, record_of(number, inputs=inputs)).path
