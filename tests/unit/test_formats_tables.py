"""Formats that are tables (npy, npz, HDF5, text), written with NumPy, h5py and plain string formatting."""

from __future__ import annotations

import io
import pickle
import zipfile
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.lib.recfunctions import repack_fields

from ctlev_core import event_files, event_pieces, event_tables, plugins
from data_contracts.errors import DataError
from data_contracts.events import Events

T = [0, 5, 5, 1_000_003]
X = [0, 345, 3, 7]
Y = [1, 2, 259, 0]
P = [1, 0, 0, 1]


def assert_events(events: Events, t=T, x=X, y=Y, p=P) -> None:
    assert [events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist()] == [list(t), x, y, p]


def read_both_ways(path: Path) -> Events:
    """Found by content, read whole and in pieces of three, which must agree."""
    module = event_files.find_format(path)
    events = module.read(path)
    pieces = list(module.read_chunks(path, 3))
    assert all(len(piece) == 3 for piece in pieces[:-1])
    joined = event_pieces.concatenate(pieces)
    assert_events(joined, events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist())
    assert joined.sensor_size == events.sensor_size
    return events


def raises_both_ways(path: Path, match: str) -> None:
    module = event_files.find_format(path)
    with pytest.raises(DataError, match=match):
        module.read(path)
    with pytest.raises(DataError, match=match):
        list(module.read_chunks(path, 3))


def structured(dtypes: str = "<i8 <u2 <u2 |u1", names: str = "t x y p", p=P, t=T) -> np.ndarray:
    array = np.empty(len(t), list(zip(names.split(), dtypes.split(), strict=True)))
    for name, values in zip(names.split(), (t, X[: len(t)], Y[: len(t)], p), strict=True):
        array[name] = values
    return array


# Values ------------------------------------------------------------------------------------------------------------


@settings(max_examples=300, deadline=None)
@given(st.one_of(st.floats(0, 9e12), st.floats(0, 1e-3), st.integers(0, 10**12).map(lambda n: (n + 0.5) / 1e6)))
def test_float_seconds_are_rounded_exactly(seconds):
    assert event_tables.seconds_to_us(np.array([seconds])).tolist() == [round(Fraction(seconds) * 10**6)]


@pytest.mark.parametrize(
    ("p", "dtype", "good"),
    [
        ([1, 0, 0, 1], "u1", True),
        ([1, -1, -1, 1], "i1", True),
        ([True, False, False, True], "?", True),
        ([1.0, -1.0, -1.0, 1.0], "f4", True),
        ([1, 0, -1, 1], "i8", False),
        ([2, 0, 0, 1], "u1", False),
        ([0.5, 0, 0, 1], "f8", False),
        ([np.nan, 0, 0, 1], "f8", False),
    ],
)
def test_polarity_of_any_convention(p, dtype, good, tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, structured(f"<i8 <u2 <u2 {dtype}", p=p))
    if good:
        assert_events(read_both_ways(path))
    else:
        raises_both_ways(path, "polarity -1 and 0|p must be a whole number from -1 to 1, got .* at event 0")


@pytest.mark.parametrize("order", ["<", ">"])
def test_byte_order_and_field_order_do_not_matter(order, tmp_path):
    path = tmp_path / "a.npy"
    array = structured(f"{order}u8 {order}i4 {order}f8 {order}i2", "timestamp X y_pos polarity")
    np.save(path, repack_fields(array[["polarity", "y_pos", "timestamp", "X"]]))
    events = read_both_ways(path)
    assert_events(events)
    assert events.sensor_size == (346, 260)


@pytest.mark.parametrize(("unit", "dtype"), [(1, "i8"), (1, "f8"), (1e-6, "f8"), (1e-6, ">f8")])
@pytest.mark.parametrize("order", "CF")
def test_npy_of_four_columns_is_x_y_t_p(unit, dtype, order, tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.asarray(np.stack([X, Y, np.array(T) * unit, P], 1), dtype, order))
    assert_events(read_both_ways(path))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t": [0, 2, 1, 3]}, "t decreases at event 2: 2 us, then 1 us"),
        ({"t": [-1, 2, 3, 4]}, "must be a whole number from 0 .* got -1 at event 0"),
        ({"t": [0.5, np.nan, 1, 2]}, "t must be seconds from 0 on, got nan at event 1"),
        ({"t": [0.5, 1, 1, np.inf]}, "t must be seconds from 0 on, got inf at event 3"),
        ({"x": [0, 1, 2, 65536]}, "x must be a whole number from 0 to 65535, got 65536 at event 3"),
        ({"y": [0, 1, -2, 0]}, "y must be a whole number from 0 to 65535, got -2 at event 2"),
        ({"x": [0, 1.5, 2, 3]}, "x must be a whole number from 0 to 65535, got 1.5 at event 1"),
        ({"x": [0, 1281, 2, 3]}, "fit none of the known sensors"),
        ({"p": ["1", "0", "1", "0"]}, "column p must hold numbers"),
        ({"q": P}, "no column p .*; got t, x, y, q"),
    ],
)
def test_wrong_values_name_the_event(change, message, tmp_path):
    columns = {"t": T, "x": X, "y": Y, "p": P} | change
    if "q" in change:
        del columns["p"]
    arrays = {name: np.array(values) for name, values in columns.items()}
    array = np.empty(4, [(name, values.dtype) for name, values in arrays.items()])
    for name, values in arrays.items():
        array[name] = values
    np.save(tmp_path / "a.npy", array)
    raises_both_ways(tmp_path / "a.npy", message)


