"""How well generated event images match the real ones of the same pairs: what chooses among checkpoints.

Events of single pixels are random; what a window's motion fixes is how many there are where, and how sparse they lie.
The comparison is therefore one of blocks.
"""

from __future__ import annotations

import math

import numpy as np

BLOCK_PX = 8


def local_statistics_error(generated: np.ndarray, real: np.ndarray) -> float:
    """Mean of two relative errors over blocks of 8 x 8 px: of the local event rate and of the share of active pixels.

    Args:
        generated: [N, H, W, 3] uint8.
        real: [N, H, W, 3] uint8.
    Returns:
        sum |generated - real| / sum real of the block means, averaged over the two: 0 where both agree in every block,
        1 for images without events, up to 2 for the right number of events in the wrong places; infinity where events
        were generated and none are real.
    """
    errors = []
    for statistic in (_as_rate, _as_activity):
        expected, got = _block_means(statistic(real)), _block_means(statistic(generated))
        difference, total = np.abs(got - expected).sum(), expected.sum()
        errors.append(difference / total if total else math.inf if difference else 0.0)
    return float(np.mean(errors))


def _as_rate(frames: np.ndarray) -> np.ndarray:
    return frames.astype(np.float64)


def _as_activity(frames: np.ndarray) -> np.ndarray:
    return (frames > 0).astype(np.float64)


def _block_means(values: np.ndarray) -> np.ndarray:
    """[N, h, w, 3] means of blocks; those at the right and lower edge may be smaller."""
    _, height, width, _ = values.shape
    rows, columns = np.arange(0, height, BLOCK_PX), np.arange(0, width, BLOCK_PX)
    sums = np.add.reduceat(np.add.reduceat(values, rows, axis=1), columns, axis=2)
    counts = np.diff([*rows, height])[:, None] * np.diff([*columns, width])
    return sums / counts[None, :, :, None]
