"""The sections of the report that set synthetic beside recorded in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ctlev_core.realism.summary import AXES
from ctlev_core.report.page.display_names import metric_name, set_name
from ctlev_core.report.page.html import Curves, Section, Table
from ctlev_core.report.sections.two_sample import two_sample_tables

_HOW_TO_READ = (
    "Means over recordings, in brackets 95 % intervals under resampling of recordings. Distance: magnitude of the "
    "difference, or between distributions the Wasserstein-1 distance in the unit named and the Jensen-Shannon "
    "divergence (0 = equal, 1 = nothing in common). Floor: the same distance between random halves of the left set. "
    "Bold: the distance lies above the floor's interval. Resampling repeats recordings, which makes divergences a "
    "little larger: with few recordings their interval may lie above the value. Ratio: of the right number to the left "
    "one, bold beyond a factor of ten."
)
_TITLES = {
    "frames": (
        "How real do the synthetic frames look?",
        "Event images have no time stamps: what compares them is where and how bright their pixels are. Active: value "
        "of 25 of 255 and more. Speckle: active pixels in groups of one or two; isolated: without an active one "
        "around; hot: 128 and more, and four times those around. Contrast: standard deviation over full scale. "
        "Told apart: how well a network tells the two sets apart, 0.5 = not at all.",
    ),
    "events": (
        "How alike are the recordings?",
        "Events of the training split beside those of the test split: what the data are like, and how much subjects "
        "and recordings differ. Noise rate: events that nothing around joins within 10 ms, a pixel and second in which "
        "nothing happens around.",
    ),
    "reference": (
        "How alike are the recordings and the reference?",
        "Events of the training split beside those of the recordings given as a reference.",
    ),
}
_OF_BASELINE = "How real do the frames of {} look?"
_RATIO_COLUMN, _DISTANCE_COLUMN = 3, 4


def realism_sections(
    rows: Sequence[dict[str, Any]],
    distributions: Sequence[dict[str, Any]],
    tests: Sequence[dict[str, Any]] = (),
) -> list[Section]:
    """Tables of numbers and distances, the two-sample tests, and charts of values and power spectra.

    Args:
        rows: of the table `scores` with the task `realism`.
        distributions: of the table `distributions`.
        tests: of the table `two_sample_tests`.
    Returns:
        One table a group, frames first; tests and charts follow the frames of the first generator.
    """
    sections: list[Section] = []
    how_to_read = _HOW_TO_READ
    prefix = "frames of "
    baselines = {row["group"]: (_OF_BASELINE, "") for row in rows if row["group"].startswith(prefix)}
    for group, (title, caption) in ({"frames": _TITLES["frames"]} | baselines | _TITLES).items():
        of_group = [row for row in rows if row["group"] == group]
        if of_group:
            titled = title.format(set_name(group.removeprefix(prefix)))
            sections.append(_table(of_group, titled, f"{caption} {how_to_read}".strip()))
            how_to_read = "To be read like the table of frames."
        if group == "frames":
            sections += two_sample_tables(tests)
            sections += _values(_series(distributions, "value"))
            sections += _spectra(_series(distributions, "power_spectrum"))
    return sections


Series = dict[str, tuple[list[float], list[float]]]


def _series(distributions: Sequence[dict[str, Any]], axis: str) -> Series:
    """Middles and shares of the bins, by set."""
    rows = [row for row in distributions if row["axis"] == axis]
    series: Series = {}
    # Recorded frames are in the comparison with each generator, and the same in all.
    groups = {row["subject"]: row["group"] for row in reversed(rows)}
    for subject in dict.fromkeys(row["subject"] for row in rows):
        of_set = [row for row in rows if row["subject"] == subject and row["group"] == groups[subject]]
        series[set_name(subject)] = ([row["centre"] for row in of_set], [row["share"] for row in of_set])
    return series


def _values(series: Series) -> list[Section]:
    series = {name: (centres, np.cumsum(shares).tolist()) for name, (centres, shares) in series.items()}
    caption = (
        "The area between the lines is their Wasserstein-1 distance in grey levels. Recorded lines have steps: event "
        "images hold few different counts."
    )
    title, labels = "Brightness of active pixels", (AXES["value"].label, "share of active pixels up to it")
    return [Curves(title, series, *labels, caption=caption)] if series else []


def _spectra(series: Series) -> list[Section]:
    """On a logarithmic axis, without the rings in which an image of this size has no frequency."""
    shown = {}
    for name, (centres, shares) in series.items():
        kept = [(centre, share) for centre, share in zip(centres, shares, strict=True) if share > 0]
        shown[name] = ([centre for centre, _ in kept], [share for _, share in kept])
    caption = "Share of each spatial frequency, whatever its direction, in the power of an image without its mean."
    labels = AXES["power_spectrum"].label, "share of the power"
    return [Curves("Power spectrum", shown, *labels, log_y=True, caption=caption)] if shown else []


def _table(rows: Sequence[dict[str, Any]], title: str, caption: str) -> Table:
    """Numbers down; the two sets, their ratio and distance, and the floor across."""
    found = {(row["subject"], row["metric"]): row for row in rows}
    sets = [name for name in dict.fromkeys(row["subject"] for row in rows) if " against " not in name]
    first, second = (*sets, "", "")[:2]
    subjects = (first, second, f"{second} against {first}", f"{first} against {first}")
    body: list[list[str]] = []
    bold: set[tuple[int, int]] = set()
    for metric in dict.fromkeys(row["metric"] for row in rows):
        cells = [found.get((subject, metric)) for subject in subjects]
        if _is_above(cells[2], cells[3]):
            bold.add((len(body), _DISTANCE_COLUMN))
        ratio = _ratio(cells[0], cells[1])
        if ratio is not None and not 0.1 < ratio < 10:
            bold.add((len(body), _RATIO_COLUMN))
        numbers, rest = [_cell(cell) for cell in cells[:2]], [_cell(cell) for cell in cells[2:]]
        body.append([metric_name(metric), *numbers, "" if ratio is None else _digits(ratio, 2), *rest])
    counts = [next((row["num_samples"] for row in rows if row["subject"] == name), 0) for name in (first, second)]
    left, right = set_name(first), set_name(second)
    columns = ["number", f"{left} ({counts[0]})", f"{right} ({counts[1]})", "ratio", "distance"]
    columns.append(f"floor: {left}, halves")
    return Table(title, columns, body, caption=caption, bold=bold, footnotes=["In parentheses: recordings."])


def _ratio(first: dict[str, Any] | None, second: dict[str, Any] | None) -> float | None:
    """Of the second number to the first; None where there is none, or the first is 0."""
    return second["value"] / first["value"] if first and second and first["value"] else None


def _is_above(distance: dict[str, Any] | None, floor: dict[str, Any] | None) -> bool:
    return bool(distance and floor and floor["high"] is not None and distance["value"] > floor["high"])


def _cell(row: dict[str, Any] | None) -> str:
    if row is None:
        return ""
    text = _digits(row["value"], 3)
    return text if row["low"] is None else f"{text} [{_digits(row['low'], 2)}, {_digits(row['high'], 2)}]"


def _digits(value: float, digits: int) -> str:
    """Significant digits, but no powers of ten for large values."""
    return f"{value:.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"
