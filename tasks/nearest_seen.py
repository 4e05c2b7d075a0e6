"""Which class that a generator has learnt from is most like each one that it is asked for and has never seen."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from ctlev_core import plugins
from ctlev_core.scoring.zero_shot import nearest_seen_classes
from data_contracts import tables
from data_contracts.config import GeneratorChoice
from data_contracts.manifest import Manifest
from tasks.stage import Output, stage

NUM_NEAREST = 3


@stage(version=1, schema=tables.NEAREST_SEEN)
def nearest_seen(
    out: Output, checkpoint: Manifest, frames: Manifest, conditions: Manifest, *, generator: GeneratorChoice
) -> pa.Table:
    """The nearest classes of the training frames for each other class in `conditions`, by the generator's own text
    encoder.
    """
    seen = sorted(set(np.array(frames.column("class_name"))[frames.rows_where(split="train")].tolist()))
    unseen = sorted(set(conditions.column("class_name")) - set(seen))
    found = []
    if unseen:
        vectors = plugins.load_options(generator).module.embed_names(checkpoint.ref.path / "checkpoint", unseen + seen)
        count = min(NUM_NEAREST, len(seen))
        found = nearest_seen_classes(vectors[: len(unseen)], vectors[len(unseen) :], seen, count=count)
    rows = [
        {"unseen": name, "rank": rank, "seen": nearest, "similarity": similarity}
        for name, ranked in zip(unseen, found, strict=True)
        for rank, (nearest, similarity) in enumerate(ranked, start=1)
    ]
    return pa.Table.from_pylist(rows, schema=tables.NEAREST_SEEN.arrow())
