"""NumPy archives of events, as N-ImageNet has them, in both of its layouts.

- compressed: one key `event_data` (or `events`), a structured array with fields such as x, y, t, p in any order;
- plain: one key a column, `x_pos`, `y_pos`, `timestamp`, `polarity` or any other name of `event_tables.COLUMN_NAMES`.

Polarity is {0, 1}, {-1, 1} or bool. Times: integers are microseconds, and so are floats none of which has a fraction,
because N-ImageNet counts microseconds and its own loader casts whatever it finds; other floats are seconds, unless
their key or field says `_us`. A key
`sensor_size` (width, height) states the sensor; without it the sensor is N-ImageNet's, 640 x 480 px, or where that is
too small for the events the next common one. Archives are never unpickled.

Source: 82magnolia/n_imagenet, real_cnn_model/data/imagenet.py (layouts; the types on disk were not published).
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from ctlev_core.events.decoding import array_files, event_chunks, event_tables
from ctlev_core.events.decoding.sensor_sizes import COMMON_SENSORS
from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, SensorSize, check_events

VERSION = 2
HAS_SIGNATURE = True
SUFFIXES = (".npz",)

_STRUCTURED_KEYS = ("event_data", "events")
_MAGIC = b"PK\x03\x04"
_BLOCK = 1 << 18
_SENSORS = ((640, 480), *COMMON_SENSORS)


def sniff(path: Path) -> bool:
    """Is it a ZIP archive of .npy files?"""
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            return False
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except Exception:  # a cut archive: its first member still tells
        with path.open("rb") as file:
            return b".npy" in file.read(256)
    return bool(names) and all(name.endswith(".npy") for name in names)


def read(path: Path) -> Events:
    """The whole file.

    Raises:
        DataError: a cut or corrupt archive, a missing column, pickled objects, or events that break `check_events`.
    """
    return event_chunks.concatenate(_chunks(path, 1 << 62))


def read_chunks(path: Path, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks; the archive is decompressed twice, first for its sensor and its unit of time.

    Raises:
        DataError: as `read`.
    """
    return event_chunks.regroup(_chunks(path, min(num_events, _BLOCK)), num_events)


def check_complete(path: Path) -> None:
    """Raise `DataError` where the file is cut, as far as can be told without decoding it."""
    with _as_data_error(path), zipfile.ZipFile(path):
        pass  # its table of contents is the last thing in it


def write(path: Path, events: Events, compressed: bool = True) -> None:
    """Write events in the compressed or the plain layout, with `sensor_size`, so that `read` returns them unchanged.

    Raises:
        DataError: events break `check_events`.
    """
    check_events(events, f"events to be written to {path}")
    size = np.array(events.sensor_size)
    with path.open("wb") as file:
        if compressed:
            fields = [(name, EVENT_DTYPES[name]) for name in ("x", "y", "t", "p")]
            records = np.empty(len(events), fields)
            for name in EVENT_DTYPES:
                records[name] = getattr(events, name)
            np.savez_compressed(file, event_data=records, sensor_size=size)
        else:
            np.savez(file, x_pos=events.x, y_pos=events.y, timestamp=events.t, polarity=events.p, sensor_size=size)


def _chunks(path: Path, num_events: int) -> Iterator[Events]:
    with _as_data_error(path), zipfile.ZipFile(path) as archive:
        keys = {name.removesuffix(".npy"): name for name in archive.namelist()}
        size = _sensor_size(archive, keys, path)
        structured = next((key for key in _STRUCTURED_KEYS if key in keys), None)
        if structured:
            members = {"": keys[structured]}
        else:
            found = event_tables.require_columns((key for key in keys if key != "sensor_size"), str(path))
            members = {column: keys[key] for column, key in found.items()}

        def chunks() -> Iterator[event_tables.Columns]:
            return _read_members(archive, members, num_events, path)

        yield from event_tables.to_events(chunks, str(path), size, whole_floats_are_us=True, sensors=_SENSORS)


@contextmanager
def _as_data_error(path: Path) -> Iterator[None]:
    try:
        yield
    except (DataError, MemoryError):
        raise
    except Exception as error:  # zipfile and zlib report damage as a dozen types
        raise DataError(f"{path}: not a complete NumPy archive: {error}") from error


def _sensor_size(archive: zipfile.ZipFile, keys: dict[str, str], path: Path) -> SensorSize | None:
    if "sensor_size" not in keys:
        return None
    where = f"{path}: key 'sensor_size'"
    with archive.open(keys["sensor_size"]) as file:
        header = array_files.read_array_header(file, where, archive.getinfo(keys["sensor_size"]).file_size)
        if header.shape != (2,) or header.dtype.kind not in "ui":
            raise DataError(f"{where}: expected (width, height) as two integers, got {header.shape} {header.dtype}")
        width, height = array_files.read_items(file, header.dtype, 2, where).tolist()
    return width, height


def _read_members(
    archive: zipfile.ZipFile, members: dict[str, str], num_events: int, path: Path
) -> Iterator[event_tables.Columns]:
    """Columns in chunks; `members` maps column to archive member, the empty column to a structured array."""
    with ExitStack() as stack:
        files, headers = {}, {}
        for column, name in members.items():
            where = f"{path}: key {name.removesuffix('.npy')!r}"
            files[column] = stack.enter_context(archive.open(name))
            size = archive.getinfo(name).file_size
            headers[column] = array_files.read_array_header(files[column], where, size)
            if len(headers[column].shape) != 1:
                raise DataError(f"{where}: expected an array [N], got shape {headers[column].shape}")
        lengths = {name: headers[column].shape[0] for column, name in members.items()}
        if len(set(lengths.values())) != 1:
            raise DataError(f"{path}: columns must have one length, got {lengths}")
        remaining = next(iter(lengths.values()))
        while True:
            count = min(num_events, remaining)
            arrays = {
                column: array_files.read_items(file, headers[column].dtype, count, str(path))
                for column, file in files.items()
            }
            if "" in arrays:
                arrays = array_files.split_structured(arrays[""], f"{path}: event_data")
            else:
                arrays["t"] = event_tables.times_as_named(
                    members["t"].removesuffix(".npy"), arrays["t"], f"{path}: key 't'"
                )
            yield arrays
            remaining -= count
            if remaining == 0:
                return