# NumPy files -------------------------------------------------------------------------------------------------------

RAN: list[str] = []


def spring() -> None:
    RAN.append("ran")


class Trap:
    """A pickle that runs code when it is loaded."""

    def __reduce__(self):
        return (spring, ())


def test_pickled_objects_are_refused_and_never_run(tmp_path):
    pickle.loads(pickle.dumps(Trap()))
    assert RAN == ["ran"]  # the trap works
    RAN.clear()
    trap = np.array([Trap()] * 4, object)
    np.save(tmp_path / "a.npy", trap, allow_pickle=True)
    raises_both_ways(tmp_path / "a.npy", "Python objects, which only a pickle can hold")
    np.savez(tmp_path / "a.npz", event_data=trap, allow_pickle=True)
    raises_both_ways(tmp_path / "a.npz", "event_data.*Python objects, which only a pickle can hold")
    np.savez(tmp_path / "b.npz", t=trap, x=X, y=Y, p=P, sensor_size=trap)
    raises_both_ways(tmp_path / "b.npz", "sensor_size.*Python objects, which only a pickle can hold")
    (tmp_path / "c.npy").write_bytes(pickle.dumps(Trap()))
    with pytest.raises(DataError, match="not an event file"):
        event_files.read_events_file(tmp_path / "c.npy")
    assert RAN == []


@pytest.mark.parametrize("cut", [5, 60, 100, 130, -1])
def test_a_cut_npy_is_an_error(cut, tmp_path):
    np.save(tmp_path / "a.npy", structured())
    content = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(content[:cut])
    with pytest.raises(DataError, match=r"a\.npy: not (a complete NumPy|an event) file"):
        event_files.read_events_file(tmp_path / "a.npy")


def test_npy_of_another_shape_is_an_error(tmp_path):
    for array in (np.zeros((4, 5)), np.zeros(4), np.zeros((2, 2, 4)), structured().reshape(2, 2)):
        np.save(tmp_path / "a.npy", array)
        raises_both_ways(tmp_path / "a.npy", r"expected a structured array \[N\] or an array \[N, 4\]")
    np.save(tmp_path / "a.npy", np.zeros((0, 4)))
    raises_both_ways(tmp_path / "a.npy", "no events, and nothing else tells the sensor size")


def test_npz_compressed_layout_of_n_imagenet(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, event_data=structured("<f8 <u2 <u2 ?"))
    events = read_both_ways(path)
    assert_events(events)  # floats without a fraction are microseconds
    assert events.sensor_size == (640, 480)


def test_npz_plain_layout_of_n_imagenet(tmp_path):
    path = tmp_path / "a.npz"
    columns = {"x_pos": np.array(X, "i2"), "y_pos": np.array(Y, ">i4"), "polarity": np.array(P) * 2 - 1}
    np.savez(path, **columns, timestamp=np.array(T))
    assert_events(read_both_ways(path))
    np.savez(path, **columns, timestamp=np.array(T) / 1e6)
    assert_events(read_both_ways(path))
    np.savez(path, **columns, timestamp=np.array(T), sensor_size=[400, 300])
    assert read_both_ways(path).sensor_size == (400, 300)
    np.savez(path, **columns, timestamp=np.array(T), sensor_size=[345, 300])
    raises_both_ways(path, "x must be below 345, got 345 at event 1")


def test_npz_with_other_content_is_an_error(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, x_pos=X, y_pos=Y, timestamp=T)
    raises_both_ways(path, "no column p .*; got x_pos, y_pos, timestamp")
    np.savez(path, x_pos=X, y_pos=Y, timestamp=T[:-1], polarity=P)
    raises_both_ways(path, "columns must have one length")
    np.savez(path, x=X, y=Y, t=T, ts=T, p=P)
    raises_both_ways(path, "two columns for t: 't' and 'ts'")
    np.savez(path, event_data=np.zeros((4, 4)))
    raises_both_ways(path, r"expected an array \[N\]")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("letter.txt", "hello")
    with pytest.raises(DataError, match="not an event file"):
        event_files.find_format(path)


