"""Compressed arrays read as NumPy's own, in any order and process; damage is told with its place."""

import io
import multiprocessing
import pickle
import shutil
import struct
import subprocess
import sys
import threading
import zlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from data_contracts import compressed_arrays
from data_contracts.arrays import load_array, save_compressed, times_file
from data_contracts.compressed_arrays import CHUNK_BYTES, CompressedArray, CompressedArrayWriter
from data_contracts.errors import DataError
from data_contracts.image_rows import ImageRows, as_image_rows, load_image_rows

REAL = Path(__file__).resolve().parents[3] / "shared" / "real"
DTYPES = [np.uint8, np.uint16, np.uint32, np.int64, np.float32, np.float64, np.bool_, np.complex64, ">u2"]
ROWS = np.random.default_rng(0).integers(0, 40, (23, 61, 40, 3)).astype(np.uint8) // 30


@pytest.fixture
def file(tmp_path):
    """Four rows a chunk, and three in the last."""
    save_compressed(tmp_path / "rows.npy.zst", ROWS)
    return tmp_path / "rows.npy.zst"


@st.composite
def arrays(draw):
    shape = draw(st.tuples(st.integers(0, 40)) | hnp.array_shapes(min_dims=1, max_dims=5, min_side=0, max_side=7))
    if draw(st.booleans()):
        shape = (*shape[:1], *draw(st.tuples(st.integers(0, 9), st.integers(0, 9))), 3)
    dtype = np.dtype(draw(st.sampled_from(DTYPES)))
    seed = draw(st.integers(0, 99))
    return np.random.default_rng(seed).integers(0, 2 + seed, shape).astype(dtype)


