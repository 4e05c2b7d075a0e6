"""Generated frames and their conditions in a small store, for the tests of what is made of them."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from ctlev_core.events import files as event_files
from data_contracts import tables
from data_contracts.events import Events
from data_contracts.labels import Labels
from data_contracts.manifest import ManifestRef, label_columns, write_manifest
from data_contracts.tables import TableSchema
from tasks.store import Store

SIZE = (20, 14)
REJECTED_ROW = 1


@dataclass(frozen=True)
class Generated:
    """Artefacts of a store, and what is in them."""

    synthetic: ManifestRef
    conditions: ManifestRef
    frames: np.ndarray
    images: np.ndarray
    labels: Labels

    @property
    def artefacts(self) -> dict[str, ManifestRef]:
        """As `tasks.export_images` takes them."""
        return {"synthetic": self.synthetic, "conditions": self.conditions}


def make_labels(count: int, *, joints: bool = True) -> Labels:
    """Classes that take turns; joints of which one is unknown, and bodies."""
    classes = tuple(("walk", "jump", "bow")[row % 3] for row in range(count))
    if not joints:
        return Labels(classes, np.zeros(count, np.int64))
    rng = np.random.default_rng(5)
    joints2d = rng.uniform(0, SIZE[1], (count, 13, 2)).astype(np.float32)
    visible = np.ones((count, 13), bool)
    joints2d[:, 4], visible[:, 4] = np.nan, False
    return Labels(
        classes,
        np.zeros(count, np.int64),
        joints2d,
        visible,
        "dhp19",
        smpl_pose=rng.normal(size=(count, 72)).astype(np.float32),
        smpl_betas=rng.normal(size=(count, 10)).astype(np.float32),
        smpl_transl=rng.normal(size=(count, 3)).astype(np.float32),
    )


def publish(
    home: Path, stage: str, key: str, columns: dict, schema: TableSchema, inputs: dict[str, ManifestRef], **arrays
) -> ManifestRef:
    """Put an artefact into the store as its stage would."""
    store = Store(home)
    folder = store.temporary_folder(key)
    folder.mkdir(parents=True, exist_ok=True)  # it may hold files already
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    table = pa.table({name: columns[name] for name in schema.arrow().names}).cast(schema.arrow())
    write_manifest(folder, table, schema)
    record = {
        "stage": stage, "stage_version": 1, "key": key, "versions": {"python": "3"}, "started": "", "wall_seconds": 0.0,
        "arguments": {name: {"manifest": ref.key} for name, ref in inputs.items()}, "cpu_seconds": 0.0,
        "upstream": {ref.key: ref.digest for ref in inputs.values()}, "process_peak_memory_mib": 0.0,
    }  # fmt: skip
    return store.publish(stage, key, folder, json.loads(json.dumps(record)))


def make_generated(home: Path, count: int = 7, *, seed: int = 0, joints: bool = True, images: bool = True) -> Generated:
    """`count` noisy frames, of which the quality filter rejected one."""
    rng, labels = np.random.default_rng(seed), make_labels(count, joints=joints)
    shape = (count, SIZE[1], SIZE[0], 3)
    frames, pictures = (rng.integers(0, 256, shape, np.uint8) for _ in range(2))
    key = f"{seed:02d}{count:02d}{int(joints)}{int(images)}"
    names = [f"condition/{row:06d}" for row in range(count)]
    shared = {
        "source_id": names, "subject": ["s"] * count, "class_name": list(labels.class_names),
        "prompt": [f"a {name}" for name in labels.class_names], **label_columns(labels),
    }  # fmt: skip
    windows = {name: [1] * count for name in ("t_start_us", "t_end_us")}
    conditions = publish(
        home, "condition_samples", f"c{key}", {"sample_id": names, **windows, **shared}, tables.CONDITIONS, {},
        **({"images": pictures} if images else {}),
    )  # fmt: skip
    made = [f"synthetic/{row:06d}" for row in range(count)]
    same = {
        "split": "train", "generator": "test 1", "checkpoint_digest": "d", "scheduler": "unipc",
        "num_inference_steps": 3, "guidance_scale": 1.0, "num_attempts": 1,
    }  # fmt: skip
    columns = {
        "sample_id": made, "recording_id": made, "condition_id": names, **shared,
        **{name: [value] * count for name, value in same.items()}, "seed": list(range(100, 100 + count)),
        "rejected": ["empty: all" if row == REJECTED_ROW else "" for row in range(count)],
    }  # fmt: skip
    inputs = {"conditions": conditions}
    synthetic = publish(home, "sample", f"s{key}", columns, tables.SYNTHETIC, inputs, frames=frames)
    return Generated(synthetic, conditions, frames, pictures, labels)


def make_recorded(home: Path) -> tuple[ManifestRef, np.ndarray]:
    """Encoded frames, three to train on and one to test on."""
    frames = np.random.default_rng(9).integers(0, 256, (4, 14, 20, 3), np.uint8)
    columns = {
        "sample_id": [f"r{row}" for row in range(4)], "recording_id": ["r"] * 4, "subject": ["s"] * 4,
        "split": ["train"] * 3 + ["test"], "class_name": ["walk"] * 4,
        **{name: [1] * 4 for name in ("t_start_us", "t_end_us", "t_us", "num_events")}, **label_columns(make_labels(4)),
    }  # fmt: skip
    return publish(home, "encode", "recorded", columns, tables.FRAMES, {}, frames=frames), frames


def make_streams(made: Generated, home: Path, key: str, *, a_file: int) -> tuple[list[Events], dict]:
    """Files of an `export_events` artefact, `a_file` streams of a few events in each; the streams, and the columns of
    its table.
    """
    count, streams, rows = len(made.frames), [], []
    for row in range(count):
        t = np.arange(row + 1, dtype=np.int64) * 10
        one, x = np.ones(len(t), np.uint8), np.full(len(t), row, np.uint16)
        streams.append(Events(t, x, x, one, SIZE))
    folder = Store(home).temporary_folder(key) / "events"
    folder.mkdir(parents=True)
    for first in range(0, count, a_file):
        name = "events.parquet" if a_file >= count else f"{first // a_file:06d}.parquet"
        start, start_us, moved = 0, 0, []
        for events in streams[first : first + a_file]:
            last_us = start_us + int(events.t[-1])
            rows.append((f"events/{name}", start, len(events), start_us, last_us))
            moved.append(replace(events, t=events.t + start_us))
            start, start_us = start + len(events), last_us + 100
        event_files.write_event_chunks_parquet(folder / name, moved)
    names = ("file", "event_start", "num_events", "t_start_us", "t_end_us")
    columns = {name: [row[number] for row in rows] for number, name in enumerate(names)}
    columns |= {
        "sample_id": [f"synthetic/{row:06d}" for row in range(count)], "class_name": list(made.labels.class_names),
        "has_polarity": [False] * count, "is_exact": [True] * count, "error_levels": [0.0] * count,
        "seed": list(range(count)), **label_columns(made.labels),
    }  # fmt: skip
    return streams, columns
