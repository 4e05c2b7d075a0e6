"""Event-HPE: the preprocessed download and raw recordings, written with OpenCV, joblib and as text."""

from __future__ import annotations

from pathlib import Path

import cv2
import joblib
import numpy as np
import pytest

from ctlev_core.datasets import event_hpe
from ctlev_core.geometry.camera import project
from ctlev_core.labels.labelling import labels_at_windows
from data_contracts.config import cache_material
from data_contracts.errors import DataError
from data_contracts.labels import Part, check_labels

INTRINSICS = np.array([1679.3, 1679.3, 641, 641])
ACTION = "subject03_group1_time1"


def pose_values(number: int, **changes):
    """The five values of a pose file; joints2d as geometry.py projects joints3d onto the picture of 256 px."""
    random = np.random.default_rng(number)
    joints3d = random.uniform([-0.6, -1, 2.5], [0.6, 1, 3.5], (24, 3))
    fx, fy, cx, cy = INTRINSICS * 256 / 1280
    u, v = joints3d[:, 0] / joints3d[:, 2] * fx + cx, joints3d[:, 1] / joints3d[:, 2] * fy + cy
    values = {
        "beta": random.normal(size=(1, 10)),
        "theta": random.normal(size=(1, 72)),
        "tran": np.array([[0.1, 0.2, 3.0 + number]]),
        "joints3d": joints3d,
        "joints2d": np.column_stack([u, v, joints3d[:, 2]]),
    } | changes
    return tuple(values.values())


def write_poses(root: Path, numbers, action=ACTION, **changes) -> Path:
    folder = root / "pose_events" / action
    folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        joblib.dump(pose_values(number, **changes), folder / f"pose{number:04d}.pkl", compress=3)
    joblib.dump(list(numbers), folder / "pose_info.pkl", compress=3)
    return folder


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_preprocessed(root: Path, action=ACTION, count=4, poses=(0, 1, 2, 4)) -> None:
    """Event image n has an event in slice n % 4 at row n, column 7."""
    for number in range(count):
        slices = np.zeros((256, 256, 4), np.uint8)
        slices[number, 7, number % 4] = 1
        write_image(root / f"events_256/{action}/event{number:04d}.png", slices)
        write_image(root / f"full_pic_256/{action}/fullpic{number:04d}.jpg", np.full((256, 256), 40 * number, np.uint8))
    write_poses(root, poses, action)


def write_events(root: Path, number: int, rows, action=ACTION) -> Path:
    path = root / action / f"event_camera/events/event{number:04d}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(",".join(map(str, row)) + "\n" for row in rows))
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_preprocessed(tmp_path)
    return tmp_path


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """Three files of events and a last one that is not read; poses 10 .. 13."""
    for i, number in enumerate((10, 11, 12, 13)):
        rows = [(0, 0, 1000 * i + 500, 0, 1), (1279, 799, 1000 * i + 100, 0, -1), (5, 6, 1000 * i + 900, 0, 0)]
        write_events(tmp_path, number, rows)
        picture = np.full((1280, 800), 40 * i, np.uint8)
        write_image(tmp_path / ACTION / f"event_camera/full_pic/fullpic{number:04d}.jpg", picture)
    write_poses(tmp_path, (10, 11, 12, 13))
    return tmp_path


def first(root: Path, **changes):
    options = event_hpe.Options(root=root, **changes)
    return event_hpe.list_recordings(options)[0], options


def test_actions_become_recordings_split_by_subject(root):
    for action in ("subject01_group2_time1", "subject07_group1_time3", "subject12_group4_time1"):
        write_preprocessed(root, action, count=2)
    write_image(root / "events_256/subject05_group1_time1/event0000.png", np.zeros((256, 256, 4), np.uint8))
    recordings = event_hpe.list_recordings(event_hpe.Options(root=root))
    assert [r.recording_id for r in recordings] == [
        "subject01/group2_time1", "subject03/group1_time1", "subject07/group1_time3",
    ]  # fmt: skip
    assert [r.parts[0] for r in recordings] == [Part("test"), Part("train"), Part("test")]
    assert recordings[1].subject == "subject03" and recordings[1].class_name == "group1"
    assert len(recordings[1].files) == 4 + 4 + 4 and recordings[1].sensor_size == (256, 256)
    assert all(r.has_event_images and r.has_intensity and not r.has_events for r in recordings)
    only = event_hpe.list_recordings(
        event_hpe.Options(root=root, subjects=(7,), validation_subjects=(7,), test_subjects=())
    )
    assert [r.parts[0].split for r in only] == ["validation"]


