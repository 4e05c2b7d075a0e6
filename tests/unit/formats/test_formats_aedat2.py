"""AEDAT 2.0: records written with struct, the header's end, and the clock of 32 bits."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.events.decoding import aedat2
from data_contracts.errors import DataError

HEADER = b"#!AER-DAT2.0\r\n# This is a raw AE data file - do not edit\r\n# AEChip: eu.seebetter.ini.chips.davis.%s\r\n"


def write_records(path: Path, records: list[tuple[int, int]], chip: bytes = b"DAVIS346B") -> Path:
    path.write_bytes(HEADER % chip + b"".join(struct.pack(">II", *record) for record in records))
    return path


def slow_unwrap(clock: list[int]) -> list[int]:
    times, overflows, previous = [], 0, 0
    for value in clock:
        if previous - value > 2**31:
            overflows += 1
        elif value - previous > 2**31 and overflows:
            overflows -= 1
        times.append(value + overflows * 2**32)
        previous = value
    return times


def test_records_are_big_endian_pairs(tmp_path):
    path = write_records(tmp_path / "a.aedat", [(0x80000001, 2), (0x12345678, 70000)])
    addresses, times = aedat2.read_records(path)
    assert addresses.dtype == np.uint32 and times.dtype == np.int64
    assert addresses.tolist() == [0x80000001, 0x12345678]
    assert times.tolist() == [2, 70000]
    assert aedat2.read_header(path).chip == "DAVIS346B"


def test_a_first_address_that_starts_with_a_hash_is_no_header_line(tmp_path):
    records = [(0x23000001, 10), (0x230A0D0A, 0x0D0A0D0A)]
    path = write_records(tmp_path / "a.aedat", records)
    addresses, times = aedat2.read_records(path)
    assert list(zip(addresses.tolist(), times.tolist(), strict=True)) == records


def test_the_line_that_ends_the_header_ends_it(tmp_path):
    path = tmp_path / "a.aedat"
    path.write_bytes(b"#!AER-DAT2.0\r\n#End Of ASCII Header\r\n" + b"#0AAAAA\n")
    assert aedat2.read_records(path)[0].tolist() == [int.from_bytes(b"#0AA", "big")]


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.sampled_from([0, 1, 2**31 - 1, 2**31, 2**31 + 1, 2**32 - 2, 2**32 - 1]), min_size=1, max_size=30),
    st.integers(1, 31),
)
def test_unwrapped_times_equal_a_slow_loop_in_chunks_of_any_size(tmp_path_factory, clock, size):
    path = write_records(tmp_path_factory.mktemp("a") / "a.aedat", [(7, time) for time in clock])
    chunks = list(aedat2.read_record_chunks(path, size))
    assert [len(times) for _, times in chunks[:-1]] == [size] * (len(chunks) - 1)
    assert np.concatenate([times for _, times in chunks]).tolist() == slow_unwrap(clock)


def test_a_clock_that_was_reset_shows_in_the_times(tmp_path):
    path = write_records(tmp_path / "a.aedat", [(0, 1000), (0, 3), (0, 4)])
    assert aedat2.read_records(path)[1].tolist() == [1000, 3, 4]


def test_other_versions_headers_alone_and_cut_records_are_errors(tmp_path):
    path = tmp_path / "a.aedat"
    path.write_bytes(b"#!AER-DAT3.1\r\n")
    with pytest.raises(DataError, match=r"a\.aedat: expected the first line #!AER-DAT2.0"):
        aedat2.read_records(path)
    write_records(path, [])
    with pytest.raises(DataError, match=r"a\.aedat: the file ends after its \d+-byte header"):
        aedat2.read_records(path)
    content = write_records(path, [(1, 2), (3, 4)]).read_bytes()
    for cut in range(1, 8):
        path.write_bytes(content[:-cut])
        with pytest.raises(DataError, match=r"a\.aedat: cut inside a record"):
            aedat2.read_records(path)
