"""Options of the export of generated frames as event streams."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from data_contracts.config import ADDED_LATER, Frozen


class EventExport(Frozen):
    """How generated frames become event files."""

    format: str = Field(default="parquet", description="a module of `ctlev_core/formats` that writes")
    one_file: bool = Field(default=False, description="all streams one after another in one file, not a file each")
    gap_us: int = Field(default=100_000, ge=0, description="between two streams of one file")
    streams: Literal["frames", "stretches"] = Field(
        default="frames",
        json_schema_extra=ADDED_LATER,
        description="what is one stream: a frame, or frames whose labels follow one another in time, each in the "
        "window of its own",
    )
    spread: Literal["uniform", "paced", "field"] = Field(
        default="field", description="how events lie in their window (ctlev_core.postprocessing.event_streams)"
    )
