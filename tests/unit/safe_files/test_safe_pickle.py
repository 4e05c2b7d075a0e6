"""Pickles and joblib dumps written by their own packages are read back; code, lies and damage are refused."""

from __future__ import annotations

import contextlib
import gzip
import io
import os
import pickle
import struct
import zlib
from collections import OrderedDict
from pathlib import Path

import joblib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from ctlev_core.safe_files import safe_pickle
from data_contracts.errors import DataError

ARRAYS = {
    "float": np.arange(12, dtype=np.float64).reshape(3, 4),
    "fortran": np.asfortranarray(np.arange(12, dtype=np.float32).reshape(3, 4)),
    "transposed": np.arange(24, dtype=np.int16).reshape(2, 3, 4).transpose(2, 0, 1),
    "big-endian": np.array([1, 256, 65536], ">i4"),
    "bool": np.array([True, False]),
    "empty": np.zeros((0, 72), np.float32),
    "no axes": np.array(7, np.uint8),
    "complex": np.array([1 + 2j], np.complex64),
    "text": np.array(["ab", "c"]),
    "bytes": np.array([b"ab", b"c"]),
}
TREE = {
    "smpl_poses": ARRAYS["float"],
    "list": [1, -(2**70), 1.5, True, None, "käfer", b"\x00\xff", b"", (), {2, 3}, 1 + 2j],
    "scalars": (np.float32(0.1), np.int64(-5), np.bool_(True), np.str_("x"), np.str_("")),
    7: {"nested": {"arrays": list(ARRAYS.values())}},
}


def assert_same(got: object, expected: object) -> None:
    assert type(got) is type(expected)
    if isinstance(expected, dict):
        assert list(got) == list(expected)
        for key in expected:
            assert_same(got[key], expected[key])
    elif isinstance(expected, list | tuple):
        assert len(got) == len(expected)
        for one, other in zip(got, expected, strict=True):
            assert_same(one, other)
    elif isinstance(expected, np.ndarray | np.generic):
        expected = expected.astype(expected.dtype.newbyteorder("="))
        assert (got.dtype, got.shape) == (expected.dtype, expected.shape)
        assert got.tobytes() == expected.tobytes()
    else:
        assert got == expected


