"""Scores of a classifier: per class, confusion matrix, calibration; what the classification metrics share.

Source: scikit-learn's definitions, with `zero_division=0`; Guo et al., On Calibration of Modern Neural Networks, ICML
2017 (expected calibration error).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from data_contracts.labels import Labels


@dataclass(frozen=True, eq=False)
class Guesses:
    """Classes as numbers: those the model knows first, in its order, then others that occur among the targets, sorted.

    Attributes:
        classes: [K] names.
        truth: [N] int64, the class of each row.
        guess: [N] int64, the one with the highest probability; of equal ones the first.
        confidence: [N] float64, that probability.
    """

    classes: np.ndarray
    truth: np.ndarray
    guess: np.ndarray
    confidence: np.ndarray


@dataclass(frozen=True, eq=False)
class ClassScores:
    """Scores [K] of each class; 0 where a class is never predicted, or never a target.

    Attributes:
        precision: of the rows predicted as the class, the share that are of it.
        recall: of the rows of the class, the share predicted as it.
        f1: harmonic mean of the two.
        num_true: rows of the class.
        num_guessed: rows predicted as the class.
    """

    precision: np.ndarray
    recall: np.ndarray
    f1: np.ndarray
    num_true: np.ndarray
    num_guessed: np.ndarray


@dataclass(frozen=True, eq=False)
class Calibration:
    """A reliability diagram over bins of equal width, the last with its upper edge 1.

    Attributes:
        count: [B] rows whose confidence lies in the bin: above its lower edge, up to its upper one.
        confidence: [B] their mean confidence, 0 in an empty bin.
        accuracy: [B] the share of them that is right, 0 in an empty bin.
        expected_error: mean over rows of |accuracy - confidence| of their bin (ECE).
    """

    count: np.ndarray
    confidence: np.ndarray
    accuracy: np.ndarray
    expected_error: float


def read_guesses(predicted: Mapping[str, Any], target: Labels) -> Guesses:
    """What a classifier says, and what is true.

    Args:
        predicted: `probability` [N, K] in [0, 1] and `classes` [K], the names of the columns.
        target: N rows with class names. A class the model does not know counts as an error.
    Raises:
        ValueError: shapes differ, there are no rows, a target has no class, a column's name occurs twice, or a
            probability is not finite or outside [0, 1].
    """
    probability, classes = np.asarray(predicted["probability"]), np.asarray(predicted["classes"])
    if not len(target):
        raise ValueError("there is no row to score")
    if probability.shape != (len(target), len(classes)):
        raise ValueError(f"probability must be [{len(target)}, {len(classes)}], got {probability.shape}")
    if len(set(classes.tolist())) != len(classes):
        raise ValueError(f"classes must differ from one another, got {classes.tolist()}")
    if not np.isfinite(probability).all():
        raise ValueError(f"probability of row {int(np.argwhere(~np.isfinite(probability))[0][0])} is not finite")
    # Rounding of a softmax in half precision stays below a thousandth; logits do not.
    outside = ((probability < -1e-3) | (probability > 1 + 1e-3)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        raise ValueError(f"probability of row {row} must lie in [0, 1], got {probability[row].tolist()}")
    if "" in target.class_names:
        raise ValueError(f"target row {target.class_names.index('')} has no class name")
    columns = {name: column for column, name in enumerate(classes.tolist())}
    for name in sorted(set(target.class_names) - set(columns)):
        columns[name] = len(columns)
    guess = probability.argmax(axis=1)
    confidence = np.take_along_axis(probability, guess[:, None], axis=1)[:, 0].astype(np.float64)
    truth = np.array([columns[name] for name in target.class_names], dtype=np.int64)
    return Guesses(np.array(list(columns)), truth, guess.astype(np.int64), confidence)


def class_scores(truth: np.ndarray, guess: np.ndarray, num_classes: int) -> ClassScores:
    """Scores of each class, from class numbers [N] below `num_classes`."""
    hits, true, guessed = (
        np.bincount(column, minlength=num_classes) for column in (truth[truth == guess], truth, guess)
    )
    return ClassScores(
        precision=hits / np.maximum(guessed, 1),
        recall=hits / np.maximum(true, 1),
        f1=2 * hits / np.maximum(true + guessed, 1),
        num_true=true,
        num_guessed=guessed,
    )


def calibrate(confidence: np.ndarray, is_right: np.ndarray, num_bins: int) -> Calibration:
    """Compare confidences [N] in [0, 1] with how often they are right [N]."""
    index = bin_of(confidence, num_bins)
    count = np.bincount(index, minlength=num_bins)
    sums = [np.bincount(index, weights=column, minlength=num_bins) for column in (confidence, is_right)]
    return Calibration(
        count=count,
        confidence=sums[0] / np.maximum(count, 1),
        accuracy=sums[1] / np.maximum(count, 1),
        expected_error=float(np.abs(sums[1] - sums[0]).sum() / max(len(confidence), 1)),
    )


def bin_of(confidence: np.ndarray, num_bins: int) -> np.ndarray:
    """The bin [N] of `Calibration` that each confidence [N] lies in."""
    return np.searchsorted(np.arange(1, num_bins) / num_bins, confidence, side="left")


def adds_up_exactly(confidence: np.ndarray, num_rows: int) -> bool:
    """Are sums of up to `num_rows` of the confidences [N] exact in float64, so that their order changes nothing?

    Those that were float32 mostly are: all are multiples of a power of two that leaves room for the sum in 53 bits.
    """
    fraction_bits = 51 - num_rows.bit_length()
    scaled = np.ldexp(confidence, fraction_bits)
    return bool((scaled == np.floor(scaled)).all())
