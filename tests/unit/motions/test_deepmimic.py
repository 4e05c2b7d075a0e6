"""DeepMimic's humanoid: its frames become SMPL poses whose limbs point where the humanoid's do."""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_writers import limb_error_deg, smpl_positions, solve_deepmimic, standing_frames, write_deepmimic
from scipy.spatial.transform import Rotation

from ctlev_core.body.motion.clip import check_clip
from ctlev_core.geometry.joint_sets import SMPL_JOINTS
from ctlev_core.motions import deepmimic
from data_contracts.errors import DataError

REAL = Path(__file__).resolve().parents[3].parent / "shared" / "real" / "motion"
MOTIONS = ("cartwheel", "dance_a", "jump", "kick", "punch", "run", "spinkick", "walk")
FACING = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
"""x forward, z right to z forward, x left."""
LIMIT_DEG = 1e-5


def real(name: str) -> Path:
    path = REAL / f"humanoid3d_{name}.txt"
    if not path.is_file():
        pytest.skip("the real motions are not beside this checkout")
    return path


@pytest.mark.parametrize("seed", range(4))
def test_limbs_point_where_the_humanoid_s_do(seed, tmp_path):
    frames = standing_frames(5, seed)
    clip = deepmimic.read(write_deepmimic(tmp_path / "humanoid3d_big_jump.txt", frames))
    assert limb_error_deg(clip, solve_deepmimic(frames), FACING) < LIMIT_DEG
    assert clip.caption == "big jump"
    np.testing.assert_allclose(clip.time_s, np.arange(5) / 30)


@pytest.mark.parametrize("name", MOTIONS)
def test_limbs_of_real_files(name):
    path = real(name)
    frames = np.array(json.loads(path.read_text())["Frames"])
    clip = deepmimic.read(path)
    assert len(clip) == len(frames) and clip.caption == name.replace("_", " ")
    assert limb_error_deg(clip, solve_deepmimic(frames), FACING) < LIMIT_DEG
    np.testing.assert_allclose(np.diff(clip.time_s), frames[:-1, 0])
    joints = smpl_positions(clip)
    lowest = min(joints[f"{side}_foot"][:, 1].min() for side in ("left", "right"))
    assert -0.1 < lowest < 0.08, "the humanoid's ground is at 0; its feet are boxes without a heel"


def test_people_walk_and_run_forwards():
    for name in ("walk", "run"):
        pelvis = smpl_positions(deepmimic.read(real(name)))["pelvis"]
        way = pelvis[-1] - pelvis[0]
        assert way[2] > 1 and abs(way[0]) < 0.1


def test_the_rest_pose_faces_z_with_hanging_arms(tmp_path):
    body = smpl_positions(deepmimic.read(write_deepmimic(tmp_path / "a.txt", standing_frames(1))))
    np.testing.assert_allclose((body["left_hip"] - body["right_hip"])[0] / 0.138, [1, 0, 0], atol=1e-6)
    for side in ("left", "right"):
        arm = (body[f"{side}_wrist"] - body[f"{side}_shoulder"])[0]
        np.testing.assert_allclose(arm / np.linalg.norm(arm), [0, -1, 0], atol=1e-9)
        foot = (body[f"{side}_foot"] - body[f"{side}_ankle"])[0]
        assert foot[0] == pytest.approx(0, abs=1e-9) and foot[2] > 0.1


def test_chest_neck_and_root_turn_trunk_and_head(tmp_path):
    """One joint of the chest is three of SMPL's, one of the neck two; bending forward is about the left: -z, then x."""
    frames = standing_frames(1)
    for column, degrees in ((8, 60), (12, 30)):
        frames[0, column : column + 4] = Rotation.from_euler("z", -degrees, degrees=True).as_quat()[[3, 0, 1, 2]]
    pose = np.rad2deg(deepmimic.read(write_deepmimic(tmp_path / "a.txt", frames)).pose.reshape(24, 3))
    for name, bend in (("pelvis", 0), ("spine1", 20), ("spine2", 20), ("spine3", 20), ("neck", 15), ("head", 15)):
        np.testing.assert_allclose(pose[SMPL_JOINTS.index(name)], [bend, 0, 0], atol=1e-9)


def test_hinges_of_the_humanoid_are_hinges_of_smpl(tmp_path):
    """Knees bend back about the left, elbows of a T forward about the vertical; bones of the two differ by degrees."""
    frames = standing_frames(1)
    frames[0, [20, 34]], frames[0, [29, 43]] = -1.0, 1.2
    pose = deepmimic.read(write_deepmimic(tmp_path / "a.txt", frames)).pose.reshape(24, 3)
    hinges = (("knee", 1.0, [1, 0, 0], [1, 0, 0]), ("elbow", 1.2, [0, -1, 0], [0, 1, 0]))
    for part, angle, left, right in hinges:
        for side, axis in (("left", left), ("right", right)):
            turn = pose[SMPL_JOINTS.index(f"{side}_{part}")]
            assert turn @ axis / np.linalg.norm(turn) > np.cos(np.deg2rad(15)), (side, part)
            assert np.linalg.norm(turn) == pytest.approx(angle, abs=0.15)


