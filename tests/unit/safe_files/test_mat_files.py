"""Structs of MATLAB files, against SciPy's reader and writer, and files that made SciPy's reader hang or crash."""

import io
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import loadmat, savemat

from ctlev_core.safe_files import mat_files
from ctlev_core.safe_files.mat_files import read_struct
from data_contracts.errors import DataError

TYPES = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")


def written(values, compressed=False):
    buffer = io.BytesIO()
    savemat(buffer, values, do_compression=compressed)
    return buffer.getvalue()


@pytest.mark.parametrize("compressed", [False, True])
@given(
    st.lists(st.tuples(st.sampled_from(TYPES), st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=6),
    st.integers(0, 2**31),
)
@settings(deadline=None, max_examples=60)
def test_structs_are_read_as_scipy_reads_them(tmp_path_factory, compressed, fields, seed):
    random = np.random.default_rng(seed)
    arrays = {
        f"field{number}": random.integers(0, 100, (rows, columns)).astype(kind)
        for number, (kind, rows, columns) in enumerate(fields)
    }
    path = tmp_path_factory.mktemp("mat") / "a.mat"
    path.write_bytes(written({"other": np.ones(3), "wanted": arrays}, compressed))
    expected, found = loadmat(path)["wanted"][0, 0], read_struct(path, "wanted")
    for name, values in arrays.items():
        if values.size:  # an empty array has no values to be read
            np.testing.assert_array_equal(found[name], expected[name])
            np.testing.assert_array_equal(found[name], values)


def test_large_ends_and_what_is_no_array_of_numbers(tmp_path):
    path = tmp_path / "a.mat"
    path.write_bytes(written({"s": {"text": "abc", "cells": np.array([1, "b"], object), "complex": np.array([[1j]])}}))
    assert read_struct(path, "s") == {}

    def element(kind, content):
        return struct.pack(">II", kind, len(content)) + content + bytes(-len(content) % 8)

    numbers = element(14, element(6, struct.pack(">II", 6, 0)) + element(5, struct.pack(">ii", 1, 2)) + element(1, b"")
                      + element(9, struct.pack(">dd", 3.0, 4.0)))  # fmt: skip
    whole = element(14, element(6, struct.pack(">II", 2, 0)) + element(5, struct.pack(">ii", 1, 1)) + element(1, b"s")
                    + element(5, struct.pack(">i", 8)) + element(1, b"xyz\0\0\0\0\0") + numbers)  # fmt: skip
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI" + whole)
    np.testing.assert_array_equal(read_struct(path, "s")["xyz"], [[3.0, 4.0]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected a .mat file of version 5 to 7"),
        (b"\x89HDF\r\n\x1a\n".ljust(200), "expected a .mat file of version 5 to 7"),
        (written({"s": np.ones(3)}), r"expected s to be one struct, got class 6, shape \[1, 3\]"),
        (written({"t": {"a": 1.0}}), "expected a variable s, got t"),
        (written({"s": {"a": np.ones((4, 4))}})[:-20], "damaged: an element of"),
        (written({"s": {"a": np.ones((4, 4))}}, True)[:-9], "damaged: "),
    ],
    ids=["empty", "HDF5", "an array", "another variable", "cut", "cut, compressed"],
)
def test_what_is_no_such_file_is_named(tmp_path, content, message):
    path = tmp_path / "a.mat"
    path.write_bytes(content)
    with pytest.raises(DataError, match=rf"a\.mat: {message}"):
        read_struct(path, "s")


def test_a_file_that_unpacks_to_more_than_the_limit_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(mat_files, "MAX_BYTES", 100_000)
    path = tmp_path / "a.mat"
    path.write_bytes(written({"s": {"a": np.zeros(1_000_000)}}, True))
    assert path.stat().st_size < 20_000
    with pytest.raises(DataError, match="larger than the limit"):
        read_struct(path, "s")


@given(st.integers(0, 10_000), st.binary(min_size=1, max_size=8))
@settings(deadline=None, max_examples=300)
def test_changed_bytes_give_numbers_or_a_data_error(tmp_path_factory, at, change):
    """SciPy 1.17 ends the process with a segmentation fault, or never ends, on about one in a thousand."""
    content = bytearray(written({"s": {f"joint{number}": np.ones((5, 3)) for number in range(13)}}))
    at = min(at, len(content) - 1)
    content[at : at + len(change)] = change
    path = tmp_path_factory.mktemp("mat") / "a.mat"
    path.write_bytes(content)
    try:
        found = read_struct(path, "s")
    except DataError as error:
        assert str(path) in str(error) and len(str(error)) < 500
    else:
        assert all(isinstance(values, np.ndarray) for values in found.values())
