"""The body layer against slow loops, the procedural body against its own construction, the motions against physics."""

import pickle

import numpy as np
import pytest
import trimesh

from ctlev_core.body import layer, procedural
from ctlev_core.body.motion import procedural as motions
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.geometry.joint_sets import SMPL_JOINTS, SMPL_PARENTS
from data_contracts.errors import DataError

BODY = layer.load_body()
STILL = np.zeros((24, 3))


def random_pose(seed, frames=1):
    rng = np.random.default_rng(seed)
    return (
        matrix_from_axis_angle(rng.normal(0, 0.6, (frames, 24, 3))),
        rng.normal(size=10),
        rng.normal(size=(frames, 3)),
    )


def style(**changes):
    values = {"start": 0.0, "speed": 1.0, "amplitude": 1.0, "mirrored": False, "habit_start": STILL, "habit_end": STILL}
    return motions.MotionStyle(**{**values, **changes})


def joints_of(name, time_s, performed):
    rotations, transl = motions.pose_at(name, time_s, performed)
    return layer.joint_transforms(BODY, rotations, np.zeros(10), transl)[1]


def test_bundled_body_is_a_closed_human_sized_surface():
    mesh = trimesh.Trimesh(BODY.v_template, BODY.faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.body_count == 1 and mesh.euler_number == 2
    assert 0.06 < mesh.volume < 0.1
    assert 1.7 < mesh.extents[1] < 1.85
    # trimesh weights the faces around a vertex by angle, not by area.
    agreement = np.sum(mesh.vertex_normals * BODY.normals, axis=1)
    assert agreement.min() > 0.75 and np.median(agreement) > 0.99


def test_left_is_plus_x_and_the_face_looks_along_z():
    assert BODY.joints[SMPL_JOINTS.index("left_hand"), 0] > 0.7
    toes = BODY.joints[SMPL_JOINTS.index("left_foot")] - BODY.joints[SMPL_JOINTS.index("left_ankle")]
    assert toes[2] > 0.1
    nose = BODY.v_template[np.argmax(np.where(BODY.v_template[:, 1] > 0.3, BODY.v_template[:, 2], -1))]
    assert nose[2] > 0.1 and abs(nose[0]) < 0.02


def test_regressor_gives_the_joints_and_their_shape_derivatives():
    rest = procedural.rest_joints()
    np.testing.assert_allclose(BODY.joints, rest, atol=1e-6)
    for direction in range(10):
        betas = np.eye(10)[direction]
        regressed = BODY.j_regressor.astype(np.float64) @ layer.shape_vertices(BODY, betas)
        # float32 storage of weights up to 0.6 over 160 vertices
        np.testing.assert_allclose(regressed, rest + BODY.joint_shapedirs @ betas, atol=2e-6)


def test_weights_are_a_partition_of_unity_on_the_right_bones():
    assert BODY.weight_values.min() >= 0
    np.testing.assert_allclose(BODY.weight_values.sum(axis=1), 1.0, atol=1e-6)
    hand = np.argmax(BODY.v_template[:, 0])
    assert SMPL_JOINTS[BODY.weight_indices[hand, 0]] == "left_hand"


@pytest.mark.parametrize("direction", range(10))
def test_every_shape_direction_does_something_and_stays_symmetric(direction):
    move = BODY.shapedirs[:, :, direction]
    assert 0.004 < np.abs(move).max() < 0.2
    mirrored = BODY.joint_shapedirs[:, :, direction] * [-1, 1, 1]
    partner = [
        SMPL_JOINTS.index(n.replace("left", "#").replace("right", "left").replace("#", "right")) for n in SMPL_JOINTS
    ]
    np.testing.assert_allclose(mirrored[partner], BODY.joint_shapedirs[:, :, direction], atol=2e-6)


def test_forward_kinematics_against_a_loop_over_bones():
    rotations, betas, transl = random_pose(0)
    _, joints = layer.joint_transforms(BODY, rotations, betas, transl)
    rest = BODY.joints + BODY.joint_shapedirs @ betas

    def world(joint):
        transform = np.eye(4)
        while joint >= 0:
            parent = SMPL_PARENTS[joint]
            local = np.eye(4)
            local[:3, :3] = rotations[0, joint]
            local[:3, 3] = rest[joint] - (rest[parent] if parent >= 0 else 0)
            transform, joint = local @ transform, parent
        return transform

    expected = [world(joint)[:3, 3] + transl[0] for joint in range(24)]
    np.testing.assert_allclose(joints[0], expected, atol=1e-12)


def test_skinning_against_dense_float64():
    rotations, betas, transl = random_pose(1, frames=2)
    posed, _ = layer.pose_vertices(BODY, rotations, betas, transl)
    transforms, _ = layer.joint_transforms(BODY, rotations, betas, transl)
    dense = np.zeros((len(BODY.v_template), 24))
    np.put_along_axis(dense, BODY.weight_indices, BODY.weight_values, axis=1)
    rest = BODY.v_template.astype(np.float64) + BODY.shapedirs.astype(np.float64) @ betas
    blended = np.einsum("vj,tjab->tvab", dense, transforms)
    expected = np.einsum("tvab,vb->tva", blended[..., :3], rest) + blended[..., 3]
    # float32 positions of a few metres
    np.testing.assert_allclose(posed, expected, atol=3e-6)


def test_root_rotation_turns_the_body_rigidly_about_the_pelvis():
    rotations = np.tile(np.eye(3), (1, 24, 1, 1))
    rotations[0, 0] = turn = matrix_from_axis_angle(np.array([0.3, 2.0, -1.0]))
    posed, joints = layer.pose_vertices(BODY, rotations, np.zeros(10), np.array([[1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(joints[0, 0], BODY.joints[0] + [1, 2, 3], atol=1e-12)
    expected = (BODY.v_template - BODY.joints[0]) @ turn.T + joints[0, 0]
    np.testing.assert_allclose(posed[0], expected, atol=3e-6)


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match="rotations must be"):
        layer.joint_transforms(BODY, np.zeros((1, 23, 3, 3)), np.zeros(10), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="transl must be"):
        layer.joint_transforms(BODY, np.zeros((2, 24, 3, 3)), np.zeros(10), np.zeros((1, 3)))


def test_bundled_file_is_what_the_generator_makes():
    pytest.importorskip("skimage")
    built = procedural.build_body()
    np.testing.assert_array_equal(built.faces, BODY.faces)
    # Another linear-algebra library may round differently; a micrometre is far below what anything here resolves.
    np.testing.assert_allclose(built.v_template, BODY.v_template, atol=1e-6)
    np.testing.assert_allclose(built.shapedirs, BODY.shapedirs, atol=1e-5)
    np.testing.assert_allclose(built.joints, BODY.joints, atol=1e-6)


def test_build_refuses_a_useless_grid():
    with pytest.raises(ValueError, match="voxel_m"):
        procedural.build_body(voxel_m=0.2)


def body_arrays():
    dense = np.zeros((len(BODY.v_template), 24), np.float32)
    np.put_along_axis(dense, BODY.weight_indices, BODY.weight_values, axis=1)
    return {
        "v_template": BODY.v_template,
        "f": BODY.faces,
        "weights": dense,
        "shapedirs": BODY.shapedirs,
        "J_regressor": BODY.j_regressor,
    }


def test_load_body_reads_files_with_smpl_keys(tmp_path):
    path = tmp_path / "body.npz"
    # SMPL files may carry 300 shape directions; ten are used.
    arrays = body_arrays() | {"shapedirs": np.tile(BODY.shapedirs, (1, 1, 3))}
    np.savez(path, **arrays)
    loaded = layer.load_body(path)
    np.testing.assert_array_equal(loaded.shapedirs, BODY.shapedirs)
    np.testing.assert_allclose(loaded.joints, BODY.joints, atol=1e-7)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": np.zeros((5, 24))}, "weights must have the shape"),
        ({"f": np.array([[0, 1, 10**6]])}, "faces must name vertices"),
        ({"v_template": np.full_like(BODY.v_template, np.nan)}, "not finite"),
        ({"shapedirs": BODY.shapedirs[..., :3]}, "shapedirs must have the shape"),
    ],
)
def test_load_body_names_what_is_wrong(tmp_path, change, message):
    path = tmp_path / "body.npz"
    np.savez(path, **(body_arrays() | change))
    with pytest.raises(DataError, match=message):
        layer.load_body(path)


def test_load_body_refuses_other_files(tmp_path):
    with pytest.raises(DataError, match="cannot be read"):
        layer.load_body(tmp_path / "absent.npz")
    (tmp_path / "text.npz").write_text("not a zip")
    with pytest.raises(DataError, match="cannot be read"):
        layer.load_body(tmp_path / "text.npz")
    np.savez(tmp_path / "part.npz", v_template=BODY.v_template)
    with pytest.raises(DataError, match="lacks f, weights"):
        layer.load_body(tmp_path / "part.npz")
    np.savez(tmp_path / "object.npz", **(body_arrays() | {"J_regressor": np.array([{"a": 1}], dtype=object)}))
    with pytest.raises(DataError, match="pickle"):
        layer.load_body(tmp_path / "object.npz")
    (tmp_path / "model.pkl").write_bytes(pickle.dumps({"v_template": 1}))
    with pytest.raises(DataError, match="cannot be read"):
        layer.load_body(tmp_path / "model.pkl")


def test_motion_groups_share_nothing_and_cover_everything():
    groups = (motions.SEEN, motions.UNSEEN, motions.HELD_OUT)
    assert sum(map(len, groups)) == len(motions.MOTIONS) == len(set().union(*groups))
    assert motions.SEEN == ("walk", "run", "punch", "jump") and len(motions.HELD_OUT) == 3


@pytest.mark.parametrize("name", motions.MOTIONS)
def test_motion_is_smooth_and_stands_on_the_ground(name):
    time_s = np.arange(0, 2 * motions.MOTIONS[name].duration_s, 0.005)
    rotations, transl = motions.sample_pose(name, time_s, np.random.default_rng(4))
    np.testing.assert_allclose(
        rotations @ np.swapaxes(rotations, -1, -2), np.broadcast_to(np.eye(3), rotations.shape), atol=1e-12
    )
    joints = layer.joint_transforms(BODY, rotations, np.zeros(10), transl)[1]
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1) / 0.005
    # A kicking foot or throwing hand reaches about 15 m/s; a gap between two poses would be a hundred.
    assert speed.max() < 20.0
    lowest = joints[..., 1].min(axis=1)
    assert lowest.min() > -0.06
    if name not in ("run", "jump", "jumping_jack"):
        assert lowest.max() < 0.04
    # Somebody who does not move makes no events.
    assert speed.max(axis=1).mean() > 0.2


@pytest.mark.parametrize("name", [n for n, m in motions.MOTIONS.items() if m.cyclic and not m.turn_deg])
def test_cyclic_motion_repeats(name):
    duration = motions.MOTIONS[name].duration_s
    rotations, _ = motions.pose_at(name, np.array([0.1, 0.1 + duration]), style(start=0.4))
    np.testing.assert_allclose(rotations[0], rotations[1], atol=1e-9)


def test_walking_goes_forward_at_walking_speed():
    joints = joints_of("walk", np.linspace(0, 4.2, 50), style())
    velocity = (joints[-1, 0] - joints[0, 0]) / 4.2
    assert 0.7 < velocity[2] < 1.6 and abs(velocity[0]) < 0.1


def test_the_foot_on_the_ground_stays_where_it_is():
    time_s = np.linspace(0.25, 0.40, 16)
    foot = joints_of("walk", time_s, style())[:, SMPL_JOINTS.index("left_foot")]
    assert np.ptp(foot[:, 2]) < 0.06


@pytest.mark.parametrize("name", ["punch", "dance", "cartwheel"])
def test_mirrored_motion_is_the_mirror_image(name):
    time_s = np.linspace(0, 0.8, 5)
    plain, mirrored = (joints_of(name, time_s, style(mirrored=flag)) for flag in (False, True))
    partner = [
        SMPL_JOINTS.index(n.replace("left", "#").replace("right", "left").replace("#", "right")) for n in SMPL_JOINTS
    ]
    # The rest joints are stored in float32.
    np.testing.assert_allclose(mirrored[:, partner] * [-1, 1, 1], plain, atol=1e-6)


def test_poses_do_not_depend_on_which_other_times_are_asked_for():
    performed = motions.sample_style("run", np.random.default_rng(0))
    time_s = np.linspace(0, 0.25, 64)
    rotations, transl = motions.pose_at("run", time_s, performed)
    rows = [40, 3, 20]
    some_rotations, some_transl = motions.pose_at("run", time_s[rows], performed)
    np.testing.assert_array_equal(some_rotations, rotations[rows])
    np.testing.assert_allclose(some_transl, transl[rows], atol=1e-12)


def test_every_performance_differs():
    poses = [motions.sample_pose("walk", np.zeros(1), np.random.default_rng(seed))[0] for seed in range(3)]
    assert np.abs(poses[0] - poses[1]).max() > 0.05 and np.abs(poses[1] - poses[2]).max() > 0.05


def test_bad_motions_and_times_are_named():
    with pytest.raises(DataError, match=r"unknown motion 'fly'; known: walk"):
        motions.sample_pose("fly", np.zeros(1), np.random.default_rng(0))
    for times in ([-0.1], [np.nan], [[0.0]]):
        with pytest.raises(DataError, match="time_s"):
            motions.pose_at("walk", np.array(times), style())
