"""Bodies between key poses: the patch is the whole picture, and nothing moves faster than the bound says."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from ctlev_core.body.layer import load_body, pose_vertices
from ctlev_core.body.motion.procedural import pose_at, sample_style
from ctlev_core.geometry.camera import camera_from_intrinsics, is_inside, orbit_rotation
from ctlev_core.render.rasteriser import NEAR_M, render_attributes
from ctlev_core.sensor.adaptive_rendering import RenderingOptions, simulate_rendered
from ctlev_core.sensor.dvs_pixel import PRESETS
from ctlev_core.studio.moving_body import MovingBody
from ctlev_core.studio.scene import (
    BOUNCE_LIGHT,
    SUPERSAMPLING,
    Camera,
    Light,
    Subject,
    sample_background,
    sample_light,
    sample_subject,
)
from data_contracts.errors import DataError

SIZE = (48, 36)
T_S = np.array([0.0, 0.05, 0.2])
FRONT = Camera(
    np.array([[50.0, 0, 24], [0, 50.0, 18], [0, 0, 1]]), orbit_rotation(0.3, 0.1), np.array([0, 0.9, 3.5]), SIZE
)


def random_poses(seed, count=3, turn_rad=0.3, shift_m=0.1):
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(count, 24, 3)) * turn_rad
    rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(count, 24, 3, 3)
    return rotations, rng.normal(size=(count, 3)) * shift_m


def record(seed=0, camera=FRONT, transl_m=(0.0, 0.0, 0.0), body=None, turn_rad=0.3, t_s=T_S):
    rng = np.random.default_rng(seed)
    rotations, transl = random_poses(seed, len(t_s), turn_rad)
    subject, background = sample_subject(rng, colour=False), sample_background(rng, camera.image_size, colour=False)
    return MovingBody(subject, t_s, rotations, transl + transl_m, camera, background, sample_light(rng), body)


def whole_picture(record, time_s):
    """The picture by another way: posed in the world, shaded in NumPy, rasterised over all of it."""
    painter = record._painter
    rotations, transl = record.poses_at([time_s])
    subject, light, camera = painter.subject, painter.light, painter.camera
    vertices, _ = pose_vertices(painter.body, rotations, subject.betas, transl)
    in_camera = vertices[0] @ camera.R.T + camera.translation
    normals, _ = pose_vertices(  # a normal is the difference of two skinned points
        replace(painter.body, v_template=painter.body.v_template + painter.body.normals),
        rotations, subject.betas, transl,
    )  # fmt: skip
    normals = (normals[0] - vertices[0]) @ camera.R.T
    cosine = normals @ light.direction / np.linalg.norm(normals, axis=1)
    shade = light.ambient + (1 - light.ambient) * np.where(cosine > 0, cosine, -BOUNCE_LIGHT * cosine)
    picture = np.kron(record.background, np.ones((SUPERSAMPLING, SUPERSAMPLING))).astype(np.float32)[..., None]
    fine = camera.scaled(SUPERSAMPLING)
    colours = subject.albedo * shade[:, None]
    render_attributes(in_camera.astype(np.float32), painter.body.faces, colours, fine.K, fine.image_size, picture)
    height, width = record.background.shape
    return picture.reshape(height, SUPERSAMPLING, width, SUPERSAMPLING).mean(axis=(1, 3))


def pasted(record, patch):
    height, width = patch.intensity.shape
    assert 0 <= patch.left <= patch.left + width <= record.background.shape[1]
    assert 0 <= patch.top <= patch.top + height <= record.background.shape[0]
    picture = record.background.copy()
    picture[patch.top : patch.top + height, patch.left : patch.left + width] = patch.intensity
    return picture


PLACES = {
    "in the middle": (0.0, 0.0, 0.0),
    "cut by an edge": (1.2, 0.0, 0.0),
    "out of sight": (8.0, 0.0, 0.0),
    "behind the camera": tuple(FRONT.R.T @ [0.0, 0.0, -6.0]),
    "through the camera's plane": tuple(FRONT.R.T @ [0.0, 0.0, -3.3]),
}


@pytest.mark.parametrize("place", PLACES)
def test_the_patch_is_the_whole_picture(place):
    recorded = record(transl_m=PLACES[place])
    sizes = []
    for time_s in (0.0, 0.03, 0.2, 0.11):
        patch = recorded(time_s)
        sizes.append(patch.intensity.size)
        difference = np.abs(pasted(recorded, patch) - whole_picture(recorded, time_s))
        # Rounding may move an edge over a sample: some quarters of pixels may differ, whole pixels may not.
        assert np.mean(difference > 1e-5) < 0.003 and difference.max() < 0.5
    assert max(sizes) == 0 if place in ("out of sight", "behind the camera") else min(sizes) > 0
    assert place != "in the middle" or max(sizes) < 0.7 * recorded.background.size


def test_a_picture_leaves_no_traces():
    recorded = record(1)
    first = recorded(0.02).intensity.copy()
    for other_s in (0.17, 0.2):
        recorded(other_s)
    again = recorded(0.02).intensity
    assert np.array_equal(first, again)
    frames = recorded.render_frames([0.02, 0.17])
    assert frames.shape == (2, 36, 48) and frames.dtype == np.float32
    assert np.array_equal(frames[0], pasted(recorded, recorded(0.02))) and frames.min() > 0 and frames.max() <= 1


def test_joints_turn_at_constant_speed_between_key_poses():
    recorded, (rotations, _) = record(2), random_poses(2)
    times_s = np.array([0.0, 0.01, 0.05, 0.06, 0.125, 0.2])
    turned, shifted = recorded.poses_at(times_s)
    for joint in range(24):
        expected = Slerp(T_S, Rotation.from_matrix(rotations[:, joint]))(times_s).as_matrix()
        np.testing.assert_allclose(turned[:, joint], expected, atol=1e-12)
    np.testing.assert_allclose(shifted[4], (shifted[2] + shifted[5]) / 2, atol=1e-12)
    assert np.array_equal(recorded.poses_at([-1.0, 9.0])[0], recorded.poses_at([0.0, 0.2])[0])


def measured_speeds(recorded, times_s, camera=FRONT):
    """Mean speed [T - 1, V], px/s, of each vertex that is in the picture before or after, else 0; and pixels [T, V, 2].

    NaN where a vertex is not in front.
    """
    rotations, transl = recorded.poses_at(times_s)
    painter = recorded._painter
    points, _ = pose_vertices(painter.body, rotations, painter.subject.betas, transl)
    points = points.astype(np.float64) @ camera.R.T + camera.translation
    pixels = np.where(points[..., 2:] > NEAR_M, (points / points[..., 2:]) @ camera.K.T, np.nan)[..., :2]
    inside = is_inside(pixels, SIZE)
    speeds = np.linalg.norm(np.diff(pixels, axis=0), axis=-1) / np.diff(times_s)[:, None]
    return np.where(np.logical_or(inside[1:], inside[:-1]), speeds, 0.0 * speeds), pixels


# Vertices are float32, 2e-7 m at 3 m: that is 3e-6 px, and over a millisecond 3e-3 px/s.
ROUNDING_PX_S = 0.02


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000), turn_rad=st.sampled_from([0.0, 0.05, 0.5, 2.0]), distance_m=st.floats(-2.2, 3.0))
def test_nothing_is_faster_than_the_bound(seed, turn_rad, distance_m):
    recorded = record(seed, turn_rad=turn_rad, transl_m=FRONT.R.T @ [0.0, 0.0, distance_m])
    times_s = np.linspace(0.0, 0.2, 161)
    speeds, _ = measured_speeds(recorded, times_s)
    for first, last in ((0, 160), (0, 1), (38, 42), (90, 97), (159, 160)):
        bound = recorded.speed_bound(times_s[first], times_s[last])
        assert speeds[first:last].max() <= bound + ROUNDING_PX_S


def test_the_bound_is_close_for_people():
    style = sample_style("run", np.random.default_rng(0))
    key_s = np.arange(51) / 200
    recorded = record()
    painter = recorded._painter
    running = MovingBody(
        painter.subject, key_s, *pose_at("run", key_s, style), FRONT, painter.background, painter.light
    )
    times_s = np.linspace(0.0, 0.25, 251)
    speeds = measured_speeds(running, times_s)[0].max(axis=1)
    bounds = np.array([running.speed_bound(*pair) for pair in pairwise(times_s)])
    assert np.min(bounds / speeds) >= 1.0 and np.mean(bounds / speeds) < 1.15


def test_correctives_of_the_pose_are_within_the_bound():
    body = load_body()
    directions = np.random.default_rng(0).normal(size=(207, body.v_template.size)) * 0.002
    recorded = record(4, turn_rad=0.5, body=replace(body, posedirs=directions.astype(np.float32)))
    times_s = np.linspace(0.0, 0.2, 81)
    speeds, _ = measured_speeds(recorded, times_s)
    plain = measured_speeds(record(4, turn_rad=0.5), times_s)[0]
    assert np.abs(speeds - plain).max() > 5.0
    assert all(
        speed <= recorded.speed_bound(*pair) for speed, pair in zip(speeds.max(axis=1), pairwise(times_s), strict=True)
    )


def test_a_body_cut_off_by_the_camera_is_bounded_in_the_picture():
    recorded = record(5, transl_m=FRONT.R.T @ [0.0, 0.0, -3.3])
    times_s = np.linspace(0.0, 0.2, 161)
    speeds, pixels = measured_speeds(recorded, times_s)
    inside = is_inside(pixels, SIZE)
    stays = np.logical_and(inside[1:], inside[:-1])
    assert np.isnan(speeds).any() and stays.any()
    assert np.isfinite(recorded.speed_bound(0.0, 0.2))
    assert speeds[stays].max() <= recorded.speed_bound(0.0, 0.2)
    assert record(5, transl_m=FRONT.R.T @ [0.0, 0.0, -8.0]).speed_bound(0.0, 0.2) == 0.0


def test_who_is_out_of_sight_is_slow():
    assert record(6, transl_m=(8.0, 0.0, 0.0)).speed_bound(0.0, 0.2) < 0.3 * record(6).speed_bound(0.0, 0.2)


def test_what_rests_has_no_speed():
    recorded = record(6)
    assert recorded.speed_bound(0.2, 0.3) == 0.0 and recorded.speed_bound(-0.3, 0.0) == 0.0
    assert recorded.speed_bound(0.19, 0.3) > 0.0
    still = record(6, t_s=np.array([1.0]))
    assert still.speed_bound(0.0, 2.0) == 0.0 and np.array_equal(still(0.0).intensity, still(2.0).intensity)


def test_events_of_patches_are_those_of_whole_pictures():
    recorded = record(7)

    def simulate(render):
        return simulate_rendered(
            render, 0, 200_000, PRESETS["ideal"], RenderingOptions(max_displacement_px=0.5),
            sensor_seed=1, seed=2, speed_bound=recorded.speed_bound, background=recorded.background,
        )  # fmt: skip

    events, times_us = simulate(recorded)
    whole, _ = simulate(lambda time_s: recorded.render_frames([time_s])[0])
    assert len(events) > 200 and all(np.array_equal(getattr(events, n), getattr(whole, n)) for n in "txyp")
    # Each frame is at most half a pixel of the fastest vertex after the one before.
    assert (measured_speeds(recorded, 1e-6 * times_us)[0].max(axis=1) * 1e-6 * np.diff(times_us)).max() <= 0.5


def test_poses_in_the_camera_frame_look_the_same():
    """Seen by a camera in whose frame the poses are given, as labels have them, the picture is the same."""
    recorded = record(8)
    painter = recorded._painter
    rotations, transl = recorded.poses_at(T_S)
    pelvis = painter.body.joints[0] + painter.body.joint_shapedirs[0] @ painter.subject.betas
    rotations[:, 0] = FRONT.R @ rotations[:, 0]
    transl = (pelvis + transl) @ FRONT.R.T + FRONT.translation - pelvis
    own = camera_from_intrinsics(FRONT.intrinsics, SIZE)
    same = MovingBody(painter.subject, T_S, rotations, transl, own, painter.background, painter.light)
    np.testing.assert_allclose(same.render_frames([0.1]), recorded.render_frames([0.1]), atol=2e-5)


BAD = {
    "times": ({"t_s": np.array([0.0, 0.1])}, "rotations .K, 24, 3, 3. .* got"),
    "no key poses": ({"t_s": np.zeros(0)}, "K >= 1"),
    "order": ({"t_s": np.array([0.0, 0.2, 0.2])}, "got 0.2 s and then 0.2 s"),
    "not a time": ({"t_s": np.array([0.0, np.nan, 0.2])}, "key pose 1 is not"),
    "not a place": ({"transl": np.full((3, 3), np.inf)}, "key pose 0 is not"),
    "background": ({"background": np.ones((36, 48, 3), np.float32)}, "background must be"),
    "lens": ({"camera": replace(FRONT, distortion=np.zeros(8))}, "without distortion"),
    "colour": ({"subject": Subject(np.zeros(10), np.ones((7558, 3), np.float32))}, "grey subject"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_named(what):
    changes, message = BAD[what]
    rotations, transl = random_poses(0)
    arguments = {
        "subject": Subject(np.zeros(10), np.ones((len(load_body().v_template), 1), np.float32)),
        "t_s": T_S, "rotations": rotations, "transl": transl, "camera": FRONT,
        "background": np.ones((36, 48, 1), np.float32), "light": Light(np.array([0.0, 0.0, -1.0]), 0.3),
    }  # fmt: skip
    with pytest.raises(DataError, match=message):
        MovingBody(**arguments | changes)
    with pytest.raises(DataError, match="no pose at nan s"):
        MovingBody(**arguments)(float("nan"))
