"""The folder dataset: good trees become recordings, every bad tree one error that says where."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from ctlev_core import plugins
from ctlev_core.datasets import folder
from data_contracts.config import DatasetChoice, cache_material
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import Part, check_labels


def write_recording(path: Path, num_events: int = 4, name: str = "parquet") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    zeros = np.zeros(num_events, np.uint16)
    t = np.arange(num_events, dtype=np.int64)
    plugins.load("formats", name).write(path, Events(t, zeros, zeros, zeros.astype(np.uint8), (8, 6)))
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two classes, three formats, and files that are none of the dataset's business."""
    root = tmp_path / "recordings"
    for name, format_name in (("b.raw", "evt3"), ("a.raw", "evt2"), ("c.d.parquet", "parquet")):
        write_recording(root / "person" / name, name=format_name)
    write_recording(root / "car" / "a.parquet")
    (root / "README.md").write_text("about")
    (root / ".hidden").mkdir()
    (root / "car" / ".DS_Store").write_text("x")
    return root


def listed(root: Path, **options) -> list:
    return folder.list_recordings(folder.Options(root=root, **options))


def test_recordings_in_a_stable_order(root):
    recordings = listed(root)
    assert [r.recording_id for r in recordings] == ["car/a", "person/a", "person/b", "person/c.d"]
    assert [r.class_name for r in recordings] == ["car", "person", "person", "person"]
    assert [r.subject for r in recordings] == [r.recording_id for r in recordings]
    assert recordings[1].files == (root / "person" / "a.raw",)
    assert all(r.has_events for r in recordings)


def test_all_recordings_are_of_the_sensor_that_is_named(root):
    options = folder.Options(root=root, sensor_size=(64, 48))
    for recording in folder.list_recordings(options):
        assert folder.read_events(recording, options).sensor_size == (64, 48)
        assert {chunk.sensor_size for chunk in folder.read_event_chunks(recording, options)} == {(64, 48)}
    events = Events(np.zeros(1, np.int64), *(np.full(1, 5, np.uint16) for _ in "xy"), np.ones(1, np.uint8), (8, 6))
    plugins.load("formats", "parquet").write(root / "car" / "b.parquet", events)
    options = folder.Options(root=root, sensor_size=(4, 48))
    recording = next(one for one in folder.list_recordings(options) if one.recording_id == "car/b")
    for read in (folder.read_events, lambda *asked: list(folder.read_event_chunks(*asked))):
        with pytest.raises(DataError, match=r"b\.parquet, on the sensor_size that was set: "):
            read(recording, options)


def test_split_by_time_gives_each_file_two_parts_that_meet(root):
    for recording in listed(root, test_fraction=0.25):
        assert recording.parts == (Part("train", 0.0, 0.75), Part("test", 0.75, 1.0))


@pytest.mark.parametrize(
    ("num", "fraction", "num_test"), [(2, 0.01, 1), (2, 0.99, 1), (10, 0.3, 3), (5, 0.5, 2), (4, 0.9, 3)]
)
def test_split_by_recording_tests_on_the_last_files(num, fraction, num_test, tmp_path):
    for index in range(num):
        write_recording(tmp_path / "person" / f"{index}.parquet")
    recordings = listed(tmp_path, split="recording", test_fraction=fraction)
    assert [r.parts for r in recordings] == [(Part("train"),)] * (num - num_test) + [(Part("test"),)] * num_test


def test_what_comes_before_the_test_part_is_for_validation(root):
    for recording in listed(root, test_fraction=0.25, validation_fraction=0.25):
        assert recording.parts == (Part("train", 0.0, 0.5), Part("validation", 0.5, 0.75), Part("test", 0.75, 1.0))


@pytest.mark.parametrize(
    ("num", "fractions", "counts"),
    [
        (3, (0.01, 0.01), (1, 1, 1)),
        (3, (0.9, 0.05), (1, 1, 1)),
        (10, (0.3, 0.2), (5, 2, 3)),
        (4, (0.3, 0.6), (1, 2, 1)),
    ],
)
def test_split_by_recording_validates_on_the_files_before(num, fractions, counts, tmp_path):
    for index in range(num):
        write_recording(tmp_path / "person" / f"{index}.parquet")
    test, validation = fractions
    recordings = listed(tmp_path, split="recording", test_fraction=test, validation_fraction=validation)
    splits = [name for name, count in zip(("train", "validation", "test"), counts, strict=True) for _ in range(count)]
    assert [r.parts for r in recordings] == [(Part(split),) for split in splits]


def test_validation_by_recording_needs_three_recordings_a_class(tmp_path):
    for index in range(2):
        write_recording(tmp_path / "car" / f"{index}.parquet")
    with pytest.raises(DataError, match="car: split 'recording' needs three recordings a class, got 2"):
        listed(tmp_path, split="recording", validation_fraction=0.2)
    with pytest.raises(ValidationError, match="leave nothing to learn from"):
        folder.Options(root=tmp_path, test_fraction=0.5, validation_fraction=0.5)


def test_split_by_recording_needs_two_recordings_a_class(root):
    with pytest.raises(DataError, match=r"car: split 'recording' needs two recordings a class, got one \(a\.parquet\)"):
        listed(root, split="recording")


