"""Rows of arrays on disk are those of the arrays joined in memory, and take no more memory than what is asked for."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from data_contracts.image_rows import ImageRows, as_image_rows, image_chunks, load_image_rows

RNG = np.random.default_rng(0)
ARRAYS = [RNG.integers(0, 256, (count, 4, 5, 3), np.uint8) for count in (7, 3, 5)]
ROWS = [np.array([6, 0, 0, 3]), np.zeros(0, np.int64), np.array([4, 1])]
JOINED = np.concatenate([array[rows] for array, rows in zip(ARRAYS, ROWS, strict=True)])


@pytest.fixture
def rows(tmp_path):
    mapped = []
    for number, array in enumerate(ARRAYS):
        np.save(tmp_path / f"{number}.npy", array)
        mapped.append(np.load(tmp_path / f"{number}.npy", mmap_mode="r"))
    return ImageRows.of(list(zip(mapped, ROWS, strict=True)), "content")


@pytest.mark.parametrize(
    "index",
    [
        0,
        -1,
        np.int64(4),
        slice(None),
        slice(1, 4),
        slice(None, None, -2),
        slice(9, 12),
        np.array([5, 1, 1, -2]),
        np.zeros(0, np.int64),
        np.array([True, False, True, True, False, True]),
        [2, 0],
        (slice(None), slice(None, None, -1)),
        (Ellipsis, 1),
        (slice(1, 3), slice(None), 2),
        (3, 1, 2),
    ],
)
def test_indexing_is_that_of_the_joined_array(rows, index):
    found = rows[index]
    np.testing.assert_array_equal(found, JOINED[index])
    assert np.asarray(found).dtype == np.uint8 and found.shape == JOINED[index].shape


def test_it_looks_like_the_joined_array(rows):
    assert (rows.shape, rows.dtype, rows.ndim, len(rows)) == (JOINED.shape, JOINED.dtype, 4, len(JOINED))
    np.testing.assert_array_equal(np.asarray(rows), JOINED)
    np.testing.assert_array_equal(list(rows), list(JOINED))
    with pytest.raises(IndexError):
        rows[len(JOINED)]


def test_taken_rows_are_rows_of_the_joined_array(rows):
    chosen = np.array([5, 5, 0, 2])
    np.testing.assert_array_equal(rows.take(chosen)[:], JOINED[chosen])
    np.testing.assert_array_equal(as_image_rows(JOINED).take(chosen)[1:], JOINED[chosen][1:])


@pytest.mark.parametrize("chunk_bytes", [1, 60, 130, 10**6])
def test_chunks_are_bounded_and_hold_every_row_once(rows, chunk_bytes):
    for images in (rows, JOINED):
        chunks = list(image_chunks(images, chunk_bytes))
        np.testing.assert_array_equal(np.concatenate(chunks), JOINED)
        assert all(len(chunk) == 1 or chunk.nbytes <= chunk_bytes for chunk in chunks)


def test_digests_tell_rows_and_content_apart(rows):
    digests = [
        rows.digest(),
        rows.take(np.arange(5)).digest(),
        rows.take(np.arange(6)[::-1]).digest(),
        ImageRows.of(list(zip(ARRAYS, ROWS, strict=True)), "other content").digest(),
        ImageRows.of(list(zip(ARRAYS, ROWS, strict=True))).digest(),
        as_image_rows(JOINED + np.uint8(1)).digest(),
    ]
    assert len(set(digests)) == len(digests)
    assert rows.take(np.arange(6)).digest() == digests[0]
    # Without a name for the content it is the pixels that count, wherever they lie.
    assert digests[4] == as_image_rows(JOINED).digest() == as_image_rows(JOINED.copy()).digest()


def test_saved_rows_are_opened_where_they_lie(rows, tmp_path):
    rows.save(tmp_path / "noted")
    opened = load_image_rows(tmp_path / "noted")
    np.testing.assert_array_equal(opened[:], JOINED)
    assert opened.digest() == rows.digest()
    assert not list((tmp_path / "noted").glob("array_*.npy"))


def test_arrays_in_memory_and_parts_of_files_are_written_when_saved(rows, tmp_path):
    part = np.load(tmp_path / "0.npy", mmap_mode="r")[2:]
    for number, array in enumerate((ARRAYS[0], part)):
        as_image_rows(array).save(tmp_path / f"noted_{number}")
        np.testing.assert_array_equal(load_image_rows(tmp_path / f"noted_{number}")[:], array)


def test_arrays_that_are_not_alike_are_refused():
    for other in (np.zeros((2, 4, 4, 3), np.uint8), np.zeros((2, 4, 5, 3), np.float32)):
        with pytest.raises(ValueError, match="must be alike, got"):
            ImageRows.of([(ARRAYS[0], np.arange(2)), (other, np.arange(2))])
    with pytest.raises(ValueError, match="got no array"):
        ImageRows.of([])


TRAIN = """
import resource, sys
from pathlib import Path
import numpy as np
from ctlev_core.downstream import classifier
from data_contracts.compressed_arrays import CompressedArray, CompressedArrayWriter
from data_contracts.image_rows import ImageRows
from data_contracts.labels import Labels

resource.setrlimit(resource.RLIMIT_DATA, (3 << 30, 3 << 30))


def train(folder, count, kind):
    folder.mkdir()
    if kind == "plain":
        shape = (count, 512, 512, 3)
        frames = np.lib.format.open_memmap(folder / "frames.npy", "w+", np.uint8, shape)  # sparse: all holes
    else:
        with CompressedArrayWriter(folder / "frames.npy.zst") as written:
            written.append(np.zeros((1, 512, 512, 3), np.uint8))
            written._file.flush()
            frame = (folder / "frames.npy.zst").read_bytes()[written._sizes[0] :]
            for _ in range(count - 1):  # the same again, without compressing it
                written._write(frame, 512 * 512 * 3)
                written.rows += 1
        frames = CompressedArray(folder / "frames.npy.zst")
    images = ImageRows.of([(frames, np.arange(count))], "name of the content")
    labels = Labels(("cat", "dog") * (count // 2), np.zeros(count, np.int64))
    options = classifier.Options(num_steps=2, batch_size=2)
    classifier.train(images, labels, options, seed=0, out=folder / "model", work=folder / "work")
    assert len(classifier.features(folder / "model", images.take(np.arange(3)))) == 3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10  # the peak so far


print(*[train(Path(sys.argv[1]) / str(count), count, sys.argv[2]) for count in (100, 254_000)])
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "compressed"])
def test_training_on_200_gb_of_frames_takes_the_memory_of_its_batches(tmp_path, kind):
    """A sparse file, or one of black frames: 254,000 frames of 512 px. Loaded, they would be 200 GB."""
    command = [sys.executable, "-c", TRAIN, str(tmp_path), kind]
    root = Path(__file__).parents[2]
    printed = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout
    few, many = map(int, printed.split())
    if kind == "plain":
        assert (tmp_path / "254000" / "frames.npy").stat().st_size > 190e9
    assert many < few + 300, f"MiB: {few} for 100 frames, {many} for 254,000"