@pytest.mark.parametrize("layout", ["preprocessed", "raw"])
def test_condition_subjects_give_labels_only(layout, tmp_path, request):
    root = request.getfixturevalue("root" if layout == "preprocessed" else "raw")
    recording, options = first(root, condition_subjects=(3,))
    assert not (recording.has_events or recording.has_event_images)
    labels = event_hpe.read_labels(recording, options)
    # Grey pictures come along, on the clock of the labels: what frame-to-event generators are asked with.
    pictures = event_hpe.read_intensity_frames(recording, options)
    assert recording.has_intensity and set(labels.t_us[:2]) <= set(pictures.t_us)
    number = int(labels.t_us[1]) // 15_000
    pixels = project(event_hpe.read_camera(recording, options), pose_values(number)[3])
    np.testing.assert_allclose(labels.joints2d[1], pixels, rtol=1e-4, atol=1e-2)


def test_an_event_image_is_labelled_with_the_pose_at_its_end(root):
    recording, options = first(root)
    track, labels = event_hpe.read_event_images(recording, options), event_hpe.read_labels(recording, options)
    # Images 0 and 1 end at the poses 1 and 2, image 3 at pose 4; image 2 ends at a pose that is missing.
    assert track.t_us.tolist() == [15_000, 30_000, 60_000]
    assert [np.argwhere(image).tolist() for image in track.images] == [[[0, 7]], [[1, 7]], [[3, 7]]]
    assert set(np.unique(track.images)) == {0, 255} and track.images.dtype == np.uint8
    assert labels.t_us.tolist() == [0, 15_000, 30_000, 60_000]
    matched = labels_at_windows(labels, track.t_us, track.t_us)
    np.testing.assert_allclose(matched.smpl_transl[:, 2], [4, 5, 7])


def test_all_four_time_slices_count(root):
    slices = np.zeros((256, 256, 4), np.uint8)
    for channel in range(4):
        slices[10, channel, channel] = 1
    slices[11, 0] = 1
    write_image(root / f"events_256/{ACTION}/event0000.png", slices)
    image = event_hpe.read_event_images(*first(root)).images[0]
    assert np.argwhere(image).tolist() == [[10, 0], [10, 1], [10, 2], [10, 3], [11, 0]] and image.max() == 255


def test_labels_are_smpl_parameters_and_joints_in_mm_and_px(root):
    recording, options = first(root)
    labels = check_labels(event_hpe.read_labels(recording, options), "x")
    beta, theta, tran, joints3d, joints2d = pose_values(2)
    assert labels.joint_set == "smpl" and labels.class_names == ("group1",) * 4
    np.testing.assert_allclose(labels.smpl_betas[2], beta[0], rtol=1e-6)
    np.testing.assert_allclose(labels.smpl_pose[2], theta[0], rtol=1e-6)
    np.testing.assert_allclose(labels.smpl_transl[2], tran[0], rtol=1e-6)
    np.testing.assert_allclose(labels.joints3d[2], 1000 * joints3d, rtol=1e-6)
    np.testing.assert_allclose(labels.joints2d[2], joints2d[:, :2], rtol=1e-6)
    assert labels.visible[2].all()
    camera = event_hpe.read_camera(recording, options)
    np.testing.assert_allclose([camera.K[0, 0], camera.K[0, 2]], [335.86, 128.2])
    np.testing.assert_allclose(project(camera, joints3d), labels.joints2d[2], rtol=1e-5)
    np.testing.assert_allclose(labels.intrinsics, [[335.86, 335.86, 128.2, 128.2]] * 4, rtol=1e-6)
    assert camera.distortion is None


def test_joints_outside_behind_and_unknown_are_not_visible(root):
    _, _, _, joints3d, joints2d = pose_values(0)
    joints3d[0, 2], joints2d[1, 0], joints2d[2, 1], joints3d[3], joints2d[3] = -1, 256, -0.5, np.nan, np.nan
    write_poses(root, (0,), joints3d=joints3d, joints2d=joints2d)
    labels = check_labels(event_hpe.read_labels(*first(root)), "x")
    assert labels.visible[0].tolist() == [False] * 4 + [True] * 20


