"""AIST++: dance motions in their pickles become SMPL labels without events, and without running what they carry."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctlev_core import plugins
from ctlev_core.body.motion.clip import REST_PELVIS
from ctlev_core.datasets import aist
from ctlev_core.motions import aist as aist_format
from data_contracts.config import DatasetChoice
from data_contracts.errors import DataError
from data_contracts.labels import Part, check_labels

BREAK, HOUSE, BAD = "gBR_sBM_cAll_d04_mBR0_ch01", "gHO_sFM_cAll_d20_mHO5_ch13", "gWA_sBM_cAll_d26_mWA1_ch09"


def motion(num_frames: int = 30, **changes) -> dict:
    """As published: centimetres, and a body about 93 times SMPL's size."""
    random = np.random.default_rng(0)
    return {
        "smpl_loss": 1.7,
        "smpl_poses": random.normal(0, 0.4, (num_frames, 72)),
        "smpl_scaling": np.array([93.7]),
        "smpl_trans": random.normal([0, 170, 0], 40, (num_frames, 3)),
    } | changes


def write(path: Path, loaded: object, protocol: int = 4) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(loaded, protocol))
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "aist_plusplus_final"
    for name in (HOUSE, BREAK, BAD):
        write(root / "motions" / f"{name}.pkl", motion())
    (root / "ignore_list.txt").write_text(f"{BAD}\ngPO_sBM_cAll_d10_mPO0_ch01\n")
    (root / "cameras").mkdir()
    (root / "splits").mkdir()
    return root


def options_of(root: Path, **options) -> aist.Options:
    front = {"yaw_range_deg": (0.0, 0.0), "pitch_range_deg": (0.0, 0.0), "rate_hz": None}
    return aist.Options(root=root, **{**front, **options})


def listed(root: Path, **options) -> list:
    return aist.list_recordings(options_of(root, **options))


def test_motions_are_label_only_recordings_by_dancer_and_genre(root):
    recordings = listed(root)
    assert [r.recording_id for r in recordings] == [BREAK, HOUSE]
    assert [(r.subject, r.class_name) for r in recordings] == [("d04", "break"), ("d20", "house")]
    assert all(not r.has_events and r.parts == (Part("condition"),) for r in recordings)
    assert [r.recording_id for r in listed(root, genres=("house",))] == [HOUSE]
    assert BAD in [r.recording_id for r in listed(root, with_ignored=True)]
    with pytest.raises(DataError, match="a pose source has no events"):
        aist.read_events(recordings[0], options_of(root))


@pytest.mark.parametrize("protocol", range(6))
def test_labels_are_metres_before_the_camera(protocol, root):
    keys = motion()
    write(root / "motions" / f"{BREAK}.pkl", keys, protocol)
    labels = check_labels(aist.read_labels(listed(root)[0], options_of(root)), "labels")
    assert len(labels) == 30 and labels.t_us[:3].tolist() == [0, 16_667, 33_333]
    assert set(labels.class_names) == {"break"} and (labels.smpl_betas == 0).all()
    np.testing.assert_allclose(labels.smpl_pose[:, 3:], keys["smpl_poses"][:, 3:], atol=1e-6)
    head = np.array([0.0, 0.5, 0.1])
    rest = Rotation.from_rotvec(keys["smpl_poses"][:, :3]).apply(head) + REST_PELVIS
    expected = (rest + keys["smpl_trans"] / 93.7) * [1, -1, -1]
    got = Rotation.from_rotvec(labels.smpl_pose[:, :3].astype(float)).apply(head) + REST_PELVIS + labels.smpl_transl
    np.testing.assert_allclose(got - got[0], expected - expected[0], atol=1e-5)


def test_poses_by_joint_are_the_same_poses(root):
    keys = motion()
    flat = aist_format.read(write(root / "a.pkl", keys))
    by_joint = aist_format.read(write(root / "a.pkl", keys | {"smpl_poses": keys["smpl_poses"].reshape(-1, 24, 3)}))
    np.testing.assert_array_equal(flat.pose, by_joint.pose)


class RunsCode:
    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def test_code_in_a_motion_is_not_run(root, tmp_path):
    write(root / "motions" / f"{BREAK}.pkl", motion(smpl_loss=RunsCode(f"touch {tmp_path / 'ran'}")))
    with pytest.raises(DataError, match=rf"{BREAK}\.pkl: refused: it names posix\.system"):
        aist.read_labels(listed(root)[0], options_of(root))
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("loaded", "message"),
    [
        (motion(smpl_poses=np.zeros((30, 66))), r"pose must be \[30, 72\], got \[30, 66\]"),
        (motion(smpl_poses=np.zeros(30)), r"smpl_poses must be \[T, 72\], got \[30\]"),
        (motion(smpl_trans=np.zeros((29, 3))), r"transl must be \[30, 3\], got \[29, 3\]"),
        (motion(smpl_poses=np.full((30, 72), np.nan)), "pose of frame 0 is not finite"),
        (motion(0), "zero frames"),
        (motion(smpl_scaling=np.array([0.0])), r"smpl_scaling must be one positive number, got \[0\.0\]"),
        (motion(smpl_scaling=np.array([1.0, 2.0])), "smpl_scaling must be one positive number"),
        (motion(smpl_scaling=np.array([np.nan])), r"smpl_scaling must be one positive number, got \[nan\]"),
        (motion(smpl_scaling="large"), "smpl_scaling must be numbers"),
        ({"smpl_poses": np.zeros((30, 72))}, "lacks smpl_trans; found smpl_poses"),
        ([1, 2], "expected a dictionary, got list"),
    ],
)
def test_files_that_are_wrong(loaded, message, tmp_path):
    file = write(tmp_path / "a.pkl", loaded)
    with pytest.raises(DataError, match=message) as error:
        aist_format.read(file)
    assert str(error.value).startswith(str(file))


def assert_refused(root: Path, message: str, shows_tree: bool = True, **options) -> None:
    with pytest.raises(DataError, match=message) as error:
        listed(root, **options)
    assert ("ROOT/\n    motions/\n" in str(error.value)) == shows_tree


def test_a_root_that_is_missing_or_at_another_level(root, tmp_path):
    assert_refused(tmp_path / "absent", "absent: no such folder")
    assert_refused(tmp_path, "not the dataset itself; the root is .*/aist_plusplus_final;")
    assert_refused(root / "motions", "motions: lies inside the dataset; the root is .*/aist_plusplus_final;")


def test_trees_that_are_wrong(root):
    (root / "motions" / "walk.pkl").write_bytes(b"")
    assert_refused(root, r"walk\.pkl: expected a name such as gBR_sBM_cAll_d04_mBR0_ch01", shows_tree=False)
    (root / "motions" / "walk.pkl").unlink()
    assert_refused(root, "no genre 'tango'; there are: break, pop", shows_tree=False, genres=("tango",))
    assert_refused(root, "no motion is left", shows_tree=False, genres=("krump",))
    (root / "ignore_list.txt").unlink()
    assert_refused(root, r"ignore_list\.txt: no such file; without it bad motions would be taken")
    for file in (root / "motions").iterdir():
        file.unlink()
    assert_refused(root, r"motions: expected \*\.pkl files, found none", shows_tree=False, with_ignored=True)


def test_a_preset_without_a_root_is_told_so():
    with pytest.raises(plugins.PluginError, match="option 'root': field required"):
        plugins.load_options(DatasetChoice(name="aist"))