@settings(deadline=None, max_examples=200)
@given(arrays(), st.integers(1, 200), st.data())
def test_any_array_is_read_as_it_was(tmp_path_factory, array, chunk_bytes, data):
    path = tmp_path_factory.mktemp("any") / "a.npy.zst"
    cuts = sorted(data.draw(st.lists(st.integers(0, len(array)), max_size=6)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compressed_arrays, "CHUNK_BYTES", chunk_bytes)
        with CompressedArrayWriter(path) as written:
            for start, stop in zip([0, *cuts], [*cuts, len(array)], strict=True):
                written.append(array[start:stop])
        assert written.rows == len(array)
        save_compressed(path.with_name("whole.npy.zst"), array)
    assert path.read_bytes() == path.with_name("whole.npy.zst").read_bytes(), "how many come at a time is seen"
    opened = CompressedArray(path)
    assert (opened.shape, opened.dtype, opened.ndim, len(opened)) == (array.shape, array.dtype, array.ndim, len(array))
    np.testing.assert_array_equal(np.asarray(opened), array, strict=True)
    np.testing.assert_array_equal(np.asarray(load_array(path)), array, strict=True)
    index = data.draw(st.slices(len(array)))
    np.testing.assert_array_equal(opened[index], array[index], strict=True)
    if len(array):
        rows = np.array(data.draw(st.lists(st.integers(-len(array), len(array) - 1), max_size=30)), np.int64)
        np.testing.assert_array_equal(opened[rows], array[rows], strict=True)
        np.testing.assert_array_equal(
            opened[int(rows[0])] if len(rows) else opened[0], array[rows[0] if len(rows) else 0]
        )
        mask = np.array(data.draw(st.lists(st.booleans(), min_size=len(array), max_size=len(array))))
        np.testing.assert_array_equal(opened[mask], array[mask], strict=True)


def zstd_content(path):
    """What any Zstandard program makes of a file."""
    return pa.CompressedInputStream(pa.OSFile(str(path)), "zstd").read()


def saved(array):
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


@pytest.mark.parametrize("array", [ROWS[..., :2], ROWS[0], ROWS.astype(np.uint16), np.zeros((0, 4), np.float32)])
def test_decompressed_it_is_the_file_that_numpy_writes(tmp_path, array):
    save_compressed(tmp_path / "a.npy.zst", array)
    assert zstd_content(tmp_path / "a.npy.zst") == saved(array)


def test_decompressed_colour_images_are_planes(file, tmp_path):
    assert zstd_content(file) == saved(np.ascontiguousarray(ROWS.transpose(0, 3, 1, 2)))
    if shutil.which("zstd"):
        subprocess.run(["zstd", "-dq", str(file)], check=True)
        np.testing.assert_array_equal(np.load(file.with_suffix("")), ROWS.transpose(0, 3, 1, 2))


def test_the_table_at_the_end_is_that_of_the_seekable_format(file):
    """Read here as its specification says: sizes of all frames, from which each is found and decompressed alone."""
    content = file.read_bytes()
    count, descriptor, magic = struct.unpack("<IBI", content[-9:])
    assert (magic, descriptor) == (0x8F92EAB1, 0)
    table = content[-9 - 8 * count : -9]
    assert struct.unpack("<II", content[-17 - 8 * count : -9 - 8 * count]) == (0x184D2A5E, 8 * count + 9)
    start, found = 0, b""
    for compressed, size in struct.iter_unpack("<II", table):
        frame = content[start : start + compressed]
        found += pa.CompressedInputStream(pa.BufferReader(frame), "zstd").read() if size else b""
        start += compressed
    assert start == len(content) - 17 - 8 * count and found == zstd_content(file)


def test_reading_a_row_takes_its_chunk_alone(file, monkeypatch):
    reads = []
    opened, pread = CompressedArray(file), compressed_arrays.os.pread
    monkeypatch.setattr(compressed_arrays.os, "pread", lambda *asked: reads.append(asked[1]) or pread(*asked))
    np.testing.assert_array_equal(opened[9], ROWS[9])
    np.testing.assert_array_equal(opened[[8, 11]], ROWS[[8, 11]])
    assert len(reads) == 1 and reads[0] < file.stat().st_size / 4
    opened[:]
    assert len(reads) == 6


def test_what_is_read_may_be_changed(file):
    opened = CompressedArray(file)
    for index in (3, slice(0, 8), [3]):
        opened[index][:] = 77
    np.testing.assert_array_equal(opened[:], ROWS)


def test_memory_of_decompressed_chunks_is_bounded(file, monkeypatch):
    monkeypatch.setattr(compressed_arrays, "CACHE_BYTES", 3 * CHUNK_BYTES)
    cache = compressed_arrays._ChunkCache()
    monkeypatch.setattr(compressed_arrays, "_cache", cache)
    several = [CompressedArray(file) for _ in range(3)]
    for opened in several:
        np.testing.assert_array_equal(opened[::-1], ROWS[::-1])
        assert 0 < sum(chunk.nbytes for chunk in cache._chunks.values()) == cache._bytes <= 3 * CHUNK_BYTES


def test_rows_that_are_not_alike_are_refused(tmp_path):
    with CompressedArrayWriter(tmp_path / "a.npy.zst") as writer:
        writer.append(np.zeros((2, 3), np.uint8))
        for other in (np.zeros((2, 4), np.uint8), np.zeros((2, 3), np.uint16)):
            with pytest.raises(DataError, match=r"a\.npy\.zst: rows must be alike"):
                writer.append(other)
    assert CompressedArray(tmp_path / "a.npy.zst").shape == (2, 3)
    for wrong in (np.array([{}]), np.array(["text"]), np.zeros((1, 2, 1 << 28), np.uint8)[:, :1].repeat(2, axis=1)[:0]):
        with (
            pytest.raises(DataError, match="expected rows of numbers"),
            CompressedArrayWriter(tmp_path / "b") as writer,
        ):
            writer.append(wrong)


def test_rows_out_of_bounds_are_refused(file):
    opened = CompressedArray(file)
    for index in (23, -24, [0, 23], 1.5, [[0, 1]], np.zeros(4, bool)):
        with pytest.raises(IndexError):
            opened[index]


def test_an_array_that_was_not_finished_is_none(tmp_path):
    with pytest.raises(RuntimeError), CompressedArrayWriter(tmp_path / "a.npy.zst") as writer:
        writer.append(ROWS)
        raise RuntimeError
    with pytest.raises(DataError, match=r"a\.npy\.zst: is no whole compressed array; at byte"):
        CompressedArray(tmp_path / "a.npy.zst")


def test_every_cut_is_found_when_it_is_opened(file):
    content = file.read_bytes()
    for size in [*range(0, len(content), 37), *range(len(content) - 200, len(content))]:
        file.write_bytes(content[:size])
        with pytest.raises(DataError, match=r"rows\.npy\.zst: is no whole compressed array; at byte \d+ it has"):
            CompressedArray(file)


def test_every_changed_byte_is_found(file):
    content = file.read_bytes()
    rng = np.random.default_rng(0)
    for place in [*range(0, 200), *rng.integers(0, len(content), 200), *range(len(content) - 200, len(content))]:
        changed = bytearray(content)
        changed[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(changed)
        with pytest.raises(DataError, match=r"rows\.npy\.zst: is no whole compressed array; at byte \d+ it has"):
            CompressedArray(file)[:]


def test_damage_says_where_and_leaves_the_other_rows(file):
    content = bytearray(file.read_bytes())
    third = int(CompressedArray(file)._starts[3])  # frame 0 is the header
    content[third + 20] ^= 1
    file.write_bytes(content)
    opened = CompressedArray(file)
    np.testing.assert_array_equal(opened[:8], ROWS[:8])
    with pytest.raises(DataError, match=rf"at byte {third} it has other content than was written"):
        opened[8]


def test_a_file_that_is_cut_while_it_is_read_is_told(file):
    opened = CompressedArray(file)
    with file.open("r+b") as cut:
        cut.truncate(1000)
    with pytest.raises(DataError, match="bytes of a chunk, expected"):
        opened[22]


def forged(header_shape, sizes, frames):
    """A file with valid checksums that claims another shape or larger chunks than it has."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": header_shape})
    raw = header.getvalue()
    first = struct.pack("<IBI", 0xFD2FB528, 0xA0, len(raw)) + (len(raw) << 3 | 1).to_bytes(3, "little") + raw
    every, table = [first, *frames], [len(raw), *sizes]
    checks = struct.pack("<6sH", b"ctlev\x01", 0) + b"".join(struct.pack("<I", zlib.crc32(one)) for one in every)
    checks += struct.pack("<I", zlib.crc32(checks))
    every.append(struct.pack("<II", 0x184D2A50, len(checks)) + checks)
    entries = b"".join(struct.pack("<II", len(one), size) for one, size in zip(every, [*table, 0], strict=True))
    entries += struct.pack("<IBI", len(every), 0, 0x8F92EAB1)
    return b"".join(every) + struct.pack("<II", 0x184D2A5E, len(entries)) + entries


def test_forged_files_allocate_nothing(tmp_path):
    path, frame = tmp_path / "forged.npy.zst", bytes(pa.Codec("zstd").compress(b"\0" * 12))
    path.write_bytes(forged((4, 3), [12], [frame]))
    np.testing.assert_array_equal(CompressedArray(path)[:], np.zeros((4, 3)))
    cases = [
        ((1 << 50, 3), [12], [frame]),
        ((4, 1 << 50), [12], [frame]),
        ((4, 10**30), [12], [frame]),
        ((1 << 62, 0), [0], [frame]),
        ((2, 0, 10**30), [0], [frame]),
        ((-4, -3), [12], [frame]),
        ((4, 3), [12, 0xFFFFFFFF], [frame, frame]),
        ((1 << 30, 4), [0xFFFFFFFC, 4], [frame, frame]),
        ((1, 3 << 30), [3 << 30], [frame]),
        ((4, 3), [], []),
        ((), [12], [frame]),
        ((8, 3), [12, 6, 6], [frame, frame, frame]),
    ]
    for case in cases:
        path.write_bytes(forged(*case))
        with pytest.raises(DataError, match=r"forged\.npy\.zst: is no whole compressed array; at byte 0"):
            CompressedArray(path)
    path.write_bytes(forged((8, 3), [24], [frame]))  # twelve bytes where it says twenty-four
    with pytest.raises(DataError, match="cannot be decompressed"):
        CompressedArray(path)[0]


@pytest.mark.parametrize("content", [b"", b"short", saved(ROWS), bytes(5000), b"\xff" * 5000])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "other.npy.zst").write_bytes(content)
    with pytest.raises(DataError, match=r"other\.npy\.zst: is no whole compressed array"):
        CompressedArray(tmp_path / "other.npy.zst")


def _checked(opened, seed):
    rows = np.random.default_rng(seed).integers(0, len(ROWS), 200)
    return all(np.array_equal(opened[some], ROWS[some]) for some in rows.reshape(40, 5))


def test_threads_read_at_once(file, monkeypatch):
    monkeypatch.setattr(compressed_arrays, "CACHE_BYTES", 2 * CHUNK_BYTES)
    opened, found = CompressedArray(file), []
    threads = [threading.Thread(target=lambda seed=seed: found.append(_checked(opened, seed))) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [True] * 4


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_processes_read_at_once(file, method):
    opened = CompressedArray(file)
    opened[:4]
    with multiprocessing.get_context(method).Pool(2) as pool:
        assert pool.starmap(_checked, [(opened, seed) for seed in range(4)]) == [True] * 4
    assert _checked(opened, 9)


FORK = """
import os, sys, threading
from data_contracts import compressed_arrays
from data_contracts.compressed_arrays import CompressedArray
opened = CompressedArray(sys.argv[1])
compressed_arrays._cache._lock.acquire()  # as another thread has it while this one forks
child = os.fork()
if not child:
    opened[:]
    os._exit(0)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_a_process_forked_while_a_thread_reads_can_read(file):
    subprocess.run([sys.executable, "-c", FORK, str(file)], cwd=Path(__file__).parents[2], check=True, timeout=60)


def test_it_travels_as_its_path(file):
    assert len(pickle.dumps(CompressedArray(file))) < 1000
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(CompressedArray(file)))[:], ROWS)


