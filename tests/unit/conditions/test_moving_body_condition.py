"""Bodies and where their surface moves in the image, against what a camera sees of a translated point."""

from dataclasses import replace

import numpy as np
import pytest

from ctlev_core.body.layer import load_body, pose_vertices
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.conditions import moving_body, normals
from data_contracts.errors import DataError
from data_contracts.labels import BodyMotions, Labels

SIZE = (64, 64)
FOCAL = 70.0
SPAN_US = 40_000


def people(count=3, depth=3.0, seed=0):
    random = np.random.default_rng(seed)
    pose = random.normal(0, 0.2, (count, 72)).astype(np.float32)
    pose[:, :3] = [np.pi, 0, 0]
    return Labels(
        ("",) * count,
        SPAN_US * np.arange(1, count + 1),
        smpl_pose=pose,
        smpl_betas=random.normal(0, 1, (count, 10)).astype(np.float32),
        smpl_transl=np.tile(np.array([0, 0.2, depth], np.float32), (count, 1)),
        intrinsics=np.tile(np.array([FOCAL, FOCAL, 32, 32], np.float32), (count, 1)),
    )


def moved(labels, velocity, span_us=SPAN_US):
    """Key poses half of `span_us` before the label, at it, and half after; `velocity` [3] m/s."""
    times = np.array([-1, 0, 1]) * (span_us // 2)
    steps = (1e-6 * times[:, None] * np.asarray(velocity, float)).astype(np.float32)
    return BodyMotions(
        labels.t_us[:, None] + times, labels.t_us, np.repeat(labels.smpl_pose[:, None], 3, axis=1),
        labels.smpl_transl[:, None] + steps, labels.smpl_betas, labels.intrinsics,
    )  # fmt: skip


def render(labels, motions, **options):
    return moving_body.render(labels, SIZE, moving_body.Options(**options), range(len(labels)), motions).images


def test_what_stands_still_is_grey_and_covers_what_the_normal_map_covers():
    labels = people()
    images = render(labels, moved(labels, [0, 0, 0]))
    assert (images[..., 1:] == moving_body.STILL).all()
    maps = normals.render(labels, SIZE, normals.Options(), range(3)).images
    assert np.array_equal(images[..., 0] > 0, (maps != maps[:, :1, :1]).any(axis=3))
    assert images[..., 0].max() > 245, "something faces the camera"


@pytest.mark.parametrize("span_us", [SPAN_US, SPAN_US // 4])
def test_flow_across_is_focal_length_times_speed_over_depth(span_us):
    labels = people(1)
    rotations = matrix_from_axis_angle(labels.smpl_pose.reshape(1, 24, 3))
    vertices, _ = pose_vertices(load_body(None), rotations, labels.smpl_betas, labels.smpl_transl)
    near, far = vertices[0, :, 2].min(), vertices[0, :, 2].max()
    image = render(labels, moved(labels, [0.3, -0.6, 0], span_us))[0]
    body = image[..., 0] > 0
    for channel, speed in ((1, 0.3), (2, -0.6)):
        found = (image[body][:, channel].astype(float) - moving_body.STILL) / 127 * SIZE[0]
        bounds = sorted((FOCAL * speed / near, FOCAL * speed / far))
        assert bounds[0] - 0.3 < found.min() and found.max() < bounds[1] + 0.3, "half a step of a colour is 0.25 px/s"
    assert (image[~body] == [0, moving_body.STILL, moving_body.STILL]).all()


def test_a_body_that_comes_nearer_grows_away_from_the_middle_of_the_picture():
    labels = people(1)
    image = render(labels, moved(labels, [0, 0, -2.0])).astype(int)[0]
    rows, columns = np.nonzero(image[..., 0])
    flow = image[rows, columns, 1:] - moving_body.STILL
    away = np.column_stack([columns + 0.5, rows + 0.5]) - 32
    clear = np.abs(away) > 3
    assert clear.sum() > 100 and (np.sign(flow[clear]) == np.sign(away[clear])).all()


def test_what_is_faster_than_the_full_speed_has_the_strongest_colour():
    labels = people(1)
    image = render(labels, moved(labels, [5.0, 0, 0]), full_speed=0.5)[0]
    assert (image[image[..., 0] > 0][:, 1] == 255).all()


@pytest.mark.parametrize("count", range(5))
def test_turned_images_are_those_of_a_turned_camera(count):
    """A quarter turn of the picture against the clock takes the right to the top: (x, y) becomes (y, -x)."""
    labels = people(2)
    images = render(labels, moved(labels, [0.4, -0.7, 0.2]))
    turned = moving_body.turn(images, np.full(2, count), moving_body.Options()).astype(int) - moving_body.STILL
    expected = images.astype(int) - moving_body.STILL
    for _ in range(count):
        expected = np.rot90(expected, axes=(1, 2))
        expected = np.stack([expected[..., 0], expected[..., 2], -expected[..., 1]], axis=-1)
    assert np.array_equal(turned, expected)


def test_vertices_behind_the_camera_move_nowhere():
    labels = people(1, depth=0.1)
    images = render(labels, moved(labels, [0.1, 0, 0]))
    assert images.shape == (1, 64, 64, 3)


def test_a_row_depends_on_nothing_but_itself(monkeypatch):
    labels = people(5)
    motions = moved(labels, [0.4, 0.1, 0.2])
    together = render(labels, motions)
    monkeypatch.setattr(moving_body, "BATCH", 2)
    assert np.array_equal(render(labels, motions), together)
    assert np.array_equal(render(labels.take([3]), motions.take([3])), together[[3]])


def test_what_does_not_fit_is_refused():
    labels = people()
    motions = moved(labels, [0, 0, 0])
    with pytest.raises(DataError, match="3 labels but 2 motions and 3 seeds"):
        render(labels, motions.take([0, 1]))
    with pytest.raises(DataError, match="no SMPL parameters; use condition 'moving_skeleton'"):
        render(replace(labels, smpl_pose=None), motions)
    with pytest.raises(DataError, match="no camera intrinsics"):
        render(replace(labels, intrinsics=None), motions)
    with pytest.raises(DataError, match="row 0 needs ascending times"):
        render(labels, replace(motions, t_us=motions.t_us[:, ::-1]))
