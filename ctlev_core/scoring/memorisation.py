"""Does a generator copy? How near its frames lie to training frames, against how near other recorded frames lie to
them.

Other recorded frames are those of other recordings: a frame beside another of the same recording resembles it without
being copied. A generated frame is called close where it is nearer to a training frame than the closest 1 % of the other
recorded frames are to theirs; of a generator that does not copy, about 1 % are. Frames are compared in features of a
network, or as small blurred pictures (`small_pictures`), by Euclidean distance. Both see copies that are mirrored or
shifted badly, and neither says why a frame is close: look at the closest pairs.

A frame is authentic where its nearest training frame has another training frame, of another recording, that is nearer
to it still. Without copying fewer than half of the frames are: of as many independent frames 1/3 in one dimension, .38
in two, and towards 1/2 in many. So the share means something beside that of other recorded frames only.

Sources: Somepalli et al., Diffusion Art or Digital Forgery?, CVPR 2023 (nearest neighbours and their figure); Meehan,
Chaudhuri & Dasgupta, A Non-Parametric Test to Detect Data-Copying in Generative Models, AISTATS 2020 (generated to
training against held-out to training distances; `data_copying`); Alaa et al., How Faithful is your Synthetic Data?,
ICML 2022, section 4.3 (authenticity; there the other training frame may be of the same recording).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from ctlev_core.scoring.data_copying import CopyingTest, assign_cells, data_copying_test
from ctlev_core.scoring.gaussians import check_features, check_same_width
from ctlev_core.statistics.bootstrap import bootstrap_interval, rows_of_groups
from ctlev_core.statistics.small_samples import percentile_levels
from data_contracts.image_rows import Images
from data_contracts.tables import Column, TableSchema

CLOSEST_PAIRS = TableSchema(
    "closest_pairs",
    1,
    None,
    (
        Column("subject", pa.string(), "which generated frames"),
        Column("features", pa.string(), "what frames were compared in"),
        Column("generated_id", pa.string(), "sample_id of a generated frame"),
        Column("training_id", pa.string(), "sample_id of the training frame nearest to it"),
        Column("generated_row", pa.int64(), "row of the generated frame", minimum=0),
        Column("training_row", pa.int64(), "row of the training frame", minimum=0),
        Column("distance", pa.float64(), "Euclidean, in the features", minimum=0),
        Column("threshold", pa.float64(), "the distance that 1 % of other recorded frames lie below", minimum=0),
    ),
)

NEAR_QUANTILE = 0.01
NUM_REPLICATES = 1000
_BLOCK_NUMBERS, _ROWS_AT_ONCE = 4_000_000, 1024
_ROUNDING = 4 * float(np.finfo(np.float64).eps)
"""Of squared distances, relative to the squared norms they are the difference of, for each feature added up."""


@dataclass(frozen=True, eq=False)
class MemorisationCheck:
    """Distances of N generated and M other recorded frames to their nearest training frames.

    Attributes:
        distances: [N] float64, generated to nearest training frame.
        nearest: [N] int64, that training frame; the first where several are equally near.
        real_distances: [M] float64, other recorded to nearest training frame of another recording.
        threshold: quantile `NEAR_QUANTILE` of `real_distances`.
        close_share: share of generated frames nearer than the threshold.
        low: lower end of the 95 % interval of `close_share`, under resampling of the frames and of the recordings.
        high: upper end. Both NaN where there are fewer than two recordings, or generated frames.
        num_duplicates: generated frames equal to a training frame in all features.
        ratio: median of `distances` / median of `real_distances`; NaN where the latter is 0.
        authentic_share: share of generated frames that are authentic; NaN with a single training frame.
        authentic_low: lower end of its 95 % interval, under resampling of the generated frames or their recordings.
        authentic_high: upper end. Both NaN where there are fewer than two.
        copying: C_T.
    """

    distances: np.ndarray
    nearest: np.ndarray
    real_distances: np.ndarray
    threshold: float
    close_share: float
    low: float
    high: float
    num_duplicates: int
    ratio: float
    authentic_share: float
    authentic_low: float
    authentic_high: float
    copying: CopyingTest

    def closest(self, count: int) -> list[tuple[int, int, float]]:
        """The closest (generated row, training row, distance), no training row twice, nearest first."""
        found: list[tuple[int, int, float]] = []
        seen: set[int] = set()
        for row in np.argsort(self.distances, kind="stable").tolist():
            if len(found) == count:
                break
            if int(self.nearest[row]) not in seen:
                seen.add(int(self.nearest[row]))
                found.append((row, int(self.nearest[row]), float(self.distances[row])))
        return found


def check_memorisation(
    generated: np.ndarray,
    training: np.ndarray,
    real: np.ndarray,
    *,
    training_recordings: Sequence[str] | np.ndarray,
    real_recordings: Sequence[str] | np.ndarray,
    generated_recordings: Sequence[str] | np.ndarray | None = None,
    seed: int = 0,
) -> MemorisationCheck:
    """Compare generated with training frames; see the head of this file.

    With fewer than 100 other recorded frames the threshold is hardly more than the smallest of their distances.

    Args:
        generated: [N, D] features, N >= 1.
        training: [T, D] features of the frames the generator learnt from, T >= 1.
        real: [M, D] features of other recorded frames, M >= 1; the training frames themselves may be given again.
        training_recordings: [T] recording of each training frame.
        real_recordings: [M] recording of each other recorded frame; it is not compared with training frames of the
            same.
        generated_recordings: [N] recording of each frame where held-out recorded frames take the place of generated
            ones: it is not compared with training frames of the same, and recordings are resampled in the place of
            frames. None = each frame is its own.
        seed: of the resampling, and of the cells.
    Raises:
        ValueError: shapes do not fit, a set is empty, a value is not finite (names the row), or all training frames are
            of one recording and so is a recorded frame.
    """
    of_training = None if generated_recordings is None else training_recordings
    distances, nearest = nearest_rows(
        generated, training, row_groups=generated_recordings, reference_groups=of_training
    )
    real_distances, _ = nearest_rows(real, training, row_groups=real_recordings, reference_groups=training_recordings)
    threshold = float(np.quantile(real_distances, NEAR_QUANTILE))
    groups = np.arange(len(distances)) if generated_recordings is None else np.asarray(generated_recordings)
    low, high = _interval(distances, real_distances, groups, np.asarray(real_recordings), seed)
    median = float(np.median(real_distances))
    share = authentic_low = authentic_high = float("nan")
    if len(training) > 1:
        authentic = find_authentic(distances, nearest, training, training_recordings).astype(np.float64)
        share = float(authentic.mean())
        authentic_low, authentic_high = bootstrap_interval(authentic, groups, seed=seed)
    cells, real_cells = assign_cells(training, generated, real, seed=seed)
    return MemorisationCheck(
        distances=distances,
        nearest=nearest,
        real_distances=real_distances,
        threshold=threshold,
        close_share=float((distances < threshold).mean()),
        low=low,
        high=high,
        num_duplicates=int(np.count_nonzero(distances == 0)),
        ratio=float(np.median(distances)) / median if median > 0 else float("nan"),
        authentic_share=share,
        authentic_low=authentic_low,
        authentic_high=authentic_high,
        copying=data_copying_test(
            distances,
            real_distances,
            cells=cells,
            real_cells=real_cells,
            groups=groups,
            real_groups=real_recordings,
            seed=seed,
        ),
    )


def find_authentic(
    distances: np.ndarray, nearest: np.ndarray, training: np.ndarray, training_recordings: Sequence[str] | np.ndarray
) -> np.ndarray:
    """Which frames [N] bool are farther from their nearest training frame than another training frame is from it.

    Args:
        distances: [N] to the nearest training frame.
        nearest: [N] that training frame.
        training: [T, D] features of the training frames, T >= 2.
        training_recordings: [T] recording of each: the other training frame is of another one, unless there is one
            recording alone.
    """
    recordings = np.asarray(training_recordings)
    groups = recordings if len(np.unique(recordings)) > 1 else np.arange(len(training))
    used, places = np.unique(nearest, return_inverse=True)
    radii, _ = nearest_rows(training[used], training, row_groups=groups[used], reference_groups=groups)
    return radii[places] < distances


def nearest_rows(
    rows: np.ndarray,
    references: np.ndarray,
    *,
    row_groups: Sequence[str] | np.ndarray | None = None,
    reference_groups: Sequence[str] | np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest reference of each row, exactly: equal rows have distance 0.

    Matrix products name the candidates, blocks of both sets at a time, so that memory does not grow with them; their
    distances are then computed from differences.

    Args:
        rows: [N, D].
        references: [M, D].
        row_groups: [N], or None; a row is not compared with references of its own group.
        reference_groups: [M], or None.
    Returns:
        Euclidean distances [N] float64 and the numbers [N] int64 of the references, the first of equally near ones.
    Raises:
        ValueError: shapes do not fit, a set is empty, a value is not finite (names the row), or a row has no reference
            of another group.
    """
    rows = check_features(rows, "first", least_rows=1)
    references = check_features(references, "second", least_rows=1)
    check_same_width(rows, references)
    groups = _numbers_of_groups(row_groups, reference_groups, len(rows), len(references))
    distances, nearest = np.empty(len(rows)), np.empty(len(rows), np.int64)
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        block = rows[start : start + _ROWS_AT_ONCE].astype(np.float64)
        own = None if groups is None else (groups[0][start : start + _ROWS_AT_ONCE], groups[1])
        for row, chosen in enumerate(_candidates(block, references, own)):
            if len(chosen) == 0:
                raise ValueError(f"row {start + row} has no reference of another group")
            distances[start + row], nearest[start + row] = _nearest_of(block[row], references, chosen)
    return distances, nearest


