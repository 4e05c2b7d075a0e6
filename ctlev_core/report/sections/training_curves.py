"""Losses over training, and how generated frames get better with it, from pre-trained weights and from random ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ctlev_core.report.page.display_names import metric_name, set_name
from ctlev_core.report.page.html import Curves
from ctlev_core.report.sections.score_tables import interval_over_trainings
from data_contracts.manifest import Manifest
from data_contracts.training_sets import RECORDED, SYNTHETIC, LabelAgreement, TrainingSet

FEWEST_AMOUNTS = 2
"""Amounts of training that are worth a line."""
PRE_TRAINED, RANDOM = "pre-trained weights", "random weights"
_VARIED = ("num_steps", "random_init")
_CAPTION = (
    "Each point is a fine-tuning of its own with so many steps; bars are 95 % intervals, over fine-tunings too where "
    "there are several. Both start from the same data; only the weights before the first step differ."
)


def base_model_figures(
    rows: Sequence[dict[str, Any]], options: Mapping[str, Mapping[str, Any]], metric: str
) -> list[Curves]:
    """Label error, distance to recorded frames, and the error of a model trained on them too, over steps of
    fine-tuning; none where those were not varied for both starts.

    Args:
        rows: of the table `scores`.
        options: all of each generator that learnt, by its name, with `random_init` where it has a base model. Those
            that differ from the experiment's own in anything but this and `num_steps` are left out.
        metric: of the labels.
    """
    found: dict[str, dict[int, str]] = {PRE_TRAINED: {}, RANDOM: {}}
    own = options.get(SYNTHETIC, {})
    for name, chosen in options.items():
        alike = {one: value for one, value in chosen.items() if one not in _VARIED}
        if "random_init" in chosen and alike == {one: value for one, value in own.items() if one not in _VARIED}:
            found[RANDOM if chosen["random_init"] else PRE_TRAINED].setdefault(chosen["num_steps"], name)
    if min(map(len, found.values())) < FEWEST_AMOUNTS:
        return []
    distance = next(
        (r["metric"] for r in rows if r["task"] == "distance" and r["metric"].startswith(("fd", "fid"))), ""
    )
    figures = []
    for title, subject_of, wanted in (
        ("Are labels found in the frames?", LabelAgreement, metric),
        ("How far are the frames from recorded ones?", str, distance),
        (
            "What does a model learn from recorded frames and these?",
            lambda name: TrainingSet.of(RECORDED, name),
            metric,
        ),
    ):
        series: dict[str, tuple[list[float], list[float]]] = {}
        spans: dict[str, tuple[list[float], list[float]]] = {}
        for start, names in found.items():
            for num_steps, name in sorted(names.items()):
                subject = str(subject_of(name))
                scored = [r for r in rows if (r["subject"], r["metric"], r["group"]) == (subject, wanted, "all")]
                if scored:
                    value, low, high = interval_over_trainings(scored)
                    _append(series.setdefault(start, ([], [])), float(num_steps), value)
                    _append(spans.setdefault(start, ([], [])), low, high)
        if series:
            steps, far = "optimiser steps of fine-tuning", wanted == distance
            figures.append(
                Curves(title, series, steps, metric_name(wanted), log_x=True, log_y=far, caption=_CAPTION, spans=spans)
            )
    return figures


def _append(columns: tuple[list[float], list[float]], first: float, second: float) -> None:
    columns[0].append(first)
    columns[1].append(second)


def loss_curves(title: str, manifests: Sequence[Manifest], names: Sequence[str]) -> Curves:
    """Losses over steps, of training and validation; `names` are of generators or of `TRAINING SET, seed N`."""

    def told(name: str) -> str:
        training_set, comma, seed = name.partition(", ")
        return f"{set_name(training_set)}{comma}{seed}"

    series: dict[str, tuple[list[float], list[float]]] = {}
    for manifest, name in zip(manifests, names, strict=True):
        for curve in dict.fromkeys(manifest.column("curve")):
            rows = [row for row in manifest.table.to_pylist() if row["curve"] == curve]
            label = f"{told(name)}, {'shuffled conditions' if curve == 'shuffled' else curve}"
            series[label] = ([row["step"] for row in rows], [row["loss"] for row in rows])
    shuffled = any(label.endswith("shuffled conditions") for label in series)
    caption = (
        "Validation on frames that are not learnt from, with their own conditions and with those of others: where the "
        "two lines part, the generator heeds its conditions."
    )
    return Curves(title, series, x_label="optimiser step", y_label="loss", caption=caption if shuffled else "")
