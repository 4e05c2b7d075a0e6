"""The page that says in which part a generator loses realism."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctlev_core.events.windows import spread
from ctlev_core.realism.two_sample import C2ST
from ctlev_core.report.page.html import Folded, ImageGrid, Section, Table
from ctlev_core.report.page.tables import Cell
from ctlev_core.statistics.bootstrap import score_text
from data_contracts.training_sets import RECORDED

Row = dict[str, Any]
Key = tuple[str, int]
"""What frames went through, and the time step or the number of steps."""

GRID_COLUMNS = 8
COLUMNS = {
    "active_pixel_share": "active",
    "isolated_pixel_share": "isolated",
    "speckle_share": "speckle",
    "hot_pixel_share": "hot",
    "value_mean": "value",
    "rms_contrast": "contrast",
    "neighbour_correlation": "neighbours",
    "positive_share": "positive",
}
"""Numbers of frames, and the headings of their columns."""
FIRST_TABLE = ("active_pixel_share", "isolated_pixel_share", "value_mean", "rms_contrast", "neighbour_correlation")
"""Those that stand beside the area."""
_NAMES = {
    RECORDED: "recorded",
    "autoencoder": "autoencoder",
    "values": "values as in sampling",
    "counts": "whole counts",
    "denoised": "denoised from t = {amount}",
    "sampled": "sampled in {amount} steps",
}
_AREA_CAPTION = (
    "Recorded frames after each part of the generator, one row each. What is denoised has been encoded, is decoded "
    "again, and its values are treated as in sampling. Area: under the ROC curve of a small network that tells "
    "the frames from what they were before; whole recordings are learnt from or held out, with what was made of them. "
    "0.5 = it cannot, 1 = it always can; frames that come out unchanged have 0.5. The first row is the floor: random "
    "halves of the recorded frames. Bold: told apart, the interval lies above 0.5. Steps: evaluations of the network "
    "an image. Active: share of pixels with a value of 25 of 255 and more; isolated: share of these without an active "
    "one around; value: mean of active pixels; contrast: standard deviation of an image over 255; neighbours: "
    "correlation of neighbouring pixels. Means over recordings. In brackets the 95 % interval."
)
_DIFFERENCE_CAPTION = (
    "The same numbers minus those of the recorded frames that were put in, recording by recording, with 95 % "
    "intervals over recordings. Bold: the interval excludes 0."
)
_MORE_CAPTION = (
    "Differences, likewise. Speckle: share of active pixels in groups of one or two; hot: share of pixels of 128 and "
    "more that are more than four times as bright as those around; positive: share of red in red and blue."
)
_GRID_CAPTION = (
    "The same recorded frames in every row, evenly spread, none chosen by eye; sampled ones were only told their "
    "condition."
)


def link_name(link: str, amount: int) -> str:
    """A row as the reader knows it."""
    return _NAMES[link].format(amount=amount)


@dataclass(frozen=True, eq=False)
class ChainPage:
    """What the page is made of.

    Attributes:
        rows: of the table `realism_chain`, in order.
        pictures: [N, H, W, 3] uint8 of each row of the page, in order, those of the recorded frames first.
    """

    rows: Sequence[Row]
    pictures: Mapping[Key, np.ndarray]

    def verdict(self) -> str:
        """From which row on frames are told apart, and between which rows the area rises most."""
        areas = {key: row for key, row in self._of_metric(C2ST).items() if key[0] != RECORDED}
        known = {key: row for key, row in areas.items() if row["value"] is not None}
        if not known:
            reasons = "; ".join(dict.fromkeys(row["note"] for row in areas.values()))
            return f"Nothing can be said about what is told apart: {reasons}."
        told = [key for key, row in known.items() if row["low"] is not None and row["low"] > 0.5]
        if not told:
            return "In no row are frames told from recorded ones: no interval of an area lies above 0.5."
        first = known[told[0]]
        area = score_text(first["value"], first["low"], first["high"])
        return f"Told from recorded frames first: {link_name(*told[0])}, area {area}. {_largest_rise(known)}"

    def sections(self) -> list[Section | Folded]:
        """The tables, then the pictures; numbers that seldom decide are folded."""
        others = self._differences("More numbers", [name for name in COLUMNS if name not in FIRST_TABLE])
        return [
            self._areas(),
            self._differences("What has changed?", FIRST_TABLE, _DIFFERENCE_CAPTION),
            self._grid(),
            Folded("More numbers", [others], _MORE_CAPTION),
        ]

    def _of_metric(self, metric: str) -> dict[Key, Row]:
        return {(row["link"], row["amount"]): row for row in self.rows if row["metric"] == metric}

    def _areas(self) -> Table:
        measured = {name: self._of_metric(name) for name in (C2ST, *COLUMNS)}
        shown = [name for name in FIRST_TABLE if measured[name]]
        body: list[list[Cell]] = []
        bold, notes = set(), []
        for key, tested in measured[C2ST].items():
            if tested["low"] is not None and tested["low"] > 0.5 and key[0] != RECORDED:
                bold.add((len(body), 2))
            if tested["note"]:
                notes.append(f"{link_name(*key)}: {tested['note']}.")
            numbers = [row["value"] if (row := measured[name].get(key)) else None for name in shown]
            area = _cell(tested, "value", "low", "high")
            body.append([link_name(*key), tested["evaluations"] or None, area, tested["num_samples"], *numbers])
        columns = ["frames", "steps", "area", "number", *(COLUMNS[name] for name in shown)]
        return Table("Where is realism lost?", columns, body, _AREA_CAPTION, notes, bold)

    def _differences(self, title: str, names: Sequence[str], caption: str = "") -> Table:
        """Of the numbers of these names that were measured."""
        measured = {name: found for name in names if (found := self._of_metric(name))}
        body: list[list[Cell]] = []
        bold = set()
        for key in self._of_metric(C2ST):
            if key[0] == RECORDED:
                continue
            cells: list[Cell] = [link_name(*key)]
            for found in measured.values():
                row = found.get(key)
                low, high = (None, None) if row is None else (row["difference_low"], row["difference_high"])
                if low is not None and high is not None and (low > 0 or high < 0):
                    bold.add((len(body), len(cells)))
                cells.append(_cell(row, "difference", "difference_low", "difference_high", signed=True))
            body.append(cells)
        return Table(title, ["frames", *(COLUMNS[name] for name in measured)], body, caption, bold=bold)

    def _grid(self) -> ImageGrid:
        count = min(map(len, self.pictures.values()))
        chosen = spread(count, GRID_COLUMNS)
        rows = [(link_name(*key), list(frames[chosen])) for key, frames in self.pictures.items()]
        return ImageGrid("What do they look like?", rows, caption=_GRID_CAPTION)


def _largest_rise(areas: Mapping[Key, Row]) -> str:
    """From one row to the next; unchanged frames, with an area of 0.5, are before the first."""
    before, rises = (RECORDED, 0.5), []
    for key, row in areas.items():
        name = link_name(*key)
        rises.append((row["value"] - before[1], before, (name, row["value"])))
        before = name, row["value"]
    rise, (first, low), (second, high) = max(rises)
    if rise <= 0:
        return ""
    return f"The area rises most from {first} ({low:.2f}) to {second} ({high:.2f})."


def _cell(row: Row | None, value: str, low: str, high: str, *, signed: bool = False) -> str | None:
    if row is None or row[value] is None:
        return None
    return score_text(row[value], row[low], row[high], signed=signed)
