"""A finished study of several numbers of recordings and several draws of each, as folders, for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pooled_tables import samples_table

from ctlev_core.report.page.html import ImageGrid, Step
from ctlev_core.report.studies.summary import Summary, write_summary
from data_contracts import tables
from data_contracts.manifest import Manifest, ManifestRef
from tasks.stage import Output
from tasks.study_report import study_report

METRIC, LABELS = "accuracy", "label agreement of synthetic"
# How much each training set gains over recorded frames, and how much of it is left with 20 recordings of each class.
GAINS = {
    "recorded": 0.0, "synthetic": -0.03, "augmentation": -0.01, "random_weights": -0.12, "simulator": -0.09,
    "oracle": 0.12, "recorded+synthetic": 0.08, "recorded+augmentation": 0.03, "recorded+random_weights": 0.01,
    "recorded+simulator": 0.02, "recorded+oracle": 0.14,
}  # fmt: skip
GENERATORS = ["synthetic", "augmentation", "random_weights", "simulator"]
COUNTS, DRAWS, NUM_GENERATORS, SEEDS, NUM_TEST = (2, 5, 10, 20), 3, 5, 15, 60


def pooled_groups(counts=COUNTS) -> list[tuple[str, list[str]]]:
    """What `study_report` takes as `pooled`."""
    return [(f"{count} recordings a class", [f"k{count}_{draw}" for draw in range(DRAWS)]) for count in counts]


def write_pooled_study(home: Path, counts=COUNTS, others: tuple[Manifest, ...] = (), **changes) -> str:
    """Write the reports of all experiments and the study's into `<home>/made`; returns the page.

    Args:
        home: an empty folder.
        counts: of recordings of each class.
        others: reports of further experiments, `other0` and so on, in no group.
        changes: of the arguments of `study_report`.
    """
    random = np.random.default_rng(0)
    easy = random.normal(0, 0.8, NUM_TEST)
    names = [name for _, members in pooled_groups(counts) for name in members]
    reports = [_report(home / name, name, easy, random) for name in names] + list(others)
    names += [f"other{number}" for number in range(len(others))]
    made = home / "made"
    made.mkdir()
    arguments = {
        "title": "numbers", "notice": "Data: made up.", "names": names, "training_sets": [list(GAINS)] * len(names),
        "generator_names": [GENERATORS] * len(names), "pooled": pooled_groups(counts),
        "num_generators": [NUM_GENERATORS] * len(names),
    }  # fmt: skip
    study_report.function(Output(made, made), reports, **arguments | changes)
    return (made / "report.html").read_text()


def _report(folder: Path, name: str, easy: np.ndarray, random: np.random.Generator) -> Manifest:
    """The report of the experiment `kCOUNT_DRAW`."""
    folder.mkdir()
    count = int(name[1:].partition("_")[0])
    draw, values = random.normal(0, 0.06), {}
    for training_set, gain in GAINS.items():
        tuned = random.normal(0, 0.04, NUM_GENERATORS) * (training_set != "recorded")
        level = 0.25 * np.log2(count) + draw + 8 * gain / np.sqrt(count) + random.normal(0, 0.03)
        trained = level + np.tile(tuned, SEEDS // NUM_GENERATORS)[:, None] + random.normal(0, 0.05, (SEEDS, 1))
        noise = random.logistic(0, 0.25, (SEEDS, NUM_TEST))
        values[training_set] = (trained + easy + noise > 0).astype(float)
    pq.write_table(samples_table(values), folder / "samples.parquet")
    scored = {
        **{training_set: of.mean(axis=1) for training_set, of in values.items()},
        LABELS: random.normal(0.8, 0.02, SEEDS),
    }
    rows = [
        _row(training_set, seed, float(value)) for training_set, of in scored.items() for seed, value in enumerate(of)
    ]
    rows += [
        {**_row(training_set, 0, 9.0), "task": "distance", "metric": "fd_event_x"}
        for training_set in ("held-out recorded", "synthetic")
    ]
    pq.write_table(pa.Table.from_pylist(rows, schema=tables.SCORES.arrow()), folder / "scores.parquet")
    pq.write_table(tables.SCORES.arrow().empty_table(), folder / "realism.parquet")
    pictures = [random.integers(0, 255, (16, 16, 3), np.uint8) for _ in range(4)]
    grid = ImageGrid("asked for, and sampled", [("asked for", pictures), ("sampled", pictures)])
    write_summary(folder, Summary(f"Verdict of {name}.", [Step("1. A label", "7", "see")], grid))
    (folder / "report.html").write_text(f"the page of {name}")
    return Manifest(ManifestRef(key=name, path=folder), None, (), ())


def _row(training_set: str, seed: int, value: float) -> dict:
    return {
        "task": "classification", "subject": training_set, "seed": seed, "group": "all", "metric": METRIC,
        "value": value,
        "low": value - 0.1, "high": value + 0.1, "num_samples": NUM_TEST, "num_train": 20, "model_digest": str(seed),
        "data_digest": "",
    }  # fmt: skip
