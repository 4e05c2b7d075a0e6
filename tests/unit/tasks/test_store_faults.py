"""What passes (no descriptors, a disk error) is no damage; damaged records are damage like any other."""

import errno
import json
import os
import resource
import signal
import subprocess
import sys
import textwrap
import threading
import time

import pytest
from test_stage import calls, first, run, second

from ctlev_core.provenance.raw_file_digests import digest_raw_files, read_remembered
from data_contracts.config import Windows
from data_contracts.errors import DataError
from data_contracts.run_record import read_run_record
from flows import cli
from tasks import file_locks
from tasks.stage import in_one_run, planning
from tasks.store import Store


@pytest.fixture(autouse=True)
def _home(home):
    calls.clear()


def verified(monkeypatch, home):
    monkeypatch.setattr(sys, "argv", ["verify", "--home", str(home)])
    with pytest.raises(SystemExit) as end:
        cli.script("verify")
    return end.value.code


def plan():
    with planning() as rows:
        second(first(windows=Windows()))
    return [row.cached for row in rows]


FULL_DISK = """
    import resource, signal, sys
    from pathlib import Path
    from tasks.stage import _prepare_work
    work, upstream = Path(sys.argv[1]), {"a" * 32: "b" * 64}
    _prepare_work(work, upstream)
    (work / "checkpoint").write_text("half way")
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    none, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    for room in (0, none):  # files can be emptied, and nothing written
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, most))
        try:
            _prepare_work(work, upstream)
        except OSError:
            pass
"""


def test_a_run_on_a_full_disk_keeps_the_checkpoints_of_the_one_before(tmp_path):
    subprocess.run([sys.executable, "-c", textwrap.dedent(FULL_DISK), str(tmp_path / "work")], check=True)
    assert (tmp_path / "work" / "checkpoint").read_text() == "half way"


def test_without_descriptors_nothing_is_set_aside(home):
    ref, _ = run(first, windows=Windows())
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    in_use = max(int(name) for name in os.listdir("/proc/self/fd")) + 1
    waiting = []
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (in_use, hard))
        with pytest.raises(OSError, match="Too many open files"):
            while True:
                waiting.append(os.open(os.devnull, os.O_RDONLY))
        for ask in (plan, lambda: run(first, windows=Windows()), lambda: Store().check(ref.path)):
            with pytest.raises(OSError) as raised:
                ask()
            assert raised.value.errno == errno.EMFILE
    finally:
        for descriptor in waiting:
            os.close(descriptor)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert not (home / "damaged").exists() and run(first, windows=Windows()) == (ref, True)


@pytest.mark.parametrize("name", ["run.json", "manifest.parquet", "frames.npy.zst"])
@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES, errno.ENOMEM, errno.EMFILE])
def test_errors_that_pass_are_raised_and_nothing_moves(home, monkeypatch, capsys, name, number):
    ref, _ = run(first, windows=Windows())
    real_open, real_stat = os.open, os.stat

    def fail(path, *rest, real, **named):
        if str(path).endswith(f"{ref.key}/{name}") and named.get("follow_symlinks", True):
            raise OSError(number, os.strerror(number), str(path))
        return real(path, *rest, **named)

    with monkeypatch.context() as patch:
        patch.setattr("io.open", lambda *a, real=open, **k: fail(*a, real=real, **k))
        patch.setattr("os.open", lambda *a, **k: fail(*a, real=real_open, **k))
        patch.setattr("os.stat", lambda *a, **k: fail(*a, real=real_stat, **k))
        for ask in (plan, lambda: run(first, windows=Windows())):
            with pytest.raises(OSError) as raised:
                ask()
            assert raised.value.errno == number
        assert verified(monkeypatch, home) == 2
    assert "cannot be read" in capsys.readouterr().err
    assert not (home / "damaged").exists() and run(first, windows=Windows()) == (ref, True)


