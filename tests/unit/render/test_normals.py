"""Normal maps: conventions against ControlNet v1.0's own formula, hard cases, independence of batch and threads."""

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from ctlev_core.render.normals import CONVENTIONS, normal_map, render_normal_maps, render_normals, turn_normal_map
from ctlev_core.render.rasteriser import NEAR_M
from data_contracts.errors import DataError

SIZE = (40, 30)
INTRINSICS = np.array([36.0, 37.0, 20.4, 14.6])


def render(vertices, faces, **options):
    vertices = np.asarray(vertices, np.float32)
    vertices = vertices if vertices.ndim == 3 else vertices[None]
    return render_normals(vertices, np.asarray(faces), np.tile(INTRINSICS, (len(vertices), 1)), SIZE, **options)


def ball(radius=0.6, centre=(0.0, 0.0, 2.0), subdivisions=3):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return (mesh.vertices + centre).astype(np.float32), mesh.faces.astype(np.int32)


def exact_sphere(size, focal, distance, radius):
    """Inverse depth [H, W] and normals [H, W, 3] of a sphere in the middle of the view; 0 where there is nothing."""
    rows, columns = np.mgrid[:size, :size] + 0.5
    rays = np.stack([(columns - size / 2) / focal, (rows - size / 2) / focal, np.ones_like(rows)], -1)
    squared = (rays**2).sum(-1)
    inside = distance**2 - squared * (distance**2 - radius**2)
    depth = (distance - np.sqrt(np.maximum(inside, 0))) / squared
    normals = (depth[..., None] * rays - [0, 0, distance]) / radius
    hit = inside > 0
    return np.where(hit, 1 / depth, 0), np.where(hit[..., None], normals, 0)


def controlnet_v10(inverse_depth, background_threshold=0.4):
    """The formula of ControlNet v1.0 (annotator/midas) and the reversal of its app (gradio_normal2image.py)."""
    depth = inverse_depth.astype(np.float32)
    scaled = (depth - depth.min()) / (depth.max() - depth.min())
    x = cv2.Sobel(depth, cv2.CV_32F, 1, 0, ksize=3)
    y = cv2.Sobel(depth, cv2.CV_32F, 0, 1, ksize=3)
    z = np.ones_like(x) * np.pi * 2.0
    x[scaled < background_threshold] = 0
    y[scaled < background_threshold] = 0
    normal = np.stack([x, y, z], axis=2)
    normal /= np.sum(normal**2.0, axis=2, keepdims=True) ** 0.5
    return (normal * 127.5 + 127.5).clip(0, 255).astype(np.uint8)[:, :, ::-1]


@pytest.mark.parametrize("midas_scale", [300.0, 3000.0])
def test_signs_of_controlnet_are_those_of_its_formula(midas_scale):
    """On a sphere, v1.0's picture and ours turn the same way, whatever the unknown scale of MiDaS' inverse depth."""
    inverse_depth, normals = exact_sphere(256, 300.0, 3.0, 0.9)
    theirs = controlnet_v10(midas_scale * inverse_depth)
    ours = normal_map(normals[None], "controlnet")[0]
    nothing = ~normals.any(axis=-1)
    far = cv2.erode(nothing.astype(np.uint8), np.ones((3, 3))) > 0
    np.testing.assert_array_equal(ours[nothing], np.broadcast_to([255, 127, 127], ours[nothing].shape))
    np.testing.assert_array_equal(theirs[far], ours[far])
    inner = cv2.erode((~nothing).astype(np.uint8), np.ones((3, 3))) > 0
    ours_zyx, theirs_zyx = ours.astype(float) - 127.5, theirs.astype(float) - 127.5
    for channel in (1, 2):
        clear = inner & (np.abs(ours_zyx[..., channel]) > 12) & (np.abs(theirs_zyx[..., channel]) > 12)
        assert clear.sum() > 4000
        np.testing.assert_array_equal(np.sign(ours_zyx[clear, channel]), np.sign(theirs_zyx[clear, channel]))
    # The same direction on the screen: 1 / z is linear there, so its gradient is along the normal's x and y. Where
    # tilts are small, whole numbers blur it.
    tilted = inner & (np.hypot(*theirs_zyx[..., 1:].T).T > 40) & (np.hypot(*ours_zyx[..., 1:].T).T > 40)
    turn = np.angle((theirs_zyx[..., 2] + 1j * theirs_zyx[..., 1]) / (ours_zyx[..., 2] + 1j * ours_zyx[..., 1]))[tilted]
    assert tilted.sum() > 4000 and np.degrees(np.abs(turn)).max() < 3.0
    assert (ours_zyx[inner, 0] > 0).mean() > 0.99 and (theirs_zyx[inner, 0] > 0).all()


