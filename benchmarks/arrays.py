"""How small event frames, counts and condition maps become, and how fast they are read, in formats with random access.

    python benchmarks/arrays.py
    python benchmarks/arrays.py --real FOLDER       # default: ../shared/real beside the project

Sets of rows: frames and counts of simulated people (`studio`), normal and skeleton maps, latents as an autoencoder
would give them (random numbers), and of real data N-MNIST, released DHP19 frames and recordings of three cameras
(FOLDER as `benchmarks/real_frames.py` reads it). Every row of each set is written in chunks of 32 KiB, one row at
least, and read back: rows at random, 16 at a time, nothing cached; and all in order. Files are in the page cache, so
that `.npy` is read at the speed of memory. Each reading is checked against the array.

`ctlev` is `data_contracts.compressed_arrays`; its colour images lie as planes. `zstd` is the same without planes.
`arrow` is an IPC file with a record batch a chunk, `parquet` a file with a row group a chunk, `hdf5` chunks with
shuffle and gzip, `zarr` chunks with zstd in one shard, where it is installed. Then two trainings,
of the fastest network there is here and of the presets' pose network, on the same frames from `.npy` and compressed.

One thread, CPU seconds, and no decompressed chunk is kept, as if frames were too many for that. What is judged: how
small real frames become, and how much longer training takes.
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

import ctlev_core as ctlev
from ctlev_core.body.motion.procedural import pose_at, sample_style
from ctlev_core.body.rotations import axis_angle_from_matrix
from ctlev_core.datasets import studio
from ctlev_core.downstream import classifier, pose2d
from ctlev_core.encodings import event_histogram
from ctlev_core.events import files as event_files
from data_contracts import compressed_arrays
from data_contracts.array_rows import ArrayRows, Images
from data_contracts.arrays import load_array, save_compressed
from data_contracts.compressed_arrays import CHUNK_BYTES, SUFFIX, CompressedArray, CompressedArrayWriter
from data_contracts.events import Events
from data_contracts.image_rows import as_image_rows
from data_contracts.labels import Labels

REAL = Path(__file__).resolve().parents[2] / "shared" / "real"
BATCH, NUM_READ, MAX_ROWS, NUM_STEPS, ROUNDS = 16, 480, 300, 40, 3
WANTED_RATIO, WANTED_SHARE = 5.0, 0.05
RECORDINGS = {"person/tonic_sample.aedat4": 7_500, "spot/expelliarmus_evt2.raw": 50_000}
RECORDINGS |= {"street/expelliarmus_evt3.raw": 20_000}
FRAMES = "studio frames, red and blue, 64"
"""What the training learns from."""
Reader = Callable[[np.ndarray], np.ndarray]


def main() -> None:
    """Print a table for each format, then what was reached."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, default=REAL, help="folder of real recordings, left out where it is not")
    arguments = parser.parse_args()
    compressed_arrays.CACHE_BYTES = 0
    sets = {**simulated_sets(), **(real_sets(arguments.real) if arguments.real.is_dir() else {})}
    formats = {"npy": npy, "ctlev": ours, "zstd": without_planes, "arrow": arrow, "parquet": parquet, "hdf5": hdf5}
    if importlib.util.find_spec("zarr"):
        formats["zarr"] = zarr_shard
    found = {name: {kind: measure(write, rows) for kind, write in formats.items()} for name, rows in sets.items()}
    for number, head in enumerate(("times smaller", "us a row: write", "read at random", "read in order")):
        print(f"\n{head:60}" + "".join(f"{kind:>9}" for kind in formats))
        for name, rows in sets.items():
            of_formats = [found[name][kind][number] for kind in formats]
            shape = " x ".join(map(str, rows.shape[1:]))
            print(f"{f'{name}: {shape} {rows.dtype}':60}" + "".join(f"{value:9.3g}" for value in of_formats))
    print()
    judge({name: of_formats["ctlev"][0] for name, of_formats in found.items()}, sets[FRAMES])


