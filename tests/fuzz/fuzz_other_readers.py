"""Broken files for every reader that is not one of events: motions, bodies, labels, weights, records, presets.

Whatever the bytes, a reader must return or raise `DataError` or `ValueError`, in less than 500 characters that name the
file; one that lists every format's objections may be longer. Mutations are random and start from valid files.

    python tests/fuzz/fuzz_other_readers.py motion --seconds 60
    python tests/fuzz/fuzz_other_readers.py motion --file crash-motion-17
"""

from __future__ import annotations

import argparse
import io
import pickle
import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

sys.path.append(str(Path(__file__).resolve().parents[1] / "helpers"))
sys.path.append(str(Path(__file__).resolve().parent))
import dhp19_writers
import motion_writers
import smpl_writers
from fuzz_reader import mutate

from data_contracts.errors import DataError, DetailedDataError

KEY = "0" * 32
RANDOM = np.random.default_rng(0)


@dataclass(frozen=True)
class Target:
    """A reader, the name of the file it reads, and valid files."""

    file: str
    seeds: Callable[[Path], Iterator[bytes]]
    read: Callable[[Path], Any]


def _written(write: Callable[[Path], Any]) -> Callable[[Path], Iterator[bytes]]:
    def seeds(folder: Path) -> Iterator[bytes]:
        path = folder / "seed"
        made = write(path)
        yield (made if isinstance(made, Path) else path).read_bytes()

    return seeds


