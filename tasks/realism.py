"""How real do recordings and synthetic frames look? Numbers, distances and a two-sample test, beside their floors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core.events.windows import spread
from ctlev_core.realism import distances, two_sample
from ctlev_core.realism.summary import AXES, Summary, summarise_events, summarise_frames
from ctlev_core.recordings.stored_events import stored_events
from data_contracts import tables
from data_contracts.labels import HeldOut, held_out_split
from data_contracts.manifest import Manifest
from data_contracts.training_sets import RECORDED, SYNTHETIC
from tasks.stage import Output, stage

MAX_EVENTS = 500_000
"""Of a longer recording the middle stretch of so many events."""
MAX_RECORDINGS = 40
"""Of a larger split so many, evenly spread; with `MAX_EVENTS` this takes at most half a minute."""
MAX_FRAMES = 1000
"""Of a larger set of frames so many, evenly spread."""
FRAMES = "frames"
"""Group of the scores of the experiment's own generator, and of the floors."""


Frames = tuple[np.ndarray, np.ndarray]
"""Images [N, H, W, 3] uint8, and the recording [N] of each."""


@stage(version=2, schema=tables.SCORES)
def event_realism(
    out: Output, recordings: Manifest, reference: Manifest | None, *, held_out: HeldOut | None
) -> pa.Table:
    """Events of the held-out split beside those of the training split.

    `reference` are other recordings that those of the training split are compared with. `held_out` None: `test`, or
    `validation` where there is no other.

    Rows have the task `realism` and the group `events` or `reference`. Settings: the two sets, `A against B` for their
    distances and `A against A` for the floor. Distributions lie beside the table.
    """
    split = held_out or held_out_split(recordings.attached(tables.PARTS)["split"].to_pylist())
    learnt, other = (_summarise_recordings(recordings, name) for name in ("train", split))
    found = [_compare("events", "train", split, learnt, other, recordings)]
    if reference is not None:
        found.append(_compare("reference", "reference", "train", _summarise_whole(reference), learnt, recordings))
    _write_distributions(out, found)
    return _scores(rows for rows, _ in found)


@stage(version=1, schema=tables.TWO_SAMPLE_TESTS)
def realism_floors(out: Output, frames: Manifest) -> pa.Table:
    """How well a network tells recorded frames from one another: what that of generated ones is read beside.

    Three rows: the halves of the training frames (`recorded against recorded`), the halves of the held-out ones (`test
    against test`, or `validation` where these are what is held out), and held-out from training frames (`test against
    recorded`). Generators and versions that are compared with the same frames share them.
    """
    recorded = {split: _read_frames(frames, rows) for split, rows in _recorded_splits(frames).items()}
    held_out = frames.held_out
    tests = {f"{name} against {name}": two_sample.compare_halves(*of_split) for name, of_split in recorded.items()}
    tests[f"{held_out} against {RECORDED}"] = _tell_apart(held_out, recorded[held_out], RECORDED, recorded[RECORDED])
    return two_sample.tests_table(FRAMES, tests)


@stage(version=7, schema=tables.SCORES)
def realism(out: Output, frames: Manifest, generated: Manifest, floors: Manifest, *, name: str) -> pa.Table:
    """Generated frames, of the generator `name`, beside recorded training frames; `floors` are of `realism_floors`.

    Rows have the task `realism` and the group `frames`, of the experiment's own generator, or `frames of NAME`.
    Settings: the two sets, `A against B` for their distances and `A against A` for the floor. Distributions lie beside
    the table.

    How well a network tells frames apart is the metric `c2st`: generated from recorded training frames (`NAME against
    recorded`) and from recorded held-out frames (`NAME against test`, or `validation`), with the floors beside them.
    Where there are too few frames there is no such row; the table `two_sample_tests`, which lies beside, says why. The
    floors are not in that one again.
    """
    group = FRAMES if name == SYNTHETIC else f"{FRAMES} of {name}"
    found = _compare(group, RECORDED, name, _summarise_frames(frames), _summarise_frames(generated), generated)
    tests = {}
    for split, rows in _recorded_splits(frames).items():
        recorded = _read_frames(frames, rows)
        tests[f"{name} against {split}"] = _tell_apart(name, _read_made_frames(generated, recorded[1]), split, recorded)
    own = two_sample.tests_table(group, tests)
    out.write_table(own, tables.TWO_SAMPLE_TESTS)
    _write_distributions(out, [found])
    return _scores([found[0], _test_rows(group, pa.concat_tables([own, floors.table]), generated)])


def _recorded_splits(frames: Manifest) -> dict[str, str]:
    """The split of recorded frames by the name of the set: training frames, and those that are held out."""
    return {RECORDED: "train", frames.held_out: frames.held_out}


