"""SMPL poses as bare arrays: every known layout is the same motion, and no pickle runs."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from motion_writers import smpl_positions
from scipy.spatial.transform import Rotation

from ctlev_core.body.motion import files as motion_files
from ctlev_core.body.motion.clip import REST_PELVIS, MotionClip, take
from ctlev_core.motions import smpl_arrays
from ctlev_core.safe_files import numpy_files
from data_contracts.errors import DataError

NUM_FRAMES = 7


def poses(num_frames: int = NUM_FRAMES) -> np.ndarray:
    """Axis-angle [T, 24, 3] of lengths below pi, so that they survive matrices."""
    return np.random.default_rng(0).uniform(-1.5, 1.5, (num_frames, 24, 3))


def transl(num_frames: int = NUM_FRAMES) -> np.ndarray:
    return np.random.default_rng(1).normal(0, 2, (num_frames, 3))


BETAS = np.linspace(-1, 1, 10)


def matrices(num_frames: int = NUM_FRAMES) -> np.ndarray:
    return Rotation.from_rotvec(poses(num_frames).reshape(-1, 3)).as_matrix().reshape(-1, 24, 3, 3)


def sixes(num_frames: int = NUM_FRAMES) -> np.ndarray:
    """[T, 24, 6], two rows, as PyTorch3D writes them."""
    return matrices(num_frames)[:, :, :2].reshape(num_frames, 24, 6)


def mdm(num_frames: int = NUM_FRAMES) -> np.ndarray:
    """[25, 6, T]: 6D, then the pelvis and zeros."""
    pelvis = np.zeros((num_frames, 1, 6))
    pelvis[:, 0, :3] = transl(num_frames) + REST_PELVIS
    return np.concatenate([sixes(num_frames), pelvis], axis=1).transpose(1, 2, 0)


def flat(num_frames: int = NUM_FRAMES) -> np.ndarray:
    return poses(num_frames).reshape(num_frames, 72)


def shapes(num_frames: int = NUM_FRAMES) -> np.ndarray:
    return np.tile(BETAS, (num_frames, 1))


LAYOUTS = {
    "axis-angle": (flat, False, False),
    "joints": (poses, False, False),
    "position": (lambda n: np.hstack([transl(n), flat(n)]), True, False),
    "shape": (lambda n: np.hstack([flat(n), shapes(n)]), False, True),
    "position and shape": (lambda n: np.hstack([transl(n), flat(n), shapes(n)]), True, True),
    "matrices": (matrices, False, False),
    "6D": (sixes, False, False),
    "6D, time last": (lambda n: sixes(n).transpose(1, 2, 0), False, False),
    "MDM": (mdm, True, False),
    "MDM, batch": (lambda n: mdm(n)[None], True, False),
}


def check(clip: MotionClip, num_frames: int, with_transl: bool, with_betas: bool) -> None:
    np.testing.assert_allclose(clip.pose, flat(num_frames), atol=1e-6)
    np.testing.assert_allclose(clip.transl, transl(num_frames) if with_transl else 0, atol=1e-6)
    np.testing.assert_allclose(clip.betas, BETAS if with_betas else 0, atol=1e-6)
    np.testing.assert_allclose(clip.time_s, np.arange(num_frames) / 20)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("num_frames", [1, 3, 6, 24, 25])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_the_same_motion(layout, num_frames, dtype, tmp_path):
    make, *parts = LAYOUTS[layout]
    np.save(tmp_path / "a.npy", make(num_frames).astype(dtype))
    assert smpl_arrays.sniff(tmp_path / "a.npy")
    check(smpl_arrays.read(tmp_path / "a.npy"), num_frames, *parts)


def test_the_rate_is_what_the_file_says_or_else_the_caller(tmp_path):
    np.save(tmp_path / "a.npy", flat())
    np.testing.assert_allclose(smpl_arrays.read(tmp_path / "a.npy", 50.0).time_s, np.arange(NUM_FRAMES) / 50)
    np.testing.assert_allclose(motion_files.read_motion(tmp_path / "a.npy", 10.0).time_s, np.arange(NUM_FRAMES) / 10)
    for name in ("fps", "mocap_framerate"):
        np.savez(tmp_path / "a.npz", poses=flat(), **{name: np.array(60)})
        np.testing.assert_allclose(smpl_arrays.read(tmp_path / "a.npz", 50.0).time_s, np.arange(NUM_FRAMES) / 60)


@pytest.mark.parametrize(
    "names", [("poses", "trans", "betas"), ("pose", "transl", "shape"), ("smpl_poses", "tran", "beta")]
)
def test_named_arrays(names, tmp_path):
    pose_name, transl_name, betas_name = names
    arrays = {pose_name: poses(), transl_name: transl(), betas_name: BETAS}
    np.savez(tmp_path / "a.npz", **arrays, unrelated=np.array([{}], object))
    assert motion_files.find_format(tmp_path / "a.npz") is smpl_arrays
    check(smpl_arrays.read(tmp_path / "a.npz"), NUM_FRAMES, True, True)
    np.savez_compressed(tmp_path / "a.npz", **{**arrays, betas_name: shapes()})
    check(smpl_arrays.read(tmp_path / "a.npz"), NUM_FRAMES, True, True)


@pytest.mark.parametrize("num_body", [21, 23])
def test_root_and_body_apart(num_body, tmp_path):
    body = poses()[:, 1 : 1 + num_body]
    np.savez(tmp_path / "a.npz", global_orient=poses()[:, :1], body_pose=body.reshape(NUM_FRAMES, -1), transl=transl())
    pose = smpl_arrays.read(tmp_path / "a.npz").pose.reshape(-1, 24, 3)
    np.testing.assert_array_equal(pose[:, : 1 + num_body], poses()[:, : 1 + num_body])
    assert (pose[:, 1 + num_body :] == 0).all()


def mdm_parameters() -> dict:
    """What MDM's render_mesh writes, but for the tensors in it."""
    motion = mdm().astype(np.float32)
    return {
        "motion": motion,
        "thetas": motion[:-1],
        "root_translation": motion[-1, :3],
        "faces": np.zeros((20, 3), np.uint32),
        "text": "a person jumps",
        "length": np.int64(NUM_FRAMES),
    }


