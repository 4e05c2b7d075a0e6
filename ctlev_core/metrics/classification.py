"""Accuracy, macro precision, recall and F1 of a classifier, as scikit-learn defines them, and its calibration.

Macro = plain mean over the classes that occur among the targets or the predictions. A class that is never predicted has
precision 0, and one that is predicted but never a target has recall 0. The paper's Table 1 gives accuracy and
precision, without saying how the classes are averaged.

Calibration is the expected calibration error of Guo et al. (ICML 2017), over bins of equal width of the highest
probability. `ctlev_core.scoring.classification` has the scores of each class, the confusion matrix and the bins.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydantic import Field

from ctlev_core.scoring.classification import calibrate, class_scores, read_guesses
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.config import Frozen
from data_contracts.labels import Labels

VERSION = 2
INPUT = "classes"
SCORES = (
    ScoreInfo("accuracy", meaning="share of frames whose class is told right", is_share=True),
    ScoreInfo("macro_", is_share=True),
    ScoreInfo("chance_accuracy", meaning="accuracy of always naming the commonest class", is_share=True),
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


def prepare(predicted: Mapping[str, Any], target: Labels, options: Options) -> Callable[[np.ndarray], dict[str, float]]:
    """The scores of any rows: what resampling asks for many times, with names compared once."""
    guesses = read_guesses(predicted, target)

    def compute_of(rows: np.ndarray) -> dict[str, float]:
        truth, guess = guesses.truth[rows], guesses.guess[rows]
        scores = class_scores(truth, guess, len(guesses.classes))
        occurs = (scores.num_true + scores.num_guessed) > 0
        calibration = calibrate(guesses.confidence[rows], truth == guess, options.calibration_bins)
        return {
            "accuracy": float(np.mean(truth == guess)),
            "macro_precision": float(scores.precision[occurs].mean()),
            "macro_recall": float(scores.recall[occurs].mean()),
            "macro_f1": float(scores.f1[occurs].mean()),
            "chance_accuracy": float(scores.num_true.max() / len(truth)),
            f"calibration_error_ece{options.calibration_bins}": calibration.expected_error,
        }

    return compute_of


def compute_rows(predicted: Mapping[str, Any], target: Labels, options: Options) -> np.ndarray:
    """1 for each correct row and 0 for each wrong one [N]: what intervals are made of."""
    guesses = read_guesses(predicted, target)
    return (guesses.guess == guesses.truth).astype(np.float64)