def _npz(**arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def _motions(folder: Path) -> Iterator[bytes]:
    yield motion_writers.write_deepmimic(folder / "a.txt", motion_writers.standing_frames(4)).read_bytes()
    yield _npz(
        poses=RANDOM.normal(0, 0.2, (5, 156)), trans=np.zeros((5, 3)), betas=np.zeros(16),
        mocap_framerate=np.array(120.0), gender=np.array("male"),
    )  # fmt: skip
    yield pickle.dumps(
        {"smpl_poses": RANDOM.normal(0, 0.2, (5, 72)), "smpl_trans": np.zeros((5, 3)), "smpl_scaling": np.ones(1)}
    )
    from ctlev_core.body.layer import joint_transforms, load_body
    from ctlev_core.body.rotations import matrix_from_axis_angle

    pose = matrix_from_axis_angle(RANDOM.normal(0, 0.1, (5, 24, 3)))
    yield _npy(joint_transforms(load_body(), pose, np.zeros(10), np.zeros((5, 3)))[1][:, :22])
    joints = len(motion_writers.T_POSE)
    bvh = motion_writers.write_bvh(folder / "a.bvh", RANDOM.normal(0, 5, (2, joints, 3)), np.zeros((2, 3)))
    yield bvh.read_bytes()


def _read_motion(path: Path) -> Any:
    from ctlev_core.body.motion.files import read_motion

    return read_motion(path, 30.0)


def _bodies(folder: Path) -> Iterator[bytes]:
    arrays = smpl_writers.smpl_arrays(num_vertices=30, num_faces=20)
    yield _npz(**arrays)
    yield smpl_writers.pickled(arrays)


def _read_body(path: Path) -> Any:
    from ctlev_core.body.smpl_files import read_smpl_file

    return read_smpl_file(path)


def _cdehp(folder: Path) -> Iterator[bytes]:
    joints = "\n".join(f"{x:.3f} {y:.3f}" for x, y in RANDOM.random((13, 2)))
    yield f"13\ncolor_name:000001\n{joints}\n".encode()


def _read_cdehp(path: Path) -> Any:
    from ctlev_core.dataset_files.cdehp_files import read_label

    return read_label(path)


def _read_vicon(path: Path) -> Any:
    from ctlev_core.dataset_files.dhp19_files import read_vicon

    return read_vicon(path)


def _read_projection(path: Path) -> Any:
    from ctlev_core.dataset_files.dhp19_files import read_projection

    return read_projection(path)


def _poses(folder: Path) -> Iterator[bytes]:
    import joblib

    shapes = ((1, 10), (1, 72), (1, 3), (24, 3), (24, 3))
    for compress in (0, 3):
        joblib.dump([RANDOM.normal(0, 1, shape) for shape in shapes], folder / "pose.pkl", compress=compress)
        yield (folder / "pose.pkl").read_bytes()


def _read_pose(path: Path) -> Any:
    from ctlev_core.dataset_files.event_hpe_files import read_pose

    return read_pose(path)


def _safetensors(folder: Path) -> Iterator[bytes]:
    import torch
    from safetensors.torch import save

    yield save({"a.weight": torch.ones(3, 4), "b": torch.zeros(5, dtype=torch.bfloat16)})


def _read_tensors(path: Path) -> Any:
    from ctlev_core.safe_files.tensor_files import check_finite, read_tensor_table

    return check_finite(read_tensor_table(path).items())


def _torch(folder: Path) -> Iterator[bytes]:
    import torch

    torch.save({"state_dict": {"a.weight": torch.ones(3, 4), "b": torch.zeros(5)}}, folder / "weights.ckpt")
    yield (folder / "weights.ckpt").read_bytes()


def _read_torch(path: Path) -> Any:
    from ctlev_core.safe_files.torch_files import read_torch_table

    return read_torch_table(path)


def _presets(folder: Path) -> Iterator[bytes]:
    presets = Path(__file__).resolve().parents[2] / "flows" / "presets"
    for name in ("smoke", "pose", "body"):
        yield (presets / f"{name}.yaml").read_bytes()


def _read_preset(path: Path) -> Any:
    from pydantic import ValidationError

    from ctlev_core.plugins import PluginError
    from flows.command_line import load_experiment

    try:
        return load_experiment(str(path), [])
    except (PluginError, ValidationError) as error:
        # Of an option, which a message names in place of the file.
        raise DataError(f"{path.name}: {error}"[:499]) from error


def _sensors(folder: Path) -> Iterator[bytes]:
    from ctlev_core.sensor.options import PRESETS

    yield yaml.safe_dump(PRESETS["noisy"].model_dump(mode="json")).encode()


def _read_sensor(path: Path) -> Any:
    from ctlev_core.sensor.options import read_preset

    return read_preset(path)


def _artefact(folder: Path) -> Path:
    import pyarrow as pa

    from data_contracts import tables
    from data_contracts.file_lists import file_digest
    from data_contracts.manifest import write_manifest
    from data_contracts.run_record import RunRecord, write_run_record

    folder = folder / KEY
    folder.mkdir()
    table = pa.table({"curve": ["training"], "step": pa.array([1], pa.int64()), "loss": [0.5]})
    write_manifest(folder, table, tables.TRAINING)
    values = {
        "stage": "finetune", "stage_version": 1, "key": KEY, "arguments": {"seed": 1}, "upstream": {},
        "started": "2026-01-01T00:00:00Z", "wall_seconds": 1.0, "cpu_seconds": 1.0, "process_peak_memory_mib": 1.0,
        "versions": {},
    }  # fmt: skip
    write_run_record(folder, RunRecord(**values, digest=file_digest(folder / "manifest.parquet")))
    return folder


def _records(folder: Path) -> Iterator[bytes]:
    yield (_artefact(folder) / "run.json").read_bytes()


def _read_record(path: Path) -> Any:
    from data_contracts.run_record import read_run_record

    return read_run_record(path.parent)


def _manifests(folder: Path) -> Iterator[bytes]:
    yield (_artefact(folder) / "manifest.parquet").read_bytes()


def _read_manifest(path: Path) -> Any:
    from data_contracts.manifest import ManifestRef, read_manifest

    return read_manifest(ManifestRef(key=KEY, path=path.parent, digest=""), full=True)


def _remembered(folder: Path) -> Iterator[bytes]:
    from ctlev_core.provenance.raw_file_digests import digest_raw_files

    (folder / "raw.bin").write_bytes(b"123")
    digest_raw_files([("a", folder / "raw.bin")], folder)
    yield (folder / "raw_file_digests.json").read_bytes()


def _read_remembered(path: Path) -> Any:
    from ctlev_core.provenance.raw_file_digests import read_remembered

    return read_remembered(path)


def _provenance(folder: Path) -> Iterator[bytes]:
    from ctlev_core.provenance.records import read_records, write_provenance

    write_provenance(folder / "provenance.json", read_records([("frames", _artefact(folder))]))
    yield (folder / "provenance.json").read_bytes()


def _read_provenance(path: Path) -> Any:
    from ctlev_core.provenance.records import read_provenance

    return read_provenance(path)


def _shared_recordings(folder: Path) -> Iterator[bytes]:
    from ctlev_core.recordings.stored_events import SharedEventsWriter
    from data_contracts.events import Events

    for marked in (False, True):
        path = folder / f"shared_{marked}.arrow"
        with SharedEventsWriter(path) as writer:
            for count in (5, 0, 40):
                t, (x, y) = np.sort(RANDOM.integers(0, 10**6, count)), RANDOM.integers(0, 64, (2, count)).astype("u2")
                p, signal = np.arange(count, dtype="u1") % 2, np.arange(count) % 3 == 0
                writer.append(Events(t, x, y, p, (64, 64), signal=signal if marked else None), "seed")
        yield path.read_bytes()


def _read_shared_recordings(path: Path) -> Any:
    from ctlev_core.recordings.stored_events import StoredEvents

    return [StoredEvents(path, batch, (64, 64)).read(0, count) for batch, count in enumerate((5, 0, 40))]


TARGETS = {
    "motion": Target("motion.npz", _motions, _read_motion),
    "body": Target("body.pkl", _bodies, _read_body),
    "cdehp_label": Target("label.txt", _cdehp, _read_cdehp),
    "dhp19_vicon": Target("vicon.mat", _written(lambda path: dhp19_writers.write_vicon(path, 5)), _read_vicon),
    "dhp19_projection": Target("P1.npy", lambda _: iter([_npy(dhp19_writers.matrix(1))]), _read_projection),
    "event_hpe_pose": Target("pose.pkl", _poses, _read_pose),
    "safetensors": Target("weights.safetensors", _safetensors, _read_tensors),
    "torch_weights": Target("weights.ckpt", _torch, _read_torch),
    "preset": Target("preset.yaml", _presets, _read_preset),
    "sensor_preset": Target("sensor.yaml", _sensors, _read_sensor),
    "run_record": Target("run.json", _records, _read_record),
    "manifest": Target("manifest.parquet", _manifests, _read_manifest),
    "raw_file_digests": Target("raw_file_digests.json", _remembered, _read_remembered),
    "provenance": Target("provenance.json", _provenance, _read_provenance),
    "shared_recordings": Target("shared_000000.arrow", _shared_recordings, _read_shared_recordings),
}


def check(target: Target, path: Path) -> bool:
    """Was the file valid? Raises `AssertionError` where the reader breaks its promise."""
    try:
        target.read(path)
    except (DataError, ValueError) as error:
        text, limit = str(error), 2500 if isinstance(error, DetailedDataError) else 500
        place = path.name in text or path.parent.name in text
        assert place and len(text) < limit, f"{len(text)} characters, names the file: {place}: {text[:600]}"
        return False
    return True


def fuzz(name: str, seconds: float, seed: int = 0, keep: Path | None = None) -> tuple[int, int]:
    """How many files were tried, and how many of them were valid.

    Raises:
        AssertionError: the reader broke its promise; the file is kept in `keep`, or beside other temporary files.
    """
    target, chance = TARGETS[name], random.Random(seed)
    with tempfile.TemporaryDirectory(prefix="fuzzed_") as made:
        folder = Path(made)
        (folder / "seeds").mkdir()
        pool = list(target.seeds(folder / "seeds"))
        path = folder / KEY / target.file
        path.parent.mkdir()
        for content in pool:
            path.write_bytes(content)
            target.read(path)
        tried = valid = 0
        stop = time.monotonic() + seconds
        while time.monotonic() < stop:
            path.write_bytes(content := mutate(chance.choice(pool), chance))
            try:
                valid += check(target, path)
            except BaseException as error:
                kept = (keep or Path(tempfile.gettempdir())) / f"crash-{name}-{tried}"
                kept.write_bytes(content)
                raise AssertionError(f"{name}, {kept}: {type(error).__name__}: {error}"[:2000]) from error
            tried += 1
    return tried, valid


def main() -> None:
    """Fuzz one reader, or show what one file does to it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=TARGETS)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--file", type=Path, help="read this file only")
    arguments = parser.parse_args()
    if arguments.file:
        print("valid" if check(TARGETS[arguments.name], arguments.file) else "rejected")
        return
    tried, valid = fuzz(arguments.name, arguments.seconds, arguments.seed)
    print(f"{tried} files, {valid} of them valid")


if __name__ == "__main__":
    main()