def test_the_dictionary_of_mdm(tmp_path):
    np.save(tmp_path / "a.npy", mdm_parameters(), allow_pickle=True)
    assert motion_files.find_format(tmp_path / "a.npy") is smpl_arrays
    clip = smpl_arrays.read(tmp_path / "a.npy")
    check(clip, NUM_FRAMES, True, False)
    assert clip.caption == "a person jumps"


def test_tensors_beside_it_are_passed_over(tmp_path):
    torch = pytest.importorskip("torch")
    loaded = {**mdm_parameters(), "vertices": torch.zeros(4, 3, NUM_FRAMES), "rotations": torch.zeros(2)}
    np.save(tmp_path / "a.npy", loaded, allow_pickle=True)
    check(smpl_arrays.read(tmp_path / "a.npy"), NUM_FRAMES, True, False)
    np.save(tmp_path / "a.npy", {**loaded, "thetas": torch.zeros(24, 6, 3)}, allow_pickle=True)
    with pytest.raises(DataError, match="thetas must be numbers, got NoneType"):
        smpl_arrays.read(tmp_path / "a.npy")


class RunsCode:
    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def test_code_in_a_pickle_is_not_run(tmp_path):
    mark = tmp_path / "ran"
    for loaded in ({"thetas": RunsCode(f"touch {mark}")}, RunsCode(f"touch {mark}; : thetas")):
        np.save(tmp_path / "a.npy", np.array(loaded, object), allow_pickle=True)
        with pytest.raises(DataError, match=r"a\.npy: refused: it names (posix|nt)\.system"):
            motion_files.read_motion(tmp_path / "a.npy")
    assert not mark.exists()


