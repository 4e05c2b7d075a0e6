"""ctlev's own event files: Parquet with the columns of `Events`, zstd compressed.

Columns t int64 (microseconds), x and y uint16 (px), p uint8; the metadata `sensor_size` is `WIDTHxHEIGHT`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, check_events

VERSION = 1
SUFFIXES = (".parquet",)

_MAGIC = b"PAR1"


def sniff(path: Path) -> bool:
    """Does the file start like Parquet? Whether its columns are events is for `read` to say."""
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def read(path: Path) -> Events:
    """The whole file.

    Raises:
        DataError: a cut or corrupt file, other columns, nulls, no sensor size, or events that break `check_events`.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # Not read_table: that would take a folder named `key=value` for one more column.
        with pq.ParquetFile(path, memory_map=True) as file:
            table = file.read()
    except (pa.ArrowException, OSError) as error:
        raise DataError(f"{path}: not a complete Parquet file: {error}") from error
    got = {field.name: str(field.type) for field in table.schema}
    expected = {name: np.dtype(dtype).name for name, dtype in EVENT_DTYPES.items()}
    if got != expected:
        raise DataError(f"{path}: expected the columns {expected}, got {got}")
    if any(column.null_count for column in table.columns):
        raise DataError(f"{path}: expected no nulls in the columns {', '.join(expected)}")
    size_text = (table.schema.metadata or {}).get(b"sensor_size", b"").decode("ascii", errors="replace")
    size = re.fullmatch(r"(\d+)x(\d+)", size_text)
    if size is None:
        raise DataError(f"{path}: expected the metadata sensor_size as WIDTHxHEIGHT, got {size_text!r}")
    # A copy where Arrow hands out its own read-only memory: Events are plain, writable arrays whatever they came from.
    t, x, y, p = (np.require(table[name].to_numpy(), requirements="W") for name in EVENT_DTYPES)
    return check_events(Events(t, x, y, p, (int(size[1]), int(size[2]))), str(path))


def write(path: Path, events: Events) -> None:
    """Write events so that `read` returns them unchanged.

    Raises:
        DataError: events break `check_events`.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    check_events(events, f"events to be written to {path}")
    width, height = events.sensor_size
    columns = {name: pa.array(getattr(events, name)) for name in EVENT_DTYPES}
    table = pa.table(columns).replace_schema_metadata({"sensor_size": f"{width}x{height}"})
    # Time stamps grow slowly: their differences take a fraction of a dictionary of them.
    encodings = {"t": "DELTA_BINARY_PACKED", "x": "PLAIN", "y": "PLAIN", "p": "PLAIN"}
    pq.write_table(table, path, compression="zstd", use_dictionary=False, column_encoding=encodings)
