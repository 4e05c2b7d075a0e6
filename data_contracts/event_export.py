"""Export of generated frames as event streams: its options, and the table that says what lies in which file."""

from __future__ import annotations

from typing import Literal

import pyarrow as pa
from pydantic import Field

from data_contracts.config import Frozen
from data_contracts.manifest import LABEL_COLUMNS
from data_contracts.tables import SYNTHETIC, Column, TableSchema


class EventExport(Frozen):
    """How generated frames become event files."""

    format: str = Field(default="parquet", description="a module of `ctlev_core/formats` that writes")
    one_file: bool = Field(default=False, description="all streams one after another in one file, not a file each")
    gap_us: int = Field(default=100_000, ge=0, description="between two streams of one file")
    spread: Literal["uniform", "paced", "field"] = Field(
        default="field", description="how events lie in their window (ctlev_core.event_streams)"
    )


_CARRIED = ("sample_id", "class_name", "joint_set", *LABEL_COLUMNS.values())
EVENT_STREAMS = TableSchema(
    "event_streams",
    1,
    "sample_id",
    (
        *(column for column in SYNTHETIC.columns if column.name in _CARRIED),
        Column("file", pa.string(), "event file that holds the stream, relative to this table"),
        Column("t_start_us", pa.int64(), "where its window starts, on the clock of the file", minimum=0),
        Column("t_end_us", pa.int64(), "its last event, or the start where it has none", minimum=0),
        Column("event_start", pa.int64(), "its first event in the file", minimum=0),
        Column("num_events", pa.int64(), "its events", minimum=0),
        Column("has_polarity", pa.bool_(), "False: p is 1 throughout, because the image has no polarity"),
        Column("is_exact", pa.bool_(), "encoding the stream gives the generated image itself"),
        Column("error_levels", pa.float64(), "else mean difference over values that are not black", minimum=0),
        Column("seed", pa.int64(), "seed of this row alone", minimum=0),
    ),
)
