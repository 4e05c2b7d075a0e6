"""BVH: skeletons of any names, orders, units and axes become SMPL poses whose limbs point where the source's do."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_writers import (
    CMU_NAMES,
    T_POSE,
    by_landmark,
    limb_error_deg,
    smpl_positions,
    solve_bvh,
    write_bvh,
)
from scipy.spatial.transform import Rotation

from ctlev_core.body.layer import load_body
from ctlev_core.body.motion.clip import Z_UP_TO_Y_UP, check_clip
from ctlev_core.body.motion.landmarks import LANDMARKS, find_landmarks
from ctlev_core.geometry.joint_sets import SMPL_JOINTS
from ctlev_core.motions import bvh
from data_contracts.errors import DataError

REAL = Path(__file__).resolve().parents[3].parent / "shared" / "real" / "motion"
NUM_JOINTS = len(T_POSE)
# Seven digits more than a pose has anyway; what is left comes from rounding in the logarithm of a rotation.
LIMIT_DEG = 1e-5

KNEES = ("left_knee", "right_knee")

HANGING = [
    (name, parent, (0, -abs(place[0]), 0) if name.endswith(("ForeArm", "Hand")) else place)
    for name, parent, place in T_POSE
]
"""The same skeleton with arms that hang."""


def real(name: str) -> Path:
    if not (REAL / name).is_file():
        pytest.skip("the real motions are not beside this checkout")
    return REAL / name


def random_motion(num_frames: int = 6, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    chance = np.random.default_rng(seed)
    root = np.array([0.0, 95, 0]) + chance.normal(0, 5, (num_frames, 3))
    return chance.normal(0, 50, (num_frames, NUM_JOINTS, 3)), root


def standing(num_frames: int = 1) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((num_frames, NUM_JOINTS, 3)), np.tile([0.0, 95, 0], (num_frames, 1))


@pytest.mark.parametrize("joints", [T_POSE, HANGING], ids=["T", "hanging"])
@pytest.mark.parametrize("order", ["ZYX", "XYZ", "YXZ", "ZXY", "YZX", "XZY"])
def test_limbs_point_where_they_point_in_the_file(order, joints, tmp_path):
    file = write_bvh(tmp_path / "a.bvh", *random_motion(), order=order, joints=joints)
    clip = bvh.read(file)
    assert limb_error_deg(clip, by_landmark(solve_bvh(file)), np.eye(3)) < LIMIT_DEG
    np.testing.assert_allclose(clip.time_s, np.arange(6) / 60)
    assert (clip.betas == 0).all()


@pytest.mark.parametrize(
    ("name", "world", "start", "num_frames"),
    [("cmu_12_01_walk.bvh", np.eye(3), 1, 523), ("pybvh_test3.bvh", Z_UP_TO_Y_UP, 0, 100)],
)
def test_limbs_of_real_files(name, world, start, num_frames):
    """pybvh_test3 stands along y in its rest pose and along z in its frames; the walk begins with a T."""
    file = real(name)
    clip = bvh.read(file)
    assert len(clip) == num_frames
    source = {landmark: places[start:] for landmark, places in by_landmark(solve_bvh(file)).items()}
    assert limb_error_deg(clip, source, world) < LIMIT_DEG
    joints = smpl_positions(clip)
    assert (joints["head"][:, 1] > joints["pelvis"][:, 1] + 0.5).all()
    lowest = min(joints[f"{side}_foot"][:, 1].min() for side in ("left", "right"))
    # The sole is 3 cm below the joint; proportions of foot and leg differ between people by about as much.
    assert -0.05 < lowest < 0.08


def test_the_walk_of_cmu_goes_where_it_looks():
    joints = smpl_positions(bvh.read(real("cmu_12_01_walk.bvh")))
    way = joints["pelvis"][-1] - joints["pelvis"][0]
    assert way[2] > 3 and abs(way[0]) < 0.3
    left = joints["left_hip"] - joints["right_hip"]
    assert (left[:, 0] > 0.1).all()
    knees = bvh.read(real("cmu_12_01_walk.bvh")).pose.reshape(-1, 24, 3)[:, [SMPL_JOINTS.index(n) for n in KNEES]]
    bent = knees[np.linalg.norm(knees, axis=-1) > 0.5]
    assert len(bent) > 100 and (bent[:, 0] / np.linalg.norm(bent, axis=-1) > 0.95).all()
    # Four steps in four seconds; each foot stands still on the ground for a part of the time.
    for side in ("left", "right"):
        speed = np.linalg.norm(np.diff(joints[f"{side}_foot"], axis=0), axis=1) * 120
        assert np.quantile(speed, 0.2) < 0.15 and np.quantile(speed, 0.9) > 1.5


def test_a_standing_source_stands_with_its_arms_as_they_are(tmp_path):
    for joints, arm in ((T_POSE, [1, 0, 0]), (HANGING, [0, -1, 0])):
        clip = bvh.read(write_bvh(tmp_path / "a.bvh", *standing(), joints=joints))
        body = smpl_positions(clip)
        for upper, lower in (("left_elbow", "left_wrist"), ("left_knee", "left_ankle")):
            bone = (body[lower] - body[upper])[0]
            direction = bone / np.linalg.norm(bone)
            expected = arm if "elbow" in upper else np.array([0, -41, -3]) / np.hypot(41, 3)
            np.testing.assert_allclose(direction, expected, atol=1e-9)
        trunk = clip.pose.reshape(24, 3)[
            [SMPL_JOINTS.index(n) for n in ("pelvis", "spine1", "spine2", "spine3", "head")]
        ]
        np.testing.assert_allclose(trunk, 0, atol=1e-9)


def test_palms_of_hanging_arms_face_the_thighs(tmp_path):
    """In SMPL's T, palms face the ground; an arm that comes down without a twist brings them to the body."""
    pose = bvh.read(write_bvh(tmp_path / "a.bvh", *standing(), joints=HANGING)).pose.reshape(24, 3)
    left, right = (pose[SMPL_JOINTS.index(f"{side}_shoulder")] for side in ("left", "right"))
    np.testing.assert_allclose(left / np.linalg.norm(left), [0, 0, -1], atol=0.1)
    np.testing.assert_allclose(right / np.linalg.norm(right), [0, 0, 1], atol=0.1)
    for name in ("left_wrist", "right_wrist"):
        np.testing.assert_allclose(pose[SMPL_JOINTS.index(name)], 0, atol=1e-9)


