"""The table of the page on speed and error that says how real the frames of each setting look."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from ctlev_core.realism.sampling import STATISTICS
from ctlev_core.realism.two_sample import C2ST, MIN_FRAMES
from ctlev_core.report.page.tables import Cell, Table
from ctlev_core.report.studies.measurement_charts import REFERENCE_LINE, Row, find_row
from ctlev_core.statistics.bootstrap import score_text
from ctlev_core.statistics.sampling_errors import HELD_OUT, OF_HALVES

_CAPTION = (
    "Area: under the ROC curve of a small network that tells the frames from held-out recorded ones; 0.5 = it "
    "cannot, "
    "1 = it always can. Active: share of pixels with a value of 25 of 255 and more; isolated: share of these without "
    "an active one around. In brackets 95 % intervals."
)


def realism_table(rows: Sequence[Row], name_of: Callable[[str], str]) -> Table:
    """One row a setting, the held-out recorded frames first.

    Args:
        rows: of the table `speed_vs_error`.
        name_of: a line as the reader knows it.
    """
    body: list[list[Cell]] = []
    real = [_cell(rows, REFERENCE_LINE, None, *what) for what in _measured(C2ST + OF_HALVES, HELD_OUT)]
    if any(real):
        body.append(["held-out recorded frames; area: their halves", None, *real])
    missing = False
    of_generator = [row for row in rows if row["study"] == "generator"]
    for line, steps in dict.fromkeys((row["line"], row["num_inference_steps"]) for row in of_generator):
        evaluations = next(
            row["evaluations"] for row in of_generator if (row["line"], row["num_inference_steps"]) == (line, steps)
        )
        cells = [_cell(rows, line, steps, *what) for what in _measured(C2ST, "")]
        missing = missing or not cells[0]
        body.append([name_of(line), f"{evaluations:g}", *cells])
    notes = [f"No value: fewer than {MIN_FRAMES} frames of the setting or of held-out recordings."] if missing else []
    columns = ["sampler", "U-Net", "area", "active", "isolated"]
    return Table("How real do the frames of each setting look?", columns, body, caption=_CAPTION, footnotes=notes)


def _measured(test: str, against: str) -> list[tuple[str, str]]:
    return [(test, HELD_OUT), *((name, against) for name in STATISTICS)]


def _cell(rows: Sequence[Row], line: str, steps: int | None, metric: str, against: str) -> str | None:
    row = find_row(rows, line, steps, metric, against)
    return None if row is None else score_text(row["value"], row["low"], row["high"])