def test_grey_pictures_lie_at_the_poses(root):
    track = event_hpe.read_intensity_frames(*first(root))
    assert track.t_us.tolist() == [0, 15_000, 30_000, 45_000] and track.images.shape == (4, 256, 256)
    assert np.abs(track.images[:, 128, 128].astype(int) - [0, 40, 80, 120]).max() <= 2
    assert not first(root, intensity=False)[0].has_intensity
    assert event_hpe.read_intensity_frames(*first(root, frame_period_us=66_667)).t_us[1] == 66_667


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"theta": np.zeros((1, 71))}, r"theta must be \[72\] numbers, got \[71\]"),
        ({"beta": np.full((1, 10), np.nan)}, "beta is not finite"),
        ({"joints3d": np.zeros((23, 3))}, r"joints3d must be \[24, 3\] numbers, got \[23, 3\]"),
        ({"tran": "here"}, r"tran must be \[3\] numbers"),
        ({"more": 1}, "expected beta, theta, tran, joints3d and joints2d, got tuple of 6"),
    ],
)
def test_wrong_pose_files_are_named(root, changes, message):
    write_poses(root, (1,), **changes)
    with pytest.raises(DataError, match=rf"pose0001\.pkl: {message}"):
        event_hpe.read_labels(*first(root))


