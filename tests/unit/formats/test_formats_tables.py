"""NumPy arrays and archives of events, and what all tables share: units, types, polarities."""

from __future__ import annotations

import io
import pickle
import zipfile
from fractions import Fraction

import h5py
import numpy as np
import pytest
from format_helpers import P, T, X, Y, assert_events, raises_both_ways, read_both_ways
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.recfunctions import repack_fields

from ctlev_core.events import files as event_files
from ctlev_core.events.decoding import event_tables
from data_contracts.errors import DataError


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


def test_a_column_that_says_microseconds_holds_microseconds(tmp_path):
    """Whatever their type: what pandas or MATLAB wrote is often a float."""
    t, x, p = np.array([1000.0, 2000.4]), np.array([1, 2]), np.array([1, 0])
    np.savez(tmp_path / "a.npz", t_us=t, x=x, y=x, p=p)
    records = np.empty(2, [("timestamp_us", "f8"), ("x", "u2"), ("y", "u2"), ("p", "u1")])
    records["timestamp_us"], records["x"], records["y"], records["p"] = t, x, x, p
    np.save(tmp_path / "b.npy", records)
    with h5py.File(tmp_path / "c.h5", "w") as file:
        for name, values in {"t_us": t, "x": x, "y": x, "p": p}.items():
            file[f"events/{name}"] = values
    (tmp_path / "d.csv").write_text("x,y,time_us,p\n1,1,1000.0,1\n2,2,2000,0\n")
    for name in ("a.npz", "b.npy", "c.h5", "d.csv"):
        assert event_files.read_events_file(tmp_path / name).t.tolist() == [1000, 2000]
    (tmp_path / "e.csv").write_text("x,y,time_us,p\n1,1,1000.5,1\n")
    raises_both_ways(tmp_path / "e.csv", "not a whole number")
    np.savez(tmp_path / "f.npz", t_us=-t, x=x, y=x, p=p)
    raises_both_ways(tmp_path / "f.npz", "'t_us' must be microseconds from 0 on, got -1000.0")
