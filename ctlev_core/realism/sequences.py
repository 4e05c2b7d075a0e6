"""What consecutive event images are like in numbers: do they change in time as recorded ones do?

A pixel's value is its largest channel, and it is active from `ACTIVE_VALUE` on, as in `realism.summary`. Numbers of
stretches (`realism.stretches`) of L frames, N_t = active pixels of frame t:

    rate_correlation_lagK   1 - D_K / (2 V), D_K = mean of (N_t+K - N_t)^2, V = variance of N_t within a stretch (L - 1
                            in the divisor), both means over stretches: 1 = the same in every frame, and without any
                            order in time exactly 0 on average, however short stretches are
    persistent_share        active pixels with an active one within 1 px in the next frame / active pixels
    still_active_share      active pixels / pixels, of still ones: those that are farther from the skeleton than
                            `STILL_DISTANCE` of the shorter side of the image in all frames of the stretch
    still_repeat_ratio      still pixels that are active in two consecutive frames / those that would be if all still
                            pixels were alike and frames independent: 1 = by chance, more = the same pixels again
    flow_agreement          cosine of the angle between the optical flow from a frame to the next, around the middle of
                            a joint's two places, and the joint's displacement; mean weighted by that, over joints that
                            move by more than `LEAST_DISPLACEMENT_PX`: 1 = along, 0 = anywhere, -1 = backwards
    polarity_kept_share     active pixels that, moved along the flow, have the sign of the events within 1 px there /
                            those whose events there have a sign; of images with polarity

Each is a quotient of two sums over stretches, and its interval one over recordings. A number without anything to
measure (no joints, grey images, nothing active) is left out.

Sources: 1 - D / (2 V) is the autocorrelation of a variogram, as von Neumann's ratio (Annals of Mathematical Statistics
12, 1941) has it; the flow is that of `ctlev_core.geometry.image_flow`.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ctlev_core.geometry.image_flow import ImageFlow, image_flow
from ctlev_core.realism.distances import Estimate
from ctlev_core.realism.summary import ACTIVE_VALUE
from ctlev_core.statistics.bootstrap import MIN_RECORDINGS, ratio_bootstrap

LAGS = (1, 2, 4)
STILL_DISTANCE = 1 / 8
LEAST_DISPLACEMENT_PX = 0.5
"""Of the image on which the flow is estimated. Slower joints are lost in what the pixels round off."""
FLOW_RADIUS_PX = 2

Sums = Mapping[str, tuple[float, float]]
"""Numerator and denominator of each number."""


@dataclass(frozen=True, eq=False)
class LabelledJoints:
    """The joints of the frames of a stretch.

    Attributes:
        joints2d: [L, J, 2] px of the frames, (x right, y down), pixel centres at integer + 0.5; NaN = unknown.
        joint_set: a key of `ctlev_core.geometry.joint_sets.JOINT_SETS`.
    """

    joints2d: np.ndarray
    joint_set: str


def measure_stretch(frames: np.ndarray, labelled: LabelledJoints | None = None) -> dict[str, tuple[float, float]]:
    """What one stretch adds to numerator and denominator of each number; see the head of this file.

    Args:
        frames: [L, H, W, C] uint8, L of 2 or more; two channels are positive and negative events.
        labelled: joints in each frame; None leaves out what needs them.
    Raises:
        ValueError: frames or joints have another shape or dtype.
    """
    if frames.ndim != 4 or len(frames) < 2 or frames.dtype != np.uint8 or 0 in frames.shape:
        raise ValueError(f"a stretch must be [2 frames or more, H, W, C] uint8, got {frames.shape} {frames.dtype}")
    values = frames.max(axis=-1)
    active = values >= ACTIVE_VALUE
    sums = _rate_correlations(active) | {"persistent_share": _persistence(active)}
    flows = [image_flow(first, second) for first, second in itertools.pairwise(values)]
    if frames.shape[-1] == 2:
        sums["polarity_kept_share"] = _kept_polarity(frames, active, flows)
    if labelled is not None:
        if labelled.joints2d.shape[:1] + labelled.joints2d.shape[2:] != (len(frames), 2):
            raise ValueError(f"joints must be [{len(frames)}, J, 2], got {labelled.joints2d.shape}")
        sums["flow_agreement"] = _flow_agreement(flows, labelled.joints2d, values.shape[1:])
        sums |= _still_pixels(active, labelled)
    return sums


def estimate_numbers(stretches: Sequence[Sums], names: Sequence[str], seed: int = 0) -> dict[str, Estimate]:
    """The numbers of a set of stretches, with 95 % intervals under resampling of recordings.

    Args:
        stretches: what each stretch adds, as `measure_stretch` returns it.
        names: recording of each.
        seed: of the resampling.
    Returns:
        By name; intervals are NaN with fewer than `MIN_RECORDINGS` recordings. Empty without stretches.
    """
    found: dict[str, Estimate] = {}
    for name in dict.fromkeys(name for sums in stretches for name in sums):
        pairs = np.array([sums.get(name, (0.0, 0.0)) for sums in stretches])
        numerator, denominator = pairs.sum(axis=0).tolist()
        if denominator <= 0:
            continue
        measured = np.array(names, str)[pairs[:, 1] > 0]
        low, high = {}, {}
        if len(set(measured.tolist())) >= MIN_RECORDINGS:
            low, high = ratio_bootstrap({name: (pairs[:, 0], pairs[:, 1])}, names, seed=seed)
        nan = float("nan")
        found[name] = Estimate(numerator / denominator, low.get(name, nan), high.get(name, nan))
    return found


def _rate_correlations(active: np.ndarray) -> dict[str, tuple[float, float]]:
    counts = active.sum(axis=(1, 2)).astype(np.float64)
    variance = float(counts.var(ddof=1))
    return {
        f"rate_correlation_lag{lag}": (variance - float(np.mean((counts[lag:] - counts[:-lag]) ** 2)) / 2, variance)
        for lag in LAGS
        if lag < len(counts)
    }


def _persistence(active: np.ndarray) -> tuple[float, float]:
    import cv2

    around = np.stack([cv2.dilate(frame.astype(np.uint8), np.ones((3, 3), np.uint8)) for frame in active[1:]]) > 0
    return float(np.count_nonzero(active[:-1] & around)), float(np.count_nonzero(active[:-1]))


def _still_pixels(active: np.ndarray, labelled: LabelledJoints) -> dict[str, tuple[float, float]]:
    """Nothing where a joint is not known: it might be anywhere."""
    if not np.isfinite(labelled.joints2d).all():
        return {}
    still = _far_from_skeletons(labelled, active.shape[1:])
    num_still = int(np.count_nonzero(still))
    if not num_still:
        return {}
    quiet = active[:, still]
    counts = quiet.sum(axis=1).astype(np.float64)
    expected = float((counts[1:] * counts[:-1]).sum() / num_still)
    return {
        "still_active_share": (float(counts.sum()), float(quiet.size)),
        "still_repeat_ratio": (float(np.count_nonzero(quiet[1:] & quiet[:-1])), expected),
    }


def _far_from_skeletons(labelled: LabelledJoints, image_size: tuple[int, ...]) -> np.ndarray:
    """[H, W] bool: pixels that are far from every joint and limb in all frames."""
    import cv2

    from ctlev_core.render.skeleton import draw_skeleton  # here, because images without joints need no skeleton

    height, width = image_size
    is_known = np.ones(labelled.joints2d.shape[1], bool)
    drawn = [draw_skeleton(joints, is_known, labelled.joint_set, (width, height)) for joints in labelled.joints2d]
    elsewhere = (~np.any(drawn, axis=(0, 3))).astype(np.uint8)
    if elsewhere.all():
        return np.zeros((height, width), bool)  # the person is outside of the image: nothing says how far
    distance = cv2.distanceTransform(elsewhere, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return distance > STILL_DISTANCE * min(height, width)


def _flow_agreement(
    flows: Sequence[ImageFlow], joints2d: np.ndarray, image_size: tuple[int, ...]
) -> tuple[float, float]:
    import cv2

    agreed = total = 0.0
    for flow, before, after in zip(flows, joints2d[:-1], joints2d[1:], strict=True):
        moved = (after - before).astype(np.float64) / flow.factor
        with np.errstate(invalid="ignore"):  # unknown joints are not numbers
            speed = np.linalg.norm(moved, axis=-1)
            places = np.floor((before + after) / (2 * flow.factor))
            limits = np.array(flow.vectors.shape[1::-1])
            chosen = (speed > LEAST_DISPLACEMENT_PX) & ((places >= 0) & (places < limits)).all(axis=-1)
        x, y = places[chosen].astype(np.int64).T
        side = 2 * FLOW_RADIUS_PX + 1
        around = cv2.boxFilter(flow.vectors, -1, (side, side), borderType=cv2.BORDER_REPLICATE)[y, x]
        length = np.linalg.norm(around.astype(np.float64), axis=-1)
        # Where nothing is seen to move the cosine is 0: neither along nor backwards.
        scale = np.divide(1, length, out=np.zeros_like(length), where=length > 1e-3)
        agreed += float((scale * (around * moved[chosen]).sum(axis=-1)).sum())
        total += float(speed[chosen].sum())
    return agreed, total


def _kept_polarity(frames: np.ndarray, active: np.ndarray, flows: Sequence[ImageFlow]) -> tuple[float, float]:
    import cv2

    signed = frames[..., 0].astype(np.int16) - frames[..., 1]
    height, width = active.shape[1:]
    kept = seen = 0
    for number, flow in enumerate(flows):
        y, x = np.nonzero(active[number] & (signed[number] != 0))
        small = np.minimum((np.array([y, x]) / flow.factor).astype(np.int64).T, np.array(flow.vectors.shape[:2]) - 1)
        moved = np.rint(flow.vectors[small[:, 0], small[:, 1]] * flow.factor).astype(np.int64)
        to_x, to_y = x + moved[:, 0], y + moved[:, 1]
        inside = (to_x >= 0) & (to_x < width) & (to_y >= 0) & (to_y < height)
        nearby = cv2.boxFilter(
            signed[number + 1].astype(np.float32), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        after = np.rint(nearby[to_y[inside], to_x[inside]])
        before = signed[number][y, x][inside]
        seen += int(np.count_nonzero(after))
        kept += int(np.count_nonzero(np.sign(after) == np.sign(before)))
    return float(kept), float(seen)