def test_yaw_turns_the_body_and_the_legs_give_the_scale(tmp_path):
    angles, root = standing(2)
    angles[:, 0, 1] = 90  # of ZYX: about y
    root[1] += [0, 0, 83.0 + 2]
    body = smpl_positions(bvh.read(write_bvh(tmp_path / "a.bvh", angles, root)))
    np.testing.assert_allclose((body["left_hip"] - body["right_hip"])[0] / 0.138, [0, 0, -1], atol=1e-6)
    rest = dict(zip(SMPL_JOINTS, load_body().joints, strict=True))
    legs = sum(np.linalg.norm(rest[a] - rest[b]) for a, b in (("left_hip", "left_knee"), ("left_knee", "left_ankle")))
    source_legs = np.linalg.norm([2, 42, 1]) + np.linalg.norm([41, 3])
    step = body["pelvis"][1] - body["pelvis"][0]
    np.testing.assert_allclose(step, [0, 0, 85 * legs / source_legs], atol=1e-9)
    hips = (body["left_hip"] + body["right_hip"])[0] / 2
    np.testing.assert_allclose(hips, [0, 89 * legs / source_legs, 0], atol=1e-9)


@pytest.mark.parametrize("unit", [1.0, 0.01, 1 / 2.54, 10.0])
def test_the_unit_does_not_matter(unit, tmp_path):
    angles, root = random_motion()
    expected = bvh.read(write_bvh(tmp_path / "a.bvh", angles, root))
    scaled = [(name, parent, tuple(unit * x for x in place)) for name, parent, place in T_POSE]
    got = bvh.read(write_bvh(tmp_path / "b.bvh", angles, unit * root, joints=scaled))
    np.testing.assert_allclose(got.pose, expected.pose, atol=1e-9)
    np.testing.assert_allclose(got.transl, expected.transl, atol=1e-9)


@pytest.mark.parametrize("turn", [Z_UP_TO_Y_UP.T, np.diag([-1.0, 1, -1]), [[0, 1, 0], [0, 0, 1], [1, 0, 0]]])
def test_any_axis_may_be_up_and_any_forward(turn, tmp_path):
    """A file whose axes are renamed, angles and all, is the same motion."""
    turn = np.asarray(turn, float)
    angles, root = random_motion()
    expected = bvh.read(write_bvh(tmp_path / "a.bvh", angles, root, order="XYZ"))
    # R_x(a) R_y(b) R_z(c), seen in axes that are turned: each axis becomes another one, perhaps the other way round.
    order = "".join("XYZ"[int(np.argmax(np.abs(turn[:, axis])))] for axis in range(3))
    signs = np.array([turn[:, axis].sum() for axis in range(3)])
    got = bvh.read(write_bvh(tmp_path / "b.bvh", signs * angles, root @ turn.T, order=order, world=turn))
    np.testing.assert_allclose(got.pose, expected.pose, atol=1e-9)
    np.testing.assert_allclose(got.transl, expected.transl, atol=1e-9)