def test_image_rows_of_compressed_arrays_are_noted_not_copied(file, tmp_path):
    chosen = np.array([20, 3, 3])
    rows = ImageRows.of([(load_array(file), chosen)], "content")
    np.testing.assert_array_equal(rows[:], ROWS[chosen])
    rows.save(tmp_path / "noted")
    np.testing.assert_array_equal(load_image_rows(tmp_path / "noted")[:], ROWS[chosen])
    assert not list((tmp_path / "noted").glob("array_*"))
    assert as_image_rows(load_array(file)).digest() == as_image_rows(ROWS).digest(), "of the pixels, wherever they lie"


def test_times_lie_beside_pictures():
    assert times_file("intensity/a.b.npy.zst") == times_file("intensity/a.b.npy") == "intensity/a.b.t_us.npy"


WRITE = """
import resource, sys
from pathlib import Path
import numpy as np
from data_contracts.compressed_arrays import CompressedArray, CompressedArrayWriter
path, count = Path(sys.argv[1]), int(sys.argv[2])
some = np.random.default_rng(0).integers(0, 2, (16, 128, 128, 3)).astype(np.uint8)
with CompressedArrayWriter(path) as written:
    for _ in range(count // 16):
        written.append(some)
opened = CompressedArray(path)
for start in range(0, count, 16):
    assert (opened[start : start + 16] == some).all()
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10)
"""


