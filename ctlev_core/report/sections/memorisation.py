"""The sections of the report that say whether generated frames are copies of training frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ctlev_core.report.page.display_names import metric_name, set_name
from ctlev_core.report.page.html import ImageGrid, Section, Table
from ctlev_core.report.page.tables import Cell
from ctlev_core.scoring.memorisation import CLOSEST_PAIRS
from ctlev_core.statistics.bootstrap import score_text
from data_contracts.manifest import Manifest
from data_contracts.training_sets import HELD_OUT

_CAPTION = (
    "Close copies: share of frames nearer to a training frame than the closest 1 % of recorded frames are to those of "
    "other recordings; about 0.01 without copying. Exact copies: frames equal to a training frame. Ratio: median "
    "distance to the nearest training frame, over that of recorded frames. C_T: the same distances compared by the "
    "data-copying test, 0 = as near as recorded frames, far below 0 = nearer. Authentic: share of frames whose nearest "
    "training frame has a nearer neighbour among those of other recordings. In brackets 95 %. Held-out recorded frames "
    "are certainly no copies; what they score is what copies have to be told from."
)
_COLUMNS = ("close_share", "duplicates", "nearest_distance_ratio", "data_copying_z", "authentic_share")


def memorisation_sections(frames: Manifest, generated: Sequence[Manifest], copies: Sequence[Manifest]) -> list[Section]:
    """One table for all generators, and the closest pairs of the first of them.

    Args:
        frames: with the training frames.
        generated: frames of each generator.
        copies: what `tasks.memorisation` found for each, with the floor.
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
    """Sets of frames and what they were compared in down, scores and numbers of frames across; the floor last."""
    by_set: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for row in sorted(rows, key=lambda row: row["subject"] == HELD_OUT):
        # The floor is the same beside each generator.
        by_set.setdefault((row["subject"], row["group"]), {})[row["metric"]] = row
    shown = [metric for metric in _COLUMNS if any(metric in found for found in by_set.values())]
    body: list[list[Cell]] = []
    for (subject, group), found in by_set.items():
        counts = next(iter(found.values()))
        scores = ["" if metric not in found else _text(found[metric]) for metric in shown]
        body.append([set_name(subject), group, *scores, counts["num_samples"], counts["num_train"]])
    columns = ["frames", "compared in", *map(metric_name, shown), "number", "training frames"]
    return Table("Does it copy?", columns, body, caption=_CAPTION)


def _text(row: dict[str, Any]) -> str:
    if row["metric"] == "duplicates":
        return f"{row['value']:.0f}"
    return score_text(row["value"], row["low"], row["high"])
