"""Classes that a generator has not seen: test sets of one class against the others, and what seen class is nearest.

Source: the paper's section 4.1 and Table 5 (binary classification on ten unseen classes of N-Caltech101; the nearest
seen class by the cosine similarity of text embeddings). It does not say how negatives are chosen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def balanced_accuracy(is_positive: np.ndarray, is_called_positive: np.ndarray) -> float:
    """Mean of the shares of positives and of negatives that are told right; 0.5 is chance.

    That is the expected accuracy with as many negatives as positives, drawn at random: no draw is needed, and none adds
    noise.

    Args:
        is_positive: [N] bool.
        is_called_positive: [N] bool.
    Raises:
        ValueError: shapes differ, or there is no positive or no negative.
    """
    is_positive, called = np.asarray(is_positive, bool), np.asarray(is_called_positive, bool)
    if is_positive.shape != called.shape or is_positive.ndim != 1:
        raise ValueError(f"both must be [N], got {is_positive.shape} and {called.shape}")
    if is_positive.all() or not is_positive.any():
        raise ValueError(f"needs positives and negatives, got {is_positive.sum()} and {(~is_positive).sum()}")
    return float((called[is_positive].mean() + (~called[~is_positive]).mean()) / 2)


def nearest_seen_classes(
    unseen: np.ndarray, seen: np.ndarray, seen_names: Sequence[str], *, count: int = 1
) -> list[list[tuple[str, float]]]:
    """For each unseen class the seen ones with the most similar text embeddings, the nearest first.

    Args:
        unseen: [U, D] text embeddings, of any length but zero.
        seen: [S, D] text embeddings from the same encoder.
        seen_names: [S] their names; of equally similar ones the first comes first.
        count: how many to name, at most S.
    Returns:
        U lists of (name, cosine similarity).
    Raises:
        ValueError: shapes differ, or an embedding is zero or not finite.
    """
    unit = []
    for name, embeddings in (("unseen", unseen), ("seen", seen)):
        embeddings = np.asarray(embeddings, dtype=np.float64)
        if embeddings.ndim != 2 or not len(embeddings):
            raise ValueError(f"{name} embeddings must be [N, D] with N > 0, got {embeddings.shape}")
        lengths = np.linalg.norm(embeddings, axis=1, keepdims=True)
        usable = np.isfinite(lengths[:, 0]) & (lengths[:, 0] > 0)
        if not usable.all():
            raise ValueError(f"{name} embedding of row {int(np.argmin(usable))} is zero or not finite")
        unit.append(embeddings / lengths)
    if unit[0].shape[1] != unit[1].shape[1] or len(unit[1]) != len(seen_names):
        raise ValueError(
            f"embeddings must have one length and seen ones a name each, got {unit[0].shape}, {unit[1].shape} and "
            f"{len(seen_names)} names"
        )
    similarity = unit[0] @ unit[1].T
    order = np.argsort(-similarity, axis=1, kind="stable")[:, :count]
    names = list(seen_names)
    return [
        [(names[column], float(np.clip(row[column], -1, 1))) for column in columns]
        for row, columns in zip(similarity, order.tolist(), strict=True)
    ]
