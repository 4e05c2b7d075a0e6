"""Rows of the table `speed_vs_error` as lines over the number of evaluations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ctlev_core.report.page.html import Curves

REFERENCE_LINE, CONVERGED_LINE = "reference", "converged"
"""Names of the settings that others are compared with."""
_BAND_BARS = 60
"""Bars that a band is hatched with."""
_LOG_RANGE = 5.0
"""From this ratio of its largest to its smallest value on, a chart's y axis is logarithmic."""

Row = Mapping[str, Any]
Series = dict[str, tuple[list[float], list[float]]]


def rows_of(rows: Sequence[Row], metric: str, against: str, study: str = "generator") -> list[Row]:
    """The rows of one measurement, all settings."""
    return [row for row in rows if (row["study"], row["metric"], row["against"]) == (study, metric, against)]


def find_row(
    rows: Sequence[Row], line: str, steps: int | None, metric: str, against: str, study: str = "generator"
) -> Row | None:
    """The measurement at one point of a line, or (`steps` None) at its first; None where it was not made."""
    of_line = (row for row in rows_of(rows, metric, against, study) if row["line"] == line)
    return next((row for row in of_line if steps in (None, row["num_inference_steps"])), None)


def lines_of(rows: Sequence[Row], metric: str, against: str, study: str = "generator") -> Series:
    """Each line's values over its evaluations; the reference and what has converged are no lines."""
    points = _points_of_lines(rows_of(rows, metric, against, study))
    return {
        line: ([row["evaluations"] for row in of_line], [row["value"] for row in of_line])
        for line, of_line in points.items()
    }


def intervals_of(rows: Sequence[Row], metric: str, against: str, study: str = "generator") -> Series:
    """The ends of the intervals of what `lines_of` gives; NaN where one is not known."""
    points = _points_of_lines(rows_of(rows, metric, against, study))
    return {line: (_ends(of_line, "low"), _ends(of_line, "high")) for line, of_line in points.items()}


def _points_of_lines(rows: Sequence[Row]) -> dict[str, list[Row]]:
    points = [row for row in rows if row["evaluations"] > 0 and row["line"] not in (REFERENCE_LINE, CONVERGED_LINE)]
    return {
        line: sorted((row for row in points if row["line"] == line), key=lambda row: row["evaluations"])
        for line in dict.fromkeys(row["line"] for row in points)
    }


def _ends(rows: Sequence[Row], end: str) -> list[float]:
    return [float("nan") if row[end] is None else row[end] for row in rows]


def chart(
    title: str,
    series: Series,
    band: Row | None,
    band_name: str,
    y_label: str,
    caption: str,
    intervals: Series | None = None,
) -> Curves:
    """Errors over evaluations with their intervals, and the hatched interval of `band` across the chart."""
    values = [value for _, y in series.values() for value in y]
    spans = dict(intervals or {})
    if band is not None and band["high"] is not None:
        x = [value for x, _ in series.values() for value in x]
        across = np.geomspace(min(x), max(x), _BAND_BARS).tolist()
        series = series | {band_name: (across, [band["value"]] * _BAND_BARS)}
        spans[band_name] = [band["low"]] * _BAND_BARS, [band["high"]] * _BAND_BARS
        values += [band["low"], band["high"]]
    return Curves(
        title,
        series,
        "evaluations of the network an image",
        y_label,
        log_x=True,
        log_y=min(values) > 0 and max(values) / min(values) >= _LOG_RANGE,
        caption=caption,
        spans=spans,
    )
