"""The sections of the report that say whether generated frames are copies of training frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ctlev_core.report.page.display_names import Name, metric_name, set_name
from ctlev_core.report.page.html import ImageGrid, Section, Table
from ctlev_core.scoring.memorisation import CLOSEST_PAIRS
from ctlev_core.statistics.bootstrap import score_text
from data_contracts.manifest import Manifest

_CAPTION = (
    "Close copies: share of generated frames nearer to a training frame than the closest 1 % of recorded frames are to "
    "those of other recordings; about 0.01 without copying, in brackets 95 % over frames. Exact copies: frames equal "
    "to a training frame. Ratio: median distance to the nearest training frame, over that of recorded frames."
)


def memorisation_sections(frames: Manifest, generated: Sequence[Manifest], copies: Sequence[Manifest]) -> list[Section]:
    """One table for all generators, and the closest pairs of the first of them.

    Args:
        frames: with the training frames.
        generated: frames of each generator.
        copies: what `tasks.memorisation` found for each.
    """
    rows = [row for manifest in copies for row in manifest.table.to_pylist()]
    if not rows:
        return []
    sections: list[Section] = [_table(rows)]
    pairs = copies[0].attached(CLOSEST_PAIRS).to_pylist()
    for features in dict.fromkeys(pair["features"] for pair in pairs):
        shown = [pair for pair in pairs if pair["features"] == features]
        images = [
            ("generated", [generated[0].array("frames")[pair["generated_row"]] for pair in shown]),
            ("training", [frames.array("frames")[pair["training_row"]] for pair in shown]),
        ]
        names = [f"{pair['distance'] / pair['threshold']:.2f}" if pair["threshold"] else "0" for pair in shown]
        caption = "The pairs that lie closest; above each its distance over that of the closest 1 % of recorded frames."
        sections.append(
            ImageGrid(f"Closest pairs: {set_name(shown[0]['subject'])}, {features}", images, names, caption)
        )
    return sections


def _table(rows: Sequence[dict[str, Any]]) -> Table:
    """Generators down, what was compared and how across."""
    cells = {(row["subject"], row["group"], row["metric"]): row for row in rows}
    columns = list(dict.fromkeys((row["group"], row["metric"]) for row in rows))
    body: list[list[str]] = []
    for subject in dict.fromkeys(row["subject"] for row in rows):
        found = [cells.get((subject, *column)) for column in columns]
        body.append([set_name(subject), *("" if cell is None else _text(cell) for cell in found)])
    return Table(
        "Does it copy?",
        ["frames", *(Name(f"{metric_name(metric)}: {group}", metric) for group, metric in columns)],
        body,
        caption=_CAPTION,
    )


def _text(row: dict[str, Any]) -> str:
    if row["metric"] == "duplicates":
        return f"{row['value']:.0f}"
    return score_text(row["value"], row["low"], row["high"])