def test_memory_does_not_grow_with_rows(tmp_path):
    """160 rows of 48 kB and 16,000: 0.8 GB."""
    few, many = (
        int(
            subprocess.run(
                [sys.executable, "-c", WRITE, str(tmp_path / count), count],
                cwd=Path(__file__).parents[2], check=True, capture_output=True, text=True,
            ).stdout
        )
        for count in ("160", "16000")
    )  # fmt: skip
    assert many < few + 80, f"MiB: {few} of 160 rows, {many} of 16,000"


@pytest.mark.skipif(not REAL.is_dir(), reason="needs the real recordings")
def test_real_frames_of_512_px_become_20_times_smaller(tmp_path):
    from ctlev_core.encodings import event_histogram
    from ctlev_core.events import files as event_files

    for name, count in (("person/tonic_sample.aedat4", 7_500), ("street/expelliarmus_evt3.raw", 20_000)):
        events = event_files.read_events_file(REAL / "events" / name)
        windows = np.arange(4)[:, None] * count + [0, count]
        options = event_histogram.Options(image_size=(512, 512))
        counts = event_histogram.encode(events, windows, options)
        for rows in (counts, event_histogram.render_image(counts, options)):
            save_compressed(tmp_path / "rows.npy.zst", rows)
            np.testing.assert_array_equal(CompressedArray(tmp_path / "rows.npy.zst")[:], rows)
            assert rows.nbytes > 20 * (tmp_path / "rows.npy.zst").stat().st_size, name
