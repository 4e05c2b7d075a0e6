"""What each pixel of a simulated recording shows at a moment: how far it is, how it moves, and whose surface it is.

Values are exact at the centre of each pixel, for the mesh and the motion that the camera recorded: a triangle's points
move as its corners do, and the optical flow of a point (x, y, z) m that moves with (u, v, w) m/s is

    f_x (u - w x / z) / z,  f_y (v - w y / z) / z   px/s.

Source: Longuet-Higgins & Prazdny, The Interpretation of a Moving Retinal Image, Proc. R. Soc. B 1980, eq. 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ctlev_core.render.rasteriser import render_attributes
from ctlev_core.studio.moving_body import MovingBody
from data_contracts.errors import DataError
from data_contracts.events import Events

PERSON = 1
MAX_BYTES = 2**31
"""Of the maps of one recording, which lie in memory."""
_AT_ONCE = 16
"""Moments posed together: 20 MB of vertices."""


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Maps of a recording at T moments.

    Attributes:
        t_us: [T] int64, ascending.
        depth: [T, H, W] float32 m along the optical axis; 0 = the background, a picture without a distance.
        flow: [T, H, W, 2] float32 px/s to the right and down; 0 in the background, which keeps still.
    """

    t_us: np.ndarray
    depth: np.ndarray
    flow: np.ndarray

    @cached_property
    def instance(self) -> np.ndarray:
        """[T, H, W] uint8: 1 = the person, 0 = the background."""
        return instance_of(self.depth)


@dataclass(frozen=True, eq=False)
class EventLabels:
    """What N events came from: the maps' values at their pixels, at the moment nearest in time.

    Attributes:
        instance: [N] uint8: 1 = the person, 0 = the background.
        depth: [N] float32 m; 0 = the background.
        flow: [N, 2] float32 px/s.
    """

    instance: np.ndarray
    depth: np.ndarray
    flow: np.ndarray


def ground_truth(scene: MovingBody, t_us: np.ndarray) -> GroundTruth:
    """Maps of a scene at moments [T] int64 us.

    Raises:
        DataError: they would take more than 2 GiB.
    """
    width, height = scene.camera.image_size
    if (size := 12 * len(t_us) * height * width) > MAX_BYTES:
        raise DataError(
            f"depth and flow of {width} x {height} px at {len(t_us)} moments take {size / 2**30:.1f} GiB, at most "
            f"{MAX_BYTES / 2**30:.0f} are made; ask for fewer moments a second or a shorter recording"
        )
    depth = np.zeros((len(t_us), height, width), np.float32)
    flow = np.zeros((len(t_us), height, width, 2), np.float32)
    K = scene.camera.K
    rays = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0], (np.arange(height)[:, None] + 0.5 - K[1, 2]) / K[1, 1]
    for start in range(0, len(t_us), _AT_ONCE):
        points, velocities = scene.surface_at(1e-6 * t_us[start : start + _AT_ONCE])
        for row, (vertices, moving) in enumerate(zip(points, velocities, strict=True), start):
            speed, inverse = render_attributes(vertices, scene.faces, moving, K, (width, height))
            seen = inverse > 0
            depth[row][seen] = 1 / inverse[seen]
            for axis in range(2):
                across = K[axis, axis] * (speed[..., axis] - rays[axis] * speed[..., 2]) * inverse
                flow[row, ..., axis] = np.where(seen, across, 0)
    return GroundTruth(t_us, depth, flow)


def label_events(events: Events, truth: GroundTruth) -> EventLabels:
    """What events came from; at a rate of 1,000 moments a second the nearest is half a millisecond away at most."""
    after = np.clip(np.searchsorted(truth.t_us, events.t), 1, max(len(truth.t_us) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(truth.t_us) - 1)
    nearest = np.where(events.t - truth.t_us[before] <= truth.t_us[after] - events.t, before, after)
    place = nearest, events.y.astype(np.int64), events.x.astype(np.int64)
    depth = truth.depth[place]
    return EventLabels(instance_of(depth), depth, truth.flow[place])


def instance_of(depth: np.ndarray) -> np.ndarray:
    """uint8 of depths, m: 1 = the person, 0 = the background, which has none."""
    return (depth > 0).astype(np.uint8) * PERSON
