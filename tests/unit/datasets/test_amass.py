"""AMASS: motions in the published layouts become SMPL labels without events."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctlev_core import plugins
from ctlev_core.body.motion.clip import REST_PELVIS
from ctlev_core.datasets import amass
from ctlev_core.motions import amass as amass_format
from data_contracts import tables
from data_contracts.config import DatasetChoice
from data_contracts.errors import DataError
from data_contracts.labels import Part, check_labels
from data_contracts.manifest import labels_of, read_manifest
from tasks.ingest import ingest
from tasks.store import Store

HALF_PI = np.pi / 2


def smplh(num_frames: int = 24, **changes) -> dict:
    """The keys of an SMPL-H file: a body that stands on the plane z = 0 and walks along x."""
    random = np.random.default_rng(0)
    poses = random.normal(0, 0.3, (num_frames, 156))
    poses[:, :3] = [HALF_PI, 0, 0]
    trans = np.stack([np.linspace(0, 2, num_frames), np.zeros(num_frames), np.full(num_frames, 1.0)], axis=1)
    return {
        "trans": trans,
        "gender": np.array("female"),
        "mocap_framerate": np.array(120.0),
        "betas": random.normal(0, 1, 16),
        "dmpls": np.zeros((num_frames, 8)),
        "poses": poses,
    } | changes


def smplx(num_frames: int = 24, **changes) -> dict:
    """The keys of an SMPL-X file; some arrays hold pickled objects."""
    keys = smplh(num_frames)
    poses = np.zeros((num_frames, 165))
    poses[:, :66] = keys["poses"][:, :66]
    poses[:, 66:] = 0.7
    return {
        "gender": np.array("neutral"),
        "surface_model_type": np.array("smplx"),
        "mocap_frame_rate": np.array(120.0),
        "mocap_time_length": np.array(num_frames / 120),
        "labels_obs": np.array([["C7"], ["C7", "T8"]], dtype=object),
        "trans": keys["trans"],
        "poses": poses,
        "betas": keys["betas"],
        "num_betas": np.array(16),
    } | changes


def write(path: Path, keys: dict) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **keys)
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "AMASS"
    write(root / "ACCAD" / "Male1General_c3d" / "General A1 - Stand_poses.npz", smplh())
    write(root / "ACCAD" / "Male1General_c3d" / "shape.npz", {"betas": np.zeros(16)})
    write(root / "CMU" / "01" / "01_02_stageii.npz", smplx())
    write(root / "CMU" / "01" / "01_01_stageii.npz", smplx())
    write(root / "CMU" / "01" / "neutral_stagei.npz", {"betas": np.zeros(16)})
    (root / "CMU" / "LICENSE.txt").write_text("licence")
    (root / "ACCAD.tar.bz2").write_bytes(b"BZ")
    return root


def options_of(root: Path, **options) -> amass.Options:
    front = {"yaw_range_deg": (0.0, 0.0), "pitch_range_deg": (0.0, 0.0), "rate_hz": None}
    return amass.Options(root=root, **{**front, **options})


def listed(root: Path, **options) -> list:
    return amass.list_recordings(options_of(root, **options))


def test_motions_are_label_only_recordings_and_other_files_are_left_alone(root):
    recordings = listed(root)
    assert [r.recording_id for r in recordings] == [
        "ACCAD/Male1General_c3d/General_A1_-_Stand_poses",
        "CMU/01/01_01_stageii",
        "CMU/01/01_02_stageii",
    ]
    assert [r.subject for r in recordings] == ["ACCAD/Male1General_c3d", "CMU/01", "CMU/01"]
    assert all(not r.has_events and r.parts == (Part("condition"),) and len(r.files) == 1 for r in recordings)
    assert [r.subject for r in listed(root, subsets=("CMU",))] == ["CMU/01"] * 2
    assert [r.recording_id for r in listed(root, max_recordings=1)] == ["CMU/01/01_01_stageii"]
    with pytest.raises(DataError, match="a pose source has no events"):
        amass.read_events(recordings[0], options_of(root))


@pytest.mark.parametrize("number", [0, 1], ids=["SMPL-H", "SMPL-X"])
def test_labels_are_root_and_21_body_joints_and_straight_hands(number, root):
    recording = listed(root)[number]
    labels = check_labels(amass.read_labels(recording, options_of(root)), "labels")
    keys = smplh()
    assert len(labels) == 24 and labels.t_us[:3].tolist() == [0, 8333, 16667]
    np.testing.assert_allclose(labels.smpl_pose[:, 3:66], keys["poses"][:, 3:66], atol=1e-6)
    assert (labels.smpl_pose[:, 66:] == 0).all()
    np.testing.assert_allclose(labels.smpl_betas, np.tile(keys["betas"][:10], (24, 1)), atol=1e-6)


def test_a_body_that_stands_with_z_up_stands_upright_before_the_camera(root):
    recording = listed(root)[0]
    labels = amass.read_labels(recording, options_of(root, distance_m=6.0))
    root_rotation = Rotation.from_rotvec(labels.smpl_pose[0, :3].astype(float))
    np.testing.assert_allclose(root_rotation.apply([0, 1, 0]), [0, -1, 0], atol=1e-6)
    pelvis = labels.smpl_transl + REST_PELVIS
    np.testing.assert_allclose(pelvis[:, 0], np.linspace(-1, 1, 24), atol=1e-5)
    np.testing.assert_allclose(pelvis[:, 1:], np.tile([0, 6], (24, 1)), atol=1e-5)


def test_points_move_as_smpl_says(root):
    """Against SMPL's definition with the published numbers, point by point: world z up, then y up, then the camera."""
    turn = Rotation.random(24, rng=np.random.default_rng(3))
    keys = smplh()
    keys["poses"][:, :3] = turn.as_rotvec()
    write(root / "CMU" / "01" / "01_01_stageii.npz", keys)
    recording = listed(root, subsets=("CMU",))[0]
    labels = amass.read_labels(recording, options_of(root))
    nose = np.array([0.0, 0.4, 0.1])
    expected = turn.apply(nose) + REST_PELVIS + keys["trans"]
    got = Rotation.from_rotvec(labels.smpl_pose[:, :3].astype(float)).apply(nose) + REST_PELVIS + labels.smpl_transl
    y_up = np.stack([expected[:, 0], expected[:, 2], -expected[:, 1]], axis=1)
    in_camera = y_up * [1, -1, -1]
    np.testing.assert_allclose(got - got[0], in_camera - in_camera[0], atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"poses": np.zeros((24, 75))},
            r"poses must be \[T, 72\] \(SMPL\) or .*\(SMPL-X\), got \[24, 75\]",
        ),
        ({"poses": np.full((24, 156), np.nan)}, "pose of frame 0 is not finite"),
        ({"trans": np.zeros((23, 3))}, r"transl must be \[24, 3\], got \[23, 3\]"),
        ({"poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))}, "zero frames"),
        ({"betas": np.zeros(9)}, r"betas must be at least 10 numbers, got \[9\]"),
        ({"betas": np.zeros((24, 10))}, r"betas must be at least 10 numbers, got \[24, 10\]"),
        ({"mocap_framerate": np.array(0)}, "frame rate must be positive, got 0.0"),
        ({"mocap_framerate": np.array([60, 120])}, r"frame rate must be one number, got \[2\]"),
        ({"mocap_framerate": np.array("fast")}, "mocap_framerate must be numbers, got <U4"),
        (
            {"poses": np.array([{}, {}], dtype=object)},
            "poses: an array of Python objects, which only a pickle can hold",
        ),
    ],
)
def test_files_that_are_wrong(changes, message, tmp_path):
    file = write(tmp_path / "a_poses.npz", smplh(**changes))
    with pytest.raises(DataError, match=message) as error:
        amass_format.read(file)
    assert str(error.value).startswith(str(file))


