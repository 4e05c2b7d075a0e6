"""A folder of motion files: which are motions, what they are called, and how they stand before the camera."""

from __future__ import annotations

import io
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
from motion_writers import smpl_positions, standing_frames, write_bvh, write_deepmimic
from test_aist import motion as aist_motion
from test_amass import smplh
from test_bvh import random_motion, standing
from test_smpl_arrays import mdm_parameters

from ctlev_core import plugins
from ctlev_core.body.layer import load_body, pose_vertices
from ctlev_core.body.motion import files as clip_files
from ctlev_core.body.motion.clip import MotionClip, move_world
from ctlev_core.body.motion.ground_level import put_feet_on_ground
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.datasets import motion_files
from data_contracts import tables
from data_contracts.config import DatasetChoice
from data_contracts.errors import DataError
from data_contracts.labels import Part, check_labels
from data_contracts.manifest import labels_of, read_manifest
from tasks.ingest import ingest
from tasks.store import Store

REAL = Path(__file__).resolve().parents[3].parent / "shared" / "real" / "motion"


def npy_bytes(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


HUMAN_ML_3D = npy_bytes(np.zeros((5, 263)))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """One file of each format, and some that are none."""
    root = tmp_path / "motions"
    (root / "mocap" / "cmu").mkdir(parents=True)
    write_bvh(root / "mocap" / "cmu" / "12 01.bvh", *random_motion(12))
    np.savez(root / "mocap" / "a_poses.npz", **smplh(12))
    (root / "dance.pkl").write_bytes(pickle.dumps(aist_motion(12)))
    write_deepmimic(root / "humanoid3d_spin.txt", standing_frames(12, 0))
    np.save(root / "sample00_rep00_smpl_params.npy", mdm_parameters(), allow_pickle=True)
    np.save(root / "poses.npy", np.zeros((5, 72)))
    (root / "LICENSE").write_text("free")
    (root / "README.md").write_text("# motions")
    (root / "humanoid3d_character.txt").write_text('{"Skeleton": {"Joints": []}}')
    (root / "notes.json").write_text("[1]")
    (root / ".hidden.bvh").write_text("no motion")
    return root


def options_of(root: Path, **options) -> motion_files.Options:
    front = {"yaw_range_deg": (0.0, 0.0), "pitch_range_deg": (0.0, 0.0), "rate_hz": None}
    return motion_files.Options(root=root, **{**front, **options})


def test_motions_of_every_format_are_found_and_other_files_are_left_alone(root):
    options = options_of(root)
    recordings = motion_files.list_recordings(options)
    expected = [
        ("dance", "dance"),
        ("humanoid3d_spin", "spin"),
        ("mocap/a_poses", "a_poses"),
        ("mocap/cmu/12_01", "12 01"),
        ("poses", "poses"),
        ("sample00_rep00_smpl_params", "a person jumps"),
    ]
    assert [r.recording_id for r in recordings] == [name for name, _ in expected]
    assert all(not r.has_events and r.parts == (Part("condition"),) and len(r.files) == 1 for r in recordings)
    for recording, (_, class_name) in zip(recordings, expected, strict=True):
        labels = check_labels(motion_files.read_labels(recording, options), recording.recording_id)
        assert set(labels.class_names) == {class_name} and labels.smpl_pose is not None
    assert [r.recording_id for r in motion_files.list_recordings(options_of(root, max_recordings=1))] == [
        "mocap/cmu/12_01"
    ]
    with pytest.raises(DataError, match="a pose source has no events"):
        motion_files.read_events(recordings[0], options)


def labels_of_file(root: Path, **options):
    chosen = options_of(root, **options)
    (recording,) = motion_files.list_recordings(chosen)
    return motion_files.read_labels(recording, chosen)


def alone(tmp_path: Path, pose: np.ndarray, transl: np.ndarray) -> Path:
    folder = tmp_path / "alone"
    folder.mkdir(exist_ok=True)
    np.save(folder / "a.npy", np.hstack([transl, pose]))
    return folder


def in_camera(labels) -> dict[str, np.ndarray]:
    clip = MotionClip(labels.smpl_pose, np.zeros(10), labels.smpl_transl, np.arange(len(labels.smpl_pose)))
    return smpl_positions(clip)


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_the_axis_that_is_up_can_be_said(up, tmp_path):
    """A body that stands along any axis stands upright in the picture."""
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1 if "-" in up else 1
    side = np.roll(axis, 1)
    stands = np.stack([np.cross(axis, side), axis, side], axis=1)
    clip = move_world(
        MotionClip(np.zeros((2, 72)), np.zeros(10), np.zeros((2, 3)), np.arange(2.0)), stands, np.zeros(3)
    )
    joints = in_camera(labels_of_file(alone(tmp_path, clip.pose, clip.transl), up=up))
    body = joints["head"] - joints["pelvis"]
    np.testing.assert_allclose(body / np.linalg.norm(body, axis=1, keepdims=True), [[0, -1, 0]] * 2, atol=0.1)
    for hand in ("left", "right"):
        assert abs(joints[f"{hand}_wrist"] - joints[f"{hand}_shoulder"])[:, 1].max() < 0.1


def test_the_rate_of_files_that_do_not_say(tmp_path):
    folder = alone(tmp_path, np.zeros((3, 72)), np.zeros((3, 3)))
    assert labels_of_file(folder).t_us.tolist() == [0, 50_000, 100_000]
    assert labels_of_file(folder, source_rate_hz=10.0).t_us.tolist() == [0, 100_000, 200_000]
    os.remove(folder / "a.npy")
    write_deepmimic(folder / "a.txt", standing_frames(2))
    assert labels_of_file(folder, source_rate_hz=10.0).t_us.tolist() == [0, 33_333]


def test_feet_come_to_the_ground(tmp_path):
    """Against the lowest vertex of the whole skin of a body that walks."""
    pose = np.zeros((6, 72))
    pose[:, 3], pose[:, 6] = np.linspace(-0.5, 0.5, 6), np.linspace(0.5, -0.5, 6)
    pose[:, 12] = np.linspace(0.6, 0, 6)
    clip = MotionClip(pose, np.zeros(10), np.tile([0.3, 5.0, 0.1], (6, 1)), np.arange(6.0))
    stands = put_feet_on_ground(clip)
    vertices, _ = pose_vertices(
        load_body(), matrix_from_axis_angle(pose.reshape(-1, 24, 3)), np.zeros(10), stands.transl
    )
    # A vertex of the sole follows one bone here, and in the skin a little of the others.
    assert abs(float(vertices[..., 1].min())) < 0.01
    np.testing.assert_allclose((stands.transl - clip.transl)[:, [0, 2]], 0)
    assert np.ptp((stands.transl - clip.transl)[:, 1]) == 0
    still = labels_of_file(alone(tmp_path, pose, clip.transl))
    shifted = labels_of_file(alone(tmp_path, pose, clip.transl), on_ground=True)
    np.testing.assert_allclose(still.smpl_transl, shifted.smpl_transl, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.bvh", b"no motion", r"a\.bvh: not a motion file of a known format \(9 bytes\); known formats: aist"),
        ("a.bvh", b"", r"a\.bvh: not a motion file of a known format"),
        ("a.npy", b"\x93NUMPY", r"a\.npy: not a motion file"),
        ("a.npz", b"PK\x03\x04", r"a\.npz: not a motion file"),
        ("a.pkl", pickle.dumps({"poses": 1}), r"a\.pkl: not a motion file .*; aist: lacks smpl_poses; found poses"),
        ("a.npy", HUMAN_ML_3D, r"a\.npy: not a motion .*smpl_arrays: poses must be .*, got \[5, 263\]"),
    ],
    ids=["text", "empty", "cut npy", "cut npz", "other pickle", "other array"],
)
def test_damaged_files_are_named(name, content, message, root):
    (root / "mocap" / name).write_bytes(content)
    with pytest.raises(DataError, match=message):
        motion_files.list_recordings(options_of(root))


