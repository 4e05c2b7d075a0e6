"""Where the events of an ingested recording are: in a file of their own, or in one that short recordings share.

A file of its own is Parquet (`ctlev_core.formats.parquet`). A shared file is Arrow's IPC file format with one record
batch for each recording, compressed with zstd: columns t (int64, us: the first time stamp, then differences, which
compress better), x and y (uint16, px), p (uint8) and, where known, signal (bool, else null). The table at its end says
where each batch lies, so that one is read without the others.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from ctlev_core.events import files as event_files
from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, SensorSize, check_events
from data_contracts.manifest import Manifest

SUFFIX = ".arrow"
LEVEL = 1
"""Of zstd. Level 3 takes longer and saves nothing."""
_SCHEMA = pa.schema(
    [*((name, pa.from_numpy_dtype(dtype)) for name, dtype in EVENT_DTYPES.items()), ("signal", pa.bool_())]
)


class StoredEvents(NamedTuple):
    """The events of one recording.

    Attributes:
        path: of the file.
        batch: its record batch in a shared file; None where the file is its own.
        sensor_size: (width, height) px.
    """

    path: Path
    batch: int | None
    sensor_size: SensorSize

    def read(self, start: int, stop: int) -> Events:
        """Events `start` to `stop` - 1.

        Of a file of its own only that part is read; of a shared one the recording, which is short.

        Raises:
            DataError: the file is damaged, or the range does not lie in the recording.
        """
        if self.batch is None:
            return event_files.read_events_range(self.path, start, stop)
        events = _read_batch(self.path, self.batch, self.sensor_size)
        if not 0 <= start <= stop <= len(events):
            where = f"{self.path}, recording {self.batch}"
            raise DataError(f"{where}: expected a range within 0 to {len(events)}, got {start} to {stop}")
        return events.slice(start, stop)


def stored_events(recordings: Manifest, row: dict[str, Any]) -> StoredEvents:
    """Where the events of a row of the table `recordings` are; the row has events."""
    size = (row["sensor_width_px"], row["sensor_height_px"])
    return StoredEvents(recordings.path(row["events_file"]), row["events_batch"], size)


class SharedEventsWriter:
    """Append short recordings to a file, which exists only if there is one, and is complete when the block ends."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._writer: pa.ipc.RecordBatchFileWriter | None = None
        self._count = 0

    def append(self, events: Events, where: str) -> int:
        """Write a recording; returns the number of its batch.

        Raises:
            DataError: the events break `check_events`.
        """
        check_events(events, where)
        if self._writer is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            options = pa.ipc.IpcWriteOptions(compression=pa.Codec("zstd", LEVEL), use_threads=False)
            self._writer = pa.ipc.new_file(str(self.path), _SCHEMA, options=options)
        signal = pa.nulls(len(events), pa.bool_()) if events.signal is None else pa.array(events.signal)
        columns = [np.diff(events.t, prepend=0), events.x, events.y, events.p]
        batch = pa.RecordBatch.from_arrays([*map(pa.array, columns), signal], schema=_SCHEMA)
        self._writer.write_batch(batch)
        self._count += 1
        return self._count - 1

    def __enter__(self) -> SharedEventsWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._writer is not None:
            self._writer.close()


def _read_batch(path: Path, number: int, sensor_size: SensorSize) -> Events:
    where = f"{path}, recording {number}"
    try:
        # Not mapped into memory: pages of large files that were read at random would count as ours.
        with pa.OSFile(str(path)) as source:
            file = pa.ipc.open_file(source, options=pa.ipc.IpcReadOptions(use_threads=False))
            if file.schema != _SCHEMA:
                raise DataError(f"{path}: expected the columns {_SCHEMA.names} of shared recordings, got {file.schema}")
            if not 0 <= number < file.num_record_batches:
                raise DataError(f"{path}: expected a recording from 0 to {file.num_record_batches - 1}, got {number}")
            batch = file.get_batch(number)
            batch.validate(full=True)
    except FileNotFoundError:
        raise DataError(f"{path}: expected an event file, got nothing there") from None
    except (pa.ArrowException, OSError) as error:
        raise DataError(f"{where}: damaged: {error}") from error
    *columns, signal = batch.columns
    unknown = signal.null_count == len(signal)
    if any(column.null_count for column in columns) or (signal.null_count and not unknown):
        raise DataError(f"{where}: expected no nulls in the columns {', '.join(EVENT_DTYPES)}")
    t, x, y, p = (column.to_numpy() for column in columns)
    marks = None if unknown else signal.to_numpy(zero_copy_only=False).astype(np.bool_)
    # Copies: Events are plain, writable arrays whatever they came from, and Arrow's memory is not.
    events = Events(np.cumsum(t), x.copy(), y.copy(), p.copy(), sensor_size, signal=marks)
    return check_events(events, where)