def test_planning_moves_nothing_and_the_run_makes_room(home):
    ref, _ = run(first, windows=Windows())
    os.truncate(ref.path / "frames.npy.zst", 10)
    assert plan() == [False, False] and ref.path.exists() and not (home / "damaged").exists()
    again, cached = run(first, windows=Windows())
    assert not cached and again.digest == ref.digest and len(list((home / "damaged" / "first").iterdir())) == 1


def test_what_another_process_made_meanwhile_is_not_set_aside(home, monkeypatch):
    """Found damaged outside of the lock, whole inside."""
    ref, _ = run(first, windows=Windows())
    find, seen = Store.find, []

    def find_damaged_first(self, *arguments, **options):
        seen.append(options.get("make_room", False))
        if len(seen) == 1:
            frames = ref.path / "frames.npy.zst"
            whole = frames.read_bytes()
            frames.write_bytes(b"")
            try:
                return find(self, *arguments, **options)
            finally:
                frames.write_bytes(whole)
        return find(self, *arguments, **options)

    monkeypatch.setattr(Store, "find", find_damaged_first)
    assert run(first, windows=Windows()) == (ref, True)
    assert seen == [False, True] and not (home / "damaged").exists()


def flip(path, text):
    """One bit of the first byte after a text."""
    content = bytearray(path.read_bytes())
    content[content.index(text) + len(text)] ^= 1
    path.write_bytes(content)


