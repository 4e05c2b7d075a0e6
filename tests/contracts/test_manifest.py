"""Manifests vouch for every file of their artefact."""

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from data_contracts import tables
from data_contracts.errors import DataError
from data_contracts.labels import Labels, check_labels
from data_contracts.manifest import (
    ManifestRef,
    concat_labels,
    label_columns,
    labels_of,
    read_manifest,
    write_manifest,
)

REPOSITORY = Path(__file__).resolve().parents[2]


def training_table(steps=(1, 2)):
    return pa.table(
        {
            "curve": pa.array(["training"] * len(steps)),
            "step": pa.array(steps, pa.int64()),
            "loss": pa.array([0.5] * len(steps), pa.float64()),
        }
    )


@pytest.fixture
def artefact(tmp_path):
    folder = tmp_path / "artefact"
    folder.mkdir()
    np.save(folder / "frames.npy", np.arange(12, dtype=np.uint8).reshape(2, 6))
    return write_manifest(folder, training_table(), tables.TRAINING)


def test_round_trip(artefact):
    manifest = read_manifest(artefact, full=True)
    assert len(manifest) == 2
    assert manifest.schema is tables.TRAINING
    assert manifest.array("frames").tolist() == np.arange(12).reshape(2, 6).tolist()
    assert manifest.rows_where(curve="training").tolist() == [0, 1]


@pytest.fixture
def many_files(tmp_path, monkeypatch):
    """An artefact of more files than the manifest's metadata list."""
    monkeypatch.setattr("data_contracts.manifest.MAX_LISTED_FILES", 20)
    folder = tmp_path / "many"
    (folder / "events").mkdir(parents=True)
    for number in range(30):
        (folder / "events" / f"{number:02d}.bin").write_bytes(bytes([number] * number))
    return write_manifest(folder, training_table(), tables.TRAINING)


def test_many_files_are_listed_beside_the_manifest(many_files):
    manifest = read_manifest(many_files, full=True)
    assert len(manifest.files) == 30 and list(manifest.files)[:2] == ["events/00.bin", "events/01.bin"]
    assert manifest.files["events/07.bin"] == {"bytes": 7, "sha256": hashlib.sha256(bytes([7] * 7)).hexdigest()}
    assert manifest.path("events/29.bin").stat().st_size == 29 and "events/30.bin" not in manifest.files
    metadata = pq.read_metadata(many_files.path / "manifest.parquet").metadata
    assert list(json.loads(metadata[b"ctlev.files"])) == ["file_list.parquet"]


@pytest.mark.parametrize("file", ["events/09.bin", "file_list.parquet"])
def test_damage_is_found_among_many_files(many_files, file):
    path = many_files.path / file
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(DataError, match=f"{path.name}: expected {len(content)} bytes"):
        read_manifest(many_files)
    path.write_bytes(bytes([content[0] ^ 1]) + content[1:])
    with pytest.raises(DataError, match=f"{path.name}: content has changed"):
        read_manifest(many_files, full=True)
    path.unlink()
    with pytest.raises(DataError, match=f"{path.name}: file is missing"):
        read_manifest(many_files)


def test_a_list_of_files_that_is_none_is_refused(many_files):
    """The same digest as in the manifest, but not the columns: as an altered copy of the code would write."""
    from data_contracts.file_lists import read_file_list

    path = many_files.path / "file_list.parquet"
    pq.write_table(pa.table({"name": ["a"]}), path)
    with pytest.raises(DataError, match="expected columns name, bytes, sha256, got name"):
        read_file_list(path)
    with pytest.raises(DataError, match=r"no stage may write a file file_list\.parquet"):
        write_manifest(many_files.path, training_table(), tables.TRAINING)


def test_same_content_has_the_same_digest(artefact, tmp_path):
    other = tmp_path / "elsewhere"
    other.mkdir()
    np.save(other / "frames.npy", np.arange(12, dtype=np.uint8).reshape(2, 6))
    assert write_manifest(other, training_table(), tables.TRAINING).digest == artefact.digest


