"""What the store keeps, what leaves it, and how damage is found."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.provenance.raw_file_digests import RawFileDigests, digest_raw_files
from data_contracts import tables
from data_contracts.errors import DataError
from data_contracts.manifest import write_manifest
from data_contracts.published import StoredArtefact, Version, published_folder, write_latest, write_version
from data_contracts.regeneration import Gates
from data_contracts.run_record import read_run_record, write_run_record
from data_contracts.tables import TABLES
from flows import cli
from tasks.store import Store, StoreInUseError

DAY_S = 86_400
TABLE = pa.table(
    {
        "curve": pa.array(["training"] * 2),
        "step": pa.array([0, 1], pa.int64()),
        "loss": pa.array([1.0, 0.5], pa.float64()),
    }
)


def key(number):
    return f"{number:032x}"


def add(store, number, *, inputs=(), age_days=0.0, stage="encode", arguments=None):
    """An artefact as a stage publishes it, last used some days ago."""
    temporary = store.temporary_folder(key(number))
    (temporary / "checkpoint").mkdir(parents=True)
    np.save(temporary / "frames.npy", np.full(50, number))
    (temporary / "checkpoint" / "weights.bin").write_bytes(bytes([number % 256]) * 100)
    write_manifest(temporary, TABLE, tables.TRAINING)
    record = {
        "stage": stage, "stage_version": 1, "key": key(number), "arguments": arguments or {}, "versions": {},
        "upstream": {key(i): "0" * 64 for i in inputs}, "started": "2026-01-01T00:00:00Z", "wall_seconds": 0.0,
        "cpu_seconds": 0.0, "process_peak_memory_mib": 0.0,
    }  # fmt: skip
    folder = store.publish(stage, key(number), temporary, record).path
    age(folder, age_days)
    return folder


def age(folder, days):
    then = time.time() - days * DAY_S
    os.utime(folder / "run.json", (then, then))


def tree(home):
    """Every path below a folder with what it holds, except locks."""
    return {
        path.relative_to(home).as_posix(): path.read_bytes() if path.is_file() and not path.is_symlink() else None
        for path in home.rglob("*")
        if "locks" not in path.parts
    }


def command(script, monkeypatch, home, *arguments):
    monkeypatch.setattr(sys, "argv", [script, "--home", str(home), *arguments])
    with pytest.raises(SystemExit) as end:
        cli.script(script)
    return end.value.code


@st.composite
def graphs(draw):
    """Inputs of each artefact (only earlier ones), and the days since each was used."""
    count = draw(st.integers(1, 7))
    inputs = [draw(st.sets(st.integers(0, number - 1), max_size=3)) if number else set() for number in range(count)]
    days = draw(st.lists(st.sampled_from([0.0, 5.0, 20.0, 400.0]), min_size=count, max_size=count))
    return inputs, days


@settings(max_examples=30, deadline=None)  # a disk is written to
@given(graphs(), st.sampled_from([1.0, 10.0, 30.0]))
def test_what_leaves_is_unused_and_nothing_that_stays_was_made_from_it(graph, keep_days):
    inputs, days = graph
    count = len(inputs)
    # Warshall's closure of "was made from", by three loops.
    made_from = np.eye(count, dtype=bool)
    for number, of in enumerate(inputs):
        made_from[number, list(of)] = True
    for k in range(count):
        for i in range(count):
            for j in range(count):
                made_from[i, j] |= made_from[i, k] and made_from[k, j]
    expected = {j for j in range(count) if any(made_from[i, j] and days[i] < keep_days for i in range(count))}
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)  # the power stays on
        store = Store(Path(folder))
        for number in range(count):
            add(store, number, inputs=inputs[number], age_days=days[number])
        before = {item.folder.name: item for item in store.artefacts()}
        leaving, kept = store.unneeded(keep_days)
        assert {int(item.folder.name, 16) for item in kept} == expected
        assert store.prune(keep_days) == leaving
        assert {item.folder.name: item for item in store.artefacts()} == {
            name: item for name, item in before.items() if int(name, 16) in expected
        }
        for item in kept:
            store.check(item.folder)
        assert not list((store.home / "pruned").iterdir())


def test_an_artefact_gets_its_name_after_all_of_it_is_on_the_disk_and_the_name_follows(tmp_path, monkeypatch):
    """What fsync was called for, in the order of the calls: no power failure leaves half an artefact, or none."""
    done = []
    sync, rename = os.fsync, Path.rename

    def watched_sync(descriptor):
        sync(descriptor)
        done.append(Path(os.readlink(f"/proc/self/fd/{descriptor}")))

    def watched_rename(path, target):
        found = {path, *path.rglob("*")}
        assert len(found) == 6 and found <= set(done), "the folder, one below it and four files"
        # The names of the folders above, which are all new.
        assert {tmp_path, tmp_path / "home", tmp_path / "home" / "artefacts"} <= set(done)
        done.clear()
        return rename(path, target)

    monkeypatch.setattr(os, "fsync", watched_sync)
    monkeypatch.setattr(Path, "rename", watched_rename)
    folder = add(Store(tmp_path / "home"), 1)
    assert done == [folder.parent]


def test_whoever_may_read_the_record_may_read_every_file_of_an_artefact(tmp_path, monkeypatch):
    """A group shares a store; safetensors, for one, makes its files readable for their owner alone."""
    publish = Store.publish

    def publish_private(self, stage, key, temporary, record):
        for path in temporary.rglob("*.*"):
            path.chmod(0o600)
        return publish(self, stage, key, temporary, record)

    monkeypatch.setattr(Store, "publish", publish_private)
    before = os.umask(0o027)
    try:
        folder = add(Store(tmp_path), 1)
    finally:
        os.umask(before)
    modes = {path.name: path.stat().st_mode & 0o777 for path in folder.rglob("*") if path.is_file()}
    assert len(modes) == 4 and set(modes.values()) == {0o640}, modes


def test_what_cannot_be_synced_is_not_published(tmp_path, monkeypatch):
    def fail(descriptor):
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="disk full"):
        add(Store(tmp_path), 1)
    assert Store(tmp_path).artefacts() == []


def test_an_artefact_whose_path_an_option_names_stays(tmp_path):
    store = Store(tmp_path)
    base_model = add(store, 1, stage="pretrain", age_days=99)
    add(store, 2, arguments={"base_model": f"{base_model}/base_model"})
    assert store.prune(30) == []


def test_finding_an_artefact_or_reading_a_raw_file_of_it_counts_as_use(tmp_path):
    store = Store(tmp_path)
    found, read, neither = (add(store, number, age_days=99) for number in range(3))
    assert store.find("encode", found.name) is not None
    RawFileDigests(tmp_path).digest(read / "checkpoint" / "weights.bin")
    assert [item.folder for item in store.unneeded(30)[0]] == [neither]


def test_a_clock_that_was_set_back_removes_nothing(tmp_path):
    store = Store(tmp_path)
    add(store, 1, age_days=-400)
    assert store.prune(0) == []


def test_half_made_artefacts_go_and_resumable_state_stays_as_long_as_an_artefact(tmp_path):
    store = Store(tmp_path)
    for folder in (store.temporary_folder(key(1)), store.work_folder(key(1)), store.work_folder(key(2))):
        folder.mkdir(parents=True)
        (folder / "state").write_bytes(b"12345")
    for path in (store.work_folder(key(2)) / "state", store.work_folder(key(2))):
        os.utime(path, (0, 0))
    assert {(item.kind, item.name, item.size_bytes) for item in store.prune(30)} == {
        ("tmp", key(1), 5),
        ("work", key(2), 5),
    }
    assert (store.work_folder(key(1)) / "state").exists()


def test_dry_run_is_the_default_and_changes_nothing(tmp_path, monkeypatch, capsys):
    store = Store(tmp_path)
    old, new = add(store, 1, age_days=40), add(store, 2)
    size = sum(path.stat().st_size for path in old.rglob("*") if path.is_file())
    before = tree(tmp_path)
    assert command("prune", monkeypatch, tmp_path) == 0
    assert tree(tmp_path) == before
    output = capsys.readouterr().out
    assert f"encode/{old.name}" in output and new.name not in output and "1 of 2 folders" in output
    assert store.unneeded(30)[0][0].size_bytes == size
    assert command("prune", monkeypatch, tmp_path, "--apply") == 0
    assert not old.exists() and new.exists()
    assert command("prune", monkeypatch, tmp_path, "--keep-days", "0", "--apply") == 0
    assert not new.exists()


@pytest.mark.parametrize("days", ["-1", "nan", "inf", "many"])
def test_a_wrong_number_of_days_is_refused(tmp_path, monkeypatch, days):
    assert command("prune", monkeypatch, tmp_path, "--keep-days", days) == 2


@pytest.mark.parametrize("script", ["prune", "verify"])
def test_a_home_that_is_not_there_is_refused_and_not_made(tmp_path, monkeypatch, capsys, script):
    assert command(script, monkeypatch, tmp_path / "absent") == 2
    assert "there is no such home folder" in capsys.readouterr().err
    assert not (tmp_path / "absent").exists()


USER = """
import sys
from pathlib import Path
from tasks.store import Store
store = Store(Path(sys.argv[1]))
assert store.find("encode", sys.argv[2]) is not None
print("using", flush=True)
sys.stdin.read()
"""


def test_nothing_is_pruned_while_a_run_uses_the_store_and_a_killed_run_frees_it(tmp_path):
    store = Store(tmp_path)
    folder = add(store, 1)
    repository = Path(__file__).resolve().parents[3]
    user = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(USER), str(tmp_path), folder.name],
        cwd=repository,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    try:
        assert user.stdout is not None and user.stdout.readline() == b"using\n"
        with pytest.raises(StoreInUseError, match="a run uses this store"):
            store.prune(0)
        assert folder.exists()
    finally:
        user.kill()
        user.communicate()
    time.sleep(0.01)  # so that the artefact's age is above zero
    assert [item.folder for item in store.prune(0)] == [folder]


def test_a_run_that_starts_while_the_store_is_pruned_waits(tmp_path):
    store = Store(tmp_path)
    folder = add(store, 1)
    found = []
    run = threading.Thread(target=lambda: found.append(Store(tmp_path).find("encode", folder.name)))
    with store.alone():
        run.start()
        run.join(0.3)
        assert run.is_alive()
        folder.rename(tmp_path / "gone")
    run.join(10)
    assert found == [None]


def test_what_a_killed_pruning_left_goes_with_the_next(tmp_path, monkeypatch):
    store = Store(tmp_path)
    add(store, 1, age_days=99)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("tasks.store.shutil.rmtree", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        store.prune(30)
    assert store.artefacts() == [] and len(list((tmp_path / "pruned").iterdir())) == 1
    store.prune(30)
    assert not list((tmp_path / "pruned").iterdir())


def test_links_are_removed_and_never_followed(tmp_path):
    outside, home = tmp_path / "outside", tmp_path / "home"
    foreign = add(Store(outside), 7, age_days=99)
    before = tree(outside)
    store = Store(home)
    folder = add(store, 1, age_days=99)
    (folder / "data").symlink_to(outside)
    (folder / "checkpoint" / "file").symlink_to(foreign / "run.json")
    (home / "artefacts" / "linked").symlink_to(outside / "artefacts" / "encode")
    (home / "artefacts" / "encode" / key(2)).symlink_to(foreign)
    (home / "work").symlink_to(outside)
    (home / "tmp").rmdir()
    (home / "tmp").symlink_to(outside)
    assert [item.folder for item in store.prune(0)] == [folder]
    assert not folder.exists() and tree(outside) == before


def test_a_folder_that_is_no_home_keeps_what_is_in_it(tmp_path, monkeypatch):
    """Its own `tmp`, `work`, `pruned` and `artefacts` are somebody's."""
    for name in ("tmp/thesis", "work/results", "pruned/trees", "artefacts/model/v1"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "file").write_text("precious")
        for path in (tmp_path / name / "file", tmp_path / name):
            os.utime(path, (0, 0))
    before = tree(tmp_path)
    assert command("prune", monkeypatch, tmp_path, "--keep-days", "0", "--apply") == 0
    assert command("verify", monkeypatch, tmp_path) == 0
    assert {name: content for name, content in tree(tmp_path).items() if name in before} == before