class RunsCode:
    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def test_code_in_a_pickle_is_not_run(root, tmp_path):
    mark = tmp_path / "ran"
    for file in root.iterdir():
        if file.is_file():
            file.unlink()
    shutil.rmtree(root / "mocap")
    harm = {"smpl_poses": RunsCode(f"touch {mark}"), "smpl_scaling": 1}
    (root / "evil.pkl").write_bytes(pickle.dumps(harm))
    options = options_of(root)
    (recording,) = motion_files.list_recordings(options)
    with pytest.raises(DataError, match=r"evil\.pkl: refused: it names (posix|nt)\.system"):
        motion_files.read_labels(recording, options)
    (root / "evil.pkl").write_bytes(pickle.dumps(RunsCode(f"touch {mark}")))
    with pytest.raises(DataError, match=r"evil\.pkl: not a motion file .* aist: refused: it names (posix|nt)\.system"):
        motion_files.list_recordings(options)
    assert not mark.exists()


def test_folders_that_are_wrong(root, tmp_path):
    with pytest.raises(DataError, match="absent: no such folder"):
        motion_files.list_recordings(options_of(tmp_path / "absent"))
    with pytest.raises(DataError, match="LICENSE: a file, not a folder"):
        motion_files.list_recordings(options_of(root / "LICENSE"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"empty: expected motion files of the formats aist .*, found no files"):
        motion_files.list_recordings(options_of(tmp_path / "empty"))
    (tmp_path / "empty" / "notes.txt").write_text("nothing")
    with pytest.raises(DataError, match=r"found 1 other files \(notes\.txt\)"):
        motion_files.list_recordings(options_of(tmp_path / "empty"))
    np.save(root / "dance.npy", np.zeros((5, 72)))
    with pytest.raises(DataError, match="would get the recording id 'dance'"):
        motion_files.list_recordings(options_of(root))
    (root / "dance.npy").unlink()
    (root / "mocap" / "again").symlink_to(root)
    with pytest.raises(DataError, match=r"again: a link to the folder .*motions"):
        motion_files.list_recordings(options_of(root))


def test_a_file_that_two_formats_claim_is_refused(tmp_path, monkeypatch):
    write_bvh(tmp_path / "a.bvh", *standing())
    monkeypatch.setattr(plugins.load("motions", "deepmimic"), "sniff", lambda path: True)
    with pytest.raises(DataError, match=r"a\.bvh: could be any of the formats bvh, deepmimic"):
        clip_files.read_motion(tmp_path / "a.bvh")
    with pytest.raises(DataError, match="expected a motion file, got nothing there"):
        clip_files.read_motion(tmp_path / "absent.bvh")
    with pytest.raises(DataError, match="expected a motion file, got a folder"):
        clip_files.read_motion(tmp_path)


def test_the_options_say_what_is_wrong():
    with pytest.raises(plugins.PluginError, match="option 'up'"):
        plugins.load_options(DatasetChoice(name="motion_files", options={"root": ".", "up": "w"}))


def test_real_files_are_ingested(home):
    if not REAL.is_dir():
        pytest.skip("the real motions are not beside this checkout")
    arguments = {"dataset": DatasetChoice(name="motion_files", options={"root": str(REAL), "on_ground": True})}
    recordings = read_manifest(ingest.run(ingest.key(arguments, Store()), arguments)[0])
    labels = labels_of(recordings.attached(tables.LABELS))
    classes = {
        "cartwheel",
        "dance a",
        "jump",
        "kick",
        "punch",
        "run",
        "spinkick",
        "walk",
        "cmu_12_01_walk",
        "pybvh_test3",
    }
    assert set(labels.class_names) == classes and len(recordings) == len(classes)
    assert labels.smpl_transl is not None and len(labels) == 188
    assert (labels.smpl_transl[:, 2] > 2).all()
