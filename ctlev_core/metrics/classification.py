"""Accuracy, macro precision and macro recall of a classifier, as scikit-learn defines them.

Macro = plain mean over the classes that occur among the targets or the predictions. A class that is never predicted has
precision 0, and one that is predicted but never a target has recall 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from data_contracts.config import Frozen
from data_contracts.labels import Labels

VERSION = 1
INPUT = "classes"


class Options(Frozen):
    """None: the scores have no parameters."""


def compute(predicted: Mapping[str, Any], target: Labels, options: Options) -> dict[str, float]:
    """`accuracy`, `macro_precision`, `macro_recall`, and `chance_accuracy`, that of always naming the commonest class.

    Args:
        predicted: `probability` [N, K] and `classes` [K], the names of the columns; of equal maxima the first wins.
        target: N rows with class names. A class the model does not know counts as an error.
        options: none.
    Returns:
        Fractions in [0, 1].
    Raises:
        ValueError: shapes differ, there are no rows, a target has no class, or a probability is not finite.
    """
    names = _predicted_names(predicted, target)
    classes, index = np.unique(np.concatenate([names, np.array(target.class_names)]), return_inverse=True)
    guess, truth = np.split(index, 2)
    hits = np.bincount(truth[guess == truth], minlength=len(classes))
    guessed, true = (np.bincount(column, minlength=len(classes)) for column in (guess, truth))
    return {
        "accuracy": float(np.mean(guess == truth)),
        "macro_precision": float(np.mean(hits / np.maximum(guessed, 1))),
        "macro_recall": float(np.mean(hits / np.maximum(true, 1))),
        "chance_accuracy": float(true.max() / len(truth)),
    }


def compute_rows(predicted: Mapping[str, Any], target: Labels, options: Options) -> np.ndarray:
    """1 for each correct row and 0 for each wrong one [N]: what intervals are made of."""
    return (_predicted_names(predicted, target) == np.array(target.class_names)).astype(np.float64)


def _predicted_names(predicted: Mapping[str, Any], target: Labels) -> np.ndarray:
    probability = np.asarray(predicted["probability"])
    classes = np.asarray(predicted["classes"])
    if not len(target):
        raise ValueError("there is no row to score")
    if probability.shape != (len(target), len(classes)):
        raise ValueError(f"probability must be [{len(target)}, {len(classes)}], got {probability.shape}")
    if not np.isfinite(probability).all():
        raise ValueError(f"probability of row {int(np.argwhere(~np.isfinite(probability))[0][0])} is not finite")
    if "" in target.class_names:
        raise ValueError(f"target row {target.class_names.index('')} has no class name")
    return classes[probability.argmax(axis=1)]
