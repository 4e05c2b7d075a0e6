"""Do generated frames copy training frames? Distances to the nearest, and the closest pairs to look at."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.events.windows import spread
from ctlev_core.plugin_outputs import features_of_frames
from ctlev_core.scoring.memorisation import CLOSEST_PAIRS, MemorisationCheck, check_memorisation, small_pictures
from data_contracts import tables
from data_contracts.config import DownstreamChoice
from data_contracts.errors import DataError
from data_contracts.image_rows import Images
from data_contracts.manifest import Manifest
from data_contracts.training_sets import HELD_OUT
from tasks.stage import Output, stage

logger = logging.getLogger(__name__)
MAX_OTHER_FRAMES = 5_000
"""Of more other recorded, or generated, frames so many, evenly spread. Training frames are never left out: any of them
may have been copied."""
NUM_PAIRS = 10
PICTURES = "small pictures"


@stage(version=3, schema=tables.SCORES)
def memorisation(
    out: Output,
    frames: Manifest,
    generated: Manifest,
    extractor: Manifest | None,
    *,
    downstream: DownstreamChoice | None,
    subject: str,
) -> pa.Table:
    """Rows of the task `memorisation`, one group for small pictures and, with a feature extractor, one for its
    features.

    Other recorded frames are the training frames against those of other recordings; where all training frames are of
    one recording, the held-out frames of others. Where there are none, there are no rows. Rows of the subject
    `held-out recorded` are the floor: what held-out frames, which nobody made from training frames, score in the place
    of generated ones. The closest pairs lie beside the table.
    """
    learnt, made = frames.rows_where(split="train"), generated.rows_where(split="train")
    made = made[spread(len(made), MAX_OTHER_FRAMES)]
    recordings = np.array(frames.column("recording_id"))
    held_out = frames.rows_where(split=frames.held_out)
    is_alone = len(set(recordings[learnt])) == 1
    if is_alone:  # frames are compared with those of other recordings
        held_out = held_out[recordings[held_out] != recordings[learnt[0]]]
    held_out = held_out[spread(len(held_out), MAX_OTHER_FRAMES)]
    other = held_out if is_alone else learnt[spread(len(learnt), MAX_OTHER_FRAMES)]
    if not len(learnt) or not len(made):
        raise DataError(f"memorisation: needs training and generated frames, got {len(learnt)} and {len(made)}")
    ways: dict[str, Callable[[Images], np.ndarray]] = {PICTURES: small_pictures}
    if extractor is not None and downstream is not None:
        plugin, folder = plugins.load_options(downstream), extractor.ref.path / "model"
        ways[f"features of {plugin.name}"] = lambda images: features_of_frames(plugin, folder, images)
    if not len(other):
        logger.warning(
            "%s: all frames are of one recording, and no copies are looked for: a frame resembles its neighbours as a "
            "copy does",
            frames.ref.path,
        )
        ways.clear()
    scores: list[dict[str, Any]] = []
    pairs: list[dict[str, Any]] = []
    for name, features_of in ways.items():
        training, real = features_of(frames.images(learnt)), features_of(frames.images(other))
        check = partial(
            check_memorisation,
            training=training,
            real=real,
            training_recordings=recordings[learnt],
            real_recordings=recordings[other],
        )
        found = check(features_of(generated.images(made)))
        digest = extractor.ref.digest if extractor is not None and name != PICTURES else ""
        same = {"group": name, "num_train": len(learnt), "model_digest": digest}
        scores += _scores(found, same | {"subject": subject, "data_digest": generated.ref.digest})
        if len(held_out):
            floor = check(features_of(frames.images(held_out)), generated_recordings=recordings[held_out])
            scores += _scores(floor, same | {"subject": HELD_OUT, "data_digest": frames.ref.digest})
        for of_made, of_learnt, distance in found.closest(NUM_PAIRS):
            rows = int(made[of_made]), int(learnt[of_learnt])
            pairs.append(
                {
                    "subject": subject,
                    "features": name,
                    "generated_id": generated.table["sample_id"][rows[0]].as_py(),
                    "training_id": frames.table["sample_id"][rows[1]].as_py(),
                    "generated_row": rows[0],
                    "training_row": rows[1],
                    "distance": distance,
                    "threshold": found.threshold,
                }
            )
    out.write_table(pa.Table.from_pylist(pairs, CLOSEST_PAIRS.arrow()), CLOSEST_PAIRS)
    return pa.Table.from_pylist(scores, schema=tables.SCORES.arrow())


def _scores(found: MemorisationCheck, same: dict[str, Any]) -> list[dict[str, Any]]:
    values = {
        "close_share": (found.close_share, found.low, found.high),
        "duplicates": (float(found.num_duplicates), np.nan, np.nan),
        "nearest_distance_ratio": (found.ratio, np.nan, np.nan),
        "data_copying_z": (found.copying.value, found.copying.low, found.copying.high),
        "authentic_share": (found.authentic_share, found.authentic_low, found.authentic_high),
    }
    return [
        {
            "task": "memorisation",
            "seed": 0,
            "metric": metric,
            "value": value,
            "low": None if np.isnan(low) else low,
            "high": None if np.isnan(high) else high,
            "num_samples": len(found.distances),
            **same,
        }
        for metric, (value, low, high) in values.items()
        if not np.isnan(value)
    ]