def measure(write: Callable[[Path, np.ndarray], Reader], rows: np.ndarray) -> tuple[float, float, float, float]:
    """How many times smaller on disk; then microseconds a row to write, to read at random, and to read in order."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "rows"
        start = time.process_time()
        read = write(place, rows)
        written = time.process_time() - start
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
        chosen = rng.integers(0, len(rows), NUM_READ)
        batches = [chosen[first : first + BATCH] for first in range(0, NUM_READ, BATCH)]
        at_random = sum(timed(read, batch, rows) for batch in batches) / NUM_READ
        in_order = [np.arange(first, min(first + BATCH, len(rows))) for first in range(0, len(rows), BATCH)]
        whole = sum(timed(read, batch, rows) for batch in in_order) / len(rows)
    return rows.nbytes / size, 1e6 * written / len(rows), 1e6 * at_random, 1e6 * whole


def timed(read: Reader, batch: np.ndarray, rows: np.ndarray) -> float:
    """Seconds to read a batch of rows, which must be those that were written."""
    start = time.process_time()
    found = read(batch)
    seconds = time.process_time() - start
    if not np.array_equal(found, rows[batch]) or found.dtype != rows.dtype:
        raise SystemExit(f"{read}: other rows than were written")
    return seconds


def judge(ratios: dict[str, float], frames: np.ndarray) -> None:
    """Print the smallest ratios and what reading costs a training."""
    for name in sorted(ratios, key=ratios.__getitem__):
        if name.startswith("real") and "frames" in name:
            verdict = "met" if ratios[name] >= WANTED_RATIO else "missed"
            print(f"{name}: {ratios[name]:.1f} times smaller, wanted {WANTED_RATIO:g}: {verdict}")
    for name, train in {"classifier": train_classifier, "pose network": train_pose}.items():
        plain, compressed = (statistics.median(seconds) for seconds in zip(*in_turn(train, frames), strict=True))
        verdict = "met" if compressed <= (1 + WANTED_SHARE) * plain else "missed"
        print(
            f"{name}, {frames.shape[1]} px: {1e6 * plain / BATCH / NUM_STEPS:.0f} us an image from .npy; compressed "
            f"{compressed / plain:.3f} times that, wanted {1 + WANTED_SHARE:g}: {verdict}"
        )


def in_turn(train: Callable[[Images, Path], object], frames: np.ndarray) -> list[tuple[float, float]]:
    """CPU seconds of a training on the same frames from .npy and compressed, round by round; one warms up."""
    found = []
    for _ in range(ROUNDS + 1):
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            np.save(place / "frames.npy", frames)
            save_compressed(place / f"frames{SUFFIX}", frames)
            seconds = []
            for name in ("frames.npy", f"frames{SUFFIX}"):
                images = as_image_rows(load_array(place / name))
                start = time.process_time()
                train(images, place / f"trained_on_{name}")
                seconds.append(time.process_time() - start)
            found.append((seconds[0], seconds[1]))
    return found[1:]


def train_classifier(images: Images, folder: Path) -> None:
    """ResNet-10 of quarter width, the fastest network that is trained here."""
    labels = Labels(tuple(str(row % 10) for row in range(len(images))), np.zeros(len(images), np.int64))
    options = classifier.Options(num_steps=NUM_STEPS, batch_size=BATCH)
    classifier.train(images, labels, options, seed=0, out=folder / "model", work=folder / "work")


def train_pose(images: Images, folder: Path) -> None:
    """The pose network of the presets, half width."""
    joints = np.random.default_rng(0).uniform(0, images.shape[1], (len(images), 13, 2)).astype(np.float32)
    labels = Labels(
        ("walk",) * len(images),
        np.zeros(len(images), np.int64),
        joint_set="dhp19",
        joints2d=joints,
        visible=np.ones(joints.shape[:2], bool),
    )
    options = pose2d.Options(num_steps=NUM_STEPS, batch_size=BATCH, width=0.5, batch_norm=True)
    pose2d.train(images, labels, options, seed=0, out=folder / "model", work=folder / "work")


def step_of(rows: np.ndarray) -> int:
    """Rows of a chunk."""
    return max(CHUNK_BYTES // rows[:1].nbytes, 1)


def chunks(rows: np.ndarray) -> Iterator[np.ndarray]:
    """The rows of each chunk."""
    step = step_of(rows)
    return (rows[first : first + step] for first in range(0, len(rows), step))


def npy(path: Path, rows: np.ndarray) -> Reader:
    """As NumPy writes it, mapped into memory."""
    np.save(path.with_suffix(".npy"), rows)
    mapped = np.load(path.with_suffix(".npy"), mmap_mode="r")
    return lambda chosen: np.asarray(mapped[chosen])


def ours(path: Path, rows: np.ndarray) -> Reader:
    """`CompressedArray`."""
    with CompressedArrayWriter(path) as written:
        written.append(rows)
    return CompressedArray(path).__getitem__


def without_planes(path: Path, rows: np.ndarray) -> Reader:
    """The same of rows that are flat."""
    with CompressedArrayWriter(path) as written:
        written.append(rows.reshape(len(rows), -1))
    array = CompressedArray(path)
    return lambda chosen: array[chosen].reshape(-1, *rows.shape[1:])


def binary(rows: np.ndarray) -> pa.Array:
    """Rows as Arrow's fixed-size binary values."""
    flat = np.ascontiguousarray(rows)
    return pa.Array.from_buffers(pa.binary(flat[0].nbytes), len(flat), [None, pa.py_buffer(flat)])