def test_nothing_is_moved_out_through_a_link(tmp_path):
    (tmp_path / "outside").mkdir()
    store = Store(tmp_path / "home")
    folder = add(store, 1, age_days=99)
    (store.home / "pruned").symlink_to(tmp_path / "outside")
    with pytest.raises(DataError, match="pruned: is a link"):
        store.prune(30)
    assert folder.exists()


def test_an_unreadable_record_stops_pruning_for_what_it_refers_to_is_unknown(tmp_path, monkeypatch, capsys):
    store = Store(tmp_path)
    add(store, 1, age_days=99)
    damaged = add(store, 2, inputs=[1])
    (damaged / "run.json").write_text("{")
    assert command("prune", monkeypatch, tmp_path, "--apply") == 2
    assert "run flows/verify.py first" in capsys.readouterr().err
    assert len(store.artefacts()) == 2


def flip_a_bit(folder):
    path = folder / "checkpoint" / "weights.bin"
    content = bytearray(path.read_bytes())
    content[50] ^= 1
    path.write_bytes(content)


def link_outside(folder):
    """The same bytes, but not the store's."""
    path = folder / "checkpoint" / "weights.bin"
    path.rename(folder.parents[3] / "weights.bin")
    path.symlink_to(folder.parents[3] / "weights.bin")


