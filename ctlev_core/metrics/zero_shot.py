"""Binary accuracy of telling each held-out class from the others, with balanced negatives: the paper's Table 5.

For each class, the images of that class are the positives and those of the other classes the negatives. Of binary
classifiers, one of each class as in the paper (option `binary` of the downstream model), an image is called positive
where the classifier of the class gives it more than one half. Of one model of all classes it is where the class has the
highest probability of all: one against the rest.

Accuracy is given as expected for as many negatives as positives, drawn at random: the mean of the shares of positives
and negatives told right (`ctlev_core.scoring.zero_shot`). Chance is 0.5, whatever the numbers of images are. The paper
does not say how it draws negatives.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field

from ctlev_core.scoring.classification import Guesses, read_guesses
from ctlev_core.scoring.score_info import ScoreInfo
from ctlev_core.scoring.zero_shot import balanced_accuracy
from ctlev_core.statistics.bootstrap import ScoresOfDraws, sums_of_draws
from data_contracts.config import Frozen
from data_contracts.labels import Labels

VERSION = 2
INPUT = "classes"
SCORES = (
    ScoreInfo(
        "binary_accuracy",
        meaning="share told right where a class is told from the others, half of the frames its own",
        is_share=True,
    ),
)


class Options(Frozen):
    """Which classes are told from the others."""

    classes: tuple[str, ...] = Field(default=(), description="held-out classes; empty = every class of the targets")


def compute(predicted: Mapping[str, Any], target: Labels, options: Options) -> dict[str, float]:
    """`binary_accuracy_mean` over the classes, and `binary_accuracy_CLASS` of each.

    Args:
        predicted: `probability` [N, K] and `classes` [K], the names of the columns; of binary classifiers also
            `binary_probability` [N, K].
        target: N rows with class names. A class the model does not know is never called: 0.5.
        options: classes.
    Returns:
        Fractions in [0, 1]; 0.5 is chance.
    Raises:
        ValueError: see `read_guesses`; or a class has no row, or all of them.
    """
    return prepare(predicted, target, options)(np.arange(len(target)))


def prepare(predicted: Mapping[str, Any], target: Labels, options: Options) -> ScoresOfDraws:
    """The scores of any rows: what resampling asks for many times, with names compared once.

    A sample that lacks a class raises ValueError.
    """
    guesses = read_guesses(predicted, target)
    names = options.classes or tuple(sorted(set(target.class_names)))
    numbers = {name: number for number, name in enumerate(guesses.classes.tolist())}
    called = _calls(predicted, guesses)
    if missing := [name for name in names if name not in target.class_names]:
        raise ValueError(f"no target row is of class {', '.join(missing)}")
    return _Scores(guesses.truth, called, {name: numbers[name] for name in names})


@dataclass(frozen=True, eq=False)
class _Scores:
    """`compute` of any rows, and of many draws of groups of them.

    Attributes:
        truth: [N] the class of each row.
        called: [N, K] which classes it is called.
        numbers: of the classes that are told from the others, by name.
    """

    truth: np.ndarray
    called: np.ndarray
    numbers: Mapping[str, int]

    def __call__(self, rows: np.ndarray) -> dict[str, float]:
        found = {}
        for name, number in self.numbers.items():
            is_positive, is_called = self.truth[rows] == number, self.called[rows, number]
            count = int(np.count_nonzero(is_positive))
            if count in (0, len(rows)):
                raise ValueError(f"class {name!r} has {count} of {len(rows)} rows; it needs some and not all")
            found[f"binary_accuracy_{name}"] = balanced_accuracy(is_positive, is_called)
        return {"binary_accuracy_mean": float(np.mean(list(found.values()))), **found}

    def of_draws(self, groups: np.ndarray, draws: np.ndarray) -> dict[str, np.ndarray]:
        """Without the draws in which a class has no row, or all of them."""
        rows, codes = np.nonzero(self.called)
        own = codes == self.truth[rows]
        chosen, num_classes = list(self.numbers.values()), self.called.shape[1]
        true, called, hits = (
            sums_of_draws(groups[of], draws, code, num_classes)[:, chosen]
            for of, code in ((slice(None), self.truth), (rows, codes), (rows[own], codes[own]))
        )
        num_rows = (draws @ np.bincount(groups, minlength=draws.shape[1]))[:, None]
        usable = ((true > 0) & (true < num_rows)).all(axis=1)
        true, called, hits, num_rows = (counts[usable] for counts in (true, called, hits, num_rows))
        others = num_rows - true
        accuracies = np.ascontiguousarray((hits / true + (others - (called - hits)) / others) / 2)
        found = {f"binary_accuracy_{name}": of for name, of in zip(self.numbers, accuracies.T, strict=True)}
        return {"binary_accuracy_mean": accuracies.mean(axis=1), **found}


def compute_rows(predicted: Mapping[str, Any], target: Labels, options: Options) -> np.ndarray:
    """What each row adds to `binary_accuracy_mean`, times N, so that their mean is that score [N]; may exceed 1.

    A row is a positive of its own class and a negative of all others; each is worth its share of those.

    Raises:
        ValueError: as `prepare`.
    """
    guesses = read_guesses(predicted, target)
    names = options.classes or tuple(sorted(set(target.class_names)))
    prepare(predicted, target, options)(np.arange(len(target)))  # raises
    numbers = {name: number for number, name in enumerate(guesses.classes.tolist())}
    total, called = np.zeros(len(target)), _calls(predicted, guesses)
    for name in names:
        is_positive, is_called = guesses.truth == numbers[name], called[:, numbers[name]]
        share = np.where(is_positive, 1 / is_positive.sum(), 1 / (~is_positive).sum())
        total += share * (is_positive == is_called)
    return total * len(target) / (2 * len(names))


def _calls(predicted: Mapping[str, Any], guesses: Guesses) -> np.ndarray:
    """Which classes [N, K] each row is called; K as in `guesses`, which may hold classes the model does not know."""
    called = guesses.guess[:, None] == np.arange(len(guesses.classes))
    if "binary_probability" in predicted:
        known = np.asarray(predicted["binary_probability"]) > 0.5
        if known.shape != np.shape(predicted["probability"]):
            raise ValueError(f"binary_probability must be {np.shape(predicted['probability'])}, got {known.shape}")
        called[:, : known.shape[1]] = known
    return called