def _read_frames(frames: Manifest, split: str) -> Frames:
    """Frames of a split: as many as two halves may have that are told apart."""
    rows = frames.rows_where(split=split)
    rows = rows[two_sample.choose_rows(len(rows), 2 * two_sample.MAX_FRAMES)]
    return np.asarray(frames.array("frames")[rows]), np.array(frames.column("recording_id"), str)[rows]


def _read_made_frames(made: Manifest, recorded: np.ndarray) -> Frames:
    """Generated frames; one whose labels are those of a recorded one belongs to that recording.

    What was made from a recording that is held out is then held out as well.
    """
    rows = made.rows_where(split="train")
    rows = rows[two_sample.choose_rows(len(rows), two_sample.MAX_FRAMES)]
    own = np.array(made.column("recording_id"), str)[rows]
    if "source_id" not in made.table.column_names:
        return np.asarray(made.array("frames")[rows]), own
    sources = np.array([name.partition(":")[0] for name in made.column("source_id")], str)[rows]
    return np.asarray(made.array("frames")[rows]), np.where(np.isin(sources, recorded), sources, own)


def _tell_apart(first: str, of_first: Frames, second: str, of_second: Frames) -> two_sample.TwoSampleTest:
    return two_sample.compare_frames(
        of_first[0], of_second[0], first_groups=of_first[1], second_groups=of_second[1], names=(first, second)
    )


def _test_rows(group: str, tests: pa.Table, data: Manifest) -> list[dict[str, Any]]:
    """Rows of the table `scores`, of those tests that have an area."""
    return [
        _score(group, test["subject"], two_sample.C2ST, _estimate(test), test["num_first"], data)
        for test in tests.to_pylist()
        if test["value"] is not None
    ]


def _estimate(test: Mapping[str, Any]) -> distances.Estimate:
    low, high = (math.nan if test[name] is None else test[name] for name in ("low", "high"))
    return distances.Estimate(test["value"], low, high)


def _write_distributions(out: Output, found: Sequence[tuple[Any, list[dict[str, Any]]]]) -> None:
    rows = [row for _, distributions in found for row in distributions]
    out.write_table(pa.Table.from_pylist(rows, distances.DISTRIBUTIONS.arrow()), distances.DISTRIBUTIONS)


def _scores(parts: Iterable[list[dict[str, Any]]]) -> pa.Table:
    return pa.Table.from_pylist([row for rows in parts for row in rows], schema=tables.SCORES.arrow())


def _summarise_recordings(recordings: Manifest, split: str) -> list[Summary]:
    row_of = {name: row for row, name in enumerate(recordings.column("recording_id"))}
    parts = [part for part in recordings.attached(tables.PARTS).to_pylist() if part["split"] == split]
    stretches = [(row_of[part["recording_id"]], part["event_start"], part["event_stop"]) for part in parts]
    return _summarise_stretches(recordings, stretches)


def _summarise_whole(recordings: Manifest) -> list[Summary]:
    """Every recording once, also where splits divide it."""
    return _summarise_stretches(recordings, [(row, 0, n) for row, n in enumerate(recordings.column("num_events"))])


def _summarise_stretches(recordings: Manifest, stretches: list[tuple[int, int, int]]) -> list[Summary]:
    """Of stretches (row, first event, one past the last) those with events, the middle of long ones."""
    has_events = np.array([bool(file) for file in recordings.column("events_file")], bool)
    stretches = [stretch for stretch in stretches if has_events[stretch[0]]]
    found = []
    for number in spread(len(stretches), MAX_RECORDINGS).tolist():
        row, start, stop = stretches[number]
        start += max(0, stop - start - MAX_EVENTS) // 2
        stored = stored_events(recordings, recordings.table.slice(row, 1).to_pylist()[0])
        found.append(summarise_events(stored.read(start, min(stop, start + MAX_EVENTS))))
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
        _score(group, subject, metric, estimate, sizes[subject.split(" against ")[0]], data)
        for subject, estimates in found.items()
        for metric, estimate in estimates.items()
    ]
    return rows, [row for name, summaries in sets.items() for row in _distribution_rows(group, name, summaries)]


def _distribution_rows(group: str, subject: str, summaries: Sequence[Summary]) -> list[dict[str, Any]]:
    return [
        {"group": group, "subject": subject, "axis": axis, "centre": float(centre), "share": float(share)}
        for axis, shares in distances.mean_distributions(summaries).items()
        for centre, share in zip(AXES[axis].centres, shares, strict=True)
    ]


def _score(
    group: str, subject: str, metric: str, estimate: distances.Estimate, num_samples: int, data: Manifest
) -> dict[str, Any]:
    return {
        "task": "realism",
        "subject": subject,
        "seed": 0,
        "group": group,
        "metric": metric,
        "value": estimate.value,
        "low": None if np.isnan(estimate.low) else estimate.low,
        "high": None if np.isnan(estimate.high) else estimate.high,
        "num_samples": num_samples,
        "num_train": 0,
        "model_digest": "",
        "data_digest": data.ref.digest,
    }
