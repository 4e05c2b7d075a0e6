"""The table of the report that says how well a network tells frames from recorded ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ctlev_core.realism.stretches import SHUFFLED
from ctlev_core.realism.two_sample import MIN_FRAMES
from ctlev_core.report.page.display_names import set_name
from ctlev_core.report.page.tables import Cell, Table
from ctlev_core.statistics.bootstrap import score_text
from data_contracts.labels import HELD_OUT_SPLITS
from data_contracts.training_sets import RECORDED

_CAPTION = (
    "A small network learns from half of the recordings which of two sets a {one} is from. Area: under the ROC curve "
    "on the other half, mean over four trainings (two random halvings, each half once to learn from), with its 95 % "
    "interval over recordings and trainings; sd: over the trainings. 0.5 = it cannot tell, 1 = it always can. A "
    "different mix of classes or poses is told as well as a different look, and so is a set of few {many} over and "
    "over. The rows of recorded {many} say what chance and other subjects make alone. With fewer than "
    f"{MIN_FRAMES} {{many}} in a set no area is given. Bold: told apart, the interval lies above 0.5."
)
_AREA_COLUMN = 1
_NAMES = {
    f"{RECORDED} against {RECORDED}": "recorded training {many}: halves",
    **{
        name: text
        for split in HELD_OUT_SPLITS
        for name, text in (
            (f"{split} against {split}", f"recorded {split} {{many}}: halves"),
            (f"{split} against {RECORDED}", f"recorded training from recorded {split} {{many}}"),
        )
    },
    f"{SHUFFLED} against {RECORDED}": "recorded training {many}: shuffled time from true",
}


def two_sample_tables(rows: Sequence[dict[str, Any]], one: str = "frame", many: str = "frames") -> list[Table]:
    """One row a pair of sets, those of recorded frames first; no table without rows.

    Args:
        rows: of the table `two_sample_tests`.
        one: what is told apart, frames or stretches of them.
        many: the same in plural.
    """
    body: list[list[Cell]] = []
    bold: set[tuple[int, int]] = set()
    for row in sorted(rows, key=lambda row: row["subject"] not in _NAMES):
        area = deviation = None
        if row["value"] is not None:
            area, deviation = score_text(row["value"], row["low"], row["high"]), f"{row['deviation']:.3f}"
        if row["low"] is not None and row["low"] > 0.5:
            bold.add((len(body), _AREA_COLUMN))
        counts = f"{row['num_first']} + {row['num_second']}"
        body.append([_name(row["subject"], many), area, deviation, counts, row["note"].replace("frames", many)])
    title = f"Can a network tell synthetic from recorded {many}?"
    caption = _CAPTION.format(one=one, many=many)
    return [Table(title, [many, "area", "sd", "number", "note"], body, caption=caption, bold=bold)] if body else []


def _name(subject: str, many: str) -> str:
    if subject in _NAMES:
        return _NAMES[subject].format(many=many)
    first, _, second = subject.partition(" against ")
    against = {RECORDED: f"recorded training {many}"} | {split: f"recorded {split} {many}" for split in HELD_OUT_SPLITS}
    return f"{set_name(first)} from {against.get(second, second)}"
