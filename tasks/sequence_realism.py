"""Do synthetic frames follow one another in time as recorded ones do? Numbers and a two-sample test of stretches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from ctlev_core.events.windows import spread
from ctlev_core.progress import ProgressBar
from ctlev_core.realism import two_sample
from ctlev_core.realism.distances import Estimate
from ctlev_core.realism.sequences import LabelledJoints, estimate_numbers, measure_stretch
from ctlev_core.realism.stretches import (
    SHUFFLED,
    Stretches,
    labelled_stretches,
    recorded_stretches,
    shuffle_time,
    stack_frames,
    used_channels,
)
from data_contracts import tables
from data_contracts.manifest import Manifest
from data_contracts.training_sets import RECORDED
from tasks.stage import Output, stage

MAX_STRETCHES = 200
"""Of a larger set so many, of as many recordings as there can be: with stretches of 8 frames, 1,600 frames are read."""
CHANNEL_FRAMES = 64
"""Recorded frames, evenly spread, that say which channels are used."""
GROUP = "sequences"


@stage(version=2, schema=tables.SCORES)
def sequence_realism(
    out: Output,
    frames: Manifest,
    generated: list[Manifest],
    *,
    names: Sequence[str],
    length: int,
    step_us: int,
) -> pa.Table:
    """Stretches of `length` frames, each `step_us` after the one before: recorded ones, and those of each generator.

    Rows have the task `realism` and the group `sequences`. Settings: the sets (`recorded`, `recorded shuffled` in an
    order drawn at random, the held-out split, generators by their `names`) for the numbers of `realism.sequences`, and
    `A against B` for the two-sample test of stretches, `c2st`: generators and shuffled order against recorded training
    stretches, generators against held-out ones, and the floors, as in the stage `realism`. The table
    `two_sample_tests`, which lies beside, has these with their numbers of stretches, or why there is no area.
    """
    split = frames.held_out
    rows = frames.rows_where(split="train")
    some = np.asarray(frames.array("frames")[rows[spread(len(rows), CHANNEL_FRAMES)]])
    channels = used_channels(some)
    recorded = recorded_stretches(frames, "train", step_us, length).spread(MAX_STRETCHES)
    held_out = recorded_stretches(frames, split, step_us, length).spread(MAX_STRETCHES)
    sets = {
        RECORDED: _measure(frames, recorded, channels, RECORDED),
        SHUFFLED: _measure(frames, recorded, channels, SHUFFLED, shuffled=True),
        split: _measure(frames, held_out, channels, split),
    }
    for name, made in zip(names, generated, strict=True):
        stretches = labelled_stretches(made, frames, step_us, length).spread(MAX_STRETCHES)
        sets[name] = _measure(made, stretches, channels, name)
    tests = _compare(sets, split, names)
    out.write_table(two_sample.tests_table(GROUP, tests), tables.TWO_SAMPLE_TESTS)
    scores = [
        _score(name, metric, estimate, len(set(measured.names.tolist())), measured.digest)
        for name, measured in sets.items()
        for metric, estimate in measured.numbers.items()
    ]
    scores += [
        _score(subject, two_sample.C2ST, Estimate(test.value, test.low, test.high), test.num_first, frames.ref.digest)
        for subject, test in tests.items()
        if not np.isnan(test.value)
    ]
    return pa.Table.from_pylist(scores, schema=tables.SCORES.arrow())


@dataclass(frozen=True, eq=False)
class _Measured:
    """A set of stretches.

    Attributes:
        images: [S, h, w, C'] uint8, each stretch as one image (`stack_frames`).
        names: [S] recordings.
        numbers: of all.
        digest: of the manifest of the frames.
    """

    images: np.ndarray
    names: np.ndarray
    numbers: Mapping[str, Estimate]
    digest: str


def _measure(
    manifest: Manifest, stretches: Stretches, channels: slice, name: str, *, shuffled: bool = False
) -> _Measured:
    """Stretch by stretch, so that large frames take no memory; in shuffled order labels stay where they are."""
    frames, labels = manifest.array("frames"), manifest.labels
    order = shuffle_time(stretches.rows) if shuffled else stretches.rows
    pairs = list(zip(order, stretches.rows, strict=True))
    # What a set without a stretch is compared as: too small, rather than of another size.
    blank = np.zeros((stretches.rows.shape[1], *frames.shape[1:]), np.uint8)[..., channels]
    images, sums = [stack_frames(blank)], []
    for rows, labelled_rows in ProgressBar(pairs, f"stretches: {name}", unit="stretch"):
        pictures = np.asarray(frames[rows])[..., channels]
        joints = labels.joints2d
        labelled = None if joints is None else LabelledJoints(joints[labelled_rows], labels.joint_set)
        sums.append(measure_stretch(pictures, labelled))
        images.append(stack_frames(pictures))
    numbers = estimate_numbers(sums, stretches.names.tolist())
    stacked = np.stack(images)[1:]
    return _Measured(stacked, stretches.names, numbers, manifest.ref.digest)


def _compare(sets: Mapping[str, _Measured], split: str, names: Sequence[str]) -> dict[str, two_sample.TwoSampleTest]:
    """The floors, the control, and each generator against both sets of recorded stretches."""
    tests = {
        f"{name} against {name}": two_sample.compare_halves(sets[name].images, sets[name].names)
        for name in (RECORDED, split)
    }
    pairs = [(split, RECORDED), (SHUFFLED, RECORDED), *((name, other) for name in names for other in (RECORDED, split))]
    for first, second in pairs:
        tests[f"{first} against {second}"] = two_sample.compare_frames(
            sets[first].images,
            sets[second].images,
            first_groups=sets[first].names,
            second_groups=sets[second].names,
            names=(first, second),
        )
    return tests


def _score(subject: str, metric: str, estimate: Estimate, num_samples: int, digest: str) -> dict[str, Any]:
    return {
        "task": "realism",
        "subject": subject,
        "seed": 0,
        "group": GROUP,
        "metric": metric,
        "value": estimate.value,
        "low": None if np.isnan(estimate.low) else estimate.low,
        "high": None if np.isnan(estimate.high) else estimate.high,
        "num_samples": num_samples,
        "num_train": 0,
        "model_digest": "",
        "data_digest": digest,
    }
