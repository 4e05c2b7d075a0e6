"""What there is around a labelled moment: pairs of pictures, and motions of bodies."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.body.layer import load_body, pose_vertices
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.labels.body_views import from_new_side
from ctlev_core.labels.label_windows import body_motions, equally_different_window, motion_around, nearest_pair
from data_contracts.errors import DataError
from data_contracts.labels import Labels, check_body_motions

TIMES = np.array([0, 100, 200, 300])


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [
        (0, 300, (0, 3)),
        (90, 210, (1, 2)),
        (95, 104, (0, 1)),  # both nearest to 100; the window reaches farther to the left
        (98, 120, (1, 2)),
        (0, 10, (0, 1)),
        (-20, 5, (0, 1)),  # there is nothing to the left
        (299, 300, (2, 3)),
        (300, 340, (2, 3)),  # there is nothing to the right
    ],
)
def test_a_pair_is_the_pictures_nearest_to_the_ends_of_the_window(start, end, expected):
    assert nearest_pair(TIMES, start, end, "here") == expected


@given(st.lists(st.integers(0, 1000), min_size=2, max_size=20, unique=True), st.integers(0, 1000), st.integers(0, 300))
def test_a_pair_is_two_different_pictures_in_order_and_the_best_where_there_is_a_choice(times, start, length):
    track = np.array(sorted(times))
    try:
        first, last = nearest_pair(track, start, start + length, "here")
    except DataError as error:
        assert "do not show" in str(error)
        return
    assert 0 <= first < last < len(track)
    apart = [np.abs(track - end).min() for end in (start, start + length)]
    if track[np.argmin(np.abs(track - start))] != track[np.argmin(np.abs(track - start - length))]:
        assert [abs(track[first] - start), abs(track[last] - start - length)] == apart
    else:
        assert last == first + 1


def test_a_pair_needs_two_pictures_that_show_the_window():
    with pytest.raises(DataError, match="a pair needs two intensity frames, got 1"):
        nearest_pair(TIMES[:1], 0, 10, "here")
    with pytest.raises(DataError, match="from 0 to 300 us do not show a window from 401 to 410 us"):
        nearest_pair(TIMES, 401, 410, "here")


def test_a_window_is_as_long_as_it_takes_the_pictures_to_change():
    images = np.full((9, 4, 4), 100, np.uint8)
    for frame in range(9):
        images[frame, 0, 0] = 100 + 10 * frame  # one pixel of 16 gets lighter
    track = np.arange(9) * 1000
    steps = np.abs(np.log(images[:, None, 0, 0] / images[None, :, 0, 0].astype(float))) / 16
    assert equally_different_window(images, track, 4000, 9000, 1e-9, "here") == (3000, 4000)
    for wanted in (0.004, 0.01, 0.02, 0.03):
        start, end = np.array(equally_different_window(images, track, 4000, 9000, wanted, "here")) // 1000
        assert steps[start, end] >= wanted
        assert min(steps[start + 1, end], steps[start, end - 1]) < wanted  # and no longer
        assert abs((start + end) / 2 - 4) <= 1
    assert equally_different_window(images, track, 4000, 9000, 9.0, "here") == (0, 8000)
    assert equally_different_window(images, track, 4000, 2500, 9.0, "here") == (2000, 6000)
    assert equally_different_window(images, track, 4000, 2000, 9.0, "here") == (2000, 6000), "as far as the reach"
    assert equally_different_window(images, track, 0, 9000, 0.02, "here")[0] == 0
    assert equally_different_window(images, track, 9000, 9000, 1e-9, "here") == (7000, 8000)


def turning(times_us, rate=4.0, betas=0.5):
    """A body that turns about its own vertical axis at `rate` rad/s, bends an elbow and walks to the side."""
    t_s = 1e-6 * np.asarray(times_us, dtype=np.float64)
    pose = np.zeros((len(t_s), 72), np.float32)
    pose[:, 0] = np.pi  # upright before an OpenCV camera: y points down
    pose[:, 18 * 3 + 1] = rate * t_s
    transl = np.stack([0.5 * t_s, 0 * t_s, 3 + 0 * t_s], axis=1).astype(np.float32)
    shape = np.full((len(t_s), 10), betas, np.float32)
    intrinsics = np.tile(np.array([90, 90, 32, 32], np.float32), (len(t_s), 1))
    return Labels(
        ("walk",) * len(t_s),
        np.asarray(times_us, np.int64),
        smpl_pose=pose,
        smpl_betas=shape,
        smpl_transl=transl,
        intrinsics=intrinsics,
    )


def test_key_poses_between_labels_are_those_of_constant_speed():
    track = turning([0, 50_000, 100_000, 150_000])
    t_us, pose, transl = motion_around(track, 70_000, 30_000, "here")
    np.testing.assert_array_equal(t_us, np.arange(40_000, 100_001, 10_000))
    wider_us = motion_around(track, 70_000, 33_000, "here")[0]
    assert len(wider_us) == 8 and np.diff(wider_us).max() <= 10_000
    expected = turning(t_us)
    # As matrices: half a turn has two axis-angle vectors.
    found, wanted = (
        matrix_from_axis_angle(p.reshape(-1, 24, 3).astype(np.float64)) for p in (pose, expected.smpl_pose)
    )
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    np.testing.assert_allclose(transl, expected.smpl_transl, atol=1e-6)


def test_a_motion_ends_where_its_track_does_and_one_moment_is_none():
    track = turning([0, 50_000, 100_000])
    assert motion_around(track, 10_000, 30_000, "here")[0][[0, -1]].tolist() == [0, 40_000]
    with pytest.raises(DataError, match="needs labels over a time to see a body move, got 1 from 0 to 0 us"):
        motion_around(track.take([0]), 0, 30_000, "here")
    with pytest.raises(DataError, match="needs labels with SMPL parameters"):
        motion_around(Labels(("a",), np.zeros(1, np.int64)), 0, 10, "here")


def vertices(pose, betas, transl):
    rotations = matrix_from_axis_angle(pose.reshape(-1, 24, 3).astype(np.float64))
    return pose_vertices(load_body(), rotations, np.tile(betas, (len(pose), 1)), transl)[0]


def test_seen_from_a_new_side_a_motion_is_the_same_motion_of_the_same_vertices():
    track = turning([0, 50_000, 100_000])
    labelled = track.take([1])
    seen = from_new_side(labelled, np.random.default_rng(5), (64, 64))
    keys = motion_around(track, 50_000, 40_000, "here")
    moved = check_body_motions(body_motions([keys], labelled, seen, "here"), "here")
    before = vertices(keys[1], labelled.smpl_betas[0], keys[2])
    after = vertices(moved.smpl_pose[0], labelled.smpl_betas[0], moved.smpl_transl[0])
    # One rigid motion takes every key pose along: that of the labelled moment, fitted independently (Kabsch).
    still = vertices(labelled.smpl_pose, labelled.smpl_betas[0], labelled.smpl_transl)[0]
    turned = vertices(seen.smpl_pose, seen.smpl_betas[0], seen.smpl_transl)[0]
    u, _, vt = np.linalg.svd((still - still.mean(0)).T @ (turned - turned.mean(0)))
    rotation = (u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt).T
    expected = (before - still.mean(0)) @ rotation.T + turned.mean(0)
    np.testing.assert_allclose(after, expected, atol=2e-5)  # m; labels are float32
    np.testing.assert_array_equal(moved.moment_us, [50_000])


def test_bodies_without_a_camera_have_no_place_in_the_image():
    track = turning([0, 50_000, 100_000])
    blind = Labels(
        track.class_names, track.t_us, smpl_pose=track.smpl_pose, smpl_betas=track.smpl_betas,
        smpl_transl=track.smpl_transl,
    )  # fmt: skip
    keys = motion_around(track, 50_000, 40_000, "here")
    with pytest.raises(DataError, match="needs SMPL labels with camera intrinsics"):
        body_motions([keys], blind.take([1]), blind.take([1]), "here")