def test_tilt_is_true_in_ours_and_a_matter_of_scale_in_theirs():
    inverse_depth, normals = exact_sphere(256, 300.0, 3.0, 0.9)
    near, far = (controlnet_v10(scale * inverse_depth)[128, 180, 0] for scale in (300.0, 3000.0))
    assert int(near) - int(far) > 30
    assert normal_map(normals[None], "controlnet")[0, 128, 180, 0] == int(-normals[128, 180, 2] * 127.5 + 127.5)


@pytest.mark.parametrize(
    ("normal", "controlnet", "rgb"),
    [
        ((0, 0, -1), (255, 127, 127), (128, 128, 255)),
        ((-1, 0, 0), (127, 127, 255), (0, 128, 128)),
        ((1, 0, 0), (127, 127, 0), (255, 128, 128)),
        ((0, -1, 0), (127, 255, 127), (128, 255, 128)),
        ((0, 1, 0), (127, 0, 127), (128, 0, 128)),
        ((0, 0, 0), (255, 127, 127), (0, 0, 0)),
    ],
)
def test_axes_of_both_conventions(normal, controlnet, rgb):
    """Facing the camera, left, right, up, down; and nothing."""
    picture = np.full((1, 1, 1, 3), normal, np.float32)
    assert tuple(normal_map(picture, "controlnet")[0, 0, 0]) == controlnet
    assert tuple(normal_map(picture, "rgb")[0, 0, 0]) == rgb


@given(st.integers(0, 10**6))
def test_colours_are_those_of_numpy(seed):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(1, 5, 6, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    np.testing.assert_array_equal(
        normal_map(normals, "controlnet"), (-normals * 127.5 + 127.5).clip(0, 255).astype(np.uint8)[..., ::-1]
    )
    np.testing.assert_array_equal(
        normal_map(normals, "rgb"), np.floor(normals * [127.5, -127.5, -127.5] + 128).clip(0, 255).astype(np.uint8)
    )


def test_a_rendered_ball_faces_the_right_ways():
    normals, depth_inverse = render(*ball())
    picture = normal_map(normals, "rgb")[0]
    rows, columns = np.nonzero(depth_inverse[0])
    top, bottom, left, right = rows.argmin(), rows.argmax(), columns.argmin(), columns.argmax()
    assert picture[rows[top], columns[top], 1] > 220 and picture[rows[bottom], columns[bottom], 1] < 35
    assert picture[rows[left], columns[left], 0] < 35 and picture[rows[right], columns[right], 0] > 220
    assert picture[15, 20, 2] > 250


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10**6))
def test_unit_length_wherever_there_is_a_surface(seed):
    rng = np.random.default_rng(seed)
    vertices = rng.uniform([-2, -2, -1], [2, 2, 4], (2, 20, 3))
    normals, depth_inverse = render(vertices, rng.integers(0, 20, (15, 3)))
    covered = depth_inverse > 0
    np.testing.assert_allclose(np.linalg.norm(normals[covered], axis=-1), 1, atol=1e-6)
    assert not normals[~covered].any() and depth_inverse.max() <= 1.001 / NEAR_M


@pytest.mark.parametrize("workers", [2, 3, 16])
def test_frames_depend_on_nothing_but_themselves(workers):
    vertices, faces = ball()
    rng = np.random.default_rng(0)
    poses = vertices + rng.uniform(-0.5, 0.5, (37, 1, 3)).astype(np.float32)
    expected = [render(pose, faces) for pose in poses]
    together = render(poses, faces, workers=workers)
    for i, name in enumerate(("normals", "depth_inverse")):
        np.testing.assert_array_equal(together[i], np.concatenate([one[i] for one in expected]), err_msg=name)


@pytest.mark.parametrize("workers", [1, 2])
def test_memory_of_an_earlier_call_is_written_over(workers):
    vertices, faces = ball()
    first = render(np.stack([vertices] * 11), faces)
    moved = np.stack([vertices + np.array([0.4, 0.2, 0.5], np.float32)] * 11)
    expected, again = render(moved, faces), render(moved, faces, out=first, workers=workers)
    for one, other, old in zip(again, expected, first, strict=True):
        assert one is old
        np.testing.assert_array_equal(one, other)
    for bad in ((first[0][:5], first[1]), (first[0].astype(float), first[1]), (first[0], first[1][:, ::-1])):
        with pytest.raises(ValueError, match="out must hold"):
            render(moved, faces, out=bad)


