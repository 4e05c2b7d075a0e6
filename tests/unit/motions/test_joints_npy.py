"""Joint positions in .npy files: HumanML3D's layout and what MDM calls its results."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctlev_core import plugins
from ctlev_core.body.layer import joint_transforms, load_body
from ctlev_core.body.motion import files, procedural
from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from ctlev_core.motions import joints_npy
from data_contracts.errors import DataError

COUNT = 40


def walking_joints(num_joints: int = 22, name: str = "walk") -> np.ndarray:
    rotations, transl = procedural.sample_pose(name, np.arange(COUNT) / 20, np.random.default_rng(3))
    return joint_transforms(load_body(), rotations, np.zeros(10), transl)[1][:, :num_joints]


def joints_of(clip) -> np.ndarray:
    rotations = matrix_from_axis_angle(clip.pose.reshape(-1, 24, 3))
    return joint_transforms(load_body(), rotations, clip.betas, clip.transl)[1]


def results(**changes) -> dict:
    """The dictionary of MDM's results.npy: two motions, the second shorter and padded."""
    motion = np.stack([np.moveaxis(walking_joints(name=name), 0, -1) for name in ("walk", "jump")]).astype(np.float32)
    motion[1, ..., 25:] = 0
    return {
        "motion": motion,
        "text": ["a person walks", "a person jumps"],
        "lengths": np.array([COUNT, 25]),
        "num_samples": 2,
        "num_repetitions": 1,
    } | changes


def save(path: Path, content: Any) -> Path:
    np.save(path, content, allow_pickle=True)
    return path


@pytest.mark.parametrize("num_joints", [22, 24])
def test_positions_come_back(tmp_path, num_joints):
    joints = walking_joints(num_joints)
    path = save(tmp_path / "000001.npy", joints.astype(np.float32))
    assert files.find_format(path) is plugins.load("motions", "joints_npy")
    clip = files.read_motion(path)
    # The file has float32.
    np.testing.assert_allclose(joints_of(clip)[:, :num_joints], joints, atol=2e-6)
    np.testing.assert_allclose(clip.time_s, np.arange(COUNT) / 20)
    assert joints_npy.read(path, rate_hz=12.5).time_s[1] == pytest.approx(0.08)


def test_the_results_of_mdm_are_read_with_sentences_and_lengths(tmp_path):
    path = save(tmp_path / "results.npy", results())
    assert joints_npy.sniff(path)
    walk, jump = joints_npy.read_all(path)
    assert (walk.caption, jump.caption) == ("a person walks", "a person jumps")
    assert (len(walk), len(jump)) == (COUNT, 25)
    np.testing.assert_allclose(joints_of(walk)[:, :22], walking_joints(), atol=2e-6)
    np.testing.assert_allclose(joints_of(jump)[:, :22], walking_joints(name="jump")[:25], atol=2e-6)
    with pytest.raises(DataError, match=r"holds 2 motions.*text_motion"):
        joints_npy.read(path)
    one = {key: value[:1] if key in ("motion", "text", "lengths") else value for key, value in results().items()}
    assert joints_npy.read(save(tmp_path / "one.npy", one)).caption == "a person walks"


def test_rotations_are_left_to_their_own_format(tmp_path):
    rotations, _ = procedural.sample_pose("walk", np.arange(COUNT) / 20, np.random.default_rng(3))
    path = save(tmp_path / "pose.npy", axis_angle_from_matrix(rotations))
    assert not joints_npy.sniff(path)
    assert files.find_format(path) is plugins.load("motions", "smpl_arrays")


def test_other_files_are_not_claimed(tmp_path):
    for name, content in (("a", np.zeros((10, 21, 3))), ("b", np.zeros((10, 263))), ("c", {"motion": 1}), ("d", 3.0)):
        assert not joints_npy.sniff(save(tmp_path / f"{name}.npy", content))
    (tmp_path / "e.npy").write_bytes(b"")
    (tmp_path / "f.npy").write_bytes(b"\x93NUMPY\x01\x00")
    assert not joints_npy.sniff(tmp_path / "e.npy") and not joints_npy.sniff(tmp_path / "f.npy")


class _Attack:
    def __reduce__(self):
        return (exec, ("raise SystemExit('code of a file was run')",))


def test_code_in_a_file_is_refused_and_not_run(tmp_path):
    path = save(tmp_path / "results.npy", results(text=_Attack()))
    with pytest.raises(DataError, match=r"exec"):
        joints_npy.read_all(path)
    with pytest.raises(SystemExit):  # the file is as malicious as it should be
        np.load(path, allow_pickle=True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"motion": np.zeros((2, 21, 3, COUNT), np.float32)}, r"motion must be \[N, 22, 3, T\], got \[2, 21, 3, 40\]"),
        ({"motion": "none"}, "got str"),
        ({"lengths": np.array([COUNT, COUNT + 1])}, "motion 1 has a length of 41 frames; there are 40"),
        ({"lengths": np.array([0, 3])}, "motion 0 has a length of 0"),
        ({"lengths": np.array([1.5, 3])}, "whole numbers"),
        ({"text": ["a person walks"]}, "1 sentences for 2 motions"),
        ({"text": 7}, "text must be sentences"),
    ],
    ids=["joints", "no_array", "long", "empty", "fraction", "few_texts", "no_text"],
)
def test_wrong_results_are_named(tmp_path, changes, message):
    with pytest.raises(DataError, match=message):
        joints_npy.read_all(save(tmp_path / "results.npy", results(**changes)))


def test_joints_of_something_else_are_named(tmp_path):
    joints = walking_joints()
    with pytest.raises(DataError, match="expected metres"):
        joints_npy.read(save(tmp_path / "mm.npy", 1000 * joints))
    with pytest.raises(DataError, match=r"mm from those of any pose.*SMPL's order"):
        order = np.random.default_rng(0).permutation(22)
        # Legs stay where they are, so that the size is right.
        order[[1, 2, 4, 5, 7, 8]], rest = [1, 2, 4, 5, 7, 8], [i for i in order if i not in (1, 2, 4, 5, 7, 8)]
        order[[i for i in range(22) if i not in (1, 2, 4, 5, 7, 8)]] = rest
        joints_npy.read(save(tmp_path / "order.npy", joints[:, order]))
    joints[7, 3, 1] = np.inf
    with pytest.raises(DataError, match="frame 7: the spine1 is at"):
        joints_npy.read(save(tmp_path / "inf.npy", joints))
    with pytest.raises(ValueError, match="rate_hz"):
        joints_npy.read(tmp_path / "mm.npy", rate_hz=0)


def test_a_single_frame_is_a_motion(tmp_path):
    assert len(joints_npy.read(save(tmp_path / "one.npy", walking_joints()[:1]))) == 1