def test_who_stands_along_z_is_turned_and_who_lies_is_not(tmp_path):
    angles, root = standing(3)
    angles[:, 0, 2] = 90  # of ZYX: about x, so that the head comes to lie along z
    on_feet = bvh.read(write_bvh(tmp_path / "a.bvh", angles, root[:, [0, 2, 1]]))
    assert (smpl_positions(on_feet)["head"] - smpl_positions(on_feet)["pelvis"])[0, 1] > 0.5
    lying = bvh.read(write_bvh(tmp_path / "a.bvh", angles, np.tile([0.0, 12, 30], (3, 1))))
    assert (smpl_positions(lying)["head"] - smpl_positions(lying)["pelvis"])[0, 2] > 0.5


def renamed(template_left: str, template_right: str, words: dict[str, str], others: dict[str, str]) -> dict[str, str]:
    parts = {"UpLeg": "hip", "Leg": "knee", "Foot": "ankle", "Arm": "shoulder", "ForeArm": "elbow", "Hand": "wrist"}
    names = dict(others)
    for part, landmark in parts.items():
        names[f"Left{part}"] = template_left.format(words[landmark])
        names[f"Right{part}"] = template_right.format(words[landmark])
    return names


def words(hip: str, knee: str, ankle: str, shoulder: str, elbow: str, wrist: str) -> dict[str, str]:
    return {"hip": hip, "knee": knee, "ankle": ankle, "shoulder": shoulder, "elbow": elbow, "wrist": wrist}


NAMINGS = {
    "mixamo": {name: f"mixamorig:{name}" for name, *_ in T_POSE},
    "underscores": {name: f"Character1_{name}" for name, *_ in T_POSE},
    "below a root": {name: "Armature" if name == "Hips" else f"mixamorig_{name}" for name, *_ in T_POSE},
    "biped": {
        **{name: f"Bip01 {name}" for name, *_ in T_POSE},
        **renamed("Bip01 L {}", "Bip01 R {}", words("Thigh", "Calf", "Foot", "UpperArm", "Forearm", "Hand"), {}),
    },
    "unreal": renamed(
        "{}_l", "{}_r", words("thigh", "calf", "foot", "upperarm", "lowerarm", "hand"),
        {"LeftShoulder": "clavicle_l", "RightShoulder": "clavicle_r", "Hips": "pelvis"},
    ),
    "smpl": renamed(
        "left_{}", "right_{}", words("hip", "knee", "ankle", "shoulder", "elbow", "wrist"),
        {"LeftShoulder": "left_collar", "RightShoulder": "right_collar", "LeftToeBase": "left_foot"},
    ),
    "asf": renamed(
        "l{}", "r{}", words("femur", "tibia", "foot", "humerus", "radius", "wrist"), {"Hips": "root", "Head": "head"}
    ),
    "daz": renamed("l{}", "r{}", words("Thigh", "Shin", "Foot", "Shldr", "ForeArm", "Hand"), {"Hips": "hip"}),
    "unity": renamed(
        "Left{}", "Right{}", words("UpperLeg", "LowerLeg", "Foot", "UpperArm", "LowerArm", "Hand"), {}
    ),
}  # fmt: skip


@pytest.mark.parametrize("naming", NAMINGS)
def test_skeletons_of_other_names(naming, tmp_path):
    motion = random_motion()
    expected = bvh.read(write_bvh(tmp_path / "a.bvh", *motion))
    got = bvh.read(write_bvh(tmp_path / "b.bvh", *motion, names=NAMINGS[naming]))
    np.testing.assert_array_equal(got.pose, expected.pose)