@pytest.mark.parametrize("workers", [1, 2, 5])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_maps_without_normals_in_between_are_the_same(convention, workers):
    vertices, faces = ball()
    poses = vertices + np.random.default_rng(1).uniform(-0.5, 0.5, (19, 1, 3)).astype(np.float32)
    intrinsics = np.tile(INTRINSICS, (19, 1))
    expected = normal_map(render(poses, faces)[0], convention)
    maps = render_normal_maps(poses, faces, intrinsics, SIZE, convention, workers=workers)
    assert maps.dtype == np.uint8
    np.testing.assert_array_equal(maps, expected)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e38])
def test_a_vertex_that_is_not_finite_costs_its_own_faces_only(bad):
    vertices, faces = ball()
    chosen = np.argmin(vertices[:, 2])
    clean = render(vertices, faces[(faces != chosen).all(axis=1)])
    for axis in range(3):
        broken = vertices.copy()
        broken[chosen, axis] = bad
        normals, depth_inverse = render(broken, faces)
        assert np.isfinite(normals).all() and np.isfinite(depth_inverse).all()
        if not np.isfinite(bad):
            np.testing.assert_array_equal(normals, clean[0])
            np.testing.assert_array_equal(depth_inverse, clean[1])


def test_a_pose_of_nan_is_an_empty_picture():
    vertices, faces = ball()
    normals, depth_inverse = render(np.full_like(vertices, np.nan), faces)
    assert not normals.any() and not depth_inverse.any()


def test_behind_the_camera_there_is_nothing_to_see():
    vertices, faces = ball(centre=(0, 0, -2.0))
    assert not render(vertices, faces)[1].any()


def test_inside_a_closed_body_there_is_nothing_to_see():
    vertices, faces = ball(centre=(0, 0, 0.1))
    normals, depth_inverse = render(vertices, faces)
    assert not normals.any() and not depth_inverse.any()


def test_a_floor_under_the_camera_is_clipped_and_not_dropped():
    """Two triangles from far behind to far in front; half of each is behind the camera."""
    floor = np.array([[-50, 1, -40], [50, 1, -40], [50, 1, 60], [-50, 1, 60]])
    normals, depth_inverse = render(floor, [[0, 1, 2], [0, 2, 3]])
    rows = np.arange(SIZE[1]) + 0.5 - INTRINSICS[3]
    # Depth of the floor, 1 m below, in each row of pixels; it ends at 60 m.
    expected = np.where(rows / INTRINSICS[1] > 1 / 60, rows / INTRINSICS[1], 0)
    np.testing.assert_allclose(depth_inverse[0], np.repeat(expected[:, None], SIZE[0], axis=1), atol=1e-6)
    np.testing.assert_allclose(normals[0][depth_inverse[0] > 0], [[0, -1, 0]] * np.count_nonzero(depth_inverse))


def test_degenerate_faces_change_nothing():
    vertices, faces = ball()
    line = np.array([[-1, 0, 1.0], [0, 0, 1.0], [1, 0, 1.0]], np.float32)
    more = np.concatenate([faces, [[5, 5, 9], [7, 7, 7]], len(vertices) + np.array([[0, 1, 2], [2, 1, 0]])])
    for one, other in zip(render(vertices, faces), render(np.concatenate([vertices, line]), more), strict=True):
        np.testing.assert_array_equal(one, other)


def test_opposite_faces_that_cancel_face_the_camera():
    sheet = [[-1, -1, 2], [1, -1, 2], [0, 1, 2]]
    normals, depth_inverse = render(sheet, [[0, 1, 2], [0, 2, 1]])
    assert np.count_nonzero(depth_inverse) > 50
    np.testing.assert_array_equal(normals[depth_inverse > 0], [[0, 0, -1]] * np.count_nonzero(depth_inverse))


@pytest.mark.parametrize("distance", [3.0, 30.0, 300.0])
def test_the_nearer_of_two_sheets_a_millimetre_apart(distance):
    square = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]) * distance
    sheets = np.concatenate([square, square + np.array([0, 0, 0.001])])
    front = np.array([[0, 2, 1], [0, 3, 2]])
    for faces in (np.concatenate([front, front + 4]), np.concatenate([front + 4, front])):
        _, depth_inverse = render(sheets, faces)
        # A float32 near 300 m is 0.03 mm fine.
        np.testing.assert_allclose(1 / depth_inverse.astype(float), distance, atol=0.00004 + 1e-7 * distance)