def test_changed_manifest_is_refused(artefact):
    with pytest.raises(DataError, match="content has changed; expected digest 000000000000"):
        read_manifest(ManifestRef(key=artefact.key, path=artefact.path, digest="0" * 64, rows=2))


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="only Linux lists the threads of a process")
def test_reading_starts_no_threads_that_outlive_the_interpreter(artefact):
    """pyarrow's own let go of what was read when they like; after the interpreter has ended that aborts the process."""
    code = f"""if True:
        import os
        from pathlib import Path
        from data_contracts.manifest import ManifestRef, read_manifest
        before = len(os.listdir("/proc/self/task"))
        read_manifest(ManifestRef(key={artefact.key!r}, path=Path({str(artefact.path)!r})))
        print(len(os.listdir("/proc/self/task")) - before)"""
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout == "0\n"


def test_truncated_missing_and_altered_files_are_refused(artefact):
    file = artefact.path / "frames.npy"
    content = file.read_bytes()
    file.write_bytes(content[:-1])
    with pytest.raises(DataError, match=r"frames\.npy: expected \d+ bytes, got \d+"):
        read_manifest(artefact)
    file.write_bytes(content[:-1] + b"\xff")
    read_manifest(artefact)  # same size: only the full check reads the content
    with pytest.raises(DataError, match=r"frames\.npy: content has changed"):
        read_manifest(artefact, full=True)
    file.unlink()
    with pytest.raises(DataError, match=r"frames\.npy: file is missing"):
        read_manifest(artefact)


def test_other_schema_version_is_refused(artefact, monkeypatch):
    newer = tables.TableSchema("training", 2, None, tables.TRAINING.columns)
    monkeypatch.setitem(tables.TABLES, "training", newer)
    with pytest.raises(DataError, match="table 'training' version 1; this code reads version 2"):
        read_manifest(artefact)


def test_unlisted_file_is_not_read(artefact):
    with pytest.raises(DataError, match=r"holds no file 'secret\.npy\.zst'"):
        read_manifest(artefact).array("secret")


def some_labels(count, joint_set="dhp19"):
    random = np.random.default_rng(count)
    joints = random.uniform(0, 64, (count, 13, 2)).astype(np.float32)
    joints[0, 0] = np.nan
    visible = np.isfinite(joints).all(-1)
    return Labels(
        tuple(f"class {i}" for i in range(count)), np.arange(count, dtype=np.int64), joints, visible, joint_set
    )


def test_label_columns_round_trip():
    labels = some_labels(4)
    table = pa.table({"class_name": list(labels.class_names), "t_us": labels.t_us, **label_columns(labels)})
    back = labels_of(table)
    assert back.class_names == labels.class_names and back.joint_set == "dhp19"
    np.testing.assert_array_equal(back.joints2d, labels.joints2d)
    np.testing.assert_array_equal(back.visible, labels.visible)
    filtered = labels_of(table.filter(pa.array([False, True, False, True])))
    np.testing.assert_array_equal(filtered.joints2d, labels.joints2d[[1, 3]])


def test_class_only_labels_round_trip_and_do_not_mix_with_joints():
    labels = Labels(("a", "b"), np.array([1, 2]))
    table = pa.table({"class_name": ["a", "b"], "t_us": labels.t_us, **label_columns(labels)})
    assert labels_of(table).joints2d is None
    with pytest.raises(DataError, match="cannot mix labels"):
        concat_labels([labels, some_labels(2)])


def test_visible_joint_without_position_is_refused():
    labels = some_labels(3)
    labels.visible[0, 0] = True
    with pytest.raises(DataError, match=r"here: joint 0 of row 0 is marked visible but its position is \[nan, nan\]"):
        check_labels(labels, "here")


def test_a_damaged_name_of_a_column_is_named(tmp_path):
    from data_contracts.file_lists import read_table

    path = tmp_path / "labels.parquet"
    pq.write_table(pa.table({"class_name": ["a"]}), path, store_schema=False)
    path.write_bytes(path.read_bytes().replace(b"class_name", b"class\xffname"))
    with pytest.raises(DataError, match=r"labels\.parquet: is not a Parquet file: .*utf-8"):
        read_table(path, path)
