"""Score a version of synthetic data beside held-out recorded frames."""

from __future__ import annotations

import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.events.windows import spread
from ctlev_core.plugin_outputs import features_of_frames
from ctlev_core.report.version_gates import HELD_OUT
from ctlev_core.statistics.feature_distances import name_distance
from data_contracts import tables
from data_contracts.config import DownstreamChoice, MetricChoice
from data_contracts.errors import DataError
from data_contracts.manifest import Manifest
from data_contracts.training_sets import SYNTHETIC
from tasks.stage import Output, stage


@stage(version=1, schema=tables.SCORES)
def score_beside_real(
    out: Output,
    extractor: Manifest,
    frames: Manifest,
    generated: Manifest,
    *,
    downstream: DownstreamChoice,
    distances: list[MetricChoice],
) -> pa.Table:
    """Distances of held-out recorded and of generated frames to the recorded training frames, in a classifier's
    features.

    Equally many of either, evenly spread, because a Frechet distance grows as frames get fewer: only so is their ratio
    what generating costs. It says nothing of single frames, and has no interval.
    """
    plugin, folder = plugins.load_options(downstream), extractor.ref.path / "model"
    learnt, held_out, made = (
        data.rows_where(split=split)
        for data, split in ((frames, "train"), (frames, frames.held_out), (generated, "train"))
    )
    count = min(len(held_out), len(made))
    if min(count, len(learnt)) < 2:
        raise DataError(
            f"{generated.ref.path}: distances need two training, held-out and generated frames at least, "
            f"got {len(learnt)}, {len(held_out)} and {len(made)}"
        )
    compared = ((HELD_OUT, frames, held_out), (SYNTHETIC, generated, made))
    real = features_of_frames(plugin, folder, frames.images(learnt))
    rows = []
    for subject, data, members in compared:
        chosen = members[spread(len(members), count)]
        features = features_of_frames(plugin, folder, data.images(chosen))
        for choice in distances:
            metric = plugins.load_options(choice)
            if metric.module.INPUT != "features":
                raise DataError(f"distances: {choice.name!r} compares {metric.module.INPUT}, not features")
            rows += [
                {
                    "task": "distance",
                    "subject": subject,
                    "seed": 0,
                    "group": "all",
                    "metric": name_distance(plugin, folder, extractor.ref.digest, name),
                    "value": value,
                    "low": None,
                    "high": None,
                    "num_samples": count,
                    "num_train": len(learnt),
                    "model_digest": extractor.ref.digest,
                    "data_digest": data.ref.digest,
                }
                for name, value in metric.module.compute(features, real, metric.options).items()
            ]
    return pa.Table.from_pylist(rows, schema=tables.SCORES.arrow())