def test_names_that_are_not_known_are_listed(tmp_path):
    names = {"LeftLeg": "tentacle_1", "RightLeg": "tentacle_2"}
    file = write_bvh(tmp_path / "octopus.bvh", *standing(), names=names)
    with pytest.raises(
        DataError, match=r"octopus\.bvh: no joint of a known name for left_knee, right_knee; .*tentacle_1"
    ):
        bvh.read(file)
    with pytest.raises(DataError, match="no joint of a known name for left_hip"):
        find_landmarks(["body"], "a")
    with pytest.raises(DataError, match="no joint of a known name for left_hip"):
        find_landmarks(["", ""], "a")
    assert set(find_landmarks([name for name, *_ in T_POSE], "a")) == {*LANDMARKS, "head"}


def test_spines_of_any_length_share_the_bend(tmp_path):
    """One joint that bends by 60 degrees is three of SMPL's that bend by 20; none at all is a stiff back."""
    short = [(n, "Spine" if p == "Spine1" else p, x) for n, p, x in T_POSE if n not in ("Spine1", "Neck")]
    short = [(n, "Spine" if p == "Neck" else p, x) for n, p, x in short]
    angles = np.zeros((1, len(short), 3))
    angles[0, [n for n, *_ in short].index("Spine"), 2] = 60
    pose = bvh.read(write_bvh(tmp_path / "a.bvh", angles, standing()[1], joints=short)).pose.reshape(24, 3)
    for name in ("spine1", "spine2", "spine3"):
        np.testing.assert_allclose(np.rad2deg(pose[SMPL_JOINTS.index(name)]), [20, 0, 0], atol=1e-9)
    stiff = [(n, "Hips" if p == "Spine" else p, x) for n, p, x in short if n != "Spine"]
    clip = bvh.read(write_bvh(tmp_path / "a.bvh", np.zeros((1, len(stiff), 3)), standing()[1], joints=stiff))
    np.testing.assert_allclose(clip.pose.reshape(24, 3)[[3, 6, 9]], 0, atol=1e-12)


def test_fingers_and_roll_bones_are_left_alone(tmp_path):
    extra = [
        *T_POSE,
        ("LeftHandIndex1", "LeftHand", (8, 0, 1)),
        ("LeftHandThumb1", "LeftHand", (3, 0, 3)),
        ("Tail", "Hips", (0, 0, -20)),
    ]
    angles, root = random_motion()
    expected = bvh.read(write_bvh(tmp_path / "a.bvh", angles, root))
    more = np.concatenate([angles, np.full((6, 3, 3), 33.0)], axis=1)
    got = bvh.read(write_bvh(tmp_path / "b.bvh", more, root, joints=extra))
    np.testing.assert_allclose(got.pose, expected.pose, atol=1e-12)


def test_toes_give_the_feet_their_way_outwards(tmp_path):
    def foot(x: float) -> np.ndarray:
        joints = [(n, p, (np.sign(q[0]) * x, *q[1:]) if n.endswith("ToeBase") else q) for n, p, q in T_POSE]
        body = smpl_positions(bvh.read(write_bvh(tmp_path / "a.bvh", *standing(), joints=joints)))
        return (body["left_foot"] - body["left_ankle"])[0]

    for x in (0.0, 3.0, 8.0):
        assert np.arctan2(foot(x)[0], foot(x)[2]) == pytest.approx(np.arctan2(x, 13), abs=1e-9)
        assert foot(x)[1] == pytest.approx(load_body().joints[10, 1] - load_body().joints[7, 1], abs=1e-9)


def test_a_meaningless_rest_pose_gives_way_to_a_frame_that_stands(tmp_path):
    """LAFAN1 has all bones along x in its rest pose; each joint's frame is turned so, and motions are the same."""
    angles, root = random_motion(30, 1)
    angles *= np.linspace(0, 1, 30)[::-1, None, None]
    expected = bvh.read(write_bvh(tmp_path / "a.bvh", angles, root, joints=HANGING))
    flat, turns = folded_skeleton()
    local = Rotation.from_euler("ZYX", angles.reshape(-1, 3), degrees=True).as_matrix().reshape(30, NUM_JOINTS, 3, 3)
    parents = [next((i for i, (n, *_) in enumerate(HANGING) if n == p), -1) for _, p, _ in HANGING]
    for joint, parent in enumerate(parents):
        above = turns[parent] if parent >= 0 else np.eye(3)
        local[:, joint] = above.T @ local[:, joint] @ turns[joint]
    folded_angles = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_euler("ZYX", degrees=True).reshape(30, -1, 3)
    file = write_bvh(tmp_path / "b.bvh", folded_angles, root, joints=flat)
    got = bvh.read(file)
    assert limb_error_deg(got, by_landmark(solve_bvh(file)), np.eye(3)) < LIMIT_DEG
    # The last frame is the rest pose of the other file, and stands straightest.
    np.testing.assert_allclose(got.pose, expected.pose, atol=1e-6)