class Touch:
    """Unpickling this makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def test_a_pose_file_with_code_is_refused_and_not_run(root, tmp_path):
    joblib.dump(Touch(tmp_path / "run"), root / f"pose_events/{ACTION}/pose0001.pkl")
    with pytest.raises(DataError, match=r"pose0001\.pkl"):
        event_hpe.read_labels(*first(root))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("picture", [np.zeros((256, 256, 3)), np.zeros((128, 256, 4)), None])
def test_wrong_event_images_are_named(root, picture):
    path = root / f"events_256/{ACTION}/event0001.png"
    if picture is None:
        path.write_text("x")
    else:
        write_image(path, picture.astype(np.uint8))
    with pytest.raises(DataError, match=r"event0001\.png: expected four time slices \[256, 256, 4\] of 8 bits, got"):
        event_hpe.read_event_images(*first(root))


def test_raw_events_are_upright_and_sorted(raw):
    recording, options = first(raw)
    assert recording.has_events and not recording.has_event_images and recording.sensor_size == (800, 1280)
    events = event_hpe.read_events(recording, options)
    assert events.t.tolist() == [100, 500, 900, 1100, 1500, 1900, 2100, 2500, 2900]
    assert (events.x[:3].tolist(), events.y[:3].tolist()) == ([0, 799, 793], [0, 1279, 1274])
    assert events.p[:3].tolist() == [0, 1, 0]


def test_raw_windows_are_files_and_end_at_their_label(raw):
    recording, options = first(raw)
    windows = event_hpe.read_windows(recording, options)
    assert windows.tolist() == [[0, 3], [3, 6], [6, 9]] and windows.dtype == np.int64
    labels = check_labels(event_hpe.read_labels(recording, options), "x")
    assert labels.t_us.tolist() == [99, 900, 1900, 2900]
    t = event_hpe.read_events(recording, options).t
    matched = labels_at_windows(labels, t[windows[:, 0]], t[windows[:, 1] - 1])
    for row, number in enumerate((11, 12, 13)):
        _, _, tran, joints3d, _ = pose_values(number)
        np.testing.assert_allclose(matched.smpl_transl[row], tran[0], rtol=1e-6)
        pixels = project(event_hpe.read_camera(recording, options), joints3d)
        np.testing.assert_allclose(matched.joints2d[row], pixels, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(labels.intrinsics, [[1679.3, 1679.3, 401, 641]] * 4)
    pictures = event_hpe.read_intensity_frames(recording, options)
    assert pictures.images.shape == (4, 1280, 800) and pictures.t_us.tolist() == labels.t_us.tolist()


@pytest.mark.parametrize("gap_us", [0, 1])
def test_windows_that_touch_have_the_pose_at_their_end_alone(tmp_path, gap_us):
    for number in range(4):
        start_us = 1000 * number + gap_us
        write_events(tmp_path, 10 + number, [(0, 0, start_us, 0, 1), (9, 9, 1000 * number + 1000, 0, 0)])
    write_poses(tmp_path, (10, 11, 12, 13))
    recording, options = first(tmp_path)
    labels = check_labels(event_hpe.read_window_labels(recording, options), "windows")
    assert len(labels) == len(event_hpe.read_windows(recording, options)) == 3
    camera = event_hpe.read_camera(recording, options)
    for row, number in enumerate((11, 12, 13)):
        expected = project(camera, pose_values(number)[3])
        np.testing.assert_allclose(labels.joints2d[row], expected, atol=1e-2)
    assert labels.t_us.tolist() == [1000, 2000, 3000]


def test_windows_without_a_pose_at_their_end_are_left_out_and_empty_files_stay(raw):
    (raw / f"pose_events/{ACTION}/pose0012.pkl").unlink()
    write_events(raw, 12, [])
    recording, options = first(raw)
    assert event_hpe.read_windows(recording, options).tolist() == [[0, 3], [6, 6]]
    assert event_hpe.read_labels(recording, options).t_us.tolist() == [99, 900]


def test_a_few_broken_rows_are_dropped_and_many_refused(raw):
    good = [(i, i, 100 + i, 0, 1) for i in range(200)]
    write_events(raw, 10, [*good, (1280, 5, 150, 0, 1), ("", 5, 150, 0, 1)])
    recording, options = first(raw)
    assert len(event_hpe.read_events(recording, options)) == 200 + 6
    write_events(raw, 10, [*good, *[(5, 800, 150, 0, 1)] * 3])
    with pytest.raises(
        DataError, match=r"event0010\.csv: 3 of 203 rows are incomplete or outside 1280 x 800.* row 200"
    ):
        event_hpe.read_events(recording, options)
    write_events(raw, 10, [("v", "u", "t", "o", "p")])
    with pytest.raises(DataError, match=r"event0010\.csv: expected rows of five numbers"):
        event_hpe.read_events(recording, options)


def test_a_clock_that_starts_anew_with_every_file_is_refused(raw):
    write_events(raw, 11, [(0, 0, t, 0, 1) for t in (100, 500, 900)])
    with pytest.raises(DataError, match=r"event0011\.csv: in_pixel_time starts at 100 us, .* the clock starts anew"):
        event_hpe.read_events(*first(raw))


def test_files_may_overlap_a_little(raw):
    write_events(raw, 11, [(0, 0, t, 0, 1) for t in (880, 1500, 1900)])
    events = event_hpe.read_events(*first(raw))
    assert events.t.tolist()[:4] == [100, 500, 880, 900] and len(events) == 9


def test_a_recording_without_events_is_an_error(raw):
    for number in (10, 11, 12):
        write_events(raw, number, [])
    with pytest.raises(DataError, match="Event-HPE subject03/group1_time1: expected events, got none in 3 files"):
        event_hpe.read_events(*first(raw))


def test_wrong_trees_are_shown_the_right_one(root):
    def refused(pattern, **changes):
        with pytest.raises(DataError, match=pattern) as error:
            first(changes.pop("root", root), **changes)
        return str(error.value)

    for pattern, changes in (
        ("no such folder", {"root": root / "absent"}),
        ("neither events_512 nor raw recordings", {"image_size": 512}),
        ("events: no files event0000.csv, but subject03_group1_time1 has poses", {"layout": "raw"}),
        ("no actions of the subjects asked for", {"subjects": (4,)}),
    ):
        assert "pose_events/subject01_group1_time1/pose0000.pkl" in refused(pattern, **changes)
    write_events(root, 1, [(1, 1, 1, 1, 1)])
    refused(r"holds event images and raw events; choose with dataset\.options\.layout")
    for path in (root / f"pose_events/{ACTION}").iterdir():
        path.unlink()
    refused(r"no files pose0000\.pkl", layout="preprocessed")
    (root / f"pose_events/{ACTION}").rmdir()
    (root / "pose_events").rmdir()
    refused("pose_events: no such folder, the poses are missing", layout="preprocessed")


def test_images_that_end_at_no_pose_are_an_error(root):
    for number in (1, 2, 4):
        (root / f"pose_events/{ACTION}/pose{number:04d}.pkl").unlink()
    with pytest.raises(DataError, match="no event image n with a pose n \\+ 1"):
        event_hpe.read_event_images(*first(root))


def test_the_root_stays_outside_the_cache_key(root):
    assert "root" not in cache_material(event_hpe.Options(root=root))
