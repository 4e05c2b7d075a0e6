"""A person in motion, recorded on demand: any moment, and only the part of the picture where the person is."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ctlev_core.body.layer import BodyModel, pose_offsets
from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from ctlev_core.sensor.adaptive_rendering import Patch
from ctlev_core.studio.motion_bound import (
    SEGMENT_TURN_RAD,
    bound_acceleration,
    bound_correctives,
    bound_speeds,
    bound_turning,
)
from ctlev_core.studio.scene import BodyPainter, Camera, Light, Subject
from data_contracts.errors import DataError

VELOCITY_STEP_S = 5e-4
"""Before and after a moment, for velocities: a tenth of the time between the studio's key poses."""
SEGMENTS_AT_ONCE = 64
"""So many are posed together: 6 MB of vertices."""


class MovingBody:
    """A textured, lit body that moves between key poses before a still camera.

    It is what `ctlev_core.sensor.adaptive_rendering.simulate_rendered` asks for pictures. Between two key poses each
    joint turns about a fixed axis at constant speed, the shorter way, and the body shifts at constant speed; before the
    first and after the last it rests. An instance keeps pictures to draw on, so that several threads must not share it.

    Args:
        subject: who moves; grey (one channel).
        t_s: [K] float64, s, ascending; one or more.
        rotations: [K, 24, 3, 3] relative to the parent.
        transl: [K, 3] m.
        camera: who looks, without distortion; poses may be given in its own frame, with R = I and translation 0.
        background: [H, W, 1] float32 in (0, 1].
        light: in the camera frame.
        body: the bundled body when None.
    Raises:
        DataError: the numbers of times and poses differ, times do not ascend, a number is not finite, the camera has a
            distortion, or the background does not fit camera and subject.
    """

    def __init__(
        self,
        subject: Subject,
        t_s: np.ndarray,
        rotations: np.ndarray,
        transl: np.ndarray,
        camera: Camera,
        background: np.ndarray,
        light: Light,
        body: BodyModel | None = None,
    ) -> None:
        t_s = np.asarray(t_s, np.float64)
        count = len(t_s) if t_s.ndim == 1 else 0
        if count == 0 or rotations.shape != (count, 24, 3, 3) or transl.shape != (count, 3):
            raise DataError(
                "a moving body needs t_s [K], rotations [K, 24, 3, 3] and transl [K, 3] with K >= 1, got "
                f"{t_s.shape}, {rotations.shape} and {transl.shape}"
            )
        finite = np.isfinite(t_s) & np.isfinite(rotations).all(axis=(1, 2, 3)) & np.isfinite(transl).all(axis=1)
        if not finite.all():
            raise DataError(f"a moving body needs finite times and poses; key pose {np.argmin(finite)} is not")
        if (np.diff(t_s) <= 0).any():
            key = int(np.argmax(np.diff(t_s) <= 0))
            raise DataError(f"key poses must ascend in time, got {t_s[key]} s and then {t_s[key + 1]} s")
        if subject.albedo.shape[1] != 1 or camera.distortion is not None:
            raise DataError("a moving body needs a grey subject (albedo [V, 1]) and a camera without distortion")
        self._painter = BodyPainter(subject, camera, background, light, body)
        self.t_s = t_s
        self._rotations, self._transl = rotations.astype(np.float64), transl.astype(np.float64)
        self._turns = axis_angle_from_matrix(np.swapaxes(self._rotations[:-1], -1, -2) @ self._rotations[1:])

    @property
    def background(self) -> np.ndarray:
        """What there is around the patches, [H, W] float32."""
        return self._painter.background[..., 0]

    def __call__(self, time_s: float) -> Patch:
        """The picture at a moment, as the box around the body with the background in it; 0 x 0 px out of sight.

        Raises:
            DataError: the time is not finite.
        """
        rotations, transl = self.poses_at([time_s])
        offsets = pose_offsets(self._painter.body, rotations)
        moves = self._painter.in_camera(rotations, transl)[0]
        left, top, patch = self._painter.paint(moves, None if offsets is None else offsets[0])
        return Patch(left, top, patch[..., 0])

    def render_frames(self, times_s: Sequence[float] | np.ndarray) -> np.ndarray:
        """Full pictures [T, H, W] float32 in (0, 1], linear, at T moments, for intensity tracks.

        Raises:
            DataError: a time is not finite.
        """
        out = np.repeat(self.background[None], len(times_s), axis=0)
        for picture, time_s in zip(out, times_s, strict=True):
            patch = self(time_s)
            height, width = patch.intensity.shape
            picture[patch.top : patch.top + height, patch.left : patch.left + width] = patch.intensity
        return out

    def poses_at(self, times_s: Sequence[float] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations [T, 24, 3, 3] relative to the parent, and translations [T, 3] m, at T moments.

        Raises:
            DataError: a time is not finite.
        """
        times_s = np.asarray(times_s, np.float64)
        if not np.isfinite(times_s).all():
            raise DataError(f"a moving body has no pose at {times_s[~np.isfinite(times_s)][0]} s")
        if len(self.t_s) == 1:
            return self._rotations.repeat(len(times_s), axis=0), self._transl.repeat(len(times_s), axis=0)
        key = np.clip(np.searchsorted(self.t_s, times_s, "right") - 1, 0, len(self.t_s) - 2)
        fraction = np.clip((times_s - self.t_s[key]) / (self.t_s[key + 1] - self.t_s[key]), 0.0, 1.0)[:, None]
        rotations = self._rotations[key] @ matrix_from_axis_angle(fraction[..., None] * self._turns[key])
        return rotations, self._transl[key] + fraction * (self._transl[key + 1] - self._transl[key])

    @property
    def camera(self) -> Camera:
        """Who looks."""
        return self._painter.camera

    @property
    def faces(self) -> np.ndarray:
        """[F, 3] corners of the surface's triangles."""
        return self._painter.body.faces

    def surface_at(self, times_s: Sequence[float] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [T, V, 3] m in the camera frame at T moments, and their velocities [T, V, 3] m/s, float64.

        Velocities are differences over half a millisecond before and after, or less where the motion begins or ends.

        Raises:
            DataError: a time is not finite.
        """
        times_s = np.asarray(times_s, np.float64)
        at_rest = len(self.t_s) == 1
        before, after = (np.clip(times_s + by, self.t_s[0], self.t_s[-1]) for by in (-VELOCITY_STEP_S, VELOCITY_STEP_S))
        now, first, last = (
            self._painter.pose(*self.poses_at(each)).astype(np.float64) for each in (times_s, before, after)
        )
        if at_rest:
            return now, np.zeros_like(now)
        spans = np.where(after > before, after - before, np.inf)
        return now, (last - first) / spans[:, None, None]

    def speed_bound(self, start_s: float, stop_s: float) -> float:
        """A speed in px/s that no vertex in the picture exceeds between two times, start before stop.

        The interval touches short segments of time. In each, it is the largest mean speed of a projected vertex, plus
        what the speed of a vertex may differ from its mean, for which `ctlev_core.studio.motion_bound` has a bound.
        What moves outside of the picture, where no part of it can be seen, does not count.
        """
        ends_s, speeds_px_s = self._segments
        first = int(np.searchsorted(ends_s, start_s, "right")) - 1
        last = int(np.searchsorted(ends_s, stop_s, "left"))
        return float(speeds_px_s[max(first, 0) : max(last, 0)].max(initial=0.0))

    @cached_property
    def _segments(self) -> tuple[np.ndarray, np.ndarray]:
        """Ends [S + 1], s, of the segments, and the bound of each, [S] px/s."""
        painter, spans_s = self._painter, np.diff(self.t_s)
        turning = bound_turning(np.linalg.norm(self._turns, axis=-1) / spans_s[:, None])
        acceleration = bound_acceleration(painter.body, painter.subject.betas, painter.rest, turning)
        acceleration += bound_correctives(painter.body, turning)
        parts = np.maximum(np.ceil(turning.speed.max(axis=1) * spans_s / SEGMENT_TURN_RAD), 1).astype(np.int64)
        of_key = np.repeat(np.arange(len(parts)), parts)
        part = np.arange(len(of_key)) - np.repeat(np.cumsum(parts) - parts, parts)
        ends_s = np.append(self.t_s[of_key] + spans_s[of_key] * part / parts[of_key], self.t_s[-1])
        speeds_px_s = np.zeros(len(of_key))
        for first in range(0, len(of_key), SEGMENTS_AT_ONCE):
            chosen = slice(first, first + SEGMENTS_AT_ONCE)
            rotations, transl = self.poses_at(ends_s[first : first + SEGMENTS_AT_ONCE + 1])
            points = painter.pose(rotations, transl)
            lasting_s = np.diff(ends_s[first : first + SEGMENTS_AT_ONCE + 1])
            speeds_px_s[chosen] = bound_speeds(points, lasting_s, acceleration[of_key[chosen]], painter.camera)
        return ends_s, speeds_px_s