def by_chunk(rows: np.ndarray, load: Callable[[int], np.ndarray]) -> Reader:
    """Rows of a file whose chunks are loaded one by one."""
    step = step_of(rows)

    def read(chosen: np.ndarray) -> np.ndarray:
        found = np.empty((len(chosen), *rows.shape[1:]), rows.dtype)
        numbers = chosen // step
        for number in np.unique(numbers):
            members = numbers == number
            found[members] = load(int(number))[chosen[members] % step]
        return found

    return read


def unpacked(values: pa.Array, rows: np.ndarray) -> np.ndarray:
    """The array of fixed-size binary values."""
    flat = np.frombuffer(values.buffers()[1], rows.dtype, len(values) * rows[0].size, values.offset * rows[0].nbytes)
    return flat.reshape(-1, *rows.shape[1:])


def arrow(path: Path, rows: np.ndarray) -> Reader:
    """An IPC file: buffers compressed by zstd."""
    schema = pa.schema([("row", pa.binary(rows[0].nbytes))])
    options = pa.ipc.IpcWriteOptions(compression=pa.Codec("zstd", 3))
    with pa.ipc.new_file(str(path), schema, options=options) as file:
        for chunk in chunks(rows):
            file.write_batch(pa.record_batch([binary(chunk)], schema=schema))
    opened = pa.ipc.open_file(pa.memory_map(str(path)))
    return by_chunk(rows, lambda number: unpacked(opened.get_batch(number).column(0), rows))


def parquet(path: Path, rows: np.ndarray) -> Reader:
    """A row group a chunk, plain values compressed by zstd."""
    schema = pa.schema([("row", pa.binary(rows[0].nbytes))])
    given = {"compression": "zstd", "compression_level": 3, "use_dictionary": False, "write_statistics": False}
    with pq.ParquetWriter(str(path), schema, **given) as file:
        for chunk in chunks(rows):
            file.write_batch(pa.record_batch([binary(chunk)], schema=schema))
    opened = pq.ParquetFile(str(path), memory_map=True)
    return by_chunk(rows, lambda number: unpacked(opened.read_row_group(number).column(0).chunk(0), rows))


def hdf5(path: Path, rows: np.ndarray) -> Reader:
    """Chunks with shuffle and gzip, what every HDF5 library has."""
    import h5py

    shape = (min(step_of(rows), len(rows)), *rows.shape[1:])
    with h5py.File(path, "w", track_order=False) as file:
        file.create_dataset("rows", data=rows, chunks=shape, compression="gzip", compression_opts=1, shuffle=True)
    stored = h5py.File(path, "r", rdcc_nbytes=0)["rows"]
    assert isinstance(stored, h5py.Dataset)
    step = step_of(rows)
    return by_chunk(rows, lambda number: stored[number * step : (number + 1) * step])


