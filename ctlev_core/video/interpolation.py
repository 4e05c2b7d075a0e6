"""What lies between two frames of a video: by optical flow, or by fading one into the other.

A DVS pixel reports when an edge passes, and between two frames of a video edges jump by many pixels. Fading alone
makes events all along the way at once. Flow moves the edge; it is drawn so often that nothing moves by more than a
fraction of a pixel, and not at all where nothing moves (Gehrig et al., Video to Events, CVPR 2020).

Source: flow by dense inverse search (Kroeger et al., ECCV 2016; OpenCV); flow at an intermediate time and the weights
of the two frames after Jiang et al., Super SloMo, CVPR 2018, equation 4, without its networks. How we differ: where the
two frames, moved to the same time, disagree (what was hidden comes into view, or flow is wrong), the pixel fades
instead, as ESIM has it.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from ctlev_core.video.frames import grey_levels

VISIBLE = 2.0
"""Grey levels of 255 by which a pixel must change so that its flow counts as movement."""
DISAGREEMENT = 12.0
"""Grey levels of 255 by which two moved frames may differ until half of a pixel fades."""
STILL_PX = 0.25
"""A pixel that moves less, and looks the same in both frames, is still."""
ROW = 1024


class Between(Protocol):
    """Two frames, and all that lies between them."""

    displacement_px: float
    """The farthest that anything visible moves."""
    moving: np.ndarray
    """[K] int64 pixels, row by row, that do more between than change evenly from one frame to the other."""

    def at(self, share: float) -> np.ndarray:
        """[K] float32 light of the moving pixels at a share of the time between, 0 to 1."""
        ...


class Interpolator(Protocol):
    """Finds what lies between two frames; one of your own may take the place of those here."""

    def between(self, first: np.ndarray, second: np.ndarray) -> Between:
        """What lies between two frames [H, W] float32 of linear light, white = 1."""
        ...


class Fading:
    """Brightness changes linearly: nothing is drawn between, for the sensor does so by itself."""

    def between(self, first: np.ndarray, second: np.ndarray) -> Between:
        """See `Interpolator`."""
        return _Faded()


class _Faded:
    displacement_px = 0.0
    moving = np.empty(0, np.int64)

    def at(self, share: float) -> np.ndarray:
        return np.empty(0, np.float32)


class Flow:
    """Edges move along the optical flow between two frames."""

    def __init__(self) -> None:
        import cv2

        # On video of people at 346 x 260 px, frames left out are drawn with an error of 14.3 of 255 in 12 ms; with its
        # variational refinement 14.7 in 18, coarser (`FAST`) 18.1 in 5 (one clip, two cores busy).
        self._search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._search.setVariationalRefinementIterations(0)
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def between(self, first: np.ndarray, second: np.ndarray) -> Between:
        """See `Interpolator`."""
        before = self._last[1] if self._last is not None and self._last[0] is first else grey_levels(first)
        after = grey_levels(second)
        self._last = second, after
        changed = np.abs(after.astype(np.int16) - before) > VISIBLE
        height, width = first.shape
        if not changed.any() or min(height, width) < 16:  # smaller ones have no pyramid
            return _Faded()
        forward = self._search.calc(before, after, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
        backward = self._search.calc(after, before, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
        lengths = np.linalg.norm(forward, axis=2)[changed]
        moved = float(np.quantile(lengths, 0.99)) if len(lengths) else 0.0
        # An edge may pass a pixel that looks the same before and after: flow says so.
        moves = np.maximum(np.linalg.norm(forward, axis=2), np.linalg.norm(backward, axis=2)) > STILL_PX
        (moving,) = np.nonzero((changed | moves).reshape(-1))
        return _Moved(first, second, forward, backward, moved, moving)


class _Moved:
    def __init__(
        self,
        first: np.ndarray,
        second: np.ndarray,
        forward: np.ndarray,
        backward: np.ndarray,
        displacement_px: float,
        moving: np.ndarray,
    ) -> None:
        self.displacement_px, self.moving = displacement_px, moving
        self._frames = first, second
        self._flows = forward.reshape(-1, 2)[moving], backward.reshape(-1, 2)[moving]
        self._ends = first.reshape(-1)[moving], second.reshape(-1)[moving]
        width = first.shape[1]
        self._places = np.stack([moving % width, moving // width], axis=-1).astype(np.float32)

    def at(self, share: float) -> np.ndarray:
        first, second = self._ends
        if share <= 0:
            return first
        if share >= 1:
            return second
        forward, backward = self._flows
        rest = 1.0 - share
        # From the frame between to the first and to the second: Super SloMo, equation 4.
        moved_first = self._take(self._frames[0], -rest * share * forward + share * share * backward)
        moved_second = self._take(self._frames[1], rest * rest * forward - share * rest * backward)
        moved = rest * moved_first + share * moved_second
        faded = rest * first + share * second
        differ = 255 * (_stored(moved_first) - _stored(moved_second)) / DISAGREEMENT
        trust = 1 / (1 + differ * differ)
        return (faded + trust * (moved - faded)).astype(np.float32)

    def _take(self, frame: np.ndarray, flow: np.ndarray) -> np.ndarray:
        """[K] values of the frame where each pixel comes from."""
        import cv2

        # A picture of any shape will do; OpenCV takes none of more than 32,767 columns.
        places = np.zeros((-(-len(flow) // ROW), ROW, 2), np.float32)
        places.reshape(-1, 2)[: len(flow)] = self._places + flow
        x, y = places[..., 0].copy(), places[..., 1].copy()
        taken = cv2.remap(frame, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return taken.reshape(-1)[: len(flow)]


def num_steps(displacement_px: float, max_displacement_px: float, max_steps: int) -> int:
    """Into how many steps the time between two frames is cut, so that nothing moves farther in one; 1 to max_steps."""
    return max(math.ceil(min(displacement_px / max_displacement_px, max_steps)), 1)


def _stored(light: np.ndarray) -> np.ndarray:
    return np.sqrt(np.clip(light, 0, 1))
