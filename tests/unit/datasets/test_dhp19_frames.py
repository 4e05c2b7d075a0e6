"""DHP19's frames as its MATLAB code writes them, its real calibration, and every wrong tree."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from dhp19_writers import busy, matrix, write_aedat, write_vicon

from ctlev_core import plugins
from ctlev_core.dataset_files import dhp19_files
from ctlev_core.datasets import dhp19
from ctlev_core.geometry.camera import project
from ctlev_core.plugins import PluginError
from data_contracts.config import DatasetChoice, cache_material
from data_contracts.errors import DataError
from data_contracts.labels import check_labels

CALIBRATION = Path(__file__).resolve().parents[3].parent / "shared" / "real" / "dhp19_calib"
FOLDER = "h5_dataset_7500_events/346x260"


def write_matrices(root: Path) -> None:
    (root / "P_matrices").mkdir(exist_ok=True)
    for number in (1, 2, 3, 4):
        np.save(root / f"P_matrices/P{number}.npy", matrix(number))


def write_frames(root: Path, name="S1_session1_mov2", count=5, width=346, dtype="f8", folder=FOLDER, rows=None):
    """MATLAB's h5create gives double and the axes reversed: (N, y, x, channel) and (N, axis, joint) in Python."""
    random = np.random.default_rng(0)
    images = random.integers(0, 256, (count, 260, width, 4), np.uint8)
    positions = random.normal(0, 700, (count if rows is None else rows, 3, 13)) + np.array([[0], [0], [1000]])
    (root / folder).mkdir(parents=True, exist_ok=True)
    with h5py.File(root / folder / f"{name}_7500events.h5", "w") as file:
        file.create_dataset("DVS", data=images.astype(dtype))
    with h5py.File(root / folder / f"{name}_7500events_label.h5", "w") as file:
        file.create_dataset("XYZ", data=positions)
    return images, positions


def change(path: Path, name: str, index, value) -> None:
    with h5py.File(path, "a") as file:
        file[name][index] = value


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_matrices(tmp_path)
    return tmp_path


def first(root: Path, **changes):
    options = dhp19.Options(root=root, **changes)
    return dhp19.list_recordings(options)[0], options


@pytest.mark.parametrize(("width", "dtype"), [(346, "f8"), (344, "u1")])
def test_frames_are_pictures_of_one_channel_with_a_label_each(root, width, dtype):
    images, positions = write_frames(root, width=width, dtype=dtype, count=20)
    recording, options = first(root)
    assert recording.recording_id == "S1/session1/mov2/cam2"
    assert (recording.has_events, recording.has_event_images) == (False, True)
    assert [path.name for path in recording.files] == [
        "S1_session1_mov2_7500events.h5", "S1_session1_mov2_7500events_label.h5", "P2.npy",
    ]  # fmt: skip
    track = dhp19.read_event_images(recording, options)
    np.testing.assert_array_equal(track.images, images[..., 3])
    assert track.images.dtype == np.uint8 and track.t_us.tolist() == [10_000 * (i + 1) for i in range(20)]
    labels = check_labels(dhp19.read_labels(recording, options), "x")
    np.testing.assert_array_equal(labels.t_us, track.t_us)
    homogeneous = matrix(2) @ np.concatenate([positions, np.ones((20, 1, 13))], axis=1)
    u, v = homogeneous[:, 0] / homogeneous[:, 2], 260 - homogeneous[:, 1] / homogeneous[:, 2]
    np.testing.assert_allclose(labels.joints2d, np.stack([u, v], axis=-1), rtol=1e-4, atol=1e-3)
    assert ((v > 260) & (v < 346) & (u > 0) & (u < 346)).any(), "a joint below the picture should be among them"
    np.testing.assert_array_equal(labels.visible, (u > 0) & (u <= 346) & (v > 0) & (v <= 260))


def test_the_blank_last_frame_of_the_authors_loop_is_left_out(root):
    write_frames(root)
    label_file = root / FOLDER / "S1_session1_mov2_7500events_label.h5"
    change(label_file, "XYZ", -1, np.nan)
    recording, options = first(root)
    assert len(dhp19.read_event_images(recording, options)) == len(dhp19.read_labels(recording, options)) == 4
    change(label_file, "XYZ", 1, np.nan)
    labels = dhp19.read_labels(recording, options)
    assert len(labels) == 4 and not labels.visible[1].any() and labels.visible[0].any()


