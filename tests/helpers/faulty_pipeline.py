"""Run two stages again and again, with one system call that fails once at each place where it can.

Started with `failing_calls.so` loaded before the C library:
python faulty_pipeline.py LIBRARY FOLDER [all]. Prints one JSON object: how many places there are of each call, how many
failures were tried, how many ended the run with an error, and what went wrong. A place is one call on a file below the
home; it fails with one error, with `all` with each in turn. The process that meets the failure is forked for it.
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import shutil
import signal
import sys
import traceback
from pathlib import Path

import numpy as np
import pyarrow as pa

from data_contracts import tables
from data_contracts.errors import DataError
from data_contracts.file_lists import file_digest
from tasks.stage import stage
from tasks.store import Store

ERRORS = {
    "open": (errno.EMFILE, errno.EACCES, errno.EIO, errno.ENOSPC),
    "write": (errno.ENOSPC, errno.EIO),
    "read": (errno.EIO,),
    "fsync": (errno.EIO, errno.ENOSPC),
    "flock": (errno.ENOLCK, errno.EINTR),
    "rename": (errno.ENOSPC, errno.EACCES, errno.EIO),
    "unlink": (errno.EACCES, errno.EIO),
    "mkdir": (errno.ENOSPC, errno.EACCES),
    "chmod": (errno.EPERM,),
    "stat": (errno.EIO, errno.EACCES),
}
LONGEST_S = 60


def _table(values: list[float]) -> pa.Table:
    steps = pa.array(range(len(values)), pa.int64())
    return pa.table({"curve": ["training"] * len(values), "step": steps, "loss": pa.array(values, pa.float64())})


def _raw_files(arguments: dict) -> list[tuple[str, Path]]:
    return [("recording", Path(os.environ["CTLEV_HOME"]).parent / "raw.bin")]


@stage(version=1, schema=tables.TRAINING, raw_files=_raw_files)
def read_raw(out, *, seed: int) -> pa.Table:
    """Whole files, rows one by one, a folder, a second table and resumable state: all that stages write."""
    (_, path), *_ = _raw_files({})
    values = np.frombuffer(path.read_bytes(), np.uint8).astype(float)
    with out.open_array("frames") as frames:
        for row in range(3):
            frames.append(np.full((1, 2, 2), seed + row, np.uint8))
    (out.folder / "checkpoint" / "unet").mkdir(parents=True)
    (out.folder / "checkpoint" / "unet" / "weights.bin").write_bytes(bytes(100))
    (out.work / "state.pt").write_bytes(b"state")
    table = _table(values.tolist())
    out.write_table(table, tables.TRAINING)
    return table


@stage(version=1, schema=tables.TRAINING)
def add_up(out, source) -> pa.Table:
    """Reads what the other made."""
    return _table([float(sum(source.column("loss"))) + float(np.asarray(source.array("frames")).sum())])


def run_pipeline() -> None:
    ref = read_raw.run(read_raw.key({"seed": 1}, Store()), {"seed": 1})[0]
    add_up.run(add_up.key({"source": ref}, Store()), {"source": ref})


def digests(home: Path) -> dict[str, str]:
    """Of every manifest, which names the digests of all files beside it."""
    return {
        str(path.parent.relative_to(home)): file_digest(path)
        for path in sorted(home.glob("artefacts/*/*/manifest.parquet"))
    }


def forked(work) -> str:
    """What went wrong in a process of its own; empty where nothing did."""
    ours, theirs = os.pipe()
    process = os.fork()
    if process == 0:
        os.close(ours)
        signal.alarm(LONGEST_S)
        said = ""
        try:
            work()
        except BaseException:
            said = traceback.format_exc()
        os.write(theirs, said.encode()[-60_000:])
        os._exit(1 if said else 0)
    os.close(theirs)
    with os.fdopen(ours, "rb") as pipe:
        said = pipe.read().decode()
    _, status = os.waitpid(process, 0)
    return said or ("" if status == 0 else f"ended with status {status}: hung or crashed")


def check(home: Path, expected: dict[str, str]) -> list[str]:
    """Run undisturbed after the failure: what is not as if nothing had happened?"""
    wrong = []
    for folder in home.glob("artefacts/*/*"):
        if said := forked(lambda folder=folder: Store(home).check(folder)):
            wrong.append(f"an artefact that is not whole: {said[-400:]}")
    if said := forked(run_pipeline):
        wrong.append(f"the next run fails: {said[-1500:]}")
    elif digests(home) != expected:
        wrong.append("other digests")
    wrong += [f"left behind: {path}" for path in home.glob("tmp/*")]
    wrong += [f"set aside although nothing was damaged: {path}" for path in home.glob("damaged/*/*")]
    return wrong


def main(library: str, folder: Path, every_error: bool) -> None:
    shim = ctypes.CDLL(library)
    home = folder / "home"
    os.environ["CTLEV_HOME"] = str(home)
    (folder / "raw.bin").write_bytes(bytes(range(20)))

    def fresh() -> None:
        shutil.rmtree(home, ignore_errors=True)
        home.mkdir()

    fresh()
    assert not (said := forked(run_pipeline)), said
    expected, places_of, faults = digests(home), {}, []
    tried, told = 0, folder / "told"
    for name, numbers in ERRORS.items():

        def count(name=name) -> None:
            shim.arm(name.encode(), 0, 0, str(home).encode())
            run_pipeline()
            (folder / "count").write_text(str(shim.seen()))

        fresh()
        assert not (said := forked(count)), said
        places_of[name] = places = int((folder / "count").read_text())
        for place in range(1, places + 1):
            for number in numbers if every_error else (numbers[place % len(numbers)],):

                def fail(name=name, number=number, place=place) -> None:
                    shim.arm(name.encode(), place, number, str(home).encode())
                    try:
                        run_pipeline()
                    except (OSError, DataError, pa.ArrowException) as error:
                        assert str(error)
                        with told.open("a") as file:
                            file.write("1")

                fresh()
                tried += 1
                where = f"{name} {place} of {places}, {errno.errorcode[number]}"
                if said := forked(fail):
                    faults.append(f"{where}: {said}")
                faults += [f"{where}: {fault}" for fault in check(home, expected)]
    print(json.dumps({"places": places_of, "tried": tried, "told": len(told.read_text()), "faults": faults}))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), "all" in sys.argv[3:])