def folded_skeleton() -> tuple[list, np.ndarray]:
    """HANGING with every bone of more than one joint along x, and the turn of each joint that does it."""
    turns, joints = np.tile(np.eye(3), (NUM_JOINTS, 1, 1)), []
    for number, (name, _, _) in enumerate(HANGING):
        child = next((np.array(place, float) for _, p, place in HANGING if p == name), np.array([1.0, 0, 0]))
        turns[number] = Rotation.align_vectors([child], [[np.linalg.norm(child), 0, 0]])[0].as_matrix()
    for name, parent, place in HANGING:
        above = next((turns[i] for i, (n, *_) in enumerate(HANGING) if n == parent), np.eye(3))
        joints.append((name, parent, tuple(above.T @ np.array(place, float))))
    return joints, turns


def text_of(tmp_path: Path, num_frames: int = 2) -> str:
    return write_bvh(tmp_path / "a.bvh", *random_motion(num_frames)).read_text()


def change(tmp_path: Path, old: str, new: str) -> Path:
    text = text_of(tmp_path)
    assert old in text
    (tmp_path / "a.bvh").write_text(text.replace(old, new, 1))
    return tmp_path / "a.bvh"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Frames: 2", "Frames: 3", "3 frames of 66 channels take 198 numbers, got 132; the file may be cut"),
        ("Frames: 2", "Frames: 0", "expected a motion, got one of 0 frames"),
        ("Frames: 2", "Frames: 1.5", r"expected a motion, got one of 1\.5 frames"),
        ("Frames: 2", "Frames: many", "Frames must be numbers, got 'many'"),
        ("Frames: 2", "Frames: 1e300", "Frames must be finite"),
        ("Frame Time: 0.016666666666666666", "Frame Time: 0", "Frame Time must be positive, got 0"),
        ("Frame Time: 0.016666666666666666", "Frame Time: nan", "Frame Time must be finite"),
        ("Frame Time:", "Step:", "expected 'Frames:' and 'Frame Time:' after MOTION"),
        ("MOTION\n", "", "expected a line MOTION after the hierarchy, got none"),
        ("OFFSET 0.0 95.0 0.0", "OFFSET 0.0 95.0 high", "an OFFSET must be numbers, got '0.0 95.0 high'"),
        ("OFFSET 0.0 95.0 0.0", "OFFSET 0.0 nan 0.0", "an OFFSET must be finite"),
        ("Zrotation Yrotation Xrotation", "Zrotation Zrotation Xrotation", "CHANNELS must be different ones"),
        ("Zrotation Yrotation Xrotation", "Zrotation Yrotation Wrotation", "CHANNELS must be different ones"),
        ("CHANNELS 6", "CHANNELS 60", "CHANNELS must be different ones"),
        ("CHANNELS 6", "CHANNELS -6", "'Xposition' is not where it belongs"),
        ("JOINT Spine", "ROOT Spine", "'ROOT' is not where it belongs in the hierarchy; only files of one skeleton"),
        ("End Site", "End", "'End' is not where it belongs"),
        ("ROOT Hips\n{", "ROOT Hips\n", "is not where it belongs|ends early|before its last"),
        ("}\nMOTION", "MOTION", "the hierarchy ends before its last closing brace"),
    ],
)
def test_files_that_are_wrong(old, new, message, tmp_path):
    file = change(tmp_path, old, new)
    with pytest.raises(DataError, match=message) as error:
        bvh.read(file)
    assert str(error.value).startswith(str(file))


def test_numbers_of_the_motion_that_are_wrong(tmp_path):
    lines = text_of(tmp_path).rstrip().split("\n")
    for value, message in (("nan", "frame 1 holds a number that is not finite"), ("x1", "something that is no number")):
        row = lines[-1].split()
        row[7] = value
        (tmp_path / "a.bvh").write_text("\n".join([*lines[:-1], " ".join(row)]))
        with pytest.raises(DataError, match=message):
            bvh.read(tmp_path / "a.bvh")