def test_files_that_lack_a_key_or_are_no_npz(tmp_path):
    keys = smplh()
    del keys["mocap_framerate"]
    file = write(tmp_path / "a_poses.npz", keys)
    with pytest.raises(DataError, match="lacks mocap_framerate; found trans, gender, betas"):
        amass_format.read(file)
    for content in (b"", b"PK\x03\x04 cut", file.read_bytes()[:-900]):
        file.write_bytes(content)
        with pytest.raises(DataError, match=r"a_poses\.npz: cannot be read as a motion of AMASS"):
            amass_format.read(file)


def test_arrays_in_fortran_order_and_other_precisions(tmp_path):
    keys = smplh()
    other = {"poses": np.asfortranarray(keys["poses"].astype(">f4")), "trans": keys["trans"].astype(np.float32)}
    expected = amass_format.read(write(tmp_path / "a_poses.npz", keys))
    got = amass_format.read(write(tmp_path / "a_poses.npz", smplh(**other)))
    np.testing.assert_allclose(got.pose, expected.pose, atol=1e-6)
    np.testing.assert_allclose(got.transl, expected.transl, atol=1e-6)


def test_an_array_that_lies_about_its_size_is_not_allocated(tmp_path):
    file = write(tmp_path / "a_poses.npz", smplh())
    content = file.read_bytes()
    assert content.count(b"(24, 156)") == 1
    file.write_bytes(content.replace(b"(24, 156), }    ", b"(24000, 156), } "))
    with pytest.raises(DataError, match=r"a_poses\.npz: poses: .* takes 29952000 bytes, got 29952"):
        amass_format.read(file)