DAMAGE = {
    "a bit": flip_a_bit,
    "short file": lambda folder: os.truncate(folder / "frames.npy", 10),
    "missing file": lambda folder: (folder / "frames.npy").unlink(),
    "missing manifest": lambda folder: (folder / "manifest.parquet").unlink(),
    "changed manifest": lambda folder: os.truncate(folder / "manifest.parquet", 100),
    "missing record": lambda folder: (folder / "run.json").unlink(),
    "half a record": lambda folder: (folder / "run.json").write_text('{"digest": '),
    "a record of another kind": lambda folder: (folder / "run.json").write_text("[1]"),
    "a link to outside": link_outside,
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_is_found_and_set_aside_and_the_rest_stays(tmp_path, monkeypatch, capsys, kind):
    home = tmp_path / "home"
    store = Store(home)
    whole, damaged = add(store, 1), add(store, 2)
    assert command("verify", monkeypatch, home) == 0
    assert "2 artefacts, 0 of them damaged" in capsys.readouterr().out
    DAMAGE[kind](damaged)
    left = sorted(path.name for path in damaged.rglob("*"))
    assert command("verify", monkeypatch, home) == 1
    output = capsys.readouterr().out
    assert f"damaged: encode/{damaged.name}" in output and "2 artefacts, 1 of them damaged" in output
    assert whole.exists() and not damaged.exists()
    moved = home / "damaged" / "encode" / f"{damaged.name}.0"
    assert sorted(path.name for path in moved.rglob("*")) == left
    assert store.find("encode", damaged.name) is None
    assert command("verify", monkeypatch, home) == 0


@pytest.mark.parametrize("by", [-1, 1])
def test_what_another_version_of_the_code_wrote_is_no_damage_and_stays(tmp_path, monkeypatch, capsys, by):
    store = Store(tmp_path)
    other = replace(tables.TRAINING, version=tables.TRAINING.version + by)
    with monkeypatch.context() as patch:
        patch.setitem(TABLES, other.name, other)
        patch.setattr(tables, "TRAINING", other)
        folder = add(store, 1)
    add(store, 2)
    assert command("verify", monkeypatch, tmp_path) == 0
    output = capsys.readouterr().out
    assert f"outdated, made anew when needed: encode/{folder.name}: " in output and "damaged:" not in output
    assert "2 artefacts, 0 of them damaged, 1 outdated" in output
    assert folder.exists() and not (tmp_path / "damaged").exists()


def publish(store, number, folder, *others):
    """A record of synthetic data that refers to artefacts."""
    artefacts = [
        StoredArtefact(stage=path.parent.name, key=path.name, digest=read_run_record(path).digest, rows=2)
        for path in (folder, *others)
    ]
    record = Version(
        experiment="walks",
        number=number,
        seed=0,
        made="2026-01-01T00:00:00Z",
        synthetic=artefacts[0],
        made_from=(),
        scored_in=tuple(artefacts[1:]),
        scores={},
        gates=Gates(),
        checks=(),
    )
    place = published_folder(store.home, "walks")
    place.mkdir(parents=True, exist_ok=True)
    write_version(place, record)
    write_latest(place, record)


def test_pruning_keeps_published_versions_with_their_scores_and_what_they_were_made_from(tmp_path, monkeypatch):
    store = Store(tmp_path)
    source = add(store, 1, age_days=99, stage="finetune")
    versions = [add(store, number, inputs=[1], age_days=99, stage="sample") for number in (2, 3, 4)]
    score = add(store, 5, inputs=[2], age_days=99, stage="memorisation")
    publish(store, 1, versions[0], score)
    publish(store, 2, versions[1])
    assert command("prune", monkeypatch, tmp_path, "--apply") == 0
    assert [path.exists() for path in (source, *versions, score)] == [True, True, True, False, True]
    assert command("prune", monkeypatch, tmp_path, "--keep-versions", "1", "--apply") == 0
    assert [path.exists() for path in (source, *versions, score)] == [True, False, True, False, False]
    assert command("prune", monkeypatch, tmp_path, "--keep-versions", "-1") == 2


def test_a_damaged_record_of_a_version_stops_pruning_and_is_named(tmp_path, monkeypatch, capsys):
    store = Store(tmp_path)
    folder = add(store, 1, age_days=99, stage="sample")
    publish(store, 1, folder)
    (published_folder(tmp_path, "walks") / "v0001.json").write_text("{")
    assert command("prune", monkeypatch, tmp_path, "--apply") == 2 and folder.exists()
    assert "v0001.json: is not the record of a version" in capsys.readouterr().err
    assert command("verify", monkeypatch, tmp_path) == 1
    assert "damaged: " in capsys.readouterr().out


def test_latest_data_that_is_not_there_is_found(tmp_path, monkeypatch, capsys):
    store = Store(tmp_path)
    folder = add(store, 1, stage="sample")
    publish(store, 1, folder)
    assert command("verify", monkeypatch, tmp_path) == 0
    flip_a_bit(folder)
    assert command("verify", monkeypatch, tmp_path) == 1
    assert f"missing: sample/{folder.name} of the latest data, version 1 of walks" in capsys.readouterr().out
    record = read_run_record(add(store, 1, stage="sample"))
    assert command("verify", monkeypatch, tmp_path) == 0, "made anew with the same content"
    (folder / "manifest.parquet").unlink()
    digest = write_manifest(folder, TABLE.slice(0, 1), tables.TRAINING).digest
    write_run_record(folder, record.model_copy(update={"digest": digest}))
    assert command("verify", monkeypatch, tmp_path) == 1
    assert f"changed: sample/{folder.name} of the latest data, version 1 of walks" in capsys.readouterr().out


def test_what_a_run_has_made_anew_since_it_was_found_damaged_stays(tmp_path, monkeypatch, capsys):
    store = Store(tmp_path)
    folder = add(store, 1)
    flip_a_bit(folder)
    check, calls = Store.check, []

    def check_and_make_anew(self, place):
        calls.append(place)
        try:
            check(self, place)
        except DataError:
            self.set_aside(place)
            add(self, 1)
            raise

    monkeypatch.setattr(Store, "check", check_and_make_anew)
    assert command("verify", monkeypatch, tmp_path) == 0
    assert calls == [folder, folder] and "0 of them damaged" in capsys.readouterr().out
    assert len(list((tmp_path / "damaged/encode").iterdir())) == 1
    check(store, folder)


def test_what_was_set_aside_is_neither_overwritten_nor_pruned(tmp_path, monkeypatch):
    store = Store(tmp_path)
    for _ in range(2):
        flip_a_bit(add(store, 1))
        for item in store.artefacts():
            with pytest.raises(DataError, match=r"weights\.bin: content has changed"):
                store.check(item.folder)
            store.set_aside(item.folder)
    store.prune(0)
    assert sorted(path.name for path in (tmp_path / "damaged" / "encode").iterdir()) == [f"{key(1)}.0", f"{key(1)}.1"]


@contextlib.contextmanager
def without_write_permission(home):
    """A folder that we may read only; root, whom permissions do not bind, becomes nobody for a while."""
    paths = [home, *(path for path in home.rglob("*") if path.is_dir())]
    for path in paths:
        path.chmod(0o555)
    root = os.geteuid() == 0
    if root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)
        for path in paths:
            path.chmod(0o755)


