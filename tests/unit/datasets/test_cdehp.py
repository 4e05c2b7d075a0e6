"""CDEHP in the published layout: pictures written with OpenCV, labels and raw events as text."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from ctlev_core import plugins
from ctlev_core.dataset_files import cdehp_files
from ctlev_core.datasets import cdehp
from ctlev_core.geometry.joint_sets import JOINT_SETS, SMPL_TO_DHP19, joint_indices
from ctlev_core.plugins import PluginError
from ctlev_core.stand_ins.dataset_writers import write_cdehp_label
from data_contracts.config import DatasetChoice, cache_material
from data_contracts.errors import DataError
from data_contracts.labels import Part, check_labels

JOINTS = np.stack([np.linspace(100, 1200, 13), np.linspace(50, 700, 13)], axis=1)


def write_label(path: Path, joints=JOINTS, partner: str = "color_name:000000") -> None:
    write_cdehp_label(path, joints, partner)


def write_picture(path: Path, value: int, size=(1280, 800), channels=1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = np.zeros((size[1], size[0], channels), np.uint8)
    picture[3, 7] = value
    assert cv2.imwrite(str(path), picture)


def write_shot(folder: Path, labelled=(1, 3), count=5) -> Path:
    """Event images 0 .. count - 1; event image 2 c + 1 belongs to colour picture c."""
    for number in range(count):
        write_picture(folder / f"event_image/{number:06d}.png", 10 + number)
    for number in labelled:
        write_label(folder / f"event_label/{number:06d}.txt", partner=f"color_name:{number // 2:06d}")
    return folder


def write_points(folder: Path, rows, name="A0001P0002S00.csv") -> Path:
    path = folder / "event_point_cloud" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(",".join(map(str, row)) + "\n" for row in rows))
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "CDEHP"
    write_shot(root / "outdoor/train/A0002P0001S00")
    write_shot(root / "outdoor/valid/A0008P0002S01")
    write_shot(root / "indoor/train/A0013P0001S00")
    (root / "readme.md").write_text("about")
    return root


def first(root: Path, **changes):
    options = cdehp.Options(root=root, **({"places": ("outdoor",)} | changes))
    return cdehp.list_recordings(options)[0], options


def test_shots_become_recordings_in_the_official_split(root):
    recordings = cdehp.list_recordings(cdehp.Options(root=root))
    assert [r.recording_id for r in recordings] == [
        "indoor/A0013P0001S00", "outdoor/A0002P0001S00", "outdoor/A0008P0002S01",
    ]  # fmt: skip
    assert [r.class_name for r in recordings] == ["spinning", "running", "cartwheel"]
    assert [r.subject for r in recordings] == ["indoor_P0001", "outdoor_P0001", "outdoor_P0002"]
    assert [r.parts for r in recordings] == [(Part("train"),), (Part("train"),), (Part("test"),)]
    assert all(r.has_event_images and not r.has_events and not r.has_intensity for r in recordings)
    assert len(recordings[0].files) == 5 + 2


def test_split_by_subject_takes_the_same_numbers_everywhere(root):
    options = cdehp.Options(root=root, split="subject", test_subjects=(1,))
    assert [r.parts[0].split for r in cdehp.list_recordings(options)] == ["test", "test", "train"]


def test_condition_subjects_of_the_training_folder_give_labels_only(root):
    options = cdehp.Options(root=root, condition_subjects=(1, 2))
    recordings = cdehp.list_recordings(options)
    assert [r.parts[0].split for r in recordings] == ["condition", "condition", "test"]
    assert not recordings[1].has_event_images and len(recordings[1].files) == 2
    assert len(cdehp.read_labels(recordings[1], options)) == 2


@pytest.mark.parametrize("options", [{"split": "subject"}, {"test_subjects": [1]}, {"places": ["attic"]}])
def test_options_that_contradict_are_refused(root, options):
    with pytest.raises(PluginError):
        plugins.load_options(DatasetChoice(name="cdehp", options={"root": str(root), **options}))


def test_event_images_and_labels_match_one_to_one(root):
    recording, options = first(root)
    track, labels = cdehp.read_event_images(recording, options), cdehp.read_labels(recording, options)
    assert track.images.shape == (2, 800, 1280) and track.images.dtype == np.uint8
    assert track.images[:, 3, 7].tolist() == [11, 13] and track.images.sum() == 24
    assert track.t_us.tolist() == labels.t_us.tolist() == [2 * 8333, 4 * 8333]
    check_labels(labels, "x")
    np.testing.assert_allclose(labels.joints2d[0], JOINTS, rtol=1e-6)
    assert labels.visible.all() and labels.joint_set == "cdehp" and labels.class_names == ("running",) * 2


def test_images_without_a_label_are_read_on_request(root):
    recording, options = first(root, labelled_only=False)
    assert cdehp.read_event_images(recording, options).images[:, 3, 7].tolist() == [10, 11, 12, 13, 14]


def test_joints_outside_and_unknown_joints_are_not_visible(root):
    joints = JOINTS.copy()
    joints[0], joints[1], joints[2] = (1280, 10), (-1, 10), (np.nan, 10)
    write_label(root / "outdoor/train/A0002P0001S00/event_label/000001.txt", joints)
    labels = check_labels(cdehp.read_labels(*first(root)), "x")
    assert labels.visible[0].tolist() == [False] * 3 + [True] * 10
    np.testing.assert_allclose(labels.joints2d[0, :2], [[1280, 10], [-1, 10]])
    assert np.isnan(labels.joints2d[0, 2]).all()


def test_older_labels_have_pixels_in_brackets(root):
    path = root / "outdoor/train/A0002P0001S00/event_label/000001.txt"
    path.write_text("\n".join(["13", "color_name:000000", *[f"[{x}] [ {y} ]" for x, y in JOINTS], ""]))
    np.testing.assert_allclose(cdehp.read_labels(*first(root)).joints2d[0], JOINTS, rtol=1e-6)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["12", "color_name:0", *["0.1 0.1"] * 12], "expected 13, a name and 13 joints, got '12' first and 14 lines"),
        (["13", "color_name:0", *["0.1 0.1"] * 12], "got '13' first and 14 lines"),
        (["13", "color_name:0", *["0.1 0.1"] * 12, "0.1"], "line 15: expected two numbers, got '0.1'"),
        (["13", "color_name:0", "a b", *["0.1 0.1"] * 12], "line 3: expected two numbers, got 'a b'"),
        (["13", *["0.1 0.1"] * 13], "line 2: expected color_name: or event_name: and a number, got '0.1 0.1'"),
        (["13", "event_name:000002", *["0.1 0.1"] * 13], "expected the picture's own number 000001, got 000002"),
        ([], "line 2: expected color_name: or event_name: and a number, got nothing"),
    ],
)
def test_wrong_label_files_are_named(root, lines, message):
    path = root / "outdoor/train/A0002P0001S00/event_label/000001.txt"
    path.write_text("\n".join(lines))
    with pytest.raises(DataError, match=r"000001\.txt: ") as error:
        cdehp.read_labels(*first(root))
    assert message in str(error.value)


def test_a_label_may_name_its_own_picture(root):
    write_label(root / "outdoor/train/A0002P0001S00/event_label/000001.txt", partner="event_name:000001")
    assert len(cdehp.read_labels(*first(root))) == 2


@pytest.mark.parametrize(("content", "got"), [("size", "800 x 1280"), ("text", "none")])
def test_wrong_pictures_are_named(root, content, got):
    path = root / "outdoor/train/A0002P0001S00/event_image/000003.png"
    if content == "size":
        write_picture(path, 1, size=(800, 1280))
    else:
        path.write_text("no picture")
    with pytest.raises(DataError, match=rf"000003\.png: expected a picture of 1280 x 800 px, got {got}"):
        cdehp.read_event_images(*first(root))


def test_raw_events_are_row_column_time_without_polarity(root):
    shot = root / "outdoor/train/A0001P0002S00"
    rows = [(0, 0, 5), (799, 1279, 8332), (10, 900, 8333), (11, 901, 30_000), (12, 902, 33_332)]
    write_points(shot, rows)
    for number in (0, 2, 3):
        write_label(shot / f"event_label/{number:06d}.txt")
    recording, options = first(root)
    assert recording.has_events and not recording.has_event_images and recording.class_name == "walking"
    events = cdehp.read_events(recording, options)
    assert [*zip(events.y, events.x, events.t, strict=True)] == rows and events.p.tolist() == [1] * 5
    # Windows 0, 1 and 3 have events; the last event ends window 3 exactly, as with the authors' digitize.
    assert cdehp.read_windows(recording, options).tolist() == [[0, 2], [3, 5]]
    of_all = cdehp.Options(**{**options.model_dump(), "labelled_only": False})
    assert cdehp.read_windows(recording, of_all).tolist() == [[0, 2], [2, 3], [3, 5]]
    assert cdehp.read_labels(recording, options).t_us.tolist() == [8333 * n + 4166 for n in (0, 2, 3)]


@pytest.mark.parametrize("last", [8332, 8333, 8334, 24_999, 25_000, 1])
def test_window_numbers_are_those_of_the_authors_splitter(last):
    t = np.unique(np.append(np.random.default_rng(last).integers(0, last + 1, 50), last))
    expected = np.digitize(t, np.arange(0, t[-1], 8333)) - 1
    np.testing.assert_array_equal(cdehp_files.window_numbers(t), expected)


def test_raw_events_of_the_site_are_x_y_t_p_in_slices(root):
    shot = root / "outdoor/train/A0001P0002S00"
    write_label(shot / "event_label/000000.txt")
    (shot / "event_point_cloud").mkdir()
    np.save(shot / "event_point_cloud/000010.npy", np.array([[801, 3, 90_000, 1]]))
    np.save(shot / "event_point_cloud/000000.npy", np.array([[1, 2, 3, -1], [4, 5, 6, 1]], float))
    events = cdehp.read_events(*first(root))
    assert (events.x.tolist(), events.y.tolist()) == ([1, 4, 801], [2, 5, 3])
    assert events.t.tolist() == [3, 6, 90_000] and events.p.tolist() == [0, 1, 1]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(1, 2, 3)], "neither of the first two columns has a value of 800 or more"),
        ([(900, 900, 3)], "both columns have a value of 800 or more"),
        ([(1, 900, 30), (1, 900, 20)], "t decreases at event 1: 30 us, then 20 us"),
        ([(1, 1280, 3)], "x must be 0 .. 1279, got 1280 at event 0"),
        ([(-1, 900, 3)], "y must be 0 .. 799, got -1 at event 0"),
        ([(1, 900, 3, 70_000)], "the fourth column must be the polarity, -1, 0 or 1, got 70000"),
        ([(1, 900, 3.5)], "expected whole numbers, got 3.5 in row 0, column 2"),
        ([(1, 900)], "expected 3 or 4 columns of events in every file, got [2]"),
        ([("row", "col", "t"), (1, 900, 3)], "expected columns of numbers"),
        ([], "expected events, got none"),
    ],
)
def test_wrong_raw_events_are_named(root, rows, message):
    shot = root / "outdoor/train/A0001P0002S00"
    write_label(shot / "event_label/000000.txt")
    write_points(shot, rows)
    with pytest.raises(DataError) as error:
        cdehp.read_events(*first(root))
    assert message in str(error.value) and "A0001P0002S00" in str(error.value)


def test_a_damaged_file_of_raw_events_is_named(root):
    shot = root / "outdoor/train/A0001P0002S00"
    write_label(shot / "event_label/000000.txt")
    path = shot / "event_point_cloud/000000.npy"
    path.parent.mkdir()
    np.save(path, np.array([[801, 3, 90_000, 1]]))
    path.write_bytes(path.read_bytes().replace(b"'fortran_order': False", b"'fortran_order': (alse"))
    with pytest.raises(DataError, match=r"000000\.npy: expected columns of events: .* not a complete NumPy file"):
        cdehp.read_events(*first(root))


def test_the_order_of_coordinates_can_be_given(root):
    shot = root / "outdoor/train/A0001P0002S00"
    write_label(shot / "event_label/000000.txt")
    write_points(shot, [(1, 2, 3)])
    assert cdehp.read_events(*first(root, coordinates="row_first")).y.tolist() == [1]
    assert cdehp.read_events(*first(root, coordinates="x_first")).x.tolist() == [1]


def test_colour_pictures_are_dated_by_the_labels(root):
    shot = root / "outdoor/train/A0002P0001S00"  # event images 1 and 3 belong to the colour pictures 0 and 1
    for number in (0, 1, 2, 3):
        write_picture(shot / f"color_image/{number:06d}.png", 100 + number, (848, 480), channels=3)
    write_label(shot / "color_label/000003.txt", partner="event_name:000008")
    recording, options = first(root)
    assert recording.has_intensity
    track = cdehp.read_intensity_frames(recording, options)
    assert track.images.shape == (4, 480, 848) and track.images[:, 3, 7].tolist() == [100, 101, 102, 103]
    assert track.t_us.tolist() == [8333 * n + 4166 for n in (1, 3, 5, 8)]
    assert not first(root, intensity=False)[0].has_intensity
    labels_only, options = first(root, condition_subjects=(1,))
    assert labels_only.has_intensity and not labels_only.has_event_images
    assert cdehp.read_intensity_frames(labels_only, options).t_us.tolist() == track.t_us.tolist()


def test_colour_pictures_before_the_first_event_frame_are_left_out_and_none_run_backwards():
    numbers = np.arange(4)
    times = cdehp_files.colour_times_us(numbers, [(2, 1)], "x")
    assert ((times - 4166) // 8333).tolist() == [-3, -1, 1, 3]
    with pytest.raises(DataError, match="colour pictures run backwards: 3 belongs to event image 4, 2 to 6"):
        cdehp_files.colour_times_us(numbers, [(2, 6), (3, 4)], "x")
    with pytest.raises(DataError, match="no label file names the colour picture"):
        cdehp_files.colour_times_us(numbers, [], "x")


def test_wrong_trees_are_shown_the_right_one(root):
    def refused(pattern, **changes):
        with pytest.raises(DataError, match=pattern) as error:
            first(changes.pop("root", root), **changes)
        return str(error.value)

    for pattern, changes in (
        ("no such folder", {"root": root / "absent"}),
        ("no shots of outdoor", {"root": root / "outdoor"}),
        (r"event_point_cloud: no files", {"source": "raw"}),
    ):
        assert "A0001P0001S00" in refused(pattern, **changes)
    shot = root / "outdoor/train/A0002P0001S00"
    write_label(shot / "event_label/000009.txt")
    refused(r"A0002P0001S00: 3 label files for 5 event images; no image 000009\.png")
    (shot / "event_label/000009.txt").unlink()
    (root / "outdoor/valid/A0002P0001S00").symlink_to(shot)
    refused("the shot is in train and in valid")
    (root / "outdoor/valid/A0002P0001S00").unlink()
    (root / "outdoor/train/walking").mkdir()
    refused("walking: expected a shot such as A0001P0001S00")
    (root / "outdoor/train/walking").rmdir()
    for path in (shot / "event_label").iterdir():
        path.unlink()
    refused("event_label: no label files")
    (root / "outdoor/test/A0001P0001S00").mkdir(parents=True)
    refused("test: expected the folders train and valid")


def test_the_root_stays_outside_the_cache_key(root):
    assert "root" not in cache_material(cdehp.Options(root=root))


def test_joint_sets_correspond_by_name():
    names = {name: joints.joints for name, joints in JOINT_SETS.items()}
    assert [names["cdehp"][i] for i in joint_indices("cdehp", "dhp19")] == list(names["dhp19"])
    assert [names["dhp19"][i] for i in joint_indices("dhp19", "cdehp")] == list(names["cdehp"])
    assert joint_indices("smpl", "dhp19") == list(SMPL_TO_DHP19), "a marker on the hand is at SMPL's wrist"
    assert joint_indices("smpl", "smpl") == list(range(24))
    with pytest.raises(DataError, match="joint set 'cdehp' lacks joints of 'smpl': pelvis"):
        joint_indices("cdehp", "smpl")
    with pytest.raises(DataError, match="unknown joint set 'coco'; known: dhp19, cdehp, smpl"):
        joint_indices("coco", "smpl")
    for joints in JOINT_SETS.values():
        assert [joints.mirror[i] for i in joints.mirror] == list(range(len(joints.joints)))
