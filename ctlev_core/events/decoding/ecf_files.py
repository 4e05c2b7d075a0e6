"""Rows of a dataset of HDF5 that is compressed with Prophesee's filter ECF, which HDF5 itself does not have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from data_contracts.errors import DataError

_FILTER = 0x8ECF  # 36559
_ROW = np.dtype([("x", np.uint16), ("y", np.uint16), ("p", np.uint8), ("t", np.int64)])


def row_reader(dataset: Any, where: str) -> Callable[[slice], np.ndarray] | None:
    """What reads rows start .. stop - 1 of a dataset; None where it is not compressed with ECF.

    The reader keeps the last chunk, so that blocks may be smaller than chunks.

    Args:
        dataset: of h5py, [N] of rows, checked.
        where: names file and dataset in messages.
    Raises:
        DataError: other filters beside ECF, or other fields; from the reader: a chunk that is missing or corrupt.
    """
    filters = dataset.id.get_create_plist()
    numbers = [filters.get_filter(index)[0] for index in range(filters.get_nfilters())]
    if _FILTER not in numbers:
        return None
    if numbers != [_FILTER]:
        raise DataError(f"{where}: expected ECF as its only filter, got the filters {numbers}")
    if set(dataset.dtype.names) != set("xypt"):
        raise DataError(f"{where}: expected the fields {', '.join('xypt')}, got {', '.join(dataset.dtype.names)}")
    (chunk_rows,) = dataset.chunks
    last: dict[int, np.ndarray] = {}

    def read_rows(rows: slice) -> np.ndarray:
        parts = []
        for start in range(rows.start // chunk_rows * chunk_rows, rows.stop, chunk_rows):
            if start not in last:
                last.clear()
                last[start] = _read_chunk(dataset, start, where)
            parts.append(last[start][max(rows.start - start, 0) : rows.stop - start])
        return np.concatenate(parts) if parts else np.empty(0, _ROW)

    return read_rows


def _read_chunk(dataset: Any, start: int, where: str) -> np.ndarray:
    """The rows from `start` to the end of its chunk or of the dataset."""
    from ctlev_core.events.decoding import ecf_decoding as decoding

    where = f"{where}: chunk from row {start} on"
    stored = dataset.id.get_chunk_info_by_coord((start,))
    if stored.byte_offset is None or stored.filter_mask:
        raise DataError(f"{where}: expected it to be stored with the filter ECF, got none")
    if not decoding.HEAD_BYTES <= stored.size <= decoding.MAX_CHUNK_BYTES:
        raise DataError(
            f"{where}: expected from {decoding.HEAD_BYTES} to {decoding.MAX_CHUNK_BYTES} bytes, got {stored.size}"
        )
    content = np.frombuffer(dataset.id.read_direct_chunk((start,))[1], np.uint8)
    num_events = int(content[:4].view("<u4")[0]) >> 2
    # HDF5 pads the last chunk to its full number of rows; a writer that hands over chunks need not.
    needed = min(dataset.chunks[0], dataset.shape[0] - start)
    if not needed <= num_events <= decoding.MAX_EVENTS:
        raise DataError(f"{where}: expected from {needed} to {decoding.MAX_EVENTS} events, got {num_events}")
    t, x, y, p = (np.empty(num_events, _ROW[name]) for name in "txyp")
    problem = decoding.decode_ecf(content, t, x, y, p)
    if problem:
        raise DataError(f"{where}: not a complete chunk: {decoding.PROBLEMS[problem]}")
    rows = np.empty(needed, _ROW)
    for name, column in zip("txyp", (t, x, y, p), strict=True):
        rows[name] = column[:needed]
    return rows