def test_both_names_of_the_frame_rate_count(tmp_path):
    for keys in (smplh(mocap_framerate=np.array(100)), smplx(mocap_frame_rate=np.array(100.0))):
        assert amass_format.read(write(tmp_path / "a_poses.npz", keys)).time_s[:3].tolist() == [0, 0.01, 0.02]


def test_ingest_keeps_the_labels_and_expects_no_events(root, home):
    arguments = {"dataset": DatasetChoice(name="amass", options={"root": str(root), "rate_hz": 60.0})}
    recordings = read_manifest(ingest.run(ingest.key(arguments, Store()), arguments)[0])
    labels = labels_of(recordings.attached(tables.LABELS))
    assert len(recordings) == 3 and set(recordings.column("splits")) == {"condition"}
    assert len(labels) == 36 and labels.smpl_transl is not None and labels.smpl_transl.shape == (36, 3)


def assert_refused(root: Path, message: str, shows_tree: bool = True, **options) -> None:
    with pytest.raises(DataError, match=message) as error:
        listed(root, **options)
    assert ("ROOT/\n    ACCAD/\n" in str(error.value)) == shows_tree


def test_a_root_that_is_missing_or_at_another_level(root, tmp_path):
    assert_refused(tmp_path / "absent", "absent: no such folder")
    assert_refused(tmp_path, "not the dataset itself; the root is .*/AMASS;")
    assert_refused(root / "ACCAD", "ACCAD: lies inside the dataset; the root is .*/AMASS;")
    assert_refused(root / "ACCAD" / "Male1General_c3d", "lies inside the dataset; the root is .*/AMASS;")
    (tmp_path / "packed").mkdir()
    (tmp_path / "packed" / "ACCAD.tar.bz2").write_bytes(b"BZ")
    (tmp_path / "packed" / "AMASS").mkdir()
    assert_refused(tmp_path / "packed", r"archives that are not unpacked \(ACCAD\.tar\.bz2\)")


def test_sub_datasets_that_are_unknown_empty_or_clash(root):
    assert_refused(root, "no sub-dataset 'KIT'; there are: ACCAD, CMU", shows_tree=False, subsets=("KIT",))
    (root / "KIT" / "3").mkdir(parents=True)
    assert_refused(root, "KIT: a sub-dataset without motions")
    assert len(listed(root, subsets=("ACCAD",))) == 1
    write(root / "ACCAD" / "Male1General_c3d" / "General_A1_-_Stand_poses.npz", smplh())
    assert_refused(
        root, "would get the recording id 'ACCAD/Male1General_c3d/General_A1_-_Stand_poses'", False, subsets=("ACCAD",)
    )


def test_a_preset_without_a_root_is_told_so():
    with pytest.raises(plugins.PluginError, match="option 'root': field required"):
        plugins.load_options(DatasetChoice(name="amass"))
