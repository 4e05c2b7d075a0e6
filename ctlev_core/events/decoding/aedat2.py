"""AEDAT 2.0, the files of jAER: header lines that start with `#`, then big-endian pairs of a 32-bit address and a time.

What an address means depends on the camera: the format plug-in `aedat2` reads single cameras, the dataset `dhp19` four
cameras in one file. The clock counts microseconds in 32 bits and overflows after 71 minutes; here times are unwrapped.
A drop of more than 2^31 us is an overflow. A smaller one is a clock that was reset or records out of order: it stays in
the times as it is, for the reader above to judge.

Source: iniVation, "AEDAT file formats", docs.inivation.com; the end of the header as AedatTools finds it, except that a
line must be text to be one: a first address may start with the byte of `#`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_contracts.errors import DataError

VERSION_LINE = b"#!AER-DAT2.0"
RECORD_BYTES = 8
_HALF_RANGE = 1 << 31
_MAX_HEADER_BYTES = 1 << 20
_NOT_TEXT = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


@dataclass(frozen=True)
class Header:
    """The text before the records.

    Attributes:
        chip: last part of the class name jAER gives the camera (`DAVIS240C`), empty where the header names none.
        size: bytes before the first record.
    """

    chip: str
    size: int


def sniff(path: Path) -> bool:
    """Does the file start with the version line?"""
    with path.open("rb") as file:
        return file.read(len(VERSION_LINE)) == VERSION_LINE


def read_header(path: Path) -> Header:
    """Parse the header.

    Raises:
        DataError: the first line is not that of AEDAT 2.0.
    """
    with path.open("rb") as file:
        head = file.read(_MAX_HEADER_BYTES)
    if not head.startswith(VERSION_LINE):
        raise DataError(f"{path}: expected the first line {VERSION_LINE.decode()}, got {head[:12]!r}")
    chip, size = "", 0
    while head.startswith(b"#", size):
        stop = head.find(b"\n", size) + 1
        line = head[size:stop]
        if not line or _NOT_TEXT.search(line):
            break
        size = stop
        named = re.match(rb"#\s*AEChip:\s*(\S+)", line)
        if named:
            chip = named[1].decode("ascii", errors="replace").rsplit(".", 1)[-1]
        if line.startswith(b"#End Of ASCII Header"):
            break
    return Header(chip, size)


def check_size(path: Path, header: Header) -> int:
    """How many records follow the header.

    Raises:
        DataError: none, or the last one is cut.
    """
    num_bytes = path.stat().st_size - header.size
    if num_bytes == 0:
        raise DataError(f"{path}: the file ends after its {header.size}-byte header, expected address and time pairs")
    if num_bytes % RECORD_BYTES:
        raise DataError(
            f"{path}: cut inside a record: {num_bytes} bytes after the header, expected a multiple of {RECORD_BYTES}"
        )
    return num_bytes // RECORD_BYTES


def read_records(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """All records of a file, special events, frame samples and inertial data among them.

    Returns:
        Addresses [N] uint32 and times [N] int64 in microseconds, unwrapped, in the order of the file.
    Raises:
        DataError: another version, a header without records, or a cut record.
    """
    num_records = check_size(path, read_header(path))
    return next(read_record_chunks(path, num_records))


def read_record_chunks(path: Path, num_records: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The records of `read_records` in consecutive chunks of `num_records`, the last one shorter.

    Raises:
        DataError: as `read_records`.
    """
    if num_records < 1:
        raise ValueError(f"num_records must be at least 1, got {num_records}")
    header = read_header(path)
    remaining = check_size(path, header)
    previous, overflows = 0, 0
    with path.open("rb") as file:
        file.seek(header.size)
        while remaining:
            count = min(num_records, remaining)
            records = np.fromfile(file, ">u4", 2 * count).reshape(-1, 2)
            if len(records) != count:
                raise DataError(f"{path}: the file became shorter while it was read")
            remaining -= count
            times, overflows = _unwrap(records[:, 1].astype(np.int64), previous, overflows)
            previous = int(records[-1, 1])
            yield records[:, 0].astype(np.uint32), times


def _unwrap(clock: np.ndarray, previous: int, overflows: int) -> tuple[np.ndarray, int]:
    """Times of `clock` [N] int64, and the overflows up to its end; `previous` is the clock of the record before."""
    steps = np.diff(clock, prepend=previous)
    added = np.zeros(len(clock), np.int64)
    for index in np.flatnonzero(np.abs(steps) > _HALF_RANGE):
        # A late record just after an overflow belongs before it; before the first overflow there is no such time.
        change = 1 if steps[index] < 0 else -1 if overflows else 0
        added[index] = change
        overflows += change
    before = overflows - int(added.sum())
    return clock + ((before + np.cumsum(added)) << 32), overflows