class RunsCode:
    """What a hostile file holds: unpickling it calls os.system."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def assert_refused(content: bytes, message: str, tmp_path: Path, load=safe_pickle.load, **options) -> None:
    path = written(tmp_path / "file.pkl", content)
    with pytest.raises(DataError, match=message) as error:
        load(path, **options)
    assert str(error.value).startswith(f"{path}: ")


@pytest.mark.parametrize("protocol", range(6))
def test_every_protocol_gives_what_was_pickled(protocol, tmp_path):
    content = pickle.dumps(TREE, protocol)
    assert_same(safe_pickle.load(written(tmp_path / "a.pkl", content)), pickle.loads(content))


def test_arrays_can_be_written_to_and_shared_ones_stay_shared(tmp_path):
    array = np.arange(3)
    for protocol in (2, 5):
        first, second = safe_pickle.load(written(tmp_path / "a.pkl", pickle.dumps([array, array], protocol)))
        assert first is second
        first[0] = 9


def test_python_2_strings_are_latin_1(tmp_path):
    # cPickle.dumps({'a': numpy.array([1.0, 2.0])}, 2) of Python 2: byte strings as SHORT_BINSTRING (U).
    raw = struct.pack("<2d", 1.0, 2.0)
    content = (
        b"\x80\x02}U\x01acnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R(K\x01K\x02\x85"
        b"cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89"
        b"U" + bytes([len(raw)]) + raw + b"tbs."
    )
    loaded = safe_pickle.load(written(tmp_path / "a.pkl", content))
    assert list(loaded) == ["a"]
    np.testing.assert_array_equal(loaded["a"], [1.0, 2.0])
    assert safe_pickle.load(written(tmp_path / "b.pkl", b"U\x02k\xe4.")) == "kä"


@pytest.mark.parametrize("protocol", range(6))
def test_code_in_a_pickle_is_named_and_not_run(protocol, tmp_path):
    ran = tmp_path / "ran"
    content = pickle.dumps({"smpl_poses": np.zeros(3), "x": RunsCode(f"touch {ran}")}, protocol)
    assert_refused(content, r"refused: it names (posix|nt)\.system", tmp_path)
    assert not ran.exists()
    pickle.loads(content)
    assert ran.exists(), "the trap of this test is set: an ordinary unpickler falls into it"


@pytest.mark.parametrize("compress", [0, 3, ("gzip", 3)])
def test_code_in_a_joblib_file_is_named_and_not_run(compress, tmp_path):
    ran = tmp_path / "ran"
    joblib.dump([np.zeros(3), RunsCode(f"touch {ran}")], tmp_path / "a.joblib", compress=compress)
    assert_refused(
        (tmp_path / "a.joblib").read_bytes(), r"refused: it names posix\.system", tmp_path, safe_pickle.load_joblib
    )
    assert not ran.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pickle.dumps(OrderedDict(a=1)), r"names collections\.OrderedDict"),
        (pickle.dumps(Path("x")), r"names pathlib(\._local)?\.PosixPath"),
        (pickle.dumps(np.array([{}], object), 4), "array of type 'O8'"),
        (pickle.dumps(np.zeros(1, [("x", "f4")]), 4), "array of type 'V4'"),
        (pickle.dumps(np.dtype("f4")), "no plain data"),
        (pickle.dumps(np.ndarray), "no plain data"),
        (pickle.dumps(np.zeros(2, "M8[s]"), 4), "array of type 'M8'"),
        (pickle.dumps(np.ma.zeros(2), 4), r"names numpy\.ma"),
        (b"(S'touch x'\nios\nsystem\n.", "instruction that plain data does not need"),
        (b"Pabc\n.", "instruction that plain data does not need"),
        (b"\x82\x01.", "instruction that plain data does not need"),
        (b"]}b.", "sets the state of list"),
        (b"cnumpy\nndarray\n(K\x05\x85tR.", "calls Marker"),
        (b"]K\x00\x85R.", "calls list"),
        (b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R.", "array without content"),
    ],
)
def test_everything_but_plain_data_is_refused(content, message, tmp_path):
    assert_refused(content, message, tmp_path)


BOMB = b")" + b"q\x00h\x00\x86" * 60  # ((((), ()), ...): each tuple holds the last one twice


@pytest.mark.parametrize(
    "content",
    [
        b"\x80\x04}" + BOMB + b"K\x01s.",
        b"\x80\x04}(" + BOMB + b"K\x01u.",
        b"(" + BOMB + b"K\x01d.",
        b"\x80\x04\x8f(" + BOMB + b"\x90.",
        b"\x80\x04(" + BOMB + b"\x91.",
        b"\x80\x02c__builtin__\nset\n](" + BOMB + b"e\x85R.",
        b"\x80\x02cnumpy\ndtype\n" + BOMB + b"K\x00K\x01\x87R.",
    ],
)
def test_tuples_that_take_for_ever_to_hash_or_print_are_refused_at_once(content, tmp_path):
    assert_refused(content, r"key of a dictionary or set is \(\(\(|array of type \(\(\(", tmp_path)
    assert safe_pickle.load(written(tmp_path / "ok.pkl", pickle.dumps({(1, "a"): 2, None: 3}))) == {
        (1, "a"): 2,
        None: 3,
    }


def with_dtype_state(state: bytes) -> bytes:
    """A protocol 2 array [2] of float64 whose type has the given state."""
    return (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R(K\x01K\x02\x85cnumpy\ndtype\n"
        b"U\x02f8K\x00K\x01\x87R" + state + b"b\x89U\x10" + bytes(16) + b"tb."
    )


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (b"(K\x03U\x01<N(U\x01xt}U\x01xNsJ\xff\xff\xff\x7fK\x01K\x00t", "structured types are not read"),
        (b"(K\x03U\x01#NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00t", "byte order '#'"),
        (b"K\x03", "array type with the state 3"),
    ],
)
def test_a_dtype_with_a_state_of_its_own_is_refused(state, message, tmp_path):
    assert_refused(with_dtype_state(state), message, tmp_path)
    good = with_dtype_state(b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00t")
    np.testing.assert_array_equal(safe_pickle.load(written(tmp_path / "good.pkl", good)), [0, 0])


def test_an_array_larger_than_its_bytes_is_refused_before_it_is_made(tmp_path):
    content = pickle.dumps(np.zeros(3), 2)
    assert content.count(b"K\x03\x85") == 1
    assert_refused(content.replace(b"K\x03\x85", b"J\xff\xff\xff\x7f\x85"), "24 bytes instead of 17179869176", tmp_path)


@pytest.mark.parametrize("opcode", [b"\x8e", b"\x8d", b"\x96", b"\x95"], ids=["bytes", "str", "bytearray", "frame"])
def test_a_length_past_the_end_of_the_file_allocates_nothing(opcode, tmp_path):
    content = b"\x80\x05" + opcode + struct.pack("<Q", 2**50) + b"."
    assert_refused(content, f"claims {2**50} more bytes where at most 1 of 12 are left", tmp_path)


def test_limits_hold_for_files_for_copies_and_for_compressed_bytes(tmp_path):
    array = np.zeros(1000)
    content = pickle.dumps(array, 4)
    assert_refused(content, "more than the limit of 8000", tmp_path, max_bytes=8000)
    raw = bytes(8000)
    state = b"(K\x01M\xe8\x03\x85cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R\x89B" + struct.pack("<I", 8000) + raw + b"q\x00t"
    make = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
    twice = b"](" + make + state + b"q\x01b" + make + b"h\x01be."
    assert len(safe_pickle.load(written(tmp_path / "twice.pkl", twice))) == 2
    assert_refused(twice, "arrays have more bytes than the limit of 15000", tmp_path, max_bytes=15_000)
    joblib.dump(array, tmp_path / "a.z", compress=("zlib", 9))
    packed = (tmp_path / "a.z").read_bytes()
    assert len(packed) < 500
    assert_refused(packed, "limit of 500", tmp_path, safe_pickle.load_joblib, max_bytes=500)


@pytest.mark.parametrize("compress", [0, 1, ("zlib", 9), ("gzip", 3), ("bz2", 3), ("lzma", 3), ("xz", 3)], ids=str)
@pytest.mark.parametrize("protocol", [None, 2, 3, 5])
def test_joblib_files_give_what_was_dumped(compress, protocol, tmp_path):
    joblib.dump(TREE, tmp_path / "a.joblib", compress=compress, protocol=protocol)
    assert_same(safe_pickle.load_joblib(tmp_path / "a.joblib"), joblib.load(tmp_path / "a.joblib"))


@pytest.mark.parametrize("protocol", [0, 1])
def test_joblib_files_of_the_first_protocols(protocol, tmp_path):
    joblib.dump([ARRAYS["fortran"], "x"], tmp_path / "a.joblib", protocol=protocol)
    assert_same(safe_pickle.load_joblib(tmp_path / "a.joblib"), [ARRAYS["fortran"], "x"])


def test_joblib_files_without_padding_as_before_1_2(tmp_path, monkeypatch):
    original = joblib.numpy_pickle.NumpyArrayWrapper.__init__

    def without_padding(self, *arguments, **options):
        original(self, *arguments, **options)
        del self.numpy_array_alignment_bytes

    monkeypatch.setattr(joblib.numpy_pickle.NumpyArrayWrapper, "__init__", without_padding)
    joblib.dump(list(ARRAYS.values()), tmp_path / "a.joblib")
    monkeypatch.undo()
    assert b"numpy_array_alignment_bytes" not in (tmp_path / "a.joblib").read_bytes()
    assert_same(safe_pickle.load_joblib(tmp_path / "a.joblib"), list(ARRAYS.values()))


def test_large_arrays_and_frames_of_joblib(tmp_path):
    tree = [np.arange(300_000), "x" * 200_000, np.arange(300_000.0), list(range(40_000))]
    joblib.dump(tree, tmp_path / "a.joblib", compress=("zlib", 1))
    assert_same(safe_pickle.load_joblib(tmp_path / "a.joblib"), tree)


def test_a_memory_map_becomes_an_array(tmp_path):
    mapped = np.memmap(tmp_path / "m", np.float32, "w+", shape=(4,))
    mapped[:] = 3
    joblib.dump(mapped, tmp_path / "a.joblib")
    assert_same(safe_pickle.load_joblib(tmp_path / "a.joblib"), np.full(4, 3, np.float32))


@pytest.mark.filterwarnings("ignore:the matrix subclass")
def test_arrays_of_objects_in_joblib_files_are_refused(tmp_path):
    joblib.dump(np.array([{}, []], object), tmp_path / "a.joblib")
    with pytest.raises(DataError, match="array of type 'O8'"):
        safe_pickle.load_joblib(tmp_path / "a.joblib")
    joblib.dump(np.matrix([[1.0]]), tmp_path / "b.joblib")
    with pytest.raises(DataError, match="matrix"):
        safe_pickle.load_joblib(tmp_path / "b.joblib")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"ZF0x10               " + zlib.compress(b"N."), "joblib before 0.10"),
        (b"cjoblib.numpy_pickle\nNDArrayWrapper\n.", "files beside it, as a joblib before 0.10"),
        (b"\x04\x22\x4d\x18abc", "lz4"),
        (b"", "the file is empty"),
        (zlib.compress(pickle.dumps("x" * 99))[:-8], "ends early"),
        (zlib.compress(pickle.dumps("x" * 99))[:-1] + b"\x00", "incorrect data check"),
        (gzip.compress(pickle.dumps("x" * 99), mtime=0)[:-8] + bytes(8), "CRC check failed"),
    ],
)
def test_joblib_files_that_are_old_or_damaged(content, message, tmp_path):
    assert_refused(content, message, tmp_path, safe_pickle.load_joblib)


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(DataError, match="absent: expected a pickle file, got nothing there"):
        safe_pickle.load(tmp_path / "absent")
    with pytest.raises(DataError, match="expected a pickle file, got a folder"):
        safe_pickle.load_joblib(tmp_path)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_damaged_files_raise_data_errors_or_give_plain_data(data, tmp_path_factory):
    buffer, protocol = io.BytesIO(), data.draw(st.integers(0, 5))
    load, dump = data.draw(st.sampled_from([(safe_pickle.load, pickle.dump), (safe_pickle.load_joblib, joblib.dump)]))
    dump(TREE, buffer, protocol=protocol)
    content = bytearray(buffer.getvalue())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = written(
        tmp_path_factory.getbasetemp() / "fuzzed.pkl", bytes(content[: data.draw(st.integers(1, len(content)))])
    )
    with contextlib.suppress(DataError):
        load(path)


@settings(max_examples=50, deadline=None)
@given(
    array=npst.arrays(
        npst.floating_dtypes() | npst.integer_dtypes() | npst.boolean_dtypes(), npst.array_shapes(min_side=0)
    ),
    protocol=st.integers(0, 5),
)
def test_any_array_of_numbers_survives(array, protocol, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "array.pkl"
    content = pickle.dumps(array, protocol)
    loaded = safe_pickle.load(written(path, content))
    assert_same(loaded, pickle.loads(content))
    np.testing.assert_array_equal(loaded, array)
    joblib.dump(array, path, protocol=protocol)
    assert_same(safe_pickle.load_joblib(path), array)
