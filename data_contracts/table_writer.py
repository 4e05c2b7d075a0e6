"""Tables beside a manifest, written as their rows come."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import pyarrow as pa
import pyarrow.parquet as pq

from data_contracts.tables import TableSchema

ROW_GROUP = 1 << 16
"""Rows that wait in memory until they are written, at least."""


class TableWriter:
    """Append rows to `<schema.name>.parquet` of a folder; the file is complete when the `with` block ends.

    What the file holds depends on the rows alone, not on how many came at a time.
    """

    def __init__(self, folder: Path, schema: TableSchema) -> None:
        self._schema = schema.arrow()
        self._writer = pq.ParquetWriter(folder / f"{schema.name}.parquet", self._schema, compression="zstd")
        self._waiting: list[pa.Table] = []
        self._num_waiting = 0

    def append(self, table: pa.Table) -> None:
        """Write rows of the table's schema, in any order of columns."""
        self._waiting.append(table.select(self._schema.names).cast(self._schema))
        self._num_waiting += table.num_rows
        while self._num_waiting >= ROW_GROUP:
            rows = pa.concat_tables(self._waiting)
            self._writer.write_table(rows.slice(0, ROW_GROUP))
            self._waiting, self._num_waiting = [rows.slice(ROW_GROUP)], rows.num_rows - ROW_GROUP

    def __enter__(self) -> TableWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if error is None and self._num_waiting:
                self._writer.write_table(pa.concat_tables(self._waiting))
        finally:
            self._writer.close()
