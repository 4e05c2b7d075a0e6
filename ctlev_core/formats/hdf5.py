"""HDF5 files of events, in the layouts of DSEC, of MVSEC, of Prophesee, and plain ones.

- DSEC: datasets x, y, t, p in the group `events` (or `CD/events`, or at the root), t in microseconds from `t_offset`,
  which is added; `ms_to_idx` is not needed. Other names of `event_tables.COLUMN_NAMES` will do, such as xs and ts.
- MVSEC: a dataset `davis/left/events` [N, 4] with columns x, y, t, p, t in seconds and p in {-1, 1}. `read` takes the
  left camera, on which MVSEC's ground truth is given, or with `camera="right"` the other.
- Prophesee: a dataset `CD/events` [N] of rows with the fields x, y, p, t, compressed with Prophesee's filter ECF or one
  of HDF5's; the attribute `geometry` of the file, such as 1280x720, states the sensor. Other files may have such rows
  in `events`.

Integer times are microseconds, float times seconds unless their column says `_us`, rounded to the nearest microsecond.
An attribute `sensor_size`
(width, height) of the group or dataset states the sensor, else it is the smallest common one that holds all events.

DSEC compresses with blosc: install hdf5plugin to read it.

Source: uzh-rpg/DSEC, scripts/utils/eventslicer.py (t_offset); MVSEC, mvsec_to_hdf5 layout as its users read it;
Prophesee, "HDF5 event file format", docs.prophesee.ai.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from ctlev_core.events.decoding import ecf_files, event_chunks, event_tables
from ctlev_core.safe_files import hdf5_files
from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, SensorSize, check_events

VERSION = 2
HAS_SIGNATURE = True
SUFFIXES = (".h5", ".hdf5")

_MAGIC = b"\x89HDF\r\n\x1a\n"
_GROUPS = ("events", "CD/events", "/")
_ROWS = ("CD/events", "events")
_MATRIX_COLUMNS = ("x", "y", "t", "p")
_BLOCK = 1 << 18
_FILTER_IS_MISSING = ("not registered", "plugin", "can't open directory")
"""HDF5's words for it; of a filter that is there and fails it says `filter returned failure`."""


def sniff(path: Path) -> bool:
    """Does the file start like HDF5? Whether it holds events is for `read` to say."""
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def read(path: Path, camera: str = "left") -> Events:
    """The whole file.

    Raises:
        DataError: a cut or corrupt file, no events, a missing column (named), a compression filter that is not
            installed, or events that break `check_events`.
    """
    return event_chunks.concatenate(_chunks(path, 1 << 62, camera))


def read_chunks(path: Path, num_events: int, camera: str = "left") -> Iterator[Events]:
    """The events of `read` in chunks; without a sensor size in the file, it is read twice.

    Raises:
        DataError: as `read`.
    """
    return event_chunks.regroup(_chunks(path, min(num_events, _BLOCK), camera), num_events)


def check_complete(path: Path) -> None:
    """Raise `DataError` where the file is cut, as far as can be told without decoding it."""
    with _open(path):
        pass  # HDF5 compares the size that its superblock states


def write(path: Path, events: Events) -> None:
    """Write the layout of DSEC, compressed with gzip, with `sensor_size`, so that `read` returns the events unchanged.

    Raises:
        DataError: events break `check_events`.
    """
    import h5py

    check_events(events, f"events to be written to {path}")
    offset = int(events.t[0]) if len(events) else 0
    t = events.t - offset
    # Index of the first event of each millisecond, as DSEC has it for reading a stretch of time.
    num_ms = int(t[-1]) // 1000 + 1 if len(t) else 0
    with h5py.File(path, "w") as file:
        group = file.create_group("events")
        group.attrs["sensor_size"] = events.sensor_size
        for name in EVENT_DTYPES:
            values = t if name == "t" else getattr(events, name)
            group.create_dataset(name, data=values, compression="gzip", shuffle=True, chunks=True)
        if num_ms <= 10 * len(t) + 1000:  # an index of a recording with huge gaps would outgrow it
            file.create_dataset("ms_to_idx", data=np.searchsorted(t, 1000 * np.arange(num_ms)).astype(np.uint64))
        file.create_dataset("t_offset", data=np.int64(offset))


def _chunks(path: Path, num_events: int, camera: str) -> Iterator[Events]:
    with _open(path) as file:
        source = _find_matrix(file, path, camera) or _find_rows(file, path) or _find_columns(file, path)
        length, read_block, sensor_size = source

        def chunks() -> Iterator[event_tables.Columns]:
            for start in range(0, max(length, 1), num_events):
                yield read_block(slice(start, min(start + num_events, length)))

        yield from event_tables.to_events(chunks, str(path), sensor_size)


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    import h5py

    with suppress(ImportError):
        import hdf5plugin  # noqa: F401  # pyright: ignore[reportMissingImports]
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (DataError, MemoryError):
        raise
    except Exception as error:  # h5py passes HDF5's errors on as half a dozen types
        text = str(error)
        if any(said in text for said in _FILTER_IS_MISSING):
            raise DataError(
                f"{path}: compressed with a filter that is not installed; pip install hdf5plugin ({text})"
            ) from error
        raise DataError(f"{path}: not a complete HDF5 file: {text}") from error


Source = tuple[int, Callable[[slice], event_tables.Columns], SensorSize | None]