def test_condition_subjects_give_labels_only(root):
    write_frames(root)
    recording, options = first(root, condition_subjects=(1,))
    assert not recording.has_event_images and recording.parts[0].split == "condition" and len(recording.files) == 2
    assert len(dhp19.read_labels(recording, options)) == 5


def test_frames_and_labels_must_be_as_many(root):
    write_frames(root, rows=6)
    recording, options = first(root)
    for read in (dhp19.read_labels, dhp19.read_event_images):
        with pytest.raises(DataError, match=r"_label\.h5: expected one label for each of 5 frames, got 6"):
            read(recording, options)


@pytest.mark.parametrize("value", [256.0, -1.0, 0.5, np.nan])
def test_a_value_that_is_no_byte_is_refused(root, value):
    write_frames(root, count=20)
    change(root / FOLDER / "S1_session1_mov2_7500events.h5", "DVS", (18, 7, 9, 3), value)
    recording, options = first(root)
    with pytest.raises(DataError, match=rf"8-bit values, got {value} in frame 18, row 7, column 9, channel 3"):
        dhp19.read_event_images(recording, options)
    dhp19.read_event_images(dhp19.list_recordings(options)[1], options)


def test_damaged_frame_files_are_named(root):
    images, _ = write_frames(root)
    recording, options = first(root)
    data, labels = recording.files[:2]
    with h5py.File(data, "w") as file:
        file["DVS"] = images[..., :3]
    with pytest.raises(DataError, match=r"/DVS must be \[N, 260, 344 or 346, 4\], got \(5, 260, 346, 3\)"):
        dhp19.read_event_images(recording, options)
    with h5py.File(data, "w") as file:
        file["frames"] = images
    with pytest.raises(DataError, match="expected numbers in /DVS, got None; it holds frames"):
        dhp19.read_event_images(recording, options)
    labels.write_bytes(b"no HDF5")
    with pytest.raises(DataError, match=r"_label\.h5: expected an HDF5 file"):
        dhp19.read_labels(recording, options)
    with h5py.File(labels, "w") as file:
        file["XYZ"] = np.zeros((5, 13, 3))
    with pytest.raises(DataError, match=r"/XYZ must be \[N, 3, 13\], got \(5, 13, 3\)"):
        dhp19.read_labels(recording, options)


def test_a_damaged_object_in_a_frame_file_is_named(root):
    write_frames(root)
    path = root / FOLDER / "S1_session1_mov2_7500events_label.h5"
    with h5py.File(path) as file:
        place = h5py.h5o.get_info(file["XYZ"].id).addr
    content = bytearray(path.read_bytes())
    content[place] ^= 0xFF  # the version of its header
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"_label\.h5: expected an HDF5 file: .*bad object header version"):
        dhp19_files.read_frame_labels(path)


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_the_real_cameras_project_as_the_authors_do(number):
    if not CALIBRATION.is_dir():
        pytest.skip("the real calibration is not beside this checkout")
    path = CALIBRATION / f"P{number}.npy"
    camera = dhp19_files.camera_of(dhp19_files.read_projection(path), str(path))
    points = np.random.default_rng(number).uniform([-900, -900, 0], [900, 900, 2000], (1000, 3))
    u, v, w = np.load(path) @ np.column_stack([points, np.ones(1000)]).T
    np.testing.assert_allclose(
        project(camera, points / 1000), np.stack([u / w, 260 - v / w], axis=1), atol=1e-6, rtol=0
    )
    np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.R) > 0 and np.all(np.diag(camera.K) > 0) and camera.K[2, 2] == 1
    np.testing.assert_allclose(camera.K[[1, 2, 2], [0, 0, 1]], 0, atol=1e-12)
    # The authors publish where the cameras stood, in mm: depth, and with it the scale of 3D labels, is right.
    centre_mm = -1000 * camera.R.T @ camera.translation
    np.testing.assert_allclose(centre_mm, np.load(CALIBRATION / "camera_positions.npy")[number - 1], atol=1e-6)


