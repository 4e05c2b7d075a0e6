"""How far sampled frames are from recorded frames, from a reference's frames, and image by image from a solution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ctlev_core import plugins
from ctlev_core.statistics.bootstrap import MIN_RECORDINGS, bootstrap_interval
from ctlev_core.statistics.feature_distances import DistanceEstimate, estimate_distances
from data_contracts.labels import Labels

HELD_OUT, REFERENCE, CONVERGED, LABELS = (
    "held-out recorded frames",
    "reference",
    "converged solution",
    "labels asked for",
)
EXACT, FLOAT64 = "exact solution", "float64"
"""What is compared with."""
FD, KID = "fd_event", "kid"
OF_HALVES = "_halves"
"""Ends the name of a distance between halves of the sets, which compares with the floor: that of the reference's own
halves, as small and as biased."""
EXCESS = "_excess"
"""Ends the name of a distance minus that of the reference, over the same conditions, seeds and recorded frames: what
these have in common falls out, so that its interval is much narrower than that of either distance."""
PIXEL_RMS, PIXEL_MAX = "pixel_rms_levels", "pixel_max_levels"
LATENT_ERROR = "relative_latent_error"
WASSERSTEIN, TRAJECTORY = "wasserstein_1", "trajectory_rms"
WALL, CPU = "wall_seconds", "cpu_seconds"
CONTROLNET = "controlnet_evaluations"


@dataclass(frozen=True)
class Measurement:
    """One number with its 95 % interval (NaN = not known): `metric`, with its unit, against something."""

    metric: str
    against: str
    value: float
    num_samples: int
    low: float = float("nan")
    high: float = float("nan")


@dataclass(frozen=True, eq=False)
class FeatureSet:
    """Features [N, D] of frames, and which of them are not independent: groups [N] are condition or recording."""

    features: np.ndarray
    groups: np.ndarray


def feature_errors(sampled: FeatureSet, real: FeatureSet, reference: FeatureSet | None) -> list[Measurement]:
    """Frechet and kernel distances to held-out recorded frames and, unless None, to the frames of the reference.

    Distances to the reference are given between halves too, since those between the reference's own halves, `floors`,
    are what a sampler of the same distribution would get; and where the rows are those of the reference's first rows,
    how much farther they are from recorded frames than the reference, in pairs.
    """
    found = []
    for against, target in ((HELD_OUT, real), (REFERENCE, reference)):
        if target is None:
            continue
        for name, estimate in _estimates(sampled, target).items():
            count = estimate.num_predicted
            found.append(Measurement(name, against, estimate.value, count, estimate.low, estimate.high))
            if against == REFERENCE and not np.isnan(estimate.halved):
                found.append(Measurement(name + OF_HALVES, against, estimate.halved, count))
    if reference is not None and np.array_equal(sampled.groups, reference.groups[: len(sampled.groups)]):
        found += _excess(sampled, reference, real)
    return found


def _excess(sampled: FeatureSet, reference: FeatureSet, real: FeatureSet) -> list[Measurement]:
    """Distances to recorded frames minus those of the reference, every half cut through both alike."""
    width = sampled.features.shape[1]

    def compute(first: np.ndarray, second: np.ndarray) -> dict[str, float]:
        own, other = (_distances(first[:, side], second[:, side]) for side in (slice(width), slice(width, None)))
        return {name: own[name] - other[name] for name in own}

    beside = np.concatenate([sampled.features, reference.features[: len(sampled.features)]], axis=1)
    targets = np.tile(real.features, 2)
    estimates = estimate_distances(compute, beside, targets, predicted_groups=sampled.groups, target_groups=real.groups)
    return [
        Measurement(name + EXCESS, HELD_OUT, estimate.value, estimate.num_predicted, estimate.low, estimate.high)
        for name, estimate in estimates.items()
    ]


def floors(reference: FeatureSet) -> list[Measurement]:
    """Distances between halves of the reference's own frames: mean, and 95 % of the random halves."""
    return [
        Measurement(name + OF_HALVES, REFERENCE, e.floor, e.num_target, e.floor_low, e.floor_high)
        for name, e in _estimates(reference, reference).items()
        if not np.isnan(e.floor)
    ]


def _estimates(sampled: FeatureSet, target: FeatureSet) -> Mapping[str, DistanceEstimate]:
    return estimate_distances(
        _distances, sampled.features, target.features, predicted_groups=sampled.groups, target_groups=target.groups
    )


def _distances(first: np.ndarray, second: np.ndarray) -> dict[str, float]:
    frechet, kernel = (plugins.load("metrics", name) for name in ("frechet", "kid"))
    fd = frechet.compute(first, second, frechet.Options())["fd"]
    return {FD: fd, KID: kernel.compute(first, second, kernel.Options())["kid"]}


def pixel_error(frames: np.ndarray, solution: np.ndarray, groups: Sequence[str]) -> Measurement:
    """Root mean square difference of frames [N, H, W, 3] uint8, image by image, in grey levels of 255.

    Args:
        frames: from some noise.
        solution: from the same noise, row by row.
        groups: [N] the interval is over.
    """
    squared = np.square(frames.astype(np.float64) - solution).reshape(len(frames), -1).mean(axis=1)
    low = high = float("nan")
    if len(set(groups)) >= MIN_RECORDINGS:
        low, high = bootstrap_interval(squared, groups)
    value, low, high = (float(np.sqrt(mean)) for mean in (squared.mean(), low, high))
    return Measurement(PIXEL_RMS, CONVERGED, value, len(frames), low, high)


def label_error(metric: plugins.Plugin, prediction: Mapping[str, np.ndarray], labels: Labels) -> Measurement:
    """The first score of a metric plug-in of what a model trained on recorded frames sees: agreement of labels."""
    name, value = next(iter(metric.module.compute(prediction, labels, metric.options).items()))
    return Measurement(name, LABELS, float(value), len(labels))


def costs(wall_seconds: np.ndarray, cpu_seconds: np.ndarray, controlnet_evaluations: np.ndarray) -> list[Measurement]:
    """Median time an image, with the quartiles over images, and evaluations of the ControlNet an image."""
    found = []
    for name, seconds in ((WALL, wall_seconds), (CPU, cpu_seconds)):
        middle, low, high = (float(value) for value in np.quantile(seconds, [0.5, 0.25, 0.75]))
        found.append(Measurement(name, "", middle, len(seconds), low, high))
    mean = float(np.mean(controlnet_evaluations))
    return [*found, Measurement(CONTROLNET, "", mean, len(controlnet_evaluations))]
