"""The body layers, numba's and torch's, against a slow float64 reference written from the paper's equations."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from smpl_writers import smpl_arrays

from ctlev_core.body import layer
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.body.torch_layer import BodyLayer
from ctlev_core.geometry.joint_sets import SMPL_JOINTS, SMPL_PARENTS
from data_contracts.errors import DataError

BUNDLED = layer.load_body()
NAMES = ("v_template", "f", "weights", "shapedirs", "J_regressor")


def random_body(num_vertices=300, correctives=True, **changes):
    arrays = smpl_arrays(3, num_vertices, num_faces=20) | changes
    return layer.make_body(*(arrays[name] for name in NAMES), posedirs=arrays["posedirs"] if correctives else None)


WITH_CORRECTIVES = random_body()
WITHOUT = random_body(correctives=False)
BODIES = {"correctives": WITH_CORRECTIVES, "none": WITHOUT, "bundled": BUNDLED}


def random_batch(frames, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(0, 0.7, (frames, 72)), rng.normal(size=(frames, 10)), rng.normal(size=(frames, 3))


def rotations_of(pose):
    return matrix_from_axis_angle(pose.reshape(-1, 24, 3))


def skinned_slowly(body, pose, betas, transl):
    """One frame in float64: eq. 2-4 and 7-10, homogeneous 4 x 4 matrices, dense weights."""
    rotations = rotations_of(pose)[0]
    weights = np.zeros((len(body.v_template), 24))
    np.put_along_axis(weights, body.weight_indices, body.weight_values, axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    rest = body.v_template.astype(np.float64) + body.shapedirs.astype(np.float64) @ betas
    bones = body.joints + body.joint_shapedirs @ betas
    if body.posedirs is not None:
        features = np.concatenate([(rotation - np.eye(3)).ravel() for rotation in rotations[1:]])
        rest = rest + (features @ body.posedirs.astype(np.float64)).reshape(-1, 3)
    world = []
    for joint, parent in enumerate(SMPL_PARENTS):
        local = np.eye(4)
        local[:3, :3] = rotations[joint]
        local[:3, 3] = bones[joint] - (bones[parent] if parent >= 0 else 0)
        world.append(world[parent] @ local if parent >= 0 else local)
    world = np.stack(world)
    joints = world[:, :3, 3] + transl
    world[:, :3, 3] -= np.einsum("jab,jb->ja", world[:, :3, :3], bones)
    blended = np.einsum("vj,jab->vab", weights, world)
    return np.einsum("vab,vb->va", blended[:, :3, :3], rest) + blended[:, :3, 3] + transl, joints


def expected_batch(body, pose, betas, transl):
    frames = [skinned_slowly(body, *frame) for frame in zip(pose[:, None], betas, transl, strict=True)]
    return (np.stack(part) for part in zip(*frames, strict=True))


@pytest.mark.parametrize("name", BODIES)
def test_batches_against_the_slow_reference(name):
    body, (pose, betas, transl) = BODIES[name], random_batch(19)
    vertices, joints = layer.pose_vertices(body, rotations_of(pose), betas, transl)
    expected, expected_joints = expected_batch(body, pose, betas, transl)
    assert vertices.dtype == np.float32
    # Positions of a few metres in float32, a sum of about ten roundings.
    np.testing.assert_allclose(vertices, expected, atol=3e-6)
    np.testing.assert_allclose(joints, expected_joints, atol=1e-13)


@pytest.mark.parametrize("name", BODIES)
def test_one_shape_for_all_frames_is_that_shape_in_each(name):
    body, (pose, betas, transl) = BODIES[name], random_batch(5)
    vertices, joints = layer.pose_vertices(body, rotations_of(pose), betas[0], transl)
    each, each_joints = layer.pose_vertices(body, rotations_of(pose), np.tile(betas[0], (5, 1)), transl)
    np.testing.assert_allclose(vertices, each, atol=2e-6)
    np.testing.assert_array_equal(joints, each_joints)
    np.testing.assert_allclose(layer.shape_vertices(body, betas)[0], layer.shape_vertices(body, betas[0]), atol=1e-6)


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("first", [0, 5, 16, 63, 69])
@pytest.mark.parametrize("count", [0, 1, 2, 15, 16, 17])
def test_no_frame_depends_on_its_batch(name, first, count):
    body, (pose, betas, transl) = BODIES[name], random_batch(70)
    rows = slice(first, first + count)
    for shape in (betas, betas[0]):
        whole, joints = layer.pose_vertices(body, rotations_of(pose), shape, transl)
        some_shape = shape[rows] if shape.ndim == 2 else shape
        part, part_joints = layer.pose_vertices(body, rotations_of(pose)[rows], some_shape, transl[rows])
        assert part.shape == (len(transl[rows]), len(body.v_template), 3)
        np.testing.assert_array_equal(part, whole[rows])
        np.testing.assert_array_equal(part_joints, joints[rows])


def test_threads_share_nothing():
    pose, betas, transl = random_batch(64)
    rotations = rotations_of(pose)
    expected = layer.pose_vertices(WITH_CORRECTIVES, rotations, betas, transl)[0]
    with ThreadPoolExecutor(2) as pool:
        calls = [pool.submit(layer.pose_vertices, WITH_CORRECTIVES, rotations, betas, transl) for _ in range(8)]
        for call in calls:
            np.testing.assert_array_equal(call.result()[0], expected)


def test_results_go_where_they_are_wanted():
    pose, betas, transl = random_batch(3)
    out = np.full((3, 300, 3), np.nan, np.float32)
    vertices, _ = layer.pose_vertices(WITHOUT, rotations_of(pose), betas[0], transl, out)
    assert vertices is out
    np.testing.assert_array_equal(out, layer.pose_vertices(WITHOUT, rotations_of(pose), betas[0], transl)[0])
    for wrong in (np.empty((2, 300, 3), np.float32), np.empty((3, 300, 3)), np.empty((3, 3, 300), np.float32).mT):
        with pytest.raises(ValueError, match="out must be"):
            layer.pose_vertices(WITHOUT, rotations_of(pose), betas[0], transl, wrong)


def test_frames_one_by_one_with_their_normals_are_the_batch():
    pose, betas, transl = random_batch(4)
    rotations = rotations_of(pose)
    batch, _ = layer.pose_vertices(WITH_CORRECTIVES, rotations, betas[0], transl)
    transforms, _ = layer.joint_transforms(WITH_CORRECTIVES, rotations, betas[0], transl)
    offsets = layer.pose_offsets(WITH_CORRECTIVES, rotations)
    assert offsets is not None and layer.pose_offsets(WITHOUT, rotations) is None
    rest, posed, normals = (
        layer.shape_vertices(WITH_CORRECTIVES, betas[0]),
        np.empty_like(batch[0]),
        np.empty_like(batch[0]),
    )
    body = WITH_CORRECTIVES
    for frame, moves in enumerate(transforms.astype(np.float32)):
        layer.skin(rest + offsets[frame], body.normals, body.weight_indices, body.weight_values, moves, posed, normals)
        np.testing.assert_allclose(posed, batch[frame], atol=3e-6)


def test_weights_of_many_joints_are_all_kept():
    weights = np.random.default_rng(0).dirichlet(np.ones(24), 300)
    body, (pose, betas, transl) = random_body(weights=weights), random_batch(3)
    assert body.weight_indices.shape == (300, 24)
    np.testing.assert_allclose(body.weight_values.sum(axis=1), 1.0, atol=1e-6)
    expected, _ = expected_batch(body, pose, betas, transl)
    np.testing.assert_allclose(layer.pose_vertices(body, rotations_of(pose), betas, transl)[0], expected, atol=3e-6)


@pytest.mark.parametrize("angle", [0.0, np.pi, 2 * np.pi, -2 * np.pi, 4 * np.pi])
def test_turns_of_exactly_nothing_half_and_whole(angle):
    pose, transl = np.zeros((1, 72)), np.array([[0.5, 1.0, 3.0]])
    pose[:, 1] = angle
    vertices, joints = layer.pose_vertices(BUNDLED, rotations_of(pose), np.zeros(10), transl)
    half = np.array([-1, 1, -1]) if angle == np.pi else np.ones(3)
    expected = (BUNDLED.v_template - BUNDLED.joints[0]) * half + BUNDLED.joints[0] + transl
    np.testing.assert_allclose(vertices[0], expected, atol=2e-6)
    np.testing.assert_allclose(
        joints[0], (BUNDLED.joints - BUNDLED.joints[0]) * half + BUNDLED.joints[0] + transl, atol=1e-14
    )
    single = BodyLayer(BUNDLED)(*(torch.tensor(array, dtype=torch.float32) for array in (pose, np.zeros(10), transl)))
    # The angle itself is rounded to float32: 4 pi is off by 7e-7 rad, over an arm of a metre.
    np.testing.assert_allclose(single[0][0], expected, atol=4e-6)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.sampled_from([-5.0, 0.0, 5.0]), min_size=10, max_size=10), st.integers(0, 2**32 - 1))
def test_extreme_shapes_stay_bodies(betas, seed):
    pose, _, transl = random_batch(2, seed)
    vertices, joints = layer.pose_vertices(BUNDLED, rotations_of(pose), np.array(betas), 0 * transl)
    assert np.isfinite(vertices).all() and np.isfinite(joints).all()
    rest = BUNDLED.joints + BUNDLED.joint_shapedirs @ betas
    lengths = np.linalg.norm(rest[1:] - rest[list(SMPL_PARENTS[1:])], axis=1)
    # Five standard deviations of everything at once; nobody, but no bone vanishes and no giant appears.
    assert lengths.min() > 0.005 and lengths.max() < 1.0
    for frame in range(2):
        posed = np.linalg.norm(joints[frame, 1:] - joints[frame, list(SMPL_PARENTS[1:])], axis=1)
        np.testing.assert_allclose(posed, lengths, atol=1e-12)
    np.testing.assert_allclose(vertices.mean(axis=1), joints.mean(axis=1), atol=1.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_named(bad):
    pose, betas, transl = random_batch(4)
    rotations = rotations_of(pose)
    wrong = rotations.copy()
    wrong[2, SMPL_JOINTS.index("left_knee"), 1, 1] = bad
    for function in (layer.pose_vertices, layer.joint_transforms):
        with pytest.raises(DataError, match="rotations of frame 2, joint left_knee are not finite"):
            function(BUNDLED, wrong, betas, transl)
        wrong_betas, wrong_transl = betas.copy(), transl.copy()
        wrong_betas[3, 9] = wrong_transl[1, 0] = bad
        with pytest.raises(DataError, match="betas of frame 3 are not finite"):
            function(BUNDLED, rotations, wrong_betas, transl)
        with pytest.raises(DataError, match="betas are not finite"):
            function(BUNDLED, rotations, wrong_betas[3], transl)
        with pytest.raises(DataError, match="transl of frame 1 are not finite"):
            function(BUNDLED, rotations, betas, wrong_transl)


def test_wrong_shapes_are_named():
    pose, betas, transl = random_batch(4)
    rotations = rotations_of(pose)
    for arguments, message in (
        ((pose, betas, transl), r"rotations must be \[T, 24, 3, 3\], got \(4, 72\)"),
        ((rotations, betas[:3], transl), r"betas must be \[10\] or \[4, 10\], got \(3, 10\)"),
        ((rotations, np.zeros(16), transl), "betas must be"),
        ((rotations, betas, transl[0]), r"transl must be \[4, 3\]"),
    ):
        with pytest.raises(ValueError, match=message):
            layer.pose_vertices(BUNDLED, *arguments)
    with pytest.raises(DataError, match=r"posedirs must have the shape \(300, 3, 207\)"):
        random_body(posedirs=np.zeros((300, 3, 206)))


def as_tensors(*arrays, dtype=torch.float64):
    return tuple(torch.tensor(array, dtype=dtype) for array in arrays)


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("frames", [0, 1, 9])
def test_torch_in_float64_is_the_slow_reference(name, frames):
    body, (pose, betas, transl) = BODIES[name], random_batch(frames)
    torch_layer = BodyLayer(body, torch.float64)
    vertices, joints = torch_layer(*as_tensors(pose, betas, transl))
    assert vertices.shape == (frames, len(body.v_template), 3) and joints.shape == (frames, 24, 3)
    if frames:
        expected, expected_joints = expected_batch(body, pose, betas, transl)
        np.testing.assert_allclose(vertices, expected, atol=1e-12)
        np.testing.assert_allclose(joints, expected_joints, atol=1e-12)
    again, _ = torch_layer(*as_tensors(rotations_of(pose), betas, transl))
    np.testing.assert_allclose(again, vertices, atol=1e-12)


@pytest.mark.parametrize("name", BODIES)
def test_torch_in_float32_is_the_numba_route(name):
    body, (pose, betas, transl) = BODIES[name], random_batch(9)
    rotations = rotations_of(pose)
    vertices, joints = BodyLayer(body)(*as_tensors(rotations, betas[0], transl, dtype=torch.float32))
    expected, expected_joints = layer.pose_vertices(body, rotations, betas[0], transl)
    # Here the chain of up to nine bones is float32 as well.
    np.testing.assert_allclose(vertices, expected, atol=6e-6)
    np.testing.assert_allclose(joints, expected_joints, atol=6e-6)


@pytest.mark.parametrize("correctives", [True, False])
@pytest.mark.parametrize("scale", [0.0, 0.7])
def test_torch_gradients(correctives, scale):
    torch_layer = BodyLayer(random_body(12, correctives), torch.float64)
    pose, betas, transl = random_batch(1)
    inputs = tuple(tensor.requires_grad_() for tensor in as_tensors(scale * pose, betas, transl))
    assert torch.autograd.gradcheck(torch_layer, inputs)


def test_torch_gradients_to_rotations_and_a_common_shape():
    torch_layer = BodyLayer(random_body(12), torch.float64)
    pose, betas, _ = random_batch(2)
    inputs = tuple(tensor.requires_grad_() for tensor in as_tensors(rotations_of(pose), betas[0]))
    assert torch.autograd.gradcheck(torch_layer, inputs, fast_mode=True)


def test_a_pose_is_found_again_by_its_gradients():
    torch_layer = BodyLayer(WITHOUT, torch.float64)
    pose, betas, transl = as_tensors(*random_batch(1))
    target = torch_layer(0.4 * pose, betas, transl)[0]
    found = torch.zeros(1, 72, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([found], max_iter=200, history_size=72, line_search_fn="strong_wolfe")

    def compute_error():
        optimiser.zero_grad()
        error = (torch_layer(found, betas, transl)[0] - target).square().sum()
        error.backward()
        return error

    optimiser.step(compute_error)
    assert (torch_layer(found.detach(), betas, transl)[0] - target).abs().max() < 1e-3


def test_torch_keeps_a_bad_frame_to_itself():
    pose, betas, transl = random_batch(6)
    torch_layer = BodyLayer(WITH_CORRECTIVES)
    good, _ = torch_layer(*as_tensors(pose, betas, transl, dtype=torch.float32))
    pose[4, 10] = np.nan
    vertices, _ = torch_layer(*as_tensors(pose, betas, transl, dtype=torch.float32))
    assert vertices[4].isnan().any()
    others = [0, 1, 2, 3, 5]
    np.testing.assert_array_equal(vertices[others], good[others])


def test_torch_layer_moves_and_says_what_is_wrong():
    torch_layer = BodyLayer(WITHOUT)
    assert not list(torch_layer.parameters()) and not torch_layer.state_dict()
    assert torch_layer.faces.dtype == torch.int64
    pose, betas, transl = as_tensors(*random_batch(2), dtype=torch.float32)
    with pytest.raises(ValueError, match=r"pose must be \[N, 24, 3, 3\] or \[N, 72\], got \[2, 69\]"):
        torch_layer(pose[:, 3:], betas, transl)
    with pytest.raises(ValueError, match=r"betas must be \[2, 10\] or \[10\], got \[2, 16\]"):
        torch_layer(pose, torch.zeros(2, 16), transl)
    with pytest.raises(ValueError, match=r"transl must be \[2, 3\]"):
        torch_layer(pose, betas, transl[0])
    with pytest.raises(ValueError, match=r"betas must be torch\.float32 like the layer, got torch\.float64"):
        torch_layer(pose, betas.double(), transl)
    double = torch_layer.double()
    assert double(pose.double(), betas.double(), transl.double())[0].dtype == torch.float64


def test_smplx_poses_the_same_file_to_the_same_vertices(tmp_path):
    smplx = pytest.importorskip("smplx", reason="the optional oracle smplx is not installed")
    (tmp_path / "SMPL_NEUTRAL.pkl").write_bytes(pickle.dumps(smpl_arrays(), 2))
    body, (pose, betas, transl) = layer.load_body(tmp_path / "SMPL_NEUTRAL.pkl"), random_batch(3)
    oracle = smplx.SMPL(str(tmp_path), batch_size=3)
    pose_32, betas_32, transl_32 = as_tensors(pose, betas, transl, dtype=torch.float32)
    posed = oracle(global_orient=pose_32[:, :3], body_pose=pose_32[:, 3:], betas=betas_32, transl=transl_32)
    vertices, joints = layer.pose_vertices(body, rotations_of(pose), betas, transl)
    # It works in float32 from the pose on: a few roundings of positions of some metres.
    np.testing.assert_allclose(vertices, posed.vertices.detach(), atol=4e-6)
    np.testing.assert_allclose(joints, posed.joints[:, :24].detach(), atol=4e-6)


@pytest.mark.gpu
def test_torch_layer_on_a_gpu_is_that_of_the_cpu():
    batch = as_tensors(*random_batch(9))
    torch_layer = BodyLayer(WITH_CORRECTIVES, torch.float64)
    expected, expected_joints = torch_layer(*batch)
    vertices, joints = torch_layer.cuda()(*(tensor.cuda() for tensor in batch))
    np.testing.assert_allclose(vertices.cpu(), expected, atol=1e-12)
    np.testing.assert_allclose(joints.cpu(), expected_joints, atol=1e-12)
