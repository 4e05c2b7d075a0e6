"""The page that says how many steps of which sampler are enough."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctlev_core.events.windows import spread
from ctlev_core.report.page.display_names import metric_name
from ctlev_core.report.page.html import Curves, ImageGrid, Section, Table
from ctlev_core.report.studies.measurement_charts import (
    CONVERGED_LINE,
    REFERENCE_LINE,
    Row,
    chart,
    find_row,
    intervals_of,
    lines_of,
    rows_of,
)
from ctlev_core.report.studies.solver_studies import exact_score_sections, precision_sections
from ctlev_core.report.studies.speed_realism import realism_table
from ctlev_core.statistics.sampling_errors import (
    CONTROLNET,
    CONVERGED,
    CPU,
    EXCESS,
    FD,
    HELD_OUT,
    KID,
    LABELS,
    OF_HALVES,
    PIXEL_RMS,
    REFERENCE,
    WALL,
)
from data_contracts.array_rows import Images

QUICK = (5, 10)
"""Evaluations of the network in which a quick setting is looked for."""
GRID_COLUMNS = 10
UNKNOWN = "There are too few conditions or recordings for intervals, so nothing can be recommended."

Point = tuple[str, int]
"""A line and its number of steps."""


@dataclass(frozen=True)
class Recommendation:
    """Settings as rows of the distance to held-out recorded frames; None where there is none.

    Attributes:
        default: with the fewest evaluations from which on its line stays within the reference's interval.
        quick: the nearest to recorded frames of those with 5 to 10 evaluations.
    """

    default: Row | None
    quick: Row | None


def recommend(rows: Sequence[Row]) -> Recommendation:
    """What to use, from rows of the table `speed_vs_error`.

    Within: not above the interval's upper end, and by the paired difference, which tells more apart, not shown to be
    farther from recorded frames than the reference. A single point may be there by luck, so all points of its line with
    more evaluations must be too. Below the interval is not worse than the reference, and counts as within.
    """
    points = [row for row in rows_of(rows, FD, HELD_OUT) if row["line"] not in (REFERENCE_LINE, CONVERGED_LINE)]
    upper = next((row["high"] for row in rows_of(rows, FD, HELD_OUT) if row["line"] == REFERENCE_LINE), None)
    enough: list[Row] = []
    for line in dict.fromkeys(row["line"] for row in points):
        of_line = sorted((row for row in points if row["line"] == line), key=lambda row: -row["evaluations"])
        beyond = [number for number, row in enumerate(of_line) if upper is None or _is_farther(rows, row, upper)]
        within = of_line[: beyond[0]] if beyond else of_line
        enough += within[-1:]
    quick = [row for row in points if QUICK[0] <= row["evaluations"] <= QUICK[1]]
    return Recommendation(
        default=min(enough, key=lambda row: (row["evaluations"], row["value"]), default=None),
        quick=min(quick, key=lambda row: row["value"], default=None),
    )


def _is_farther(rows: Sequence[Row], row: Row, upper: float) -> bool:
    excess = find_row(rows, row["line"], row["num_inference_steps"], FD + EXCESS, HELD_OUT)
    return row["value"] > upper or (excess is not None and excess["low"] is not None and excess["low"] > 0)


@dataclass(frozen=True, eq=False)
class SpeedPage:
    """What the page shows.

    Attributes:
        rows: of the table `speed_vs_error`.
        pictures: frames [N, H, W, 3] uint8 of each point, of the same conditions and seeds.
        reference_pictures: those of the reference.
        condition_pictures: what was asked for, or None.
        reference_name: sampler and steps of the reference.
        converged_name: of what counts as converged.
        own: the point the experiment samples with, if it was measured.
        features: what the distances are computed from.
    """

    rows: Sequence[Row]
    pictures: Mapping[Point, Images]
    reference_pictures: Images
    condition_pictures: np.ndarray | None
    reference_name: str
    converged_name: str
    own: Point | None
    features: str

    def verdict(self) -> str:
        """What to use, what to use in a hurry, and what the experiment uses, in a sentence or two each."""
        reference, quick = self._known_reference(), recommend(self.rows).quick
        if reference is None:
            return UNKNOWN
        sentences = (
            []
            if quick is None
            else [
                f"Of {QUICK[0]} to {QUICK[1]} evaluations: {_named(quick)}, {quick['value']:.3g}, "
                f"{_where(quick, reference)}."
            ]
        )
        return " ".join([*self._recommendation(reference), *sentences, *self._own_setting(reference)])

    def recommendation(self) -> str:
        """The verdict without what is used in a hurry: for a page that is about something else."""
        reference = self._known_reference()
        if reference is None:
            return UNKNOWN
        return " ".join([*self._recommendation(reference), *self._own_setting(reference)])

    def _known_reference(self) -> Row | None:
        """The reference's distance to held-out recorded frames, where it has an interval."""
        reference = self._row(REFERENCE_LINE, FD, HELD_OUT)
        return None if reference is None or reference["high"] is None else reference

    def _recommendation(self, reference: Row) -> list[str]:
        default = recommend(self.rows).default
        band = f"the reference, {self.reference_name}, has {_text(reference)}"
        if default is None:
            return [f"No setting stays within the interval of {band}, Frechet distance to {HELD_OUT}."]
        fewer = reference["evaluations"] / default["evaluations"]
        return [
            f"Recommended: {_named(default)}, {fewer:.0f} times fewer than the reference's. Frechet distance "
            f"to {HELD_OUT} {default['value']:.3g}; {band}.",
            *self._resolution(reference, default),
            *(f"Its images differ from the converged solution by {pixels}." for pixels in self._pixels(default)),
        ]

    def _resolution(self, reference: Row, default: Row) -> list[str]:
        """How large a difference so few samples could show: half the interval of the paired one."""
        excess = self._at((default["line"], default["num_inference_steps"]), FD + EXCESS, HELD_OUT)
        if excess is None or excess["low"] is None or excess["high"] is None:
            return []
        share = (excess["high"] - excess["low"]) / 2 / reference["value"]
        return [f"With {excess['num_samples']} samples, differences below {share:.0%} of the distance do not show."]

    def _pixels(self, row: Row) -> list[str]:
        found = self._row(row["line"], PIXEL_RMS, CONVERGED, row["num_inference_steps"])
        return [] if found is None else [f"{found['value']:.2g} grey levels"]

    def _own_setting(self, reference: Row) -> list[str]:
        own = None if self.own is None else self._row(self.own[0], FD, HELD_OUT, self.own[1])
        if own is None:
            return []
        found = ", ".join([f"{own['value']:.3g}", _where(own, reference), *self._pixels(own)])
        return [f"The experiment's own setting, {_named(own)}: {found}."]

    def sections(self) -> list[Section]:
        """Charts, tables and pictures, the generator's first."""
        return [
            *self.distance_charts(),
            *self.solution_charts(),
            self.settings(),
            realism_table(self.rows, self._name),
            self._grid(),
            *exact_score_sections(self.rows),
            *precision_sections(self.rows),
        ]

    def distance_charts(self) -> list[Curves]:
        """Distances over evaluations: to held-out recorded frames, and to the reference's samples."""
        reference = self._row(REFERENCE_LINE, FD, HELD_OUT)
        floor = self._row(REFERENCE_LINE, FD + OF_HALVES, REFERENCE)
        count = 0 if reference is None else reference["num_samples"]
        shown = {
            "Distance to held-out recorded frames": (
                lines_of(self.rows, FD, HELD_OUT),
                reference,
                f"{self.reference_name}: 95 %",
                "Frechet distance",
                f"In features of {self.features}, from {count} samples a setting, so that values compare with one "
                "another only. Hatched: not to be told from the reference. All settings share conditions "
                "and seeds, and no frame was rejected and sampled again.",
            ),
            "Distance to the reference's samples": (
                lines_of(self.rows, FD + OF_HALVES, REFERENCE),
                floor,
                "halves of the reference's own",
                "Frechet distance of halves",
                "Between halves of the samples, because halves of the reference's own samples show what a perfect "
                "copy of its distribution would get: hatched, 95 % of random halves.",
            ),
        }
        return [chart(title, *parts) for title, parts in shown.items() if parts[0]]

    def solution_charts(self) -> list[Curves]:
        """Differences from the converged solution over evaluations; none where all solvers draw noise."""
        series = lines_of(self.rows, PIXEL_RMS, CONVERGED)
        caption = (
            f"Image by image from the same noise, against {self.converged_name}; bars are 95 % intervals. Only solvers "
            "that draw no noise of their own approach it; it says how exactly they solve, not how good the image is."
        )
        intervals = intervals_of(self.rows, PIXEL_RMS, CONVERGED)
        title, y_label = "Difference from the converged solution", "RMS, grey levels of 255"
        return [chart(title, series, None, "", y_label, caption, intervals)] if series else []

    def settings(self) -> Table:
        """Every setting with its costs and errors."""
        of_generator = [row for row in self.rows if row["study"] == "generator"]
        label = next((row["metric"] for row in of_generator if row["against"] == LABELS), "")
        found = recommend(self.rows)
        bold: set[tuple[int, int]] = set()
        body: list[list[Any]] = []
        for point in dict.fromkeys((row["line"], row["num_inference_steps"]) for row in of_generator):
            if point in (_point(found.default), _point(found.quick)):
                bold.add((len(body), 0))
            evaluations = next(row["evaluations"] for row in of_generator if _point(row) == point)
            distance = self._at(point, FD, HELD_OUT)
            numbers = [
                self._at(point, *what)
                for what in ((KID, HELD_OUT), (FD + OF_HALVES, REFERENCE), (PIXEL_RMS, CONVERGED))
            ]
            scales = (1000, 1, 1)
            cells = [_digits(row, scale) for row, scale in zip(numbers, scales, strict=True)]
            cells += [_digits(self._at(point, label, LABELS))] if label else []
            networks = [f"{evaluations:g}", _digits(self._at(point, CONTROLNET, ""))]
            times = [_digits(self._at(point, seconds, ""), 1000) for seconds in (WALL, CPU)]
            excess = self._at(point, FD + EXCESS, HELD_OUT)
            intervals = ["" if row is None else _text(row) for row in (distance, excess)]
            body.append([self._name(point[0]), *networks, *times, *intervals, *cells])
        columns = [
            "sampler", "U-Net", "Control Net", "ms", "CPU ms", "Frechet, recorded", "excess", "KID, recorded",
            "Frechet, reference", "RMS",
        ]  # fmt: skip
        columns += [metric_name(label)] if label else []
        caption = (
            "U-Net, ControlNet: evaluations an image, counted. ms: median time an image, batch by batch in one process "
            f"with the networks loaded and warm, on the machine as busy as it was. Frechet: distance, to "
            f"{HELD_OUT} with its 95 % interval, and between halves to the reference's samples. Excess: that to "
            f"recorded frames minus the reference's, paired, with its 95 % interval. KID: kernel distance times "
            "1,000, which has no bias. RMS: grey levels from the converged solution."
        )
        caption += (
            f" {metric_name(label)}: of a model trained on recorded frames, against the labels asked for."
            if label
            else ""
        )
        return Table("Every setting", columns, body, caption=f"{caption} Bold: recommended.", bold=bold)

    def _at(self, point: Point, metric: str, against: str) -> Row | None:
        return find_row(self.rows, *point, metric, against)

    def _grid(self) -> ImageGrid:
        """Reference and recommended settings, the same conditions below one another."""
        chosen = spread(len(self.reference_pictures), GRID_COLUMNS)
        rows: list[tuple[str, list[np.ndarray]]] = []
        if self.condition_pictures is not None:
            rows.append(("condition", [self.condition_pictures[row] for row in chosen]))
        rows.append((self.reference_name, [self.reference_pictures[row] for row in chosen]))
        found = recommend(self.rows)
        points: dict[Point, str] = {}
        for row, what in ((found.default, "recommended"), (found.quick, "quick"), (self._worst(), "farthest")):
            point = _point(row)
            if row is not None and point is not None:
                points.setdefault(point, f"{what}: {_named(row)}")
        for point, name in points.items():
            if point in self.pictures:
                rows.append((name, [self.pictures[point][row] for row in chosen]))
        return ImageGrid("The same conditions and seeds", rows, caption="One column a condition, none chosen by eye.")

    def _worst(self) -> Row | None:
        points = [
            row for row in rows_of(self.rows, FD, HELD_OUT) if row["line"] not in (REFERENCE_LINE, CONVERGED_LINE)
        ]
        return max(points, key=lambda row: row["value"], default=None)

    def _name(self, line: str) -> str:
        return {
            REFERENCE_LINE: f"{self.reference_name} (reference)",
            CONVERGED_LINE: f"{self.converged_name} (converged)",
        }.get(line, line)

    def _row(self, line: str, metric: str, against: str, steps: int | None = None) -> Row | None:
        return find_row(self.rows, line, steps, metric, against)


def _point(row: Row | None) -> Point | None:
    return None if row is None else (row["line"], row["num_inference_steps"])


def _named(row: Row) -> str:
    return f"{row['line']} in {row['evaluations']:g} evaluations"


def _where(row: Row, reference: Row) -> str:
    return "within the interval" if row["value"] <= reference["high"] else "above the interval"


def _digits(row: Row | None, scale: float = 1) -> str:
    """Three significant digits, and no powers of ten for large values."""
    if row is None:
        return ""
    value = row["value"] * scale
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _text(row: Row) -> str:
    known = row["low"] is not None and row["high"] is not None
    return _digits(row) + (f" [{row['low']:.3g}, {row['high']:.3g}]" if known else "")