def test_a_store_that_may_only_be_read_is_read_and_errors_are_clear(monkeypatch, capsys):
    with tempfile.TemporaryDirectory() as folder:  # nobody may not enter pytest's
        home = Path(folder)
        store = Store(home)
        whole, damaged = add(store, 1, age_days=99), add(store, 2, age_days=99)
        flip_a_bit(damaged)
        before = tree(home)
        with without_write_permission(home):
            assert command("prune", monkeypatch, home, "--apply") == 2
            assert "error: " in (errors := capsys.readouterr().err) and "Permission denied" in errors
            assert command("verify", monkeypatch, home) == 2
            said = capsys.readouterr()
            assert f"damaged: encode/{damaged.name}" in said.out
            assert "is damaged and cannot be set aside" in said.err and "Permission denied" in said.err
            ref = Store(home).find("encode", whole.name)
        assert ref is not None and ref.digest == json.loads((whole / "run.json").read_text())["digest"]
        assert tree(home) == before


def test_digests_of_raw_files_are_read_once_and_written_by_many(tmp_path, monkeypatch):
    for number in range(16):
        (tmp_path / f"{number}.raw").write_bytes(bytes([number]))
    with ThreadPoolExecutor(8) as pool:
        named = [[(str(number), tmp_path / f"{number}.raw")] for number in range(16)]
        found = list(pool.map(lambda files: digest_raw_files(files, tmp_path), named))
    assert len({digest for ((_, digest),) in found}) == 16
    assert not list(tmp_path.glob("*.tmp")) and len(json.loads((tmp_path / "raw_file_digests.json").read_text())) > 0
    everything = [file for files in named for file in files]
    assert digest_raw_files(everything, tmp_path) == [row for rows in found for row in rows]
    remembering = "ctlev_core.provenance.raw_file_digests"
    monkeypatch.setattr(f"{remembering}.read_remembered", lambda path: pytest.fail("read again"))
    monkeypatch.setattr(f"{remembering}.file_digest", lambda path: pytest.fail("hashed again"))
    assert digest_raw_files(everything, tmp_path) == [row for rows in found for row in rows]


def test_what_is_set_aside_gets_a_free_name(tmp_path):
    store = Store(tmp_path)
    for number in range(2):
        (tmp_path / "artefacts" / "encode" / "k").mkdir(parents=True)
        assert store.set_aside(tmp_path / "artefacts" / "encode" / "k").name == f"k.{number}"
    shutil.rmtree(tmp_path / "damaged" / "encode" / "k.0")
    (tmp_path / "artefacts" / "encode" / "k").mkdir(parents=True)
    (tmp_path / "artefacts" / "encode" / "k" / "file").touch()
    assert (store.set_aside(tmp_path / "artefacts" / "encode" / "k") / "file").exists()
