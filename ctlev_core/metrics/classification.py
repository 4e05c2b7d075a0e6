"""Accuracy, macro precision, recall and F1 of a classifier, as scikit-learn defines them, and its calibration.

Macro = plain mean over the classes that occur among the targets or the predictions. A class that is never predicted has
precision 0, and one that is predicted but never a target has recall 0. The paper's Table 1 gives accuracy and
precision, without saying how the classes are averaged.

Calibration is the expected calibration error of Guo et al. (ICML 2017), over bins of equal width of the highest
probability. `ctlev_core.scoring.classification` has the scores of each class, the confusion matrix and the bins.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from pydantic import Field

from ctlev_core.scoring.classification import (
    Guesses,
    adds_up_exactly,
    bin_of,
    calibrate,
    class_scores,
    read_guesses,
)
from ctlev_core.scoring.score_info import ScoreInfo
from ctlev_core.statistics.bootstrap import ScoresOfDraws, sums_of_draws
from data_contracts.config import Frozen
from data_contracts.labels import Labels

VERSION = 2
INPUT = "classes"
SCORES = (
    ScoreInfo("accuracy", meaning="share of frames whose class is told right", is_share=True),
    ScoreInfo("macro_", is_share=True),
    ScoreInfo(
        "chance_accuracy", meaning="accuracy of always naming the commonest class", is_share=True, is_reference=True
    ),
    ScoreInfo("calibration_error", lower_is_better=True, is_share=True),
)


class Options(Frozen):
    """Calibration."""

    calibration_bins: int = Field(default=15, ge=1, description="bins of equal width; Guo et al.: 15")


def compute(predicted: Mapping[str, Any], target: Labels, options: Options) -> dict[str, float]:
    """`accuracy`, `macro_precision`, `macro_recall`, `macro_f1`, `chance_accuracy` and `calibration_error_ece15`.

    `chance_accuracy` is that of always naming the commonest class; the number of bins ends the last name.

    Args:
        predicted: `probability` [N, K] and `classes` [K], the names of the columns; of equal maxima the first wins.
        target: N rows with class names. A class the model does not know counts as an error.
        options: calibration.
    Returns:
        Fractions in [0, 1].
    Raises:
        ValueError: see `read_guesses`.
    """
    return prepare(predicted, target, options)(np.arange(len(target)))


def prepare(predicted: Mapping[str, Any], target: Labels, options: Options) -> ScoresOfDraws:
    """The scores of any rows: what resampling asks for many times, with names compared once."""
    return _Scores(read_guesses(predicted, target), options.calibration_bins)


def compute_rows(predicted: Mapping[str, Any], target: Labels, options: Options) -> np.ndarray:
    """1 for each correct row and 0 for each wrong one [N]: what intervals are made of."""
    guesses = read_guesses(predicted, target)
    return (guesses.guess == guesses.truth).astype(np.float64)


@dataclass(frozen=True, eq=False)
class _Scores:
    """`compute` of any rows of the guesses, and of many draws of groups of them."""

    guesses: Guesses
    num_bins: int

    def __call__(self, rows: np.ndarray) -> dict[str, float]:
        truth, guess = self.guesses.truth[rows], self.guesses.guess[rows]
        scores = class_scores(truth, guess, len(self.guesses.classes))
        occurs = (scores.num_true + scores.num_guessed) > 0
        calibration = calibrate(self.guesses.confidence[rows], truth == guess, self.num_bins)
        return {
            "accuracy": float(np.mean(truth == guess)),
            "macro_precision": float(scores.precision[occurs].mean()),
            "macro_recall": float(scores.recall[occurs].mean()),
            "macro_f1": float(scores.f1[occurs].mean()),
            "chance_accuracy": float(scores.num_true.max() / len(truth)),
            f"calibration_error_ece{self.num_bins}": calibration.expected_error,
        }

    def of_draws(self, groups: np.ndarray, draws: np.ndarray) -> dict[str, np.ndarray] | None:
        """Counts are added up group by group. So are confidences, unless that rounds otherwise than row by row."""
        truth, guess, confidence = self.guesses.truth, self.guesses.guess, self.guesses.confidence
        num_rows = draws @ np.bincount(groups, minlength=draws.shape[1])
        if not adds_up_exactly(confidence, int(num_rows.max())):
            return None
        right, num_classes = truth == guess, len(self.guesses.classes)
        bins = bin_of(confidence, self.num_bins)
        add_up = partial(sums_of_draws, draws=draws)
        true, guessed = (add_up(groups, codes=codes, num_codes=num_classes) for codes in (truth, guess))
        hits = add_up(groups[right], codes=truth[right], num_codes=num_classes)
        sure = add_up(groups, codes=bins, num_codes=self.num_bins, weights=confidence)
        right_of_bin = add_up(groups[right], codes=bins[right], num_codes=self.num_bins)
        occurs = (true + guessed) > 0
        of_classes = {
            "macro_precision": hits / np.maximum(guessed, 1),
            "macro_recall": hits / np.maximum(true, 1),
            "macro_f1": 2 * hits / np.maximum(true + guessed, 1),
        }
        return {
            "accuracy": hits.sum(axis=1) / num_rows,
            **{name: _means_where(occurs, values) for name, values in of_classes.items()},
            "chance_accuracy": true.max(axis=1) / num_rows,
            f"calibration_error_ece{self.num_bins}": np.abs(right_of_bin - sure).sum(axis=1) / num_rows,
        }


def _means_where(chosen: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Means [R] of the chosen values of each row [R, K], added up in the order in which those of one row are."""
    packed = np.take_along_axis(values, np.argsort(~chosen, axis=1, kind="stable"), axis=1)
    counts, means = chosen.sum(axis=1), np.empty(len(values))
    for count in np.unique(counts).tolist():
        means[counts == count] = np.ascontiguousarray(packed[counts == count, :count]).mean(axis=1)
    return means
