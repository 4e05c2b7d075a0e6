"""Feed one reader broken files: whatever the bytes, it must return events that pass `check_events` or raise DataError.

Read whole and in chunks, the file must give the same. With atheris (`pip install atheris`) the mutations follow the
coverage of the readers' Python code, without it they are random; both start from valid files of the format.

    python tests/fuzz/fuzz_reader.py evt3 --seconds 60
    python tests/fuzz/fuzz_reader.py evt3 --file crash-0123abcd
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import random
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "helpers"))
import aedat4_writer
import ecf_writer

from ctlev_core import plugins
from ctlev_core.events.decoding import event_chunks
from data_contracts.errors import DataError
from data_contracts.events import Events, check_events

REAL_AEDAT4 = Path(__file__).resolve().parents[2].parent / "shared/real/events/person/tonic_sample.aedat4"
SENSORS = {"aedat2": (346, 260), "aedat3": (346, 260), "atis": (240, 180)}


class Failure(Exception):
    """A reader broke its promise."""


def check_reader(module: ModuleType, path: Path) -> bool:
    """Read the file in both ways; was it valid?

    Raises:
        Failure: several formats claim the file, another exception than DataError, wrong events, or chunks that differ
            from the whole.
    """
    record_files = importlib.import_module("ctlev_core.events.decoding.record_files")
    record_files._SMALLEST_BLOCK = 3  # so that small files cross from block to block
    others = [plugins.load("formats", name) for name in plugins.names("formats")]
    claims = [other.__name__ for other in others if other.sniff(path) and getattr(other, "HAS_SIGNATURE", True)]
    if len(claims) > 1:
        raise Failure(f"claimed by {', '.join(claims)}")
    whole = _attempt(module, path, lambda: [module.read(path)])
    chunks = _attempt(module, path, lambda: list(module.read_chunks(path, 3)))
    if (whole is None) != (chunks is None):
        raise Failure(
            f"whole {'refused' if whole is None else 'read'}, chunks {'refused' if chunks is None else 'read'}"
        )
    if whole is None or chunks is None:
        return False
    joined = event_chunks.concatenate(chunks)
    for name in "txyp":
        if not np.array_equal(getattr(whole[0], name), getattr(joined, name)):
            raise Failure(f"column {name} differs between whole and chunks")
    if any(chunk.sensor_size != whole[0].sensor_size for chunk in chunks):
        raise Failure("sensor size differs between whole and chunks")
    return True


def check_message(error: DataError, path: Path) -> None:
    """Raise `Failure` where a refusal does not name its file, or is too long to be read."""
    text = str(error)
    if path.name not in text or len(text) >= 500:
        raise Failure(f"a message of {len(text)} characters must name {path.name} in less than 500: {text[:600]}")


def _attempt(module: ModuleType, path: Path, run) -> list[Events] | None:
    try:
        parts = run()
    except DataError as error:
        check_message(error, path)
        return None
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        raise Failure(f"{module.__name__}: {type(error).__name__}: {error}") from error
    try:
        return [check_events(part, "a reader's events") for part in parts]
    except DataError as error:
        raise Failure(f"{module.__name__} returned events that break their promises: {error}") from error


def valid_files(name: str, folder: Path) -> Iterator[bytes]:
    """Small files of the format."""
    module = plugins.load("formats", name)
    if name == "aedat4":
        yield aedat4_writer.aedat4([aedat4_writer.packet([(1, 2, 3, 1), (5, 319, 239, 0)]), aedat4_writer.packet([])])
        if REAL_AEDAT4.is_file():
            yield REAL_AEDAT4.read_bytes()
    generator = np.random.default_rng(0)
    width, height = SENSORS.get(name, (640, 480))
    for count, duration in ((1, 1), (5, 10**5), (40, 10**6)):
        t = np.sort(generator.integers(0, duration, count))
        x, y = generator.integers(0, width, count), generator.integers(0, height, count) // 100 * 100
        x[-1], y[-1] = width - 1, height - 1
        p = generator.integers(0, 2, count)
        events = Events(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), (width, height))
        module.write(folder / "seed", events)
        yield (folder / "seed").read_bytes()
    if name == "csv":
        yield b"0.000012 3 4 1\n0.1e1 639 479 0\n"
    if name == "npy":
        np.save(folder / "matrix.npy", np.stack([x, y, t / 1e6, p], 1))
        yield (folder / "matrix.npy").read_bytes()
    if name == "npz":
        module.write(folder / "seed", events, compressed=False)
        yield (folder / "seed").read_bytes()
    if name == "hdf5":
        import h5py

        with h5py.File(folder / "mvsec", "w") as file:
            file["davis/left/events"] = np.stack([x, y, t / 1e6, p * 2 - 1], 1)
        yield (folder / "mvsec").read_bytes()
        rows = list(zip(t.tolist(), x.tolist(), y.tolist(), p.tolist(), strict=True))
        chunks = [ecf_writer.encode(rows[4 * layout : 4 * layout + 4], layout) for layout in range(3)]
        yield ecf_writer.write(folder / "ecf", chunks, 12, 4).read_bytes()


def mutate(content: bytes, chance: random.Random) -> bytes:
    """A few random changes: bytes, runs, cuts, copies."""
    data = bytearray(content)
    for _ in range(chance.choice([1, 1, 2, 4, 16])):
        at = chance.randrange(len(data) + 1)
        length = chance.choice([1, 1, 2, 4, 8, 64])
        match chance.randrange(6):
            case 0 | 1:
                data[at : at + length] = chance.randbytes(len(data[at : at + length]))
            case 2:
                data[at : at + length] = chance.choice([b"\x00", b"\xff", b"\x7f", b"9"]) * length
            case 3:
                del data[at : at + length]
            case 4:
                data[at:at] = data[at : at + length]
            case 5:
                del data[at:]
    return bytes(data)


def fuzz_with_atheris(name: str, path: Path, corpus: Path, seconds: int, max_length: int) -> None:
    """Coverage-guided; does not return."""
    import atheris

    shared = ("event_tables", "array_files", "aedat2", "prophesee", "record_files")
    packages = [f"ctlev_core.formats.{name}", *(f"ctlev_core.{module}" for module in shared)]
    for package in packages:  # loaded before: once more, instrumented
        sys.modules.pop(package, None)
    with atheris.instrument_imports(include=packages):
        module = importlib.import_module(f"ctlev_core.formats.{name}")

    def run(content: bytes) -> None:
        path.write_bytes(content)
        check_reader(module, path)

    flags = [f"-max_total_time={seconds}", f"-max_len={max_length}",
             "-rss_limit_mb=4096", "-timeout=30", "-verbosity=0",
             f"-artifact_prefix={tempfile.gettempdir()}/{name}-"]  # fmt: skip
    atheris.Setup([sys.argv[0], *flags, str(corpus)], run)
    atheris.Fuzz()


def fuzz_at_random(name: str, path: Path, seeds: Iterable[bytes], seconds: float, seed: int = 0) -> tuple[int, int]:
    """How many files were tried, and how many of them were valid."""
    module = plugins.load("formats", name)
    chance = random.Random(seed)
    pool = list(seeds)
    tried = valid = 0
    stop = time.monotonic() + seconds
    while time.monotonic() < stop:
        content = mutate(chance.choice(pool), chance)
        path.write_bytes(content)
        try:
            valid += check_reader(module, path)
        except Failure:
            kept = Path(tempfile.gettempdir()) / f"{name}-crash-{tried}"
            kept.write_bytes(content)
            print(f"kept as {kept}", file=sys.stderr)
            raise
        tried += 1
    return tried, valid


def main() -> None:
    """Fuzz one reader, or show what one file does to it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("format", choices=plugins.names("formats"))
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--file", type=Path, help="read this file only")
    parser.add_argument("--random", action="store_true", help="random mutations even where atheris is installed")
    arguments = parser.parse_args()
    if arguments.file:
        print("valid" if check_reader(plugins.load("formats", arguments.format), arguments.file) else "rejected")
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        corpus = folder / "corpus"
        corpus.mkdir()
        seeds = list(valid_files(arguments.format, folder))
        for number, content in enumerate(seeds):
            (corpus / str(number)).write_bytes(content)
            if not check_reader(plugins.load("formats", arguments.format), corpus / str(number)) and number < 3:
                print(f"seed {number} is not valid", file=sys.stderr)
        path = folder / "input.bin"
        has_atheris = False
        with contextlib.suppress(ImportError):
            import atheris  # noqa: F401

            has_atheris = True
        if has_atheris and not arguments.random:
            fuzz_with_atheris(arguments.format, path, corpus, arguments.seconds, 2 * max(map(len, seeds)))
        else:
            tried, valid = fuzz_at_random(arguments.format, path, seeds, arguments.seconds)
            print(f"{tried} files, {valid} of them valid")


if __name__ == "__main__":
    main()
