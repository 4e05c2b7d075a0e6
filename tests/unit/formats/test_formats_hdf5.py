"""HDF5 in the layouts of DSEC and MVSEC, written with h5py."""

from __future__ import annotations

import os
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import pytest
from format_helpers import P, T, X, Y, assert_events, raises_both_ways, read_both_ways

from ctlev_core import plugins


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


def test_hdf5_with_damaged_values_says_so_and_nothing_of_installing(tmp_path):
    path = write_dsec(tmp_path / "a.h5")
    with h5py.File(path) as file:
        chunk = file["events/x"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset : chunk.byte_offset + chunk.size] = b"\xff" * chunk.size
    path.write_bytes(content)
    raises_both_ways(path, "not a complete HDF5 file: .*filter returned failure")


def test_hdf5_plugins_without_the_filter_are_no_damage(tmp_path):
    pytest.importorskip("hdf5plugin")
    import hdf5plugin

    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for name in "txyp":
            file.create_dataset(f"events/{name}", data=np.zeros(5000, np.int64), **hdf5plugin.Blosc())
    code = "import sys; sys.modules['hdf5plugin'] = None; import ctlev_core; ctlev_core.read_events(sys.argv[1])"
    environment = {**os.environ, "HDF5_PLUGIN_PATH": str(tmp_path)}
    found = subprocess.run([sys.executable, "-c", code, str(path)], env=environment, capture_output=True, text=True)
    assert "filter that is not installed; pip install hdf5plugin (" in found.stderr, found.stderr


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