RECORDS = {
    "a bit of upstream": lambda path: flip(path, b'"upstream": {\n    "'),
    "a bit of the name upstream": lambda path: flip(path, b'"upstrea'),
    "a bit of the time": lambda path: flip(path, b'"started": "'),
    "a bit of the arguments": lambda path: flip(path, b'"manifest": "'),
    "a list": lambda path: path.write_text("[]"),
    "a number": lambda path: path.write_text("7"),
    "no UTF-8": lambda path: path.write_bytes(b'"\xff"'),
    "deep": lambda path: path.write_text("[" * 100_000),
    "a long number": lambda path: path.write_text('{"digest": ' + "9" * 10_000 + "}"),
    "an empty digest": lambda path: without_own_digest(path, digest=""),
    "no digest": lambda path: without_own_digest(path, digest=None),
    "another key": lambda path: without_own_digest(path, key="0" * 32),
    "upstream is a list": lambda path: without_own_digest(path, upstream=[]),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


def without_own_digest(path, **changed):
    values = json.loads(path.read_text())
    del values["record_digest"]
    path.write_text(json.dumps(values | changed))


@pytest.mark.parametrize("damage", RECORDS)
def test_a_damaged_record_is_reported_and_made_anew(home, monkeypatch, capsys, damage):
    source, _ = run(first, windows=Windows())
    made, _ = run(second, source)
    RECORDS[damage](made.path / "run.json")
    with pytest.raises(DataError, match=r"run\.json: is not a provenance record") as refused:
        read_run_record(made.path)
    assert len(str(refused.value)) < 500
    assert plan() == [True, False]
    assert verified(monkeypatch, home) == 1
    assert f"damaged: second/{made.key}: " in capsys.readouterr().out
    assert run(second, source)[0].digest == made.digest and verified(monkeypatch, home) == 0
    RECORDS[damage](made.path / "run.json")
    again, cached = run(second, source)  # without verify
    assert not cached and again.digest == made.digest
    assert len(list((home / "damaged" / "second").iterdir())) == 2


def test_records_of_before_their_digest_are_read(home):
    ref, _ = run(first, windows=Windows())
    without_own_digest(ref.path / "run.json")
    assert run(first, windows=Windows()) == (ref, True)


REMEMBERED = {
    "a bit of a digest": lambda path: flip(path, b'"files": {"'),
    "a list": lambda path: path.write_text("[]"),
    "empty": lambda path: path.write_text(""),
    "cut": lambda path: os.truncate(path, path.stat().st_size - 2),
    "of before": lambda path: path.write_text('{"/a": [1, 2, 3, "0"]}'),
    "no UTF-8": lambda path: path.write_bytes(b"\xff" * 300),
}


@pytest.mark.parametrize("damage", REMEMBERED)
def test_damaged_digests_of_raw_files_are_reported_and_hashed_again(tmp_path, home, monkeypatch, capsys, damage):
    (tmp_path / "a.raw").write_bytes(b"1")
    files, path = [("a", tmp_path / "a.raw")], home / "raw_file_digests.json"
    found = digest_raw_files(files, home)
    assert verified(monkeypatch, home) == 0
    REMEMBERED[damage](path)
    assert digest_raw_files(files, home) == found and len(read_remembered(path)) == 1
    REMEMBERED[damage](path)
    assert verified(monkeypatch, home) == 1
    assert "raw_file_digests.json: is not a file of remembered digests" in capsys.readouterr().out
    assert not path.exists() and verified(monkeypatch, home) == 0


def test_content_changed_under_an_old_time_is_hashed_again(tmp_path, home):
    path = tmp_path / "a.raw"
    path.write_bytes(b"1")
    before, status = digest_raw_files([("a", path)], home), path.stat()
    with path.open("r+b") as file:
        file.write(b"2")
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert digest_raw_files([("a", path)], home) != before


@pytest.mark.parametrize("step", ["fsync", "rename", "mark", "record"])
def test_a_publishing_that_fails_leaves_no_half_artefact(home, monkeypatch, step):
    def fail(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    place = {"fsync": "os.fsync", "rename": "pathlib.Path.rename", "mark": "tasks.store.read_manifest"}
    with monkeypatch.context() as patch:
        patch.setattr(place.get(step, "tasks.store.write_run_record"), fail)
        with pytest.raises(OSError, match="No space left"):
            run(first, windows=Windows())
    assert not list((home / "tmp").iterdir())
    run(first, windows=Windows())
    assert Store().artefacts()


def test_a_home_that_cannot_be_held_at_the_moment_is_not_used_unheld(home, monkeypatch):
    Store().folder("first", "0").parent.mkdir(parents=True)

    def fail(*_, **__):
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr("pathlib.Path.open", fail)
    with pytest.raises(OSError, match="Too many open files"):
        Store().find("first", "0")


HOLDER = """
    import sys, time
    from pathlib import Path
    from tasks.store import Store
    with Store(Path(sys.argv[1])).lock("0a1b"):
        print("holds", flush=True)
        sys.stdin.read()
"""


def test_who_waits_for_a_stopped_process_says_so(home, monkeypatch, capsys):
    monkeypatch.setattr(file_locks, "SAY_AFTER_S", 0.1)
    command = [sys.executable, "-c", textwrap.dedent(HOLDER), str(home)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == b"holds\n"
        holder.send_signal(signal.SIGSTOP)
        try:
            waiting = threading.Thread(target=wait_for, args=(home,))
            waiting.start()
            said = ""
            deadline = time.monotonic() + 30
            while "waiting" not in said and time.monotonic() < deadline:
                said += capsys.readouterr().err
                time.sleep(0.05)
        finally:
            holder.send_signal(signal.SIGCONT)
            holder.kill()
        waiting.join(30)
        assert not waiting.is_alive()
    assert f"waiting for artefact encode/0a1b: process {holder.pid} on " in said
    assert f"which is stopped (kill -CONT {holder.pid} lets it go on), holds {home}/locks/0a1b" in said


def wait_for(home):
    with Store(home).lock("0a1b", "artefact encode/0a1b"):
        pass


def test_who_need_not_wait_long_says_nothing(home, capsys):
    for _ in range(2):
        with Store(home).lock("0a1b"):
            pass
    assert capsys.readouterr().err == ""
    assert f"process {os.getpid()} on " in (home / "locks" / "0a1b").read_text()


def test_in_one_run_a_passing_error_is_not_taken_for_a_missing_artefact(monkeypatch):
    run(first, windows=Windows())
    monkeypatch.setattr("tasks.stage.run_as_task", lambda *_: pytest.fail("made anew"))

    def fail(*_, **__):
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr("tasks.store.read_manifest", fail)
    with in_one_run(), pytest.raises(OSError, match="Too many open files"):
        first(windows=Windows())
