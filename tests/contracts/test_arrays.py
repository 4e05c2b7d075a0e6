"""Arrays written row by row are the arrays NumPy would have saved at once."""

import numpy as np
import pytest

from data_contracts.arrays import ArrayWriter
from data_contracts.errors import DataError


def test_appended_rows_equal_one_saved_array(tmp_path):
    rows = np.random.default_rng(0).integers(0, 9, (1234, 3, 2), np.uint16)
    with ArrayWriter(tmp_path / "whole.npy") as writer:
        for part in (rows[:1], rows[1:1], rows[1:1000], rows[1000:][::-1][::-1]):
            writer.append(part)
        assert writer.rows == len(rows)
    np.save(tmp_path / "reference.npy", rows)
    assert (tmp_path / "whole.npy").read_bytes() == (tmp_path / "reference.npy").read_bytes()
    np.testing.assert_array_equal(np.load(tmp_path / "whole.npy", mmap_mode="r"), rows)


def test_rows_of_another_kind_are_refused(tmp_path):
    with ArrayWriter(tmp_path / "a.npy") as writer:
        writer.append(np.zeros((2, 3), np.uint8))
        for other in (np.zeros((2, 4), np.uint8), np.zeros((2, 3), np.uint16)):
            with pytest.raises(DataError, match="rows must be alike"):
                writer.append(other)
    assert np.load(tmp_path / "a.npy").shape == (2, 3)