def zarr_shard(path: Path, rows: np.ndarray) -> Reader:
    """One shard of chunks, compressed by zstd."""
    import zarr

    step = step_of(rows)
    shard = (-(-len(rows) // step) * step, *rows.shape[1:])
    made = zarr.create_array(
        str(path),
        shape=rows.shape,
        dtype=rows.dtype,
        chunks=(step, *rows.shape[1:]),
        shards=shard,
        compressors=zarr.codecs.ZstdCodec(level=3),
    )
    made[:] = rows
    stored = zarr.open_array(str(path), mode="r")
    return by_chunk(rows, lambda number: np.asarray(stored[number * step : (number + 1) * step]))


def simulated_sets() -> dict[str, np.ndarray]:
    """Frames and counts of the studio's people, maps of bodies and skeletons, and latents."""
    options = studio.Options(num_train_recordings=12, num_test_recordings=0, num_condition_recordings=0)
    recordings = [recording for recording in studio.list_recordings(options) if recording.has_events]
    events = [studio.read_events(recording, options) for recording in recordings]
    labels = [studio.read_labels(recording, options) for recording in recordings]
    starts = [np.arange(0, len(one) - 700, 700) for one in events]
    windows = [(one, np.stack([first, first + 700], 1)) for one, first in zip(events, starts, strict=True)]
    found = {}
    for polarity, colours in ((True, "red and blue"), (False, "grey")):
        for size in (64, 512):
            frames, counts = zip(*(drawn(one, ranges, size, polarity) for one, ranges in windows), strict=True)
            found[f"studio frames, {colours}, {size}"] = some(np.concatenate(frames), 40 if size > 64 else MAX_ROWS)
            if polarity and size == 64:
                found["studio counts"] = some(np.concatenate(counts), MAX_ROWS)
    rng = np.random.default_rng(0)
    for size in (64, 512):
        rotations, _ = pose_at("walk", np.linspace(0, 2, 40), sample_style("walk", rng))
        poses = axis_angle_from_matrix(rotations).reshape(len(rotations), 72)
        found[f"normal maps, {size}"] = ctlev.normal_map(pose=poses, image_size=(size, size))
        scale = size / options.sensor_size[0]
        joints = np.concatenate([one.joints2d for one in labels if one.joints2d is not None])
        found[f"skeleton maps, {size}"] = ctlev.skeleton_map(
            scale * some(joints, 40), image_size=(size, size), joint_set=options.joint_set
        )
    found["latents of 512 px"] = rng.standard_normal((40, 4, 64, 64), np.float32)
    return found


def real_sets(real: Path) -> dict[str, np.ndarray]:
    """Frames and counts of what cameras recorded."""
    digits = [path for folder in sorted((real / "nmnist").iterdir()) for path in sorted(folder.glob("*.bin"))[:30]]
    cut = {"N-MNIST": [(one, np.array([[0, len(one)]])) for one in map(event_files.read_events_file, digits)]}
    for name, count in RECORDINGS.items():
        one = event_files.read_events_file(real / "events" / name)
        starts = np.arange(0, len(one) - count + 1, count)
        cut[name.partition("/")[0]] = [(one, np.stack([starts, starts + count], 1))]
    found = {}
    for name, windows in cut.items():
        for polarity, colours in ((True, "red and blue"), (False, "grey")):
            for size in (64, 512):
                chosen = windows[:: 8 if size > 64 and len(windows) > 8 else 1]
                frames, counts = zip(*(drawn(one, ranges, size, polarity) for one, ranges in chosen), strict=True)
                found[f"real: {name} frames, {colours}, {size}"] = np.concatenate(frames)
                if polarity and size == 64:
                    found[f"real: {name} counts"] = np.concatenate(counts)
    levels = np.stack([np.array(Image.open(path).convert("L")) for path in (real / "dhp19_frames").glob("*.png")])
    found["real: DHP19 event images"] = levels
    for size in (64, 512):
        options = event_histogram.Options(polarity=False, image_size=(size, size))
        found[f"real: DHP19 frames, grey, {size}"] = event_histogram.render_levels(levels[:, None], options)
    return found


def drawn(events: Events, windows: np.ndarray, size: int, polarity: bool) -> tuple[np.ndarray, np.ndarray]:
    """Frames and counts of windows."""
    options = event_histogram.Options(image_size=(size, size), polarity=polarity)
    counts = event_histogram.encode(events, windows[:40], options)
    return event_histogram.render_image(counts, options), counts


def some(rows: np.ndarray | ArrayRows, count: int) -> np.ndarray:
    """Rows that are evenly spread."""
    return np.asarray(rows[np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int)])


if __name__ == "__main__":
    main()
