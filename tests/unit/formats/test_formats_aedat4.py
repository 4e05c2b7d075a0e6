"""AEDAT 4: a corrupt file is an error of this file, whatever it does to the decoder."""

import struct
import subprocess
import sys
import textwrap
import threading

import pytest
from aedat4_writer import aedat4, header, packet
from format_helpers import to_rows

from ctlev_core.events import files as event_files
from ctlev_core.events.decoding import aedat4_process
from ctlev_core.formats import aedat4 as reader
from data_contracts.errors import DataError

ROWS = [(1, 2, 3, 1), (5, 319, 239, 0), (5, 0, 0, 1), (9, 7, 8, 0)]
NO_SUCH_MEMORY = header(320, 240) + struct.pack("<ii", 0, -1) + b"x" * 30
"""A packet of 2^32 - 1 bytes."""


def write(tmp_path, content):
    (tmp_path / "a.aedat4").write_bytes(content)
    return tmp_path / "a.aedat4"


def test_events_are_read_whole_and_in_chunks(tmp_path):
    path = write(tmp_path, aedat4([packet(ROWS[:3]), packet([]), packet(ROWS[3:])]))
    assert to_rows(reader.read(path)) == ROWS and reader.read(path).sensor_size == (320, 240)
    assert [to_rows(chunk) for chunk in reader.read_chunks(path, 3)] == [ROWS[:3], ROWS[3:]]
    assert event_files.find_format(path) is reader


def test_no_events_are_an_empty_recording(tmp_path):
    assert len(reader.read(write(tmp_path, aedat4([])))) == 0


LONELY = """
    import resource, sys
    from pathlib import Path
    from ctlev_core.formats import aedat4
    from data_contracts.errors import DataError
    resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        aedat4.read(Path(sys.argv[1]))
    except DataError as error:
        print("DataError:", error)
"""


def test_a_file_that_aborts_the_decoder_does_not_end_us(tmp_path):
    path = write(tmp_path, NO_SUCH_MEMORY)
    command = [sys.executable, "-c", textwrap.dedent(LONELY), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert (
        f"DataError: {path}: not a complete AEDAT 4 file, the decoder says: its process ended with SIG" in done.stdout
    )


WHOLE = aedat4([packet(ROWS)])
CORRUPT = {
    "header": WHOLE[:18] + b"\xff\xff\xff\x7f" + WHOLE[22:],
    "cut": WHOLE[:-1],
    "version line alone": WHOLE[:14],
    "length of a packet": NO_SUCH_MEMORY,
    "number of events": aedat4([packet(ROWS, 1 << 31)]),
}


@pytest.mark.parametrize("kind", CORRUPT)
def test_corrupt_files_are_named(tmp_path, kind):
    path = write(tmp_path, CORRUPT[kind])
    with pytest.raises(DataError, match=r"a\.aedat4: not a complete AEDAT 4 file") as refused:
        reader.read(path)
    assert len(str(refused.value)) < 500


def test_who_stops_reading_leaves_no_process(tmp_path, monkeypatch):
    started = []

    class Watched(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            started.append(self)

    monkeypatch.setattr(aedat4_process.subprocess, "Popen", Watched)
    path = write(tmp_path, aedat4([packet(ROWS)] * 1 + [packet([(10, 1, 1, 1)] * 1000)] * 200))
    chunks = reader.read_chunks(path, 2)
    assert to_rows(next(chunks)) == ROWS[:2]
    chunks.close()
    assert started[0].returncode is not None and threading.active_count() < 10
