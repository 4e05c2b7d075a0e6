"""Prophesee's HDF5 files with chunks of its filter ECF, encoded bit by bit as `ecf_decoding` describes the format."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

FILTER = 36559
ROW = np.dtype(
    {"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"], "offsets": [0, 2, 4, 8], "itemsize": 16}
)
Rows = Sequence[tuple[int, int, int, int]]
"""(t, x, y, p)."""


def _runs(values):
    return [(value, len(list(group))) for value, group in itertools.groupby(values)]


def _times(times):
    now, content = times[0], struct.pack("<Q", times[0])
    for t, count in _runs(times):
        step = t - now
        if step >= 15:
            nibbles = [step >> place & 15 for place in range(0, step.bit_length(), 4)]
            content += bytes(0xF0 | nibble for nibble in nibbles)
            step = 0
        content += bytes([step << 4 | min(count, 15)]) + (struct.pack("<H", count) if count >= 15 else b"")
        now = t
    return content


def _ys(ys):
    words = []
    for y, count in _runs(ys):
        words += [y << 5 | min(count, 31)] + [count] * (count >= 31)
    return struct.pack(f"<{len(words)}H", *words)


def _ps(ps):
    return b"".join(
        bytes([p << 7 | min(count, 127)]) + (struct.pack("<H", count) if count >= 127 else b"")
        for p, count in _runs(ps)
    )


def _masks(xs, stray_bits):
    words, place = [], 0
    while place < len(xs):
        x, mask = xs[place], 0
        place += 1
        for step in range(1, 6):
            if place < len(xs) and xs[place] == x + step:
                mask |= 1 << 5 - step
                place += 1
        words.append(x << 5 | mask)
    if stray_bits:
        words[-1] |= 1
    return struct.pack(f"<{len(words)}H", *words)


def _packed(values, half):
    """Four values of 3 * `half` bits in three words of 4 * `half`."""
    content, low = b"", lambda value, halves: value & (1 << halves * half) - 1
    values = [*values, *[0] * (-len(values) % 4)]
    for a, b, c, d in zip(*[iter(values)] * 4, strict=True):
        words = (
            a << half | low(b, 1),
            b >> half << 2 * half | low(c, 2),
            c >> 2 * half << 3 * half | d,
        )
        content += b"".join(word.to_bytes(half // 2, "little") for word in words)
    return content


def encode(rows: Rows, layout: int, stray_bits: bool = False) -> bytes:
    """A chunk; `stray_bits` sets one of the last mask's for no event, as Prophesee's encoder may."""
    t, x, y, p = zip(*rows, strict=True)
    content = struct.pack("<I", len(rows) << 2 | layout) + _times(t)
    if layout >= 2:
        return content + _packed([b << 12 | a << 1 | c for a, b, c in zip(x, y, p, strict=True)], 8)
    if layout == 1:
        return content + _ys(y) + _packed([a << 1 | c for a, c in zip(x, p, strict=True)], 4)
    return content + _ys(y) + _masks(x, stray_bits) + _ps(p)


def write(
    path: Path,
    chunks: Sequence[bytes],
    num_rows: int,
    chunk_rows: int,
    geometry: str = "1280x720",
    fields: np.dtype = ROW,
    shuffle: bool = False,
    filter_mask: int = 0,
) -> Path:
    """A file whose `CD/events` has the encoded chunks; bit 0 of `filter_mask` says that they are not encoded."""
    with h5py.File(path, "w") as file:
        group = file.create_group("CD")
        options = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        options.set_chunk((chunk_rows,))
        if shuffle:
            options.set_shuffle()
        options.set_filter(FILTER, h5py.h5z.FLAG_OPTIONAL)  # HDF5 has no such filter, and makes do
        space = h5py.h5s.create_simple((num_rows,), (h5py.h5s.UNLIMITED,))
        dataset = h5py.h5d.create(group.id, b"events", h5py.h5t.py_create(fields), space, options)
        for number, content in enumerate(chunks):
            dataset.write_direct_chunk((number * chunk_rows,), content, filter_mask)
        file.attrs["geometry"] = geometry
    return path
