"""Records of versions, the latest, claims, and what pruning must keep for them."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from data_contracts.errors import DataError
from data_contracts.published import (
    GateCheck,
    StoredArtefact,
    Version,
    kept_versions,
    latest_frames,
    published_folder,
    read_latest,
    read_versions,
    version_file,
    write_latest,
    write_version,
)
from data_contracts.regeneration import Gates
from tasks import publish
from tasks.publish import claimed, next_number


def artefact(key, stage="sample"):
    return StoredArtefact(stage=stage, key=key, digest="d" * 64, rows=8)


def version_of(number, *, passed=True, name="studio"):
    check = GateCheck(gate="max_memorised_share", score="share of copies", value=0.5, limit=0.6 if passed else 0.1)
    return Version(
        experiment=name,
        number=number,
        seed=number + 100,
        made="2026-01-01T00:00:00Z",
        synthetic=artefact(f"{number:032x}"),
        made_from=(artefact("a" * 32, "finetune"),),
        scored_in=(artefact(f"{number + 1000:032x}", "memorisation"),),
        scores={"all: fd": 1.5},
        gates=Gates(),
        checks=(check,),
    )


def make(folder, number, **options):
    with claimed(folder) as claim:
        assert claim.number == number
        return claim.finish(version_of(number, **options))


@pytest.fixture
def folder(tmp_path):
    return published_folder(tmp_path, "studio")


def test_numbers_follow_and_only_what_passed_becomes_the_latest(tmp_path, folder):
    assert next_number(folder) == 1 and read_latest(folder) is None
    with pytest.raises(DataError, match="no version has been published yet"):
        latest_frames(tmp_path, "studio")
    made = [make(folder, 1), make(folder, 2), make(folder, 3, passed=False)]
    assert read_versions(folder) == made and read_latest(folder) == made[1]
    found = latest_frames(tmp_path, "studio")
    assert found.path == tmp_path / "artefacts" / "sample" / f"{2:032x}" and found.digest == "d" * 64
    assert str(made[2]) == (
        "version 3 of studio was rejected: max_memorised_share: share of copies is 0.5, 0.1 at most was asked for"
    )
    assert str(made[1]) == "version 2 of studio is published"
    assert sorted(path.name for path in folder.iterdir()) == [
        "latest.json", "lock", "v0001.json", "v0002.json", "v0003.json"
    ]  # fmt: skip


def test_a_version_that_was_begun_is_gone_on_with(folder):
    make(folder, 1)
    with pytest.raises(KeyboardInterrupt), claimed(folder):
        raise KeyboardInterrupt
    assert next_number(folder) == 2 and json.loads((folder / "claimed.json").read_text())["number"] == 2
    make(folder, 2)
    assert next_number(folder) == 3


@pytest.mark.parametrize("passed", [True, False])
def test_a_run_killed_between_record_and_latest_is_finished_and_its_record_stays(folder, monkeypatch, passed):
    first = make(folder, 1)

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(publish, "write_latest" if passed else "write_version", killed)
        make(folder, 2, passed=passed)
    assert read_latest(folder) == first
    before = version_file(folder, 2).read_bytes() if passed else None
    with claimed(folder) as claim:
        assert claim.number == 2 and (claim.version is not None) == passed
        claim.finish(claim.version or version_of(2, passed=False))
    assert before is None or version_file(folder, 2).read_bytes() == before
    latest = read_latest(folder)
    assert latest is not None and latest.number == (2 if passed else 1) and next_number(folder) == 3


def test_a_record_is_never_changed(folder):
    make(folder, 1)
    with pytest.raises(FileExistsError, match="this version has a record"):
        write_version(folder, version_of(1))
    with pytest.raises(ValueError, match="version 2 is claimed, not 7"), claimed(folder) as claim:
        claim.finish(version_of(7))


HOLDER = """
import pathlib, sys
from tasks.publish import claimed
with claimed(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_one_run_at_a_time(folder):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(folder)],
        cwd=Path(__file__).resolve().parents[3],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == b"held\n"
        with pytest.raises(BlockingIOError, match="another run is making a version"), claimed(folder):
            pass
    finally:
        process.kill()
        process.communicate()
    make(folder, 1)  # the kernel frees the lock of a killed process, and its version is gone on with


def test_an_interrupted_write_leaves_the_latest_as_it_was(folder, monkeypatch):
    first = make(folder, 1)
    with monkeypatch.context() as patch, pytest.raises(OSError, match="disk full"):
        patch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError("disk full")))
        write_latest(folder, version_of(2))
    assert read_latest(folder) == first


@pytest.mark.parametrize("file", ["v0001.json", "latest.json", "claimed.json"])
def test_damage_is_named(folder, file):
    make(folder, 1)
    (folder / file).write_text("{}")
    with pytest.raises(DataError, match=file):
        next_number(folder)
    if file != "claimed.json":
        with pytest.raises(DataError, match=file):
            kept_versions(folder.parents[1], 5)


@pytest.mark.parametrize(("count", "expected"), [(0, [2]), (1, [4, 2]), (2, [2, 4, 2]), (9, [1, 2, 4, 2])])
def test_kept_are_the_newest_that_passed_and_the_latest(tmp_path, folder, count, expected):
    for number, passed in ((1, True), (2, True), (3, False), (4, True), (5, False)):
        make(folder, number, passed=passed)
    write_latest(folder, version_of(2))  # gone back to by hand
    other = published_folder(tmp_path, "other")
    make(other, 1, name="other", passed=False)
    assert [version.number for version in kept_versions(tmp_path, count)] == expected


@pytest.mark.parametrize("name", ["..", ".", "", "a/b", "/a"])
def test_no_name_leads_out_of_the_home(tmp_path, name):
    with pytest.raises(DataError, match="must be that of a folder"):
        published_folder(tmp_path, name)


@pytest.mark.parametrize("number", ["-3", "0", "true", "2.7", '"4"', "1e400"])
def test_a_claim_of_a_number_that_no_version_can_have_is_refused_before_it_is_made(tmp_path, number):
    (tmp_path / "claimed.json").write_text(f'{{"number": {number}}}')
    with pytest.raises(DataError, match=r"claimed\.json: is not a claim; remove it"):
        next_number(tmp_path)