def test_knees_of_real_walks_bend_back():
    for name in ("walk", "run"):
        pose = deepmimic.read(real(name)).pose.reshape(-1, 24, 3)
        for knee in (SMPL_JOINTS.index("left_knee"), SMPL_JOINTS.index("right_knee")):
            bent = pose[:, knee][np.linalg.norm(pose[:, knee], axis=1) > 0.5]
            assert len(bent) and (bent[:, 0] / np.linalg.norm(bent, axis=1) > 0.95).all()


def test_quaternions_of_any_length_and_sign(tmp_path):
    frames = standing_frames(3, 1)
    expected = deepmimic.read(write_deepmimic(tmp_path / "a.txt", frames))
    for column in (4, 8, 12, 16, 21, 25, 30, 35, 39):
        frames[:, column : column + 4] *= -2.5
    got = deepmimic.read(write_deepmimic(tmp_path / "a.txt", frames))
    np.testing.assert_allclose(got.pose, expected.pose, atol=1e-12)


def test_the_last_duration_does_not_count(tmp_path):
    frames = standing_frames(3, 1)
    frames[:, 0] = [0.1, 0.3, 0.0]
    np.testing.assert_allclose(deepmimic.read(write_deepmimic(tmp_path / "a.txt", frames)).time_s, [0, 0.1, 0.4])
    one = deepmimic.read(write_deepmimic(tmp_path / "a.txt", frames[2:]))
    assert len(one) == 1 and one.time_s.tolist() == [0]


def test_motions_are_told_from_the_humanoid_and_other_text(tmp_path):
    assert deepmimic.sniff(write_deepmimic(tmp_path / "a.txt", standing_frames(1)))
    for text, is_motion in (
        ('{"Frames":[]}', True),
        ('\ufeff {"Loop": "none", "RightJoints": [3, 4], "LeftJoints": [6], "Frames": [', True),
        ('{"EnableCycleSync": true, "Loop": "wrap",\n"Frames":\n[', True),
        ('{"Skeleton": {"Joints": [{"ID": 0}]}, "Frames": 1}', False),
        ("Frames: 12", False),
        ("", False),
    ):
        (tmp_path / "a.txt").write_text(text, encoding="utf-8")
        assert deepmimic.sniff(tmp_path / "a.txt") == is_motion, text
    assert not deepmimic.sniff(real("character"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[1].pop(), "frame 1 must have 44 numbers, got 43"),
        (lambda rows: rows.__setitem__(1, 3), "frame 1 must have 44 numbers, got int"),
        (lambda rows: rows[1].__setitem__(7, float("nan")), "frame 1 holds something that is no finite number"),
        (lambda rows: rows[1].__setitem__(7, float("inf")), "frame 1 holds something that is no finite number"),
        (lambda rows: rows[1].__setitem__(7, "0"), "frame 1 holds something that is no finite number"),
        (lambda rows: rows[1].__setitem__(slice(16, 20), [0, 0, 0, 0]), "quaternion of right_hip in frame 1 is zero"),
        (lambda rows: rows[0].__setitem__(0, 0), "times must rise, frame 1 follows 0.0 s at 0.0 s"),
        (lambda rows: rows.clear(), "expected a motion, got one of zero frames"),
    ],
    ids=["short", "number", "nan", "inf", "text", "zero", "time", "none"],
)
def test_files_that_are_wrong(change, message, tmp_path):
    rows = standing_frames(2).tolist()
    change(rows)
    path = tmp_path / "a.txt"
    path.write_text(json.dumps({"Loop": "none", "Frames": rows}))
    with pytest.raises(DataError, match=message) as error:
        deepmimic.read(path)
    assert str(error.value).startswith(str(path))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"Loop": "none", "Frames": [[0.1, ', "damaged, or no JSON"),
        ('{"Frames": ' + "[" * 200_000, "damaged, or no JSON"),
        ("[1, 2]", "expected an object with a list of Frames, got list"),
        ('{"Frames": 1}', "expected an object with a list of Frames"),
        ('{"Frames": [[' + "9" * 400 + "]]}", "frame 0 must have 44 numbers, got 1"),
    ],
)
def test_text_that_is_wrong(text, message, tmp_path):
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(DataError, match=message):
        deepmimic.read(tmp_path / "a.txt")


SEEDS = st.integers(0, 2**32 - 1)


@settings(max_examples=150, deadline=None)
@given(SEEDS)
def test_damaged_files_give_a_motion_or_a_data_error(tmp_path_factory, seed):
    folder = tmp_path_factory.getbasetemp() / "damaged-deepmimic"
    folder.mkdir(exist_ok=True)
    path = write_deepmimic(folder / "a.txt", np.round(standing_frames(2, 3), 3))
    chance = random.Random(seed)
    data = bytearray(path.read_bytes())
    for _ in range(chance.choice([1, 2, 5])):
        at, length = chance.randrange(len(data) + 1), chance.choice([1, 1, 4, 40])
        match chance.randrange(4):
            case 0:
                data[at : at + length] = bytes(chance.choice(b' {}[],-.9eE"\n\xff') for _ in range(length))
            case 1:
                del data[at : at + length]
            case 2:
                data[at:at] = data[at : at + length]
            case 3:
                del data[at:]
    path.write_bytes(bytes(data))
    try:
        clip = deepmimic.read(path)
    except DataError as error:
        assert str(error).startswith(str(path))
    else:
        check_clip(clip, "a damaged file")
