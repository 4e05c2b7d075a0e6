"""Line charts as inline SVG: where ticks, lines and points are; `templates/chart.svg.j2` draws them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ctlev_core.report.page.html import Curves

WIDTH, HEIGHT = 560, 300
LEFT, RIGHT, TOP, BOTTOM = 84, 14, 10, 48
"""Margins, in units of the drawing."""
NUM_COLOURS, NUM_DASHES = 8, 3
_MARKED_POINTS = 24
"""Series with fewer points than this show each of them."""
_HOVERED_POINTS = 60
"""Points of a series, evenly spread, that tell their numbers."""


@dataclass(frozen=True)
class Axis:
    """Where values are in the drawing.

    Attributes:
        low: value (its logarithm on a logarithmic axis) at `start`.
        high: at `end`.
        start: of the axis, in units of the drawing.
        end: likewise.
        logarithmic: the scale.
    """

    low: float
    high: float
    start: float
    end: float
    logarithmic: bool

    @classmethod
    def around(cls, values: np.ndarray, start: float, end: float, logarithmic: bool) -> Axis:
        """The axis on which all values are seen."""
        scaled = np.log10(values) if logarithmic else values
        low, high = float(scaled.min()), float(scaled.max())
        margin = 0.05 * (high - low) or max(0.05 * abs(low), 0.05)
        return cls(low - margin, high + margin, start, end, logarithmic)

    def place(self, values: Any) -> np.ndarray:
        """In units of the drawing."""
        scaled = np.log10(values) if self.logarithmic else np.asarray(values, np.float64)
        return self.start + (scaled - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self) -> list[tuple[str, str]]:
        """(place, label) of each."""
        values = self._round_values()
        return [(f"{float(self.place(value)):.1f}", f"{value:g}") for value in values]

    def _round_values(self) -> list[float]:
        if self.logarithmic:
            decades = range(math.floor(self.low), math.ceil(self.high) + 1)
            for factors in ((1, 2, 5), (1,)):
                found = [10.0**decade * factor for decade in decades for factor in factors]
                found = [value for value in found if self.low <= math.log10(value) <= self.high]
                if 2 <= len(found) <= 10:
                    return found
            low, high = 10.0**self.low, 10.0**self.high
            return found if len(found) > 10 else _round_steps(low, high)
        return _round_steps(self.low, self.high)


def _round_steps(low: float, high: float, most: int = 7) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten."""
    magnitude = 10.0 ** math.floor(math.log10((high - low) / most))
    step = next(magnitude * factor for factor in (1, 2, 5, 10) if (high - low) / (magnitude * factor) <= most)
    return [round(index * step, 12) for index in range(math.ceil(low / step), math.floor(high / step) + 1)]


def series_class(index: int) -> str:
    """CSS classes of the series with this number: colour, and dashes once all colours are used up."""
    turn, colour = divmod(index, NUM_COLOURS)
    return f"s{colour} d{turn % NUM_DASHES}"


def draw(curves: Curves) -> dict[str, Any] | None:
    """What the template needs; None where there is no point.

    Points that are not finite, or not positive on a logarithmic axis, are left out.

    Raises:
        ValueError: x and y of a series differ in length.
    """
    lines = {name: _points(curves, name) for name in curves.series}
    every = np.concatenate([np.zeros((0, 4)), *lines.values()])
    if not len(every):
        return None
    x_axis = Axis.around(every[:, 0], LEFT, WIDTH - RIGHT, curves.log_x)
    heights = every[:, 1:].ravel()
    heights = heights[np.isfinite(heights) & ((heights > 0) | (not curves.log_y))]
    y_axis = Axis.around(heights, HEIGHT - BOTTOM, TOP, curves.log_y)
    drawn = []
    for name, points in lines.items():
        x, y = x_axis.place(points[:, 0]), y_axis.place(points[:, 1])
        chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), _HOVERED_POINTS)).round().astype(int))
        drawn.append(
            {
                "line": " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True)),
                "bars": _bars(points, x, y_axis),
                "marked": len(points) < _MARKED_POINTS,
                "points": [(f"{x[row]:.1f}", f"{y[row]:.1f}", _told(name, points[row].tolist())) for row in chosen],
            }
        )
    return {"x_ticks": x_axis.ticks(), "y_ticks": y_axis.ticks(), "lines": drawn, "frame": _FRAME}


_FRAME = {"width": WIDTH, "height": HEIGHT, "left": LEFT, "right": WIDTH - RIGHT, "top": TOP, "bottom": HEIGHT - BOTTOM}


def _points(curves: Curves, name: str) -> np.ndarray:
    """[N, 4]: x, y, and the ends of the interval or NaN."""
    x, y = (np.asarray(values, np.float64) for values in curves.series[name])
    if x.shape != y.shape or x.ndim != 1:
        raise ValueError(f"series {name!r}: x and y must have the same length, got {x.shape} and {y.shape}")
    nowhere = np.full_like(x, np.nan)
    low, high = (np.asarray(values, np.float64) for values in curves.spans.get(name, (nowhere, nowhere)))
    found = np.stack([x, y, low, high], axis=1)
    keep = np.isfinite(found[:, :2]).all(axis=1)
    for column, logarithmic in enumerate((curves.log_x, curves.log_y)):
        keep &= (found[:, column] > 0) | (not logarithmic)
    return found[keep]


def _bars(points: np.ndarray, x: np.ndarray, axis: Axis) -> list[tuple[str, str, str]]:
    known = np.isfinite(points[:, 2:]).all(axis=1) & ((points[:, 2] > 0) | (not axis.logarithmic))
    ends = axis.place(points[known, 2:])
    return [(f"{place:.1f}", f"{low:.1f}", f"{high:.1f}") for place, (low, high) in zip(x[known], ends, strict=True)]


def _told(name: str, point: Sequence[float]) -> str:
    x, y, low, high = point
    interval = f" [{low:.4g}, {high:.4g}]" if math.isfinite(low + high) else ""
    return f"{name}: {y:.4g}{interval} at {x:.6g}"