def test_a_projection_matrix_of_any_scale_and_sign_gives_the_same_camera():
    reference = dhp19_files.camera_of(matrix(1), "x")
    for factor in (-1.0, 1e-6, -300.0):
        camera = dhp19_files.camera_of(factor * matrix(1), "x")
        for name in ("K", "R", "translation"):
            np.testing.assert_allclose(getattr(camera, name), getattr(reference, name), atol=1e-9)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (np.zeros((3, 4)), "singular"),
        (np.zeros((3, 3)), r"\[3, 4\] of finite floats"),
        (np.ones((3, 4), np.int64), r"\[3, 4\] of finite floats, got \(3, 4\) int64"),
        (np.full((3, 4), np.nan), "finite"),
    ],
)
def test_a_wrong_projection_matrix_is_named(root, content, message):
    write_frames(root)
    np.save(root / "P_matrices/P2.npy", content)
    with pytest.raises(DataError, match=rf"P2\.npy: .*{message}"):
        dhp19.read_camera(*first(root))


def test_a_folder_with_both_layouts_needs_the_option(root):
    write_frames(root)
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", busy(4))
    write_vicon(root / "Vicon_data/S1_1_2.mat")
    with pytest.raises(DataError, match=r"holds raw recordings and frames; choose with dataset\.options\.layout"):
        first(root)
    assert first(root, layout="frames")[0].has_event_images
    assert first(root, layout="raw")[0].has_events


def test_frames_may_lie_in_the_root_but_not_in_two_folders(root):
    write_frames(root, folder=".")
    assert first(root)[0].has_event_images
    write_frames(root, folder="h5_dataset_5000_events/346x260")
    with pytest.raises(DataError, match=r"expected one folder of frames, got .*h5_dataset_5000_events"):
        first(root)


def test_wrong_trees_are_shown_the_right_one(root):
    def refused(pattern, **changes):
        with pytest.raises(DataError, match=pattern) as error:
            first(changes.pop("root", root), **changes)
        assert "DVS_movies/S1/session1/mov1.aedat" in str(error.value), "the expected tree must be in the message"

    refused("no such folder", root=root / "absent")
    refused("neither raw recordings nor frames")
    refused("no movement of the subjects, sessions and movements asked for, none at all", layout="raw")
    refused("expected one folder of frames, got none", layout="frames")
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", busy(4))
    refused(r"Vicon_data/S1_1_2\.mat: no such file, but mov2\.aedat is there: its labels are missing")
    write_vicon(root / "Vicon_data/S1_1_2.mat")
    (root / "P_matrices/P3.npy").unlink()
    refused(r"P3\.npy: no such file, the projection matrix is missing")


def test_wrong_motion_capture_is_named(root):
    path = root / "Vicon_data/S1_1_2.mat"
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", busy(4))
    write_vicon(path, kneeL=np.zeros((99, 3)))
    recording, options = first(root)
    with pytest.raises(DataError, match=r"joints must have the same number of rows.*'kneeL': 99"):
        dhp19.read_labels(recording, options)
    write_vicon(path, handR=None)
    with pytest.raises(DataError, match=r"XYZPOS\.handR must be \[N, 3\] numbers, got \(0,\); fields: head, shoulderR"):
        dhp19.read_labels(recording, options)
    scipy.io.savemat(path, {"XYZ": np.zeros(3)})
    with pytest.raises(DataError, match="expected a variable XYZPOS"):
        dhp19.read_labels(recording, options)
    path.write_bytes(b"MATLAB 5.0 MAT-file" * 20)
    with pytest.raises(DataError, match=r"S1_1_2\.mat: expected a \.mat file"):
        dhp19.read_events(recording, options)


@pytest.mark.parametrize("cameras", [[0], [5], [2, 2], []])
def test_unknown_cameras_are_refused(root, cameras):
    choice = DatasetChoice(name="dhp19", options={"root": str(root), "cameras": cameras})
    with pytest.raises(PluginError, match="option 'cameras'"):
        plugins.load_options(choice)


def test_the_root_stays_outside_the_cache_key(root):
    assert "root" not in cache_material(dhp19.Options(root=root))