def _find_matrix(file: Any, path: Path, camera: str) -> Source | None:
    """MVSEC's table of one camera; None where the file has no cameras."""
    cameras = hdf5_files.find_object(file, "davis", str(path))
    if not hasattr(cameras, "keys"):
        return None
    dataset = hdf5_files.find_object(cameras, f"{camera}/events", str(path))
    if not hasattr(dataset, "shape"):
        raise DataError(f"{path}: no dataset davis/{camera}/events; davis has {', '.join(cameras) or 'nothing'}")
    where = f"{path}: davis/{camera}/events"
    if len(dataset.shape) != 2 or dataset.shape[1] != len(_MATRIX_COLUMNS):
        raise DataError(f"{where}: expected [N, 4] of {', '.join(_MATRIX_COLUMNS)}, got {dataset.shape}")
    dataset = hdf5_files.check_dataset(dataset, where)

    def read_block(rows: slice) -> event_tables.Columns:
        return dict(zip(_MATRIX_COLUMNS, dataset[rows].T, strict=True))

    return dataset.shape[0], read_block, _sensor_size(dataset, where)


def _find_rows(file: Any, path: Path) -> Source | None:
    """Prophesee's table, or another of rows with named fields; None where the file has none."""
    for name in _ROWS:
        dataset = hdf5_files.find_object(file, name, str(path))
        if hasattr(dataset, "shape") and dataset.dtype.names:
            break
    else:
        return None
    where = f"{path}: {name}"
    found = event_tables.require_columns(dataset.dtype.names, where)
    if dataset.ndim != 1:
        raise DataError(f"{where}: expected rows [N], got {dataset.shape}")
    dataset = hdf5_files.check_dataset(dataset, where, rows=True)
    read_rows = ecf_files.row_reader(dataset, where) or dataset.__getitem__

    def read_block(rows: slice) -> event_tables.Columns:
        block = read_rows(rows)
        values = {column: block[key] for column, key in found.items()}
        values["t"] = event_tables.times_as_named(found["t"], values["t"], where)
        return values

    return dataset.shape[0], read_block, _sensor_size(dataset, where) or _geometry(file, path)


def _find_columns(file: Any, path: Path) -> Source:
    """One dataset a column."""
    for name in _GROUPS:
        where = f"{path}: group {name}"
        group = hdf5_files.find_object(file, name, str(path))
        names = hdf5_files.dataset_names(group, where) if hasattr(group, "keys") else []
        if not event_tables.find_columns(names, where):
            continue
        found = event_tables.require_columns(names, where)
        columns = {column: hdf5_files.find_object(group, key, where) for column, key in found.items()}
        lengths = {column: dataset.shape for column, dataset in columns.items()}
        if len(set(lengths.values())) != 1 or len(lengths["t"]) != 1:
            raise DataError(f"{where}: columns must be [N] and of one length, got {lengths}")
        columns = {c: hdf5_files.check_dataset(dataset, f"{where}, column {c}") for c, dataset in columns.items()}
        offset = _time_offset(file, path)

        def read_block(
            rows: slice, columns: dict[str, Any] = columns, offset: int = offset, name: str = found["t"]
        ) -> event_tables.Columns:
            values = {column: dataset[rows] for column, dataset in columns.items()}
            values["t"] = event_tables.times_as_named(name, values["t"], str(path))
            if offset:
                if values["t"].dtype.kind not in "ui" or (len(values["t"]) and int(values["t"].max()) >= 1 << 62):
                    raise DataError(f"{path}: t_offset needs t as whole microseconds, got {values['t'].dtype}")
                values["t"] = values["t"].astype(np.int64) + offset
            return values

        return lengths["t"][0], read_block, _sensor_size(group, where)
    raise DataError(
        f"{path}: no events: expected the datasets x, y, t, p in one of the groups {', '.join(_GROUPS)}, or "
        f"davis/left/events; the root has {', '.join(file) or 'nothing'}"
    )


def _time_offset(file: Any, path: Path) -> int:
    found = (hdf5_files.find_object(file, name, str(path)) for name in ("t_offset", "events/t_offset"))
    dataset = next((dataset for dataset in found if dataset is not None), None)
    if dataset is None:
        return 0
    if not hasattr(dataset, "shape") or dataset.size != 1 or dataset.dtype.kind not in "ui":
        raise DataError(f"{path}: expected t_offset as one whole number of microseconds")
    dataset = hdf5_files.check_dataset(dataset, f"{path}: t_offset")
    offset = int(np.asarray(dataset[()]).reshape(-1)[0])
    if abs(offset) >= 1 << 62:
        raise DataError(f"{path}: expected t_offset below 2^62 us, got {offset}")
    return offset


def _geometry(file: Any, path: Path) -> SensorSize | None:
    if "geometry" not in file.attrs:
        return None
    text = file.attrs["geometry"]
    text = text.decode("ascii", "replace") if isinstance(text, bytes) else str(text)
    size = event_tables.parse_sensor_size(text)
    if size is None:
        raise DataError(f"{path}: expected the attribute geometry as WIDTHxHEIGHT, got {text[:40]!r}")
    return size


def _sensor_size(holder: Any, where: str) -> SensorSize | None:
    if "sensor_size" not in holder.attrs:
        return None
    size = np.asarray(holder.attrs["sensor_size"])
    if size.shape != (2,) or size.dtype.kind not in "ui":
        raise DataError(f"{where}: expected the attribute sensor_size as (width, height), got {size!r}")
    return int(size[0]), int(size[1])
