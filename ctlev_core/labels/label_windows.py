"""What there is around a labelled moment: the grey pictures of its window, and what the body does."""

from __future__ import annotations

import numpy as np

from data_contracts.array_rows import Images
from data_contracts.errors import DataError
from data_contracts.labels import BodyMotions, Labels

DARKEST = 5.0
"""Grey level below which a sensor's response is no longer logarithmic: 0.02 of white."""
KEY_POSE_SPACING_US = 10_000
"""At most, so that a limb between two key poses is within a fraction of a pixel of its path."""


def nearest_pair(track_us: np.ndarray, start_us: int, end_us: int, where: str) -> tuple[int, int]:
    """The pictures of a track nearest to the two ends of a window; two different ones also of a short window.

    Args:
        track_us: [N] int64, ascending.
        start_us: of the window.
        end_us: not before `start_us`.
        where: for the message.
    Returns:
        Indices of the earlier and the later picture.
    Raises:
        DataError: there is one picture alone, or the window lies outside the track by more than the time between
            two pictures, so that they do not show it.
    """
    if len(track_us) < 2:
        raise DataError(f"{where}: a pair needs two intensity frames, got {len(track_us)}")
    reach = int(np.diff(track_us).max())
    if start_us < track_us[0] - reach or end_us > track_us[-1] + reach:
        raise DataError(
            f"{where}: intensity frames from {track_us[0]} to {track_us[-1]} us do not show a window from {start_us} "
            f"to {end_us} us"
        )
    first, last = (int(np.argmin(np.abs(track_us - time_us))) for time_us in (start_us, end_us))
    if first == last:
        # The neighbour on the side where the window reaches farther, or the only one at an end of the track.
        step = 1 if end_us - track_us[first] >= track_us[first] - start_us else -1
        other = first + step if 0 <= first + step < len(track_us) else first - step
        first, last = sorted((first, other))
    return first, last


def picture_difference(before: np.ndarray, after: np.ndarray) -> float:
    """Mean magnitude of the change of log intensity between two pictures [H, W] uint8: in proportion to events."""
    first, second = (np.maximum(picture.astype(np.float32), DARKEST) for picture in (before, after))
    return float(np.abs(np.log(second / first)).mean())


def equally_different_window(
    images: Images, track_us: np.ndarray, moment_us: int, reach_us: int, wanted: float, where: str
) -> tuple[int, int]:
    """The shortest window around a moment over which the pictures change as much as `wanted`.

    Windows of equal numbers of events are longer where less moves. Where there are pictures and no events, this is the
    window that would have as many.

    Args:
        images: [N, H, W] uint8.
        track_us: [N] int64, their times, ascending.
        moment_us: in the middle, as far as the track goes.
        reach_us: how far to go to either side.
        wanted: as `picture_difference` measures it.
        where: for the message.
    Returns:
        Times of two pictures; the farthest within reach where none differ so much.
    Raises:
        DataError: there is one picture alone.
    """
    if len(track_us) < 2:
        raise DataError(f"{where}: a pair needs two intensity frames, got {len(track_us)}")
    right = int(np.clip(np.searchsorted(track_us, moment_us), 1, len(track_us) - 1))
    left = right - 1
    while picture_difference(images[left], images[right]) < wanted:
        can_left = left > 0 and moment_us - track_us[left - 1] <= reach_us
        can_right = right < len(track_us) - 1 and track_us[right + 1] - moment_us <= reach_us
        if not (can_left or can_right):
            break
        is_nearer = not can_right or (can_left and moment_us - track_us[left - 1] <= track_us[right + 1] - moment_us)
        left, right = (left - 1, right) if is_nearer else (left, right + 1)
    return int(track_us[left]), int(track_us[right])