def test_rest_poses_that_are_wrong(tmp_path):
    folded = [(n, p, (30, 0, 0) if n.endswith(("Leg", "Foot")) else q) for n, p, q in T_POSE]
    with pytest.raises(DataError, match="expected a person who stands, in the rest pose or at least in one frame"):
        bvh.read(write_bvh(tmp_path / "a.bvh", *standing(), joints=folded))
    short = [(n, p, (0, 0, 0) if n == "LeftForeArm" else q) for n, p, q in T_POSE]
    with pytest.raises(DataError, match="LeftArm and LeftForeArm are at the same place"):
        bvh.read(write_bvh(tmp_path / "a.bvh", *standing(), joints=short))
    one_leg = [(n, p, (0, -6, 0) if n.endswith("UpLeg") else q) for n, p, q in T_POSE]
    with pytest.raises(DataError, match="both hips are at the same place"):
        bvh.read(write_bvh(tmp_path / "a.bvh", *standing(), joints=one_leg))
    torn = [(n, "Hips" if n == "LeftFoot" else p, q) for n, p, q in T_POSE]
    with pytest.raises(DataError, match="LeftLeg and LeftFoot are no limb"):
        bvh.read(write_bvh(tmp_path / "a.bvh", *standing(), joints=torn))


def test_a_calibration_pose_before_the_first_frame_is_left_out(tmp_path):
    angles, root = standing(6)
    angles[:, :, 0] = np.linspace(0, 3, 6)[:, None]
    whole = bvh.read(write_bvh(tmp_path / "a.bvh", angles, root))
    assert len(whole) == 6
    angles[0, 8, 2] = 150
    cut = bvh.read(write_bvh(tmp_path / "a.bvh", angles, root))
    np.testing.assert_array_equal(cut.pose, whole.pose[1:])
    np.testing.assert_array_equal(cut.time_s, whole.time_s[1:])
    # A flick that comes again is a motion, and so is one that is slow enough.
    angles[3, 8, 2] = 150
    assert len(bvh.read(write_bvh(tmp_path / "a.bvh", angles, root))) == 6
    angles[3, 8, 2] = 0
    assert len(bvh.read(write_bvh(tmp_path / "a.bvh", angles, root, step_s=0.1))) == 6
    assert len(bvh.read(write_bvh(tmp_path / "a.bvh", angles[:2], root[:2]))) == 2


def test_one_frame_and_a_frame_time_of_zero(tmp_path):
    clip = bvh.read(write_bvh(tmp_path / "a.bvh", *random_motion(1), step_s=0.0))
    assert len(clip) == 1 and clip.time_s.tolist() == [0]


def test_other_ways_to_write_the_same_file(tmp_path):
    text = text_of(tmp_path)
    expected = bvh.read(tmp_path / "a.bvh")
    for other in (
        "\ufeff" + text,
        text.replace("\n", "\r\n"),
        text.replace("\t", "  ").replace("Frames: ", "Frames:\t"),
        text.replace("ROOT Hips\n{", "ROOT Hips {"),
        text.replace("End Site", "End Site").replace("rotation", "Rotation"),
    ):
        (tmp_path / "a.bvh").write_text(other, encoding="utf-8", newline="")
        assert bvh.sniff(tmp_path / "a.bvh")
        np.testing.assert_array_equal(bvh.read(tmp_path / "a.bvh").pose, expected.pose)
    (tmp_path / "a.bvh").write_text("MOTION")
    assert not bvh.sniff(tmp_path / "a.bvh")


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_damaged_files_give_a_motion_or_a_data_error(tmp_path_factory, seed):
    """Cuts, copies and other characters anywhere."""
    folder = tmp_path_factory.getbasetemp() / "damaged-bvh"
    folder.mkdir(exist_ok=True)
    chance = random.Random(seed)
    data = bytearray(damageable(folder))
    for _ in range(chance.choice([1, 2, 5])):
        at, length = chance.randrange(len(data) + 1), chance.choice([1, 1, 4, 40])
        match chance.randrange(4):
            case 0:
                data[at : at + length] = bytes(chance.choice(b" {}-.9eENaX\n\xff") for _ in range(length))
            case 1:
                del data[at : at + length]
            case 2:
                data[at:at] = data[at : at + length]
            case 3:
                del data[at:]
    (folder / "b.bvh").write_bytes(bytes(data))
    try:
        clip = bvh.read(folder / "b.bvh")
    except DataError as error:
        assert str(error).startswith(str(folder / "b.bvh"))
    else:
        check_clip(clip, "a damaged file")


def damageable(folder: Path) -> bytes:
    if not (folder / "a.bvh").is_file():
        write_bvh(folder / "a.bvh", *random_motion(2))
    return (folder / "a.bvh").read_bytes()


def test_every_limb_has_a_name():
    assert set(CMU_NAMES) == set(LANDMARKS)
