"""Maps of simulated recordings: closed forms, the next picture, and the events' own pixels."""

import numpy as np
import pytest

from ctlev_core.datasets import studio
from ctlev_core.geometry.camera import Camera
from ctlev_core.studio.ground_truth import GroundTruth, ground_truth, label_events
from ctlev_core.studio.moving_body import MovingBody
from ctlev_core.studio.scene import Light, Subject
from data_contracts.errors import DataError
from data_contracts.events import Events

OPTIONS = studio.Options(
    sensor_size=(80, 60), num_train_recordings=3, num_test_recordings=0, num_condition_recordings=0,
    recording_duration_us=60_000, label_rate_hz=500,
)  # fmt: skip
SIZE = (60, 80)


def body_that_shifts(velocity, camera_size=SIZE):
    """In the rest pose, 3 m before the camera, seen from the front, at a constant velocity [3] m/s."""
    from ctlev_core.body.layer import load_body

    body = load_body()
    subject = Subject(np.zeros(10), np.full((len(body.v_template), 1), 0.5, np.float32))
    width, height = camera_size
    K = np.array([[90.0, 0, width / 2], [0, 90.0, height / 2], [0, 0, 1]])
    camera = Camera(K, np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 3.0]), camera_size)
    rotations = np.tile(np.eye(3), (2, 24, 1, 1))
    start = np.zeros(3)
    transl = np.stack([start, start + 0.1 * (camera.R.T @ np.asarray(velocity))])
    background = np.full((height, width, 1), 0.3, np.float32)
    return MovingBody(subject, [0.0, 0.1], rotations, transl, camera, background, Light(np.array([0, 0, -1.0]), 0.4))


def test_the_flow_of_a_shift_is_that_of_its_formula():
    velocity = np.array([0.6, -0.4, 0.9])
    truth = ground_truth(body_that_shifts(velocity), np.array([50_000]))
    rows, columns = np.nonzero(truth.depth[0])
    assert 200 < len(rows) < 2000
    z = truth.depth[0, rows, columns].astype(np.float64)
    x, y = (columns + 0.5 - 30) / 90 * z, (rows + 0.5 - 40) / 90 * z
    for axis, place in enumerate((x, y)):
        expected = 90 * (velocity[axis] - velocity[2] * place / z) / z
        np.testing.assert_allclose(truth.flow[0, rows, columns, axis], expected, rtol=1e-3, atol=1e-3)
    assert not truth.flow[0][truth.depth[0] == 0].any()


def test_depth_is_that_of_the_surface():
    """Moved away by a metre, every point is a metre farther, and the body looks smaller."""
    scene = body_that_shifts([0, 0, 10])
    near, far = ground_truth(scene, np.array([0, 100_000])).depth
    points, _ = scene.surface_at([0.0])
    assert points[0, :, 2].min() - 1e-3 <= near[near > 0].min() < points[0, :, 2].min() + 0.02
    assert far[far > 0].min() == pytest.approx(near[near > 0].min() + 1, abs=0.05)
    assert (far > 0).sum() < 0.7 * (near > 0).sum()


def test_the_flow_leads_to_where_a_point_is_next():
    """Of people in motion: a millisecond later the surface is where depth and flow of now say it is."""
    for recording in studio.list_recordings(OPTIONS):
        scene = studio.read_scene(recording, OPTIONS)
        points, velocities = scene.surface_at([0.032])  # between two key poses
        later, _ = scene.surface_at([0.033])
        np.testing.assert_allclose(points + 0.001 * velocities, later, atol=2e-5)
        now, then = ground_truth(scene, np.array([32_000])), ground_truth(scene, np.array([33_000]))
        seen = np.zeros((60, 80), bool)  # whose neighbours are all of the same surface
        depth = now.depth[0]
        inner = np.stack([np.roll(depth, shift, (0, 1)) for shift in ((0, 1), (0, -1), (1, 0), (-1, 0))])
        seen[1:-1, 1:-1] = ((inner > 0).all(axis=0) & (np.ptp(inner, axis=0) < 0.03))[1:-1, 1:-1]
        rows, columns = np.nonzero(seen)
        moved = now.flow[0, rows, columns] * 0.001
        assert np.abs(moved).max() < 0.5  # still the same pixel
        changed = then.depth[0, rows, columns] - depth[rows, columns]
        assert np.abs(changed[then.depth[0, rows, columns] > 0]).max() < 0.02


def test_before_and_after_the_motion_nothing_moves():
    scene = body_that_shifts([1, 0, 0])
    _, velocities = scene.surface_at([-0.01, 0.0, 0.05, 0.1, 0.2])
    assert not velocities[[0, 4]].any()
    np.testing.assert_allclose(velocities[1:4, :, 0], 1, atol=1e-3)


def test_events_have_the_values_of_their_pixel_at_the_nearest_moment():
    random = np.random.default_rng(0)
    t_us = np.array([0, 1000, 3000])
    depth = random.uniform(0, 5, (3, 6, 8)).astype(np.float32) * (random.random((3, 6, 8)) > 0.4)
    truth = GroundTruth(t_us, depth.astype(np.float32), random.normal(size=(3, 6, 8, 2)).astype(np.float32))
    t = np.sort(random.integers(0, 4000, 200))
    x, y = random.integers(0, 8, 200).astype(np.uint16), random.integers(0, 6, 200).astype(np.uint16)
    labels = label_events(Events(t, x, y, np.zeros(200, np.uint8), (8, 6)), truth)
    for number in range(200):
        place = int(np.abs(t_us - t[number]).argmin()), y[number], x[number]
        assert labels.depth[number] == truth.depth[place] and (labels.flow[number] == truth.flow[place]).all()
        assert labels.instance[number] == (truth.depth[place] > 0)
    one = GroundTruth(t_us[:1], truth.depth[:1], truth.flow[:1])
    assert (label_events(Events(t, x, y, np.zeros(200, np.uint8), (8, 6)), one).depth == depth[0, y, x]).all()


def test_marked_events_are_the_same_and_those_of_signal_lie_on_the_person():
    recording = studio.list_recordings(OPTIONS)[0]
    plain, marked = studio.read_events(recording, OPTIONS), studio.read_marked_events(recording, OPTIONS)
    for name in ("t", "x", "y", "p"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(marked, name))
    assert plain.signal is None and 0.05 < marked.signal.mean() < 1
    scene = studio.read_scene(recording, OPTIONS)
    instance = label_events(marked, ground_truth(scene, np.arange(0, 60_001, 1000))).instance
    # At its edges half of the events come from where the person has just been.
    assert instance[marked.signal].mean() > 0.6 > 0.2 > instance[~marked.signal].mean()


def test_maps_that_do_not_fit_are_refused():
    with pytest.raises(
        DataError, match=r"depth and flow of 60 x 80 px at 100000 moments take 5.4 GiB, at most 2 are made"
    ):
        ground_truth(body_that_shifts([0, 0, 0]), np.arange(100_000))
