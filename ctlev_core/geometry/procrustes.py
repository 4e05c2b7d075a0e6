"""The similarity that brings one set of points closest to another, for many sets at once, safe for degenerate ones."""

from __future__ import annotations

import numpy as np

RELATIVE_SIZE = 1e-12
"""Points whose spread is less than this share of their distance from the origin are one point to float64."""


def align_similarity(points: np.ndarray, target: np.ndarray, known: np.ndarray) -> np.ndarray:
    """`points` turned, scaled and moved onto `target`, the sum of squared distances over known points at its least.

    Never a reflection. Points that all coincide keep no shape and come out at the mean of the target; collinear points
    leave the turn about their line open, and any of the best ones is taken. Where the best scale would be negative it
    is zero.

    Args:
        points: [N, J, 3] float.
        target: [N, J, 3] float; may be NaN where not known.
        known: [N, J] bool; points that count. A row without any is only returned as it is.
    Returns:
        [N, J, 3] float64, all points, known or not.
    Raises:
        ValueError: shapes differ.
    Source: Umeyama, IEEE TPAMI 1991, eq. 34-43. Event-HPE's own function returns NaN for coinciding points and takes
    batches of two or three poses for transposed ones.
    """
    from ctlev_core.geometry.procrustes_kernels import align_rows

    if points.shape != target.shape or points.ndim != 3 or points.shape[2] != 3 or known.shape != points.shape[:2]:
        raise ValueError(
            f"points and target must be [N, J, 3] and known [N, J], got {points.shape}, {target.shape}, {known.shape}"
        )
    aligned = np.empty(points.shape)
    align_rows(
        _floating(points), _floating(target), np.ascontiguousarray(known, dtype=np.bool_), RELATIVE_SIZE, aligned
    )
    return aligned


def _floating(array: np.ndarray) -> np.ndarray:
    """Sums are float64 in any case; float32 need not be copied for that."""
    return np.ascontiguousarray(array, dtype=np.float32 if array.dtype == np.float32 else np.float64)
