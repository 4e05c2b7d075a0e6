"""ctlev's own event files: Parquet with the columns of `Events`, zstd compressed.

Columns t int64 (microseconds), x and y uint16 (px), p uint8, and where `Events.signal` is known, signal bool; the
metadata `sensor_size` is `WIDTHxHEIGHT`. Rows lie in groups of `ROW_GROUP`, so that a stretch of a long recording is
read without the rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ctlev_core.events.decoding import event_chunks
from ctlev_core.events.decoding.event_tables import parse_sensor_size
from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, SensorSize, check_events

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

VERSION = 1
HAS_SIGNATURE = True
SUFFIXES = (".parquet",)
HOLDS_SIGNAL = True
ROW_GROUP = 1 << 18
"""Events a row group."""

_MAGIC = b"PAR1"
_BATCH = 1 << 19


def sniff(path: Path) -> bool:
    """Does the file start like Parquet? Whether its columns are events is for `read` to say."""
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def read(path: Path) -> Events:
    """The whole file.

    Raises:
        DataError: a cut or corrupt file, other columns, nulls, no sensor size, or events that break `check_events`.
    """
    with _open(path) as (file, sensor_size):
        table = file.read()
        _check_count(len(table), file.metadata.num_rows, path)
        return check_events(_to_events(table, sensor_size, path), str(path))


def read_chunks(path: Path, num_events: int) -> Iterator[Events]:
    """The events of `read` in chunks.

    Raises:
        DataError: as `read`.
    """
    with _open(path) as (file, sensor_size):

        def chunks() -> Iterator[Events]:
            yield event_chunks.empty_events(sensor_size)
            num_read = 0
            for batch in file.iter_batches(min(num_events, _BATCH), use_threads=False):
                num_read += len(batch)
                yield _to_events(batch, sensor_size, path)
            _check_count(num_read, file.metadata.num_rows, path)

        yield from event_chunks.regroup(event_chunks.check_chunks(chunks(), str(path)), num_events)


def read_range(path: Path, start: int, stop: int) -> Events:
    """Events start .. stop - 1, from the row groups that hold them.

    Raises:
        DataError: as `read`, of those row groups; or the range does not lie in the recording.
    """
    with _open(path) as (file, sensor_size):
        metadata = file.metadata
        if not 0 <= start <= stop <= metadata.num_rows:
            raise DataError(f"{path}: expected a range within 0 to {metadata.num_rows}, got {start} to {stop}")
        ends = np.cumsum([metadata.row_group(group).num_rows for group in range(metadata.num_row_groups)], dtype=int)
        groups = range(int(np.searchsorted(ends, start, "right")), int(np.searchsorted(ends, stop, "left")) + 1)
        if start == stop:
            return event_chunks.empty_events(sensor_size)
        first = int(ends[groups[0] - 1]) if groups[0] else 0
        table = file.read_row_groups(list(groups), use_threads=False)
        _check_count(len(table), int(ends[groups[-1]]) - first, path)
        events = _to_events(table, sensor_size, path)
        where = f"{path} (events counted from event {first})"
        return check_events(events, where).slice(start - first, stop - first)


@contextmanager
def _open(path: Path) -> Iterator[tuple[pq.ParquetFile, SensorSize]]:
    """The opened file, its columns checked, and its sensor size; Arrow's errors within become `DataError`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # Not read_table: that would take a folder named `key=value` for one more column. A map or buffers of the file
        # would stay in memory as it is read.
        with pq.ParquetFile(path, memory_map=False, pre_buffer=False) as file:
            got = {field.name: str(field.type) for field in file.schema_arrow}
            expected = {name: np.dtype(dtype).name for name, dtype in EVENT_DTYPES.items()}
            any_signal = {"signal": "bool"} if "signal" in got else {}
            if got != expected | any_signal or len(file.schema_arrow) != len(got):
                raise DataError(f"{path}: expected the columns {expected}, got {got}")
            text = (file.schema_arrow.metadata or {}).get(b"sensor_size", b"").decode("ascii", errors="replace")
            sensor_size = parse_sensor_size(text)
            if sensor_size is None:
                raise DataError(f"{path}: expected the metadata sensor_size as WIDTHxHEIGHT, got {text!r}")
            metadata = file.metadata
            in_groups = sum(metadata.row_group(group).num_rows for group in range(metadata.num_row_groups))
            _check_count(in_groups, metadata.num_rows, path)
            yield file, sensor_size
    except DataError:
        raise
    except (pa.ArrowException, OSError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: not a complete Parquet file: {error}") from error


def _check_count(num_read: int, expected: int, path: Path) -> None:
    """Raise `DataError` where rows are missing: a damaged column ends what is read early and says nothing."""
    if num_read != expected:
        raise DataError(f"{path}: not a complete Parquet file: {num_read} rows, expected {expected}")


def _to_events(table: pa.Table | pa.RecordBatch, sensor_size: SensorSize, path: Path) -> Events:
    names = table.schema.names
    if any(table[name].null_count for name in names):
        raise DataError(f"{path}: expected no nulls in the columns {', '.join(names)}")
    columns = (np.asarray(table[name]) for name in EVENT_DTYPES)
    signal = np.array(table["signal"]) if "signal" in names else None
    # A copy where Arrow hands out its own read-only memory: Events are plain, writable arrays whatever they came from.
    t, x, y, p = (np.require(column, requirements="W") for column in columns)
    return Events(t, x, y, p, sensor_size, signal=signal)


def check_complete(path: Path) -> None:
    """Raise `DataError` where the file is cut, as far as can be told without decoding it."""
    with _open(path):
        pass  # its footer is the last thing in it


def write(path: Path, events: Events) -> None:
    """Write events so that `read` returns them unchanged.

    Raises:
        DataError: events break `check_events`.
    """
    check_events(events, f"events to be written to {path}")
    write_chunks(path, [events])


def write_chunks(path: Path, chunks: Iterable[Events]) -> None:
    """Write a recording that comes in chunks, in memory that does not grow with it.

    Raises:
        DataError: no chunk at all, or chunks that break `check_events` or do not join; the file is then unfinished.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    # Time stamps grow slowly: their differences take a fraction of a dictionary of them.
    encodings = {"t": "DELTA_BINARY_PACKED", "x": "PLAIN", "y": "PLAIN", "p": "PLAIN", "signal": "PLAIN"}
    writer: pq.ParquetWriter | None = None
    try:
        chunks = event_chunks.check_chunks(_not_none(chunks, path), f"events to be written to {path}")
        for chunk in event_chunks.regroup(chunks, ROW_GROUP):
            names = (*EVENT_DTYPES, *(["signal"] if chunk.signal is not None else []))
            table = pa.table({name: pa.array(getattr(chunk, name)) for name in names})
            if writer is None:
                width, height = chunk.sensor_size
                schema = table.schema.with_metadata({"sensor_size": f"{width}x{height}"})
                writer = pq.ParquetWriter(
                    path, schema, compression="zstd", use_dictionary=False, column_encoding=encodings
                )
            writer.write_table(table.cast(writer.schema), row_group_size=ROW_GROUP)
    finally:
        if writer is not None:
            writer.close()


def _not_none(chunks: Iterable[Events], path: Path) -> Iterator[Events]:
    any_given = False
    for chunk in chunks:
        any_given = True
        yield chunk
    if not any_given:
        raise DataError(f"events to be written to {path}: expected at least one chunk, got none")