def test_events_are_the_whole_file_and_the_label_is_the_class(root):
    options = folder.Options(root=root)
    for recording in folder.list_recordings(options):
        assert folder.read_events(recording, options).t.tolist() == [0, 1, 2, 3]
        labels = check_labels(folder.read_labels(recording, options), recording.recording_id)
        assert labels.class_names == (recording.class_name,)


def test_the_real_recordings_are_three_classes(real_recordings):
    recordings = listed(real_recordings)
    assert [r.class_name for r in recordings] == ["person", "spot", "street"]


def test_the_root_stays_outside_the_cache_key(root):
    assert cache_material(folder.Options(root=root)) == {"split": "time", "test_fraction": 0.3}


@pytest.mark.parametrize("fraction", [0, 1, -0.1, float("nan")])
def test_a_test_fraction_outside_0_and_1_is_refused(fraction, root):
    with pytest.raises(ValidationError, match="test_fraction"):
        folder.Options(root=root, test_fraction=fraction)


def test_a_preset_without_a_root_is_told_so():
    with pytest.raises(plugins.PluginError, match="datasets 'folder': option 'root': field required"):
        plugins.load_options(DatasetChoice(name="folder"))


def assert_refused(root: Path, message: str, shows_tree: bool = True) -> None:
    with pytest.raises(DataError, match=message) as error:
        listed(root)
    assert ("ROOT/\n    person/\n" in str(error.value)) == shows_tree


def test_a_missing_root(tmp_path):
    assert_refused(tmp_path / "absent", "absent: no such folder; expected one folder a class")


def test_a_root_that_is_a_file(root):
    assert_refused(root / "README.md", r"README\.md: no such folder")


def test_a_root_without_class_folders(tmp_path):
    (tmp_path / "README.md").write_text("about")
    assert_refused(tmp_path, "no class folders")


def test_a_recording_beside_the_class_folders(root):
    write_recording(root / "loose.raw", name="evt3")
    assert_refused(root, r"loose\.raw: a recording outside a class folder")


def test_a_class_folder_without_recordings(root):
    (root / "bicycle").mkdir()
    assert_refused(root, "bicycle: a class folder without recordings")


def test_a_folder_inside_a_class_folder(root):
    (root / "car" / "day_1").mkdir()
    assert_refused(root, "day_1: a folder inside a class folder")


@pytest.mark.parametrize(
    "content", [b"", b"walking, first take\n", b"% evt 2.1\n"], ids=["empty", "text", "unknown version"]
)
def test_a_file_no_format_recognises(content, root):
    (root / "car" / "notes.raw").write_bytes(content)
    assert_refused(root, r"notes\.raw: not an event file of a known format", shows_tree=False)


def test_two_recordings_of_one_name(root):
    write_recording(root / "car" / "a.raw", name="evt2")
    assert_refused(root, r"a\.raw: has the name of a\.parquet", shows_tree=False)


def test_names_are_free(root):
    names = {
        "two words/a (1).parquet": ("two words", "two_words/a_1_"),
        "ka\u0308fer/a.parquet": ("k\u00e4fer", "kue4fer/a"),  # composed of two characters, as macOS writes it
        "\u732b/1.parquet": ("\u732b", "u732b/1"),
        "\u72d7/1.parquet": ("\u72d7", "u72d7/1"),
        "a&b, <c>/d'.parquet": ("a&b, <c>", "a_b_c_/d_"),
    }
    for name in names:
        write_recording(root / name)
    made = {recording.class_name: recording.recording_id for recording in listed(root)}
    for class_name, recording_id in names.values():
        assert made[class_name] == recording_id
    write_recording(root / "two_words" / "a_1_.parquet")
    assert_refused(root, "would get the recording id 'two_words/a_1_' of .*two words", shows_tree=False)


def test_names_of_control_characters_are_refused(root):
    write_recording(root / "car" / "a\nb.parquet")
    assert_refused(root, "expected a name of printable characters", shows_tree=False)


def test_links_out_of_the_root_are_refused(root, tmp_path):
    outside = write_recording(tmp_path / "outside" / "secret.parquet")
    link = root / "car" / "link.parquet"
    link.symlink_to(outside)
    assert_refused(root, r"link\.parquet: links to .*secret\.parquet, outside the dataset folder", shows_tree=False)
    link.unlink()
    (root / "outside").symlink_to(outside.parent)
    assert_refused(root, "outside: links to .*outside, outside the dataset folder", shows_tree=False)


def test_a_broken_link_is_refused(root):
    (root / "car" / "gone.raw").symlink_to(root / "absent")
    assert_refused(root, r"gone\.raw: a link to nothing", shows_tree=False)


def test_links_within_the_root_and_to_the_root_are_fine(root, tmp_path):
    (root / "car" / "again.raw").symlink_to(root / "person" / "a.raw")
    (tmp_path / "data").symlink_to(root)
    assert [r.recording_id for r in listed(tmp_path / "data")][:2] == ["car/a", "car/again"]


def test_a_recording_without_events_is_an_error_when_read(root):
    write_recording(root / "car" / "empty.parquet", num_events=0)
    options = folder.Options(root=root)
    empty = next(r for r in folder.list_recordings(options) if r.recording_id == "car/empty")
    with pytest.raises(DataError, match=r"empty\.parquet: expected a recording, got a file without events"):
        folder.read_events(empty, options)
