"""The table of the report with what a distance between two sets of frames has to be read with."""

from __future__ import annotations

from collections.abc import Sequence

from ctlev_core.metrics.frechet import TO_STATISTICS
from ctlev_core.report.page.display_names import metric_name, set_name
from ctlev_core.report.page.tables import Cell, Table
from ctlev_core.statistics.bootstrap import score_text
from ctlev_core.statistics.feature_distances import DISTANCE_ESTIMATES
from data_contracts.manifest import Manifest

_CAPTION = (
    "A distance between small sets is larger than between large ones, even where both show the same. So it stands here "
    "beside distances of equally small halves, whole recordings to one half or the other: of the frames and the "
    "recorded training frames, and of the recorded training frames among themselves, the floor, with the central 95 % "
    "over random halvings in brackets."
)
_OF_PUBLISHED = (
    " Of a distance to given statistics, which are no frames, the halves of the recorded training frames are compared "
    "with these statistics as well: it is what recorded frames score, and no floor."
)


def floor_tables(scores: Sequence[Manifest]) -> list[Table]:
    """One row a set of frames and score; none where no distance was measured."""
    body: list[list[Cell]] = []
    caption = _CAPTION
    for manifest in scores:
        if f"{DISTANCE_ESTIMATES.name}.parquet" not in manifest.files:
            continue
        for row in manifest.attached(DISTANCE_ESTIMATES).to_pylist():
            floor = None
            if row["floor"] is not None:
                if row["metric"].startswith(TO_STATISTICS):
                    caption = _CAPTION + _OF_PUBLISHED
                floor = score_text(row["floor"], row["floor_low"], row["floor_high"])
            halved = None if row["halved"] is None else score_text(row["halved"])
            counts = [row[name] for name in ("num_predicted", "num_target", "num_features")]
            body.append(
                [set_name(row["subject"]), metric_name(row["metric"]), score_text(row["value"]), halved, floor, *counts]
            )
    columns = ["frames", "score", "all", "halves", "halves of recorded frames", "number", "recorded frames", "features"]
    return [Table("How to read the distances", columns, body, caption=caption)] if body else []
