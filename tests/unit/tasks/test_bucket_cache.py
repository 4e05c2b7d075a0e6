"""The cache of a bucket stays below its limit, and keeps what is used and what the bucket does not have."""

import fcntl
import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import bucket_server
import pytest
from stored_artefacts import key, publish

from data_contracts.errors import DataError
from data_contracts.home_folder import home_folder
from data_contracts.published import StoredArtefact, Version, published_folder, write_latest, write_version
from data_contracts.regeneration import Gates
from tasks import bucket_cache
from tasks.store import Store

VALUES = 10_000
"""Of 8 bytes each; what else is in an artefact takes a few kilobytes."""


@pytest.fixture
def store(bucket_url, tmp_path, monkeypatch):
    monkeypatch.setenv("CTLEV_CACHE", str(tmp_path / "a"))
    return Store(home_folder(bucket_url))


def limit(monkeypatch, artefacts):
    monkeypatch.setenv("CTLEV_CACHE_GB", str(artefacts * (8 * VALUES + 5000) / 1e9))


def end_of_the_process():
    """As if what was found and made so far had been in a process that has ended."""
    for file, _ in bucket_cache._notes.values():
        file.close()
    bucket_cache._notes.clear()


def add(store, number, days):
    folder = publish(store, number, values=VALUES)
    then = time.time() - days * 86_400
    os.utime(folder / "run.json", (then, then))


def here(store):
    return {int(folder.name, 16) for folder in (store.home / "artefacts" / "encode").iterdir()}


def test_what_was_used_last_longest_ago_goes_and_is_fetched_again(store, monkeypatch):
    for number, days in enumerate([3, 9, 5, 7]):
        add(store, number, days)
    end_of_the_process()
    limit(monkeypatch, 3)
    add(store, 4, 0)
    assert here(store) == {0, 2, 4}, "of five, two go: those of 9 and 7 days ago"
    assert not (store.home / "uploaded" / "encode" / key(1)).exists()
    assert not list((store.home / "pruned").iterdir())
    assert store.find("encode", key(1)) is not None
    assert here(store) == {0, 1, 4}


def test_what_this_process_found_stays_though_the_limit_is_exceeded(store, monkeypatch, capsys):
    for number in range(3):
        add(store, number, number)
    limit(monkeypatch, 1)
    add(store, 3, 0)
    assert here(store) == {0, 1, 2, 3}
    assert "GB are in use, above CTLEV_CACHE_GB=8.5e-05" in capsys.readouterr().err


def test_what_another_process_found_stays_until_it_ends(store, monkeypatch):
    for number in range(3):
        add(store, number, 9 - number)
    end_of_the_process()
    script = f"""
        from tasks.store import Store

        assert Store().find("encode", "{key(0)}") is not None
        print("found", flush=True)
        input()
    """
    environment = os.environ | {"CTLEV_HOME": store.bucket.url, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", textwrap.dedent(script)]
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "found\n"
        then = time.time() - 30 * 86_400
        os.utime(store.folder("encode", key(0)) / "run.json", (then, then))
        limit(monkeypatch, 2)
        add(store, 3, 0)
        assert here(store) == {0, 3}, "the oldest is held"
        other.stdin.close()
    end_of_the_process()
    os.utime(store.folder("encode", key(0)) / "run.json", (then, then))
    add(store, 4, 0)
    assert here(store) == {3, 4}


def test_notes_that_are_removed_before_they_are_locked_are_begun_again(store, monkeypatch):
    """Another process may take them for those of one that has ended."""
    add(store, 1, days=1)
    end_of_the_process()
    lock, removed = fcntl.flock, []

    def flock(file, mode):
        if not removed and "in_use" in str(getattr(file, "name", "")):
            removed.append(file.name)
            os.unlink(file.name)
        return lock(file, mode)

    monkeypatch.setattr(bucket_cache.fcntl, "flock", flock)
    assert store.find("encode", key(1)) is not None and removed
    monkeypatch.undo()
    assert Path(removed[0]).read_text() == f"encode/{key(1)}\n"


def test_what_the_bucket_does_not_have_stays_and_is_sent_again(store, monkeypatch):
    for number in range(3):
        add(store, number, 9 - number)
    end_of_the_process()
    store.bucket.delete(f"artefacts/encode/{key(0)}/run.json")
    limit(monkeypatch, 2)
    add(store, 3, 0)
    assert here(store) == {0, 3}, "the next ones go in its place"
    assert store.send_unsent() == 1
    assert f"artefacts/encode/{key(0)}/run.json" in bucket_server.objects(store.bucket.url)


def test_the_latest_published_version_stays(store, monkeypatch):
    for number in range(3):
        add(store, number, 9 - number)
    end_of_the_process()
    digest = Store(store.home).find("encode", key(0)).digest
    end_of_the_process()
    frames = StoredArtefact(stage="encode", key=key(0), digest=digest, rows=2)
    version = Version(
        experiment="e", number=1, seed=1, made="2026-01-01T00:00:00Z", synthetic=frames, made_from=(), scored_in=(),
        scores={}, gates=Gates(), checks=(),
    )  # fmt: skip
    folder = published_folder(store.home, "e")
    folder.mkdir(parents=True)
    write_version(folder, version)
    write_latest(folder, version)
    then = time.time() - 30 * 86_400
    os.utime(store.folder("encode", key(0)) / "run.json", (then, then))
    limit(monkeypatch, 2)
    add(store, 3, 0)
    assert here(store) == {0, 3}


@pytest.mark.parametrize("asked", ["0", "-1", "nan", "many"])
def test_a_limit_that_is_none_is_refused_before_anything_runs(store, monkeypatch, asked):
    monkeypatch.setenv("CTLEV_CACHE_GB", asked)
    with pytest.raises(DataError, match=f"CTLEV_CACHE_GB must be a number of gigabytes above 0, got '{asked}'"):
        store.connect(send=True)


def test_a_machine_notes_once_a_day_that_it_uses_an_artefact(store):
    add(store, 1, 0)
    name = f"used/encode/{key(1)}"
    store.find("encode", key(1))
    assert name not in bucket_server.objects(store.bucket.url), "it was sent today"
    then = time.time() - 90_000
    marker = store.home / "uploaded" / "encode" / key(1)
    os.utime(marker, (then, then))
    store.find("encode", key(1))
    assert name in bucket_server.objects(store.bucket.url)
    store.bucket.delete(name)
    store.find("encode", key(1))
    assert name not in bucket_server.objects(store.bucket.url)
