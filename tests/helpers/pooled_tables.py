"""Tables of scores of single samples as several draws of the training recordings leave them, for tests."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from ctlev_core.provenance.scores import PAIRED_SAMPLES


def samples_table(
    values: dict[str, np.ndarray], per_recording: int = 1, metric: str = "accuracy", digest: str = "d"
) -> pa.Table:
    """Args: `values` [R, N] of each setting, `per_recording` samples of each recording, `digest` of images."""
    parts = []
    for setting, of_setting in values.items():
        trainings, count = of_setting.shape
        rows = trainings * count
        ids = [f"s{number:05}" for number in range(count)]
        recordings = [f"r{number // per_recording:05}" for number in range(count)]
        columns = {
            "subject": [setting] * rows, "metric": [metric] * rows,
            "training": pa.array(np.repeat(np.arange(trainings), count), pa.int32()),
            "sample_id": ids * trainings, "recording_id": recordings * trainings, "value": of_setting.ravel(),
            "weight": np.ones(rows), "samples_digest": [digest] * rows,
        }  # fmt: skip
        parts.append(pa.table(columns).cast(PAIRED_SAMPLES.arrow()))
    return pa.concat_tables(parts)


def simulate_draws(random, effects, *, draws=3, generators=5, seeds=3, recordings=60, **deviations):
    """A balanced normal model: for each draw the values [R, N] of each setting.

    Args:
        random: numpy's generator.
        effects: the true score of each setting.
        deviations: standard deviations: `recording`, and, for each setting of its own, `recording_of_setting`, `draw`,
            `generator`, `seed` and `sample`.
    """
    spread = dict.fromkeys(("recording", "recording_of_setting", "draw", "generator", "seed", "sample"), 0.0)
    spread |= deviations
    shared = random.normal(0, spread["recording"], recordings)
    own = {name: random.normal(0, spread["recording_of_setting"], recordings) for name in effects}
    found = []
    for _ in range(draws):
        of_draw = {}
        for name, effect in effects.items():
            tuned = random.normal(0, spread["generator"], generators) * (name != "recorded")
            trained = np.tile(tuned, seeds) + random.normal(0, spread["seed"], generators * seeds)
            trained += effect + random.normal(0, spread["draw"])
            noise = random.normal(0, spread["sample"], (len(trained), recordings))
            of_draw[name] = trained[:, None] + shared + own[name] + noise
        found.append(of_draw)
    return found