def _candidates(
    rows: np.ndarray, references: np.ndarray, groups: tuple[np.ndarray, np.ndarray] | None
) -> list[np.ndarray]:
    """For each row [N, D] the references that may be the nearest, ascending, some at a time as float64."""
    origin = references[0].astype(np.float64)
    rows = rows - origin
    norms = np.einsum("nd,nd->n", rows, rows)
    least = np.full(len(rows), np.inf)
    found = []
    step = max(1, _BLOCK_NUMBERS // max(rows.shape))
    for start in range(0, len(references), step):
        centred = references[start : start + step] - origin
        squared = norms[:, None] + np.einsum("nd,nd->n", centred, centred)
        slack = _ROUNDING * rows.shape[1] * squared
        squared -= 2 * (rows @ centred.T)
        if groups is not None:
            squared[groups[0][:, None] == groups[1][start : start + step]] = np.inf
        # No reference that is farther than another by more than rounding can be the nearest.
        least = np.minimum(least, (squared + slack).min(axis=1))
        lower = squared - slack
        near, number = np.nonzero((lower <= least[:, None]) & np.isfinite(squared))
        found.append((near, number + start, lower[near, number]))
    near, number, lower = (np.concatenate(parts) for parts in zip(*found, strict=True))
    chosen = lower <= least[near]
    near, number = near[chosen], number[chosen]
    order = np.argsort(near, kind="stable")
    return np.split(number[order], np.searchsorted(near[order], np.arange(1, len(rows))))


def small_pictures(frames: Images, size: int = 32, blur: float = 1.0) -> np.ndarray:
    """Features of frames without a network: scaled down to `size` px along the longer side and blurred.

    The mean of the absolute or squared difference of event images punishes a shift of one pixel as much as another
    scene; small and blurred, neighbours resemble one another.

    Args:
        frames: [N, H, W, 3] uint8.
        size: px.
        blur: standard deviation of the Gaussian, px of the small picture; 0 = none.
    Returns:
        [N, D] float32 in 0 .. 1.
    Raises:
        ValueError: another shape or dtype, or no frame.
    """
    import cv2

    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8 or 0 in frames.shape:
        raise ValueError(f"frames must be [N, H, W, 3] uint8, not empty, got {frames.shape} {frames.dtype}")
    height, width = frames.shape[1:3]
    scale = min(1.0, size / max(height, width))
    small_size = max(1, round(width * scale)), max(1, round(height * scale))
    pictures = np.empty((len(frames), small_size[1], small_size[0], 3), np.float32)
    for row, frame in enumerate(frames):
        small = cv2.resize(frame.astype(np.float32) / 255, small_size, interpolation=cv2.INTER_AREA)
        pictures[row] = cv2.GaussianBlur(small, (0, 0), blur) if blur > 0 else small
    return pictures.reshape(len(frames), -1)


def _numbers_of_groups(
    row_groups: Sequence[str] | np.ndarray | None,
    reference_groups: Sequence[str] | np.ndarray | None,
    num_rows: int,
    num_references: int,
) -> tuple[np.ndarray, np.ndarray] | None:
    if row_groups is None and reference_groups is None:
        return None
    if row_groups is None or reference_groups is None:
        raise ValueError("groups are needed of both sets, or of none")
    first, second = np.asarray(row_groups), np.asarray(reference_groups)
    if first.shape != (num_rows,) or second.shape != (num_references,):
        raise ValueError(f"groups must be [{num_rows}] and [{num_references}], got {first.shape} and {second.shape}")
    numbers = np.unique(np.concatenate([first, second]), return_inverse=True)[1]
    return numbers[:num_rows], numbers[num_rows:]


def _nearest_of(row: np.ndarray, references: np.ndarray, chosen: np.ndarray) -> tuple[float, int]:
    """Distance and number of the nearest of some references."""
    best, number = np.inf, -1
    step = max(1, _BLOCK_NUMBERS // len(row))
    for start in range(0, len(chosen), step):
        part = chosen[start : start + step]
        distances = np.linalg.norm(references[part] - row, axis=1)
        first = int(np.argmin(distances))
        if distances[first] < best:
            best, number = float(distances[first]), int(part[first])
    return best, number


def _interval(
    distances: np.ndarray, real: np.ndarray, groups: np.ndarray, recordings: np.ndarray, seed: int
) -> tuple[float, float]:
    """Interval of the share of close frames over replicates of both sets, of whole groups and recordings."""
    own, others = rows_of_groups(groups), rows_of_groups(recordings)
    if min(len(own), len(others)) < 2:
        return float("nan"), float("nan")
    rng = np.random.default_rng(seed)
    shares = np.empty(NUM_REPLICATES)
    for replicate in range(NUM_REPLICATES):
        threshold = np.quantile(real[_draw(others, rng)], NEAR_QUANTILE)
        shares[replicate] = (distances[_draw(own, rng)] < threshold).mean()
    low, high = np.quantile(shares, percentile_levels(min(len(own), len(others))))
    return float(low), float(high)


def _draw(members: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """The rows of as many groups as there are, drawn with replacement."""
    drawn = rng.integers(0, len(members), len(members))
    if max(map(len, members)) == 1:
        return np.concatenate(members)[drawn]
    return np.concatenate([members[number] for number in drawn])
