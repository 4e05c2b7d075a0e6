"""One self-contained HTML page of the experiment, its tables in other languages, and where every number came from."""

from __future__ import annotations

import pyarrow as pa

from ctlev_core.report.experiment_report import TABLES, write_report
from ctlev_core.report.inputs import ReportInputs
from data_contracts import tables
from data_contracts.manifest import Manifest
from tasks.stage import Output, stage


@stage(version=26, schema=tables.REPORT, optional=("sequences",), aside=("openings",))
def report(
    out: Output, made: ReportInputs[Manifest], sequences: Manifest | None = None, *, openings: int | None = None
) -> pa.Table:
    """Write `report.html`, `tables.tex`, `tables.md`, four tables as Parquet, `provenance.json` and `summary.json`.

    With `sequences`, what `sequence_realism` made, stretches of consecutive frames are compared and played.

    `openings` is how many experiments had been scored on the same test frames when the report was made; it is no part
    of what the report is of, which later experiments do not change.
    """
    write_report(made, out.folder, openings, sequences)
    return pa.table({"table": TABLES, "file": [f"{name}.parquet" for name in TABLES]})
