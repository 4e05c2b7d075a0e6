"""How real do recordings and synthetic frames look? Numbers, and distances beside a real-against-real floor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core import event_files
from ctlev_core.realism import distances
from ctlev_core.realism.summary import AXES, Summary, summarise_events, summarise_frames
from ctlev_core.windows import spread
from data_contracts import tables
from data_contracts.manifest import Manifest
from tasks.stage import Output, stage

MAX_EVENTS = 500_000
"""Of a longer recording the middle stretch of so many events."""
MAX_RECORDINGS = 40
"""Of a larger split so many, evenly spread; with `MAX_EVENTS` this takes at most half a minute."""
MAX_FRAMES = 1000
"""Of a larger set of frames so many, evenly spread."""


@stage(version=2, schema=tables.SCORES)
def realism(
    out: Output,
    recordings: Manifest,
    frames: Manifest,
    generated: list[Manifest],
    reference: Manifest | None,
    *,
    names: Sequence[str],
) -> pa.Table:
    """Events of the test split beside those of the training split, and generated beside real training frames.

    `reference` are other recordings that those of the training split are compared with, `names` those of the
    generators behind `generated`.

    Rows have the task `realism` and the group `events`, `frames` (of the first generator), `frames of NAME` or, with
    other recordings as a reference, `reference`. Settings: the two sets, `A against B` for their distances and
    `A against A` for the floor. Distributions lie beside the table.
    """
    learnt = _summarise_recordings(recordings, "train")
    found = [_compare("events", "train", "test", learnt, _summarise_recordings(recordings, "test"), recordings)]
    if reference is not None:
        found.append(_compare("reference", "reference", "train", _summarise_whole(reference), learnt, recordings))
    real = _summarise_frames(frames)
    groups = ["frames", *(f"frames of {name}" for name in names[1:])]
    for group, name, made in zip(groups, names, generated, strict=True):
        found.append(_compare(group, "real", name, real, _summarise_frames(made), made))
    schema = distances.DISTRIBUTIONS
    shares = [row for _, distributions in found for row in distributions]
    out.write_table(pa.Table.from_pylist(shares, schema.arrow()), schema)
    return pa.Table.from_pylist([row for rows, _ in found for row in rows], schema=tables.SCORES.arrow())


def _summarise_recordings(recordings: Manifest, split: str) -> list[Summary]:
    files = dict(zip(recordings.column("recording_id"), recordings.column("events_file"), strict=True))
    parts = [part for part in recordings.attached(tables.PARTS).to_pylist() if part["split"] == split]
    stretches = [(files[part["recording_id"]], part["event_start"], part["event_stop"]) for part in parts]
    return _summarise_stretches(recordings, stretches)


def _summarise_whole(recordings: Manifest) -> list[Summary]:
    """Every recording once, also where splits divide it."""
    table = recordings.table
    files, counts = table["events_file"].to_pylist(), table["num_events"].to_pylist()
    return _summarise_stretches(recordings, [(file, 0, count) for file, count in zip(files, counts, strict=True)])


def _summarise_stretches(recordings: Manifest, stretches: list[tuple[str, int, int]]) -> list[Summary]:
    """Of stretches (events file, first event, one past the last) those with events, the middle of long ones."""
    stretches = [stretch for stretch in stretches if stretch[0]]
    found = []
    for number in spread(len(stretches), MAX_RECORDINGS).tolist():
        file, start, stop = stretches[number]
        start += max(0, stop - start - MAX_EVENTS) // 2
        path = recordings.path(file)
        found.append(summarise_events(event_files.read_events_range(path, start, min(stop, start + MAX_EVENTS))))
    return found


def _summarise_frames(frames: Manifest) -> list[Summary]:
    """One summary a recording, because frames of one resemble one another."""
    rows = frames.rows_where(split="train")
    rows = rows[spread(len(rows), MAX_FRAMES)]
    names = np.array(frames.column("recording_id"))[rows]
    images = frames.array("frames")
    return [summarise_frames(np.asarray(images[rows[names == name]])) for name in dict.fromkeys(names.tolist())]


def _compare(
    group: str,
    first: str,
    second: str,
    of_first: list[Summary],
    of_second: list[Summary],
    data: Manifest,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of the table and of the distributions: two sets, their distances, and the floor of the first."""
    sets = {first: of_first, second: of_second}
    found = {name: distances.estimate_numbers(summaries) for name, summaries in sets.items()}
    found[f"{second} against {first}"] = distances.estimate_distances(sets[first], sets[second])
    found[f"{first} against {first}"] = distances.estimate_floor(sets[first])
    sizes = {name: len(summaries) for name, summaries in sets.items()}
    rows = [
        {
            "task": "realism",
            "setting": setting,
            "seed": 0,
            "group": group,
            "metric": metric,
            "value": estimate.value,
            "low": None if np.isnan(estimate.low) else estimate.low,
            "high": None if np.isnan(estimate.high) else estimate.high,
            "num_samples": sizes[setting.split(" against ")[0]],
            "num_train": 0,
            "model_digest": "",
            "data_digest": data.ref.digest,
        }
        for setting, estimates in found.items()
        for metric, estimate in estimates.items()
    ]
    return rows, [row for name, summaries in sets.items() for row in _distribution_rows(group, name, summaries)]


def _distribution_rows(group: str, setting: str, summaries: Sequence[Summary]) -> list[dict[str, Any]]:
    return [
        {"group": group, "setting": setting, "axis": axis, "centre": float(centre), "share": float(share)}
        for axis, shares in distances.mean_distributions(summaries).items()
        for centre, share in zip(AXES[axis].centres, shares, strict=True)
    ]