def test_a_damaged_npz_is_an_error(tmp_path):
    buffer = io.BytesIO()
    np.savez_compressed(buffer, event_data=structured(t=[n * 7 for n in range(4)]))
    content = buffer.getvalue()
    path = tmp_path / "a.npz"
    for cut in (60, 150, len(content) - 30):
        path.write_bytes(content[:cut])
        raises_both_ways(path, r"a\.npz: not a complete NumPy archive")
    damaged = bytearray(content)
    damaged[len(content) // 3] ^= 0x55
    path.write_bytes(damaged)
    raises_both_ways(path, r"a\.npz: ")


# HDF5 --------------------------------------------------------------------------------------------------------------


def write_dsec(path: Path, columns: dict | None = None, offset: int | None = 49_599_300_523) -> Path:
    columns = columns or {
        "t": np.array(T, "u4"),
        "x": np.array(X, "u2"),
        "y": np.array(Y, "u2"),
        "p": np.array(P, "u1"),
    }
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file.create_dataset(f"events/{name}", data=values, compression="gzip", chunks=(2,))
        file["ms_to_idx"] = np.searchsorted(T, np.arange(1001) * 1000).astype("u8")
        if offset is not None:
            file["t_offset"] = np.int64(offset)
    return path


def test_hdf5_of_dsec_adds_its_offset(tmp_path):
    events = read_both_ways(write_dsec(tmp_path / "a.h5"))
    assert_events(events, [49_599_300_523 + t for t in T])
    assert_events(read_both_ways(write_dsec(tmp_path / "b.h5", offset=None)))


@pytest.mark.parametrize("missing", "txyp")
def test_hdf5_names_the_missing_column(missing, tmp_path):
    columns = {"t": T, "x": X, "y": Y, "p": P}
    del columns[missing]
    raises_both_ways(write_dsec(tmp_path / "a.h5", columns), rf"a\.h5: group events: no column {missing} .*; got ")


def test_hdf5_columns_of_different_lengths_or_types(tmp_path):
    path = write_dsec(tmp_path / "a.h5", {"t": T[:-1], "x": X, "y": Y, "p": P})
    raises_both_ways(path, "columns must be .* of one length")
    path = write_dsec(tmp_path / "b.h5", {"t": np.array(["a"] * 4, "S1"), "x": X, "y": Y, "p": P})
    raises_both_ways(path, "column t: expected numbers")


def write_mvsec(path: Path) -> Path:
    rows = np.stack([X, Y, 1.5e9 + np.array(T) / 1e6, np.array(P) * 2.0 - 1], 1)
    with h5py.File(path, "w") as file:
        file["davis/left/events"] = rows
        file["davis/right/events"] = rows[:2]
        file["davis/left/image_raw"] = np.zeros((2, 3))
    return path


def test_hdf5_of_mvsec_is_seconds_and_the_left_camera(tmp_path):
    path = write_mvsec(tmp_path / "a.hdf5")
    seconds = 1.5e9 + np.array(T) / 1e6
    expected = [round(Fraction(float(value)) * 10**6) for value in seconds]
    assert_events(read_both_ways(path), expected)
    assert len(plugins.load("formats", "hdf5").read(path, camera="right")) == 2
    with h5py.File(path, "a") as file:
        del file["davis/left/events"]
    raises_both_ways(path, "no dataset davis/left/events; davis has left, right")


def test_hdf5_without_events_or_cut_is_an_error(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["images"] = np.zeros(3)
    raises_both_ways(path, "no events: expected the datasets x, y, t, p .*; the root has images")
    content = write_dsec(path).read_bytes()
    path.write_bytes(content[: len(content) // 2])
    raises_both_ways(path, "not a complete HDF5 file")


def test_hdf5_filter_that_is_not_installed_says_what_to_install(tmp_path):
    path = tmp_path / "a.h5"
    write_dsec(path)
    with h5py.File(path, "a") as file:
        del file["events/t"]
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_chunk((4,))
        properties.set_filter(40_000, h5py.h5z.FLAG_OPTIONAL, (1, 2))  # a number nobody registered
        space = h5py.h5s.create_simple((4,))
        dataset = h5py.h5d.create(file["events"].id, b"t", h5py.h5t.NATIVE_INT64, space, properties)
        dataset.write_direct_chunk((0,), np.array(T).tobytes())
    raises_both_ways(path, "compressed with a filter that is not installed; pip install hdf5plugin")


def test_hdf5_with_a_shape_and_no_values_is_an_error(tmp_path):
    path = write_dsec(tmp_path / "a.h5", {"t": T, "x": X, "y": Y})
    with h5py.File(path, "a") as file:
        file["events"].create_dataset("p", shape=(1 << 50,), dtype="u1", chunks=(1 << 20,))
        for name in "txy":
            del file[f"events/{name}"]
            file[f"events/{name}"] = file["events/p"]
    raises_both_ways(path, "column [txyp]: .* values declared, 0 bytes stored")


def test_hdf5_of_dsec_as_it_is_compressed(tmp_path):
    hdf5plugin = pytest.importorskip("hdf5plugin")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in zip("txyp", (T, X, Y, P), strict=True):
            file.create_dataset(f"events/{name}", data=values, **hdf5plugin.Blosc(cname="zstd"))
    assert_events(read_both_ways(tmp_path / "a.h5"))


# Text --------------------------------------------------------------------------------------------------------------

SECONDS = "".join(f"{t / 1e6:.9f} {x} {y} {p}\n" for t, x, y, p in zip(T, X, Y, P, strict=True))


@pytest.mark.parametrize(
    "text",
    [
        SECONDS,
        SECONDS.removesuffix("\n"),
        SECONDS.replace("\n", "\r\n"),
        SECONDS.replace(" ", ","),
        "# t x y p\n\n" + SECONDS.replace(" ", " ; "),
        "\ufefft,x,y,p\n" + SECONDS.replace(" ", ", "),
        "".join(f"{t / 1e6:.18e}\t{x:.6e} {y}.0 {p}e0\n" for t, x, y, p in zip(T, X, Y, P, strict=True)),
        "".join(f"{t} {x} {y} {2 * p - 1}\n" for t, x, y, p in zip(T, X, Y, P, strict=True)),
        "polarity,Timestamp,row,col,extra\n"
        + "".join(f"{bool(p)},{t},{y},{x},word\n" for t, x, y, p in zip(T, X, Y, P, strict=True)),
    ],
)
def test_text_in_many_styles(text, tmp_path):
    path = tmp_path / "events.txt"
    path.write_text(text, encoding="utf-8", newline="")
    events = read_both_ways(path)
    assert_events(events)
    assert events.sensor_size == (346, 260)


@settings(max_examples=150, deadline=None)
@example(Decimal("8.3757164552060269014E-7"), "f")
@example(Decimal("5.000000000000000000E-7"), "e")
@example(Decimal("5.0000000000000000001E-7"), "f")
@given(st.decimals(0, 9 * 10**11, allow_nan=False, allow_infinity=False), st.sampled_from(["f", "e"]))
def test_text_seconds_are_rounded_exactly(tmp_path_factory, value, style):
    path = tmp_path_factory.mktemp("text") / "a.txt"
    text = format(value, style)
    path.write_text(f"{text}{'' if '.' in text or 'e' in text else '.'} 1 2 0\n")
    expected = int((Decimal(text) * 10**6).quantize(Decimal(1))) if abs(value) > 0 else 0
    assert plugins.load("formats", "csv").read(path).t.tolist() == [expected]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0.1 1 2 1\n0.2 1 2\n", "row at byte 10: 3 fields, expected 4, got '0.2 1 2'"),
        ("0.1 1 2 1\n0.2 1 2 1 7\n", "more than the expected 4 fields"),
        ("0.1 1 2 1\n0.2 1 a 1\n", "field 3 is not a number"),
        ("0.1 1 2 1\n0.2 1.5 2 1\n", "field 2 is not a whole number"),
        ("0.1 1 2 1\n99999999999999999999 1 2 1\n", "field 1 is too large"),
        ("0.1 1 2 1\n0.05 1 2 1\n", "t decreases at event 1: 100000 us, then 50000 us"),
        ("-0.1 1 2 1\n", "t .* whole number from 0"),
        ("nan 1 2 1\n", "not an event file"),
        ("t,x,y\n1,2,3\n", "no column p"),
        ("t,x,y,p\n", "no events, and nothing else tells the sensor size"),
        ("# sensor_size 20x10\n0.1 20 2 1\n", "x must be below 20, got 20 at event 0"),
        ("# sensor_size 20x10\n0.1 19 10 1\n", "y must be below 10, got 10 at event 0"),
        ("dear reader, this is no table of events\n", "not an event file"),
        ("1 2 3\n", "not an event file"),
    ],
)
def test_wrong_text_names_the_row(text, message, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        event_files.read_events_file(path)


def test_text_is_parsed_the_same_across_blocks(tmp_path, monkeypatch):
    module = plugins.load("formats", "csv")
    monkeypatch.setattr(module, "_BLOCK_BYTES", 37)
    path = tmp_path / "a.txt"
    path.write_text(SECONDS)
    assert_events(read_both_ways(path))
    path.write_text("0.1 1 2 1\n" + "0" * 100 + "1 1 2 1\n")
    with pytest.raises(DataError, match="a line of more than 37 bytes"):
        module.read(path)