def test_positions_of_joints_are_another_format(tmp_path):
    standing = MotionClip(np.zeros((3, 72)), np.zeros(10), np.zeros((3, 3)), np.arange(3.0))
    moving = take(standing, np.zeros(9, np.int64))
    moving.pose[:] = 0.3 * flat(9)
    for clip in (standing, moving):
        joints = np.stack(list(smpl_positions(clip).values()), axis=1)
        np.save(tmp_path / "a.npy", joints)
        assert not smpl_arrays.sniff(tmp_path / "a.npy")
    for rotations in (poses(), poses(1), np.zeros((4, 24, 3)), np.tile(poses(1), (5, 1, 1))):
        np.save(tmp_path / "a.npy", rotations)
        assert smpl_arrays.sniff(tmp_path / "a.npy")


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((5, 263)), r"poses must be \[T, 72\], .*, got \[5, 263\]"),
        (np.zeros((5, 22, 6)), r"poses must be .*, got \[5, 22, 6\]"),
        (np.zeros(72), r"poses must be .*, got \[72\]"),
        (np.zeros((0, 72)), r"expected a motion, got one of zero frames: \[0, 72\]"),
        (np.zeros((25, 6, 0)), "zero frames"),
        (np.full((5, 72), np.nan), "frame 0 holds a number that is not finite"),
        (np.where(np.arange(5)[:, None] == 3, 1e9, np.zeros((5, 72))), "frame 3 holds a number .* no pose's"),
        (np.zeros((5, 24, 6)), r"rotation_6d\[0, 0\] .*has a vector that is 0"),
        (np.ones((5, 24, 6)), r"rotation_6d\[0, 0\] .*has parallel vectors"),
        (np.ones((5, 24, 3, 3)), "a matrix of frame 0 is no rotation"),
        (np.tile(np.diag([1.0, 1, -1]), (5, 24, 1, 1)), "a matrix of frame 0 is no rotation"),
        (np.zeros((2, 25, 6, 4)), "holds 2 motions; expected one a file"),
        (np.zeros((5, 85)) + np.arange(5)[:, None], "the shape changes in frame 1; expected one body"),
        (np.where(np.arange(85) > 80, np.nan, np.zeros((5, 85))), "frame 0 holds a number that is not finite"),
    ],
)
def test_arrays_that_are_wrong(array, message, tmp_path):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(DataError, match=message) as error:
        smpl_arrays.read(tmp_path / "a.npy")
    assert str(error.value).startswith(str(tmp_path / "a.npy"))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"poses": np.zeros((5, 72)), "trans": np.zeros((4, 3))}, r"transl must be \[5, 3\], got \[4, 3\]"),
        ({"poses": np.zeros((5, 72)), "betas": np.zeros(9)}, r"the shape must be at least 10 numbers, got \[9\]"),
        ({"poses": np.zeros((5, 72)), "betas": np.zeros((0, 10))}, "betas is empty"),
        ({"poses": np.zeros((5, 72)), "fps": np.array(0)}, "frame rate must be one positive number, got 0"),
        ({"poses": np.zeros((5, 72)), "fps": np.array("fast")}, "fps must be numbers"),
        ({"poses": np.array("none")}, "poses must be numbers"),
        ({"thetas": mdm()[:-1], "root_translation": np.zeros(NUM_FRAMES)}, r"root_translation must be \[3, T\]"),
        ({"body_pose": np.zeros((5, 69))}, "lacks poses; found body_pose"),
        ({"body_pose": np.zeros((5, 69)), "global_orient": np.zeros((4, 3))}, r"must be \[T, 3\] and \[T, 69\]"),
    ],
)
def test_named_arrays_that_are_wrong(arrays, message, tmp_path):
    np.savez(tmp_path / "a.npz", **arrays)
    assert smpl_arrays.sniff(tmp_path / "a.npz")
    with pytest.raises(DataError, match=message) as error:
        smpl_arrays.read(tmp_path / "a.npz")
    assert str(error.value).startswith(str(tmp_path / "a.npz"))


def test_dictionaries_that_are_wrong(tmp_path):
    path = tmp_path / "a.npy"
    for loaded, message in (
        ([1, 2], "expected a dictionary, got list"),
        ({"poses": 1}, "lacks thetas; found poses"),
        ({"thetas": "none"}, "thetas must be numbers, got str"),
    ):
        wrapped = np.empty((), object)
        wrapped[()] = loaded
        np.save(path, wrapped, allow_pickle=True)
        with pytest.raises(DataError, match=message):
            smpl_arrays.read(path)
    np.save(path, np.array([{}, {}], object), allow_pickle=True)
    with pytest.raises(DataError, match=r"expected a dictionary, got an array \[2\] of object"):
        smpl_arrays.read(path)
    np.save(path, mdm_parameters(), allow_pickle=True)
    whole = path.read_bytes()
    for size in (0, 5, 60, 128, 200, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(DataError) as error:
            numpy_files.read_dictionary(path)
        assert str(error.value).startswith(str(path))
    path.write_bytes(whole)
    with pytest.raises(DataError, match="more than the limit of 1000"):
        numpy_files.read_dictionary(path, max_bytes=1000)


def test_other_files_are_not_claimed(tmp_path):
    for name, content in (("a.npy", b""), ("a.npz", b"PK\x03\x04 cut"), ("a.npy", b"\x93NUMPY"), ("a.txt", b"thetas")):
        Path(tmp_path / name).write_bytes(content)
        assert not smpl_arrays.sniff(tmp_path / name)
    np.savez(tmp_path / "a.npz", vertices=np.zeros(3))
    assert not smpl_arrays.sniff(tmp_path / "a.npz")
