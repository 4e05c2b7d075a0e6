"""What the page of a study shows of a page on speed against error: its recommendation, charts, and its table.

It is kept as JSON beside that page.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ctlev_core.report.page.html import Curves, Table
from data_contracts.errors import DataError

SUMMARY_FILE = "summary.json"


@dataclass(frozen=True, eq=False)
class SpeedSummary:
    """See the module's docstring.

    Attributes:
        experiment: whose generator was measured.
        recommendation: in a sentence or two.
        charts: of errors over evaluations, the most telling first.
        settings: costs and errors of every setting.
    """

    experiment: str
    recommendation: str
    charts: Sequence[Curves]
    settings: Table


def write_speed_summary(folder: Path, summary: SpeedSummary) -> None:
    """Write `summary.json`."""
    content = {
        **vars(summary),
        "charts": [vars(chart) for chart in summary.charts],
        "settings": {**vars(summary.settings), "bold": sorted(summary.settings.bold)},
    }
    (folder / SUMMARY_FILE).write_text(json.dumps(content), encoding="utf-8")


def read_speed_summary(folder: Path) -> SpeedSummary:
    """Read `summary.json`.

    Raises:
        DataError: it is missing or damaged.
    """
    path = folder / SUMMARY_FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        settings = content["settings"]
        return SpeedSummary(
            content["experiment"],
            content["recommendation"],
            [Curves(**chart) for chart in content["charts"]],
            Table(**{**settings, "bold": {(row, column) for row, column in settings["bold"]}}),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: is not the summary of speed against error: {error}") from error
