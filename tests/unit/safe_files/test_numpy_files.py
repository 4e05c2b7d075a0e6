"""Archives of arrays that unpack to far more than their size."""

import tracemalloc
import zipfile

import numpy as np
import pytest

from ctlev_core.motions import amass
from ctlev_core.safe_files import numpy_files
from data_contracts.errors import DataError


def write_bomb(path, frames):
    """A motion of AMASS whose poses are single bytes, all zero, never in memory here."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in {
            "trans": np.zeros((2, 3)),
            "betas": np.zeros(16),
            "mocap_framerate": np.array(60.0),
        }.items():
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, array)
        with archive.open("poses.npy", "w", force_zip64=True) as file:
            header = {"descr": "|u1", "fortran_order": False, "shape": (frames, 156)}
            np.lib.format.write_array_header_1_0(file, header)
            for _ in range(frames // 1000):
                file.write(bytes(156_000))


def test_single_bytes_that_become_floats_are_bounded_before(tmp_path):
    write_bomb(tmp_path / "a.npz", 1_200_000)
    assert (tmp_path / "a.npz").stat().st_size < 2**20
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"a\.npz: poses: .* numbers take 1497600000 bytes, more than the limit"):
            amass.read(tmp_path / "a.npz")
        assert tracemalloc.get_traced_memory()[1] < 20 * 2**20
    finally:
        tracemalloc.stop()


def test_the_limit_is_for_all_arrays_of_a_file_together(tmp_path, monkeypatch):
    np.savez(tmp_path / "a.npz", a=np.zeros(10), b=np.zeros(10, np.uint8))
    assert len(numpy_files.read_npz(tmp_path / "a.npz", ("a", "b"), "anything")) == 2
    monkeypatch.setattr(numpy_files, "MAX_NPZ_BYTES", 210)
    numpy_files.read_npz(tmp_path / "a.npz", ("b",), "anything")
    with pytest.raises(DataError, match=r"a\.npz: b"):
        numpy_files.read_npz(tmp_path / "a.npz", ("a", "b"), "anything")