def motion_around(track: Labels, moment_us: int, half_us: int, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Key poses of a labelled body around a moment, evenly spaced; as far as the track goes.

    Args:
        track: the labels of one recording with SMPL parameters, times ascending.
        moment_us: within the track.
        half_us: how far to go to either side.
        where: for the message.
    Returns:
        t_us [K] int64, smpl_pose [K, 72] and smpl_transl [K, 3] float32; K depends on `half_us` alone. Between two
        labels each joint turns at constant speed.
    Raises:
        DataError: the labels have no SMPL parameters, or those around the moment are of no more than one time.
    """
    from ctlev_core.body.motion.clip import MotionClip, resample

    if track.smpl_pose is None or track.smpl_betas is None or track.smpl_transl is None:
        raise DataError(f"{where}: needs labels with SMPL parameters to see a body move")
    start_us, stop_us = max(track.t_us[0], moment_us - half_us), min(track.t_us[-1], moment_us + half_us)
    num_spans = max(-(-2 * half_us // KEY_POSE_SPACING_US), 1)
    if stop_us - start_us < num_spans:
        raise DataError(
            f"{where}: needs labels over a time to see a body move, got {len(track)} from {track.t_us[0]} to "
            f"{track.t_us[-1]} us around {moment_us} us"
        )
    t_us = np.rint(np.linspace(start_us, stop_us, num_spans + 1)).astype(np.int64)
    clip = MotionClip(
        track.smpl_pose.astype(np.float64), track.smpl_betas[0], track.smpl_transl.astype(np.float64), 1e-6 * track.t_us
    )
    keys = resample(clip, 1e-6 * t_us)
    return t_us, keys.pose.astype(np.float32), keys.transl.astype(np.float32)


def follow_labels(
    pose: np.ndarray, transl: np.ndarray, labelled: Labels, seen: Labels
) -> tuple[np.ndarray, np.ndarray]:
    """Key poses in the camera frame of `labelled` as the camera of `seen` sees them.

    Args:
        pose: [N, K, 72] rad and transl [N, K, 3] m, around the moments of `labelled`.
        transl: see above.
        labelled: N bodies as labelled.
        seen: the same N bodies in the frame of another still camera each.
    Returns:
        pose [N, K, 72] and transl [N, K, 3] float32.
    """
    from ctlev_core.body.rigid_motion import motion_between, move_roots
    from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle
    from ctlev_core.labels.body_views import rest_pelvis

    def placed(labels: Labels) -> tuple[np.ndarray, np.ndarray]:
        assert labels.smpl_pose is not None and labels.smpl_transl is not None
        return matrix_from_axis_angle(labels.smpl_pose[:, :3].astype(np.float64)), labels.smpl_transl.astype(np.float64)

    assert labelled.smpl_betas is not None
    pelvis = rest_pelvis(labelled.smpl_betas)
    rotation, translation = motion_between(*placed(labelled), *placed(seen), pelvis)
    root, moved = move_roots(
        matrix_from_axis_angle(pose[..., :3].astype(np.float64)),
        transl.astype(np.float64),
        pelvis[:, None],
        rotation[:, None],
        translation[:, None],
    )
    turned = np.concatenate([axis_angle_from_matrix(root), pose[..., 3:]], axis=-1)
    return turned.astype(np.float32), moved.astype(np.float32)


def body_motions(
    keys: list[tuple[np.ndarray, np.ndarray, np.ndarray]], labelled: Labels, seen: Labels, where: str
) -> BodyMotions:
    """The motions of N bodies, from what `motion_around` found for each, as the labels `seen` see them.

    Raises:
        DataError: the labels have no intrinsics, so that bodies have no place in the image.
    """
    if seen.intrinsics is None or seen.smpl_betas is None:
        raise DataError(f"{where}: needs SMPL labels with camera intrinsics, so that bodies have a place in the image")
    t_us, pose, transl = (np.stack(column) for column in zip(*keys, strict=True))
    if labelled is not seen:
        pose, transl = follow_labels(pose, transl, labelled, seen)
    return BodyMotions(t_us, labelled.t_us, pose, transl, seen.smpl_betas, seen.intrinsics)