def test_no_frames_and_no_faces():
    vertices, faces = ball()
    assert render(np.zeros((0, *vertices.shape)), faces)[0].shape == (0, SIZE[1], SIZE[0], 3)
    assert not render(vertices, np.zeros((0, 3), int))[1].any()


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"image_size": (0, 30)}, DataError, "image_size"),
        ({"image_size": (40, -1)}, DataError, "image_size"),
        ({"vertices_cam": np.zeros((3, 3), np.float32)}, DataError, "vertices_cam"),
        ({"faces": np.array([[0, 1, 3]])}, DataError, "faces must name"),
        ({"faces": np.array([[0, 1, -1]])}, DataError, "faces must name"),
        ({"faces": np.array([[0.0, 1.0, 2.0]])}, DataError, "faces must be"),
        ({"intrinsics": np.ones((2, 4))}, DataError, "intrinsics must be"),
        ({"intrinsics": np.array([[1, np.nan, 0, 0]])}, DataError, "finite"),
        ({"intrinsics": np.array([[0.0, 1, 0, 0]])}, DataError, "positive"),
        ({"renderer": "vulkan"}, ValueError, "numba, pyrender"),
        ({"workers": 0}, ValueError, "workers"),
    ],
)
def test_wrong_calls_are_named(changes, error, message):
    arguments = {
        "vertices_cam": np.zeros((1, 3, 3), np.float32), "faces": np.array([[0, 1, 2]]), "intrinsics": INTRINSICS[None],
        "image_size": SIZE,
    }  # fmt: skip
    with pytest.raises(error, match=message):
        render_normals(**(arguments | changes))


def test_wrong_pictures_are_named():
    with pytest.raises(ValueError, match="controlnet, controlnet_unreversed, rgb"):
        normal_map(np.zeros((1, 2, 2, 3)), "blue")
    with pytest.raises(ValueError, match="controlnet, controlnet_unreversed, rgb"):
        render_normal_maps(np.zeros((1, 3, 3)), np.array([[0, 1, 2]]), INTRINSICS[None], SIZE, "blue")
    with pytest.raises(DataError, match=r"\[N, H, W, 3\]"):
        normal_map(np.zeros((2, 2, 3)), "rgb")


def test_the_unreversed_convention_is_the_reversed_one_reversed():
    """What a ControlNet with the channel order `bgr` makes of it must be what v1.0's network sees."""
    normals = np.random.default_rng(0).normal(size=(2, 6, 5, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[0, :2] = 0.0
    reversed_by_config = normal_map(normals, "controlnet_unreversed")[..., ::-1]
    np.testing.assert_array_equal(reversed_by_config, normal_map(normals, "controlnet"))


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_turned_maps_are_maps_of_turned_normals(convention, turns):
    rng = np.random.default_rng(turns)
    normals = rng.normal(size=(1, 16, 16, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[0, :4, 3:9] = 0  # background
    turned = np.rot90(normals, turns, axes=(1, 2)).copy()
    for _ in range(turns):  # what points right points up, what points down points right
        turned[..., 0], turned[..., 1] = turned[..., 1].copy(), -turned[..., 0]
    expected = normal_map(turned, convention)[0].astype(int)
    found = turn_normal_map(normal_map(normals, convention)[0], turns, convention)
    assert np.abs(found - expected).max() <= 1
    background = ~turned[0].any(axis=-1)
    np.testing.assert_array_equal(found[background], expected[background])


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_a_turned_map_is_that_of_a_rolled_camera(convention):
    size, intrinsics = (64, 64), np.array([[60.0, 60.0, 32.0, 32.0]])
    vertices, faces = ball(radius=0.3, centre=(0.2, 0.35, 2.0))
    rolled = vertices[:, [1, 0, 2]] * np.array([1, -1, 1], np.float32)  # once against the clock on the screen
    still, expected = (
        render_normal_maps(v[None], faces, intrinsics, size, convention)[0].astype(int) for v in (vertices, rolled)
    )
    found = turn_normal_map(still.astype(np.uint8), 1, convention).astype(int)
    body = (found != found[0, 0]).any(axis=2) & (expected != expected[0, 0]).any(axis=2)
    assert body.sum() > 200 and np.abs(np.rot90(still) - expected)[body].max() > 100
    assert np.abs(found - expected)[body].max() <= 1
