"""N-Caltech101: trees in the published layout become split recordings; every bad tree one error that says where."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from ctlev_core import plugins
from ctlev_core.datasets import n_caltech101
from ctlev_core.recordings.ingestion import list_recordings
from ctlev_core.stand_ins.dataset_writers import write_atis
from data_contracts.config import ConditionChoice, DatasetChoice, EncodingChoice, Windows
from data_contracts.errors import DataError
from data_contracts.labels import Part, check_labels
from data_contracts.manifest import read_manifest
from tasks.condition import condition_frames, condition_samples
from tasks.encode import encode
from tasks.ingest import ingest
from tasks.store import Store

# Table 5 of the paper, as printed.
TABLE_5 = ["bonsai", "ceiling fan", "ferry", "joshua tree", "minaret", "pagoda", "sunflower", "water lilly",
           "windsor chair", "chandelier"]  # fmt: skip


def write_some(path: Path, seed: int = 0, num_events: int = 200) -> Path:
    random = np.random.default_rng(seed)
    t = np.sort(random.integers(0, 300_000, num_events)).tolist()
    x, y, p = (random.integers(0, limit, num_events).tolist() for limit in (200, 150, 2))
    return write_atis(path, t, x, y, p)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Four classes of eight, the background, and what else lies in a download."""
    root = tmp_path / "Caltech101"
    for name in ("accordion", "crocodile_head", "bonsai", "ferry", "BACKGROUND_Google"):
        for number in range(1, 9):
            write_some(root / name / f"image_{number:04d}.bin", number)
    (root / "Annotations" / "accordion").mkdir(parents=True)
    (root / "ReadMe(Caltech101)-SINAPSE-G.txt").write_text("about")
    (root / "accordion" / "Thumbs.db").write_text("x")
    return root


def listed(root: Path, **options) -> list:
    return n_caltech101.list_recordings(n_caltech101.Options(root=root, **options))


def test_two_recordings_of_one_name_are_refused_before_any_is_read(root, monkeypatch):
    write_some(root / "accordion" / "image_0003.BIN", 99)
    monkeypatch.setattr(n_caltech101, "read_events", lambda *_: pytest.fail("read"))
    plugin = plugins.load_options(DatasetChoice(name="n_caltech101", options={"root": str(root)}))
    message = r"two recordings are called 'accordion/image_0003': .*image_0003\.bin and .*image_0003\.BIN"
    with pytest.raises(DataError, match=message):
        list_recordings(plugin)


def run_stage(stage, **arguments):
    """What a Prefect task does, without Prefect."""
    return stage.run(stage.key(arguments, Store()), arguments)[0]


def ids(recordings: list, split: str) -> list[str]:
    return [r.recording_id for r in recordings if r.parts == (Part(split),)]


def test_each_class_is_split_and_no_recording_is_in_two_splits(root):
    recordings = listed(root, test_fraction=0.25, validation_fraction=0.25)
    assert len(recordings) == len({r.recording_id for r in recordings}) == 32 + 4
    folders = ["accordion", "crocodile_head", "bonsai", "ferry"]
    for split, number in (("train", 4), ("validation", 2), ("test", 2)):
        classes = [name.split("/")[0] for name in ids(recordings, split)]
        assert classes == sorted(folders * number)
    assert ids(recordings, "condition") == [f"condition/{name}" for name in sorted(folders)]
    assert all(r.subject == r.recording_id for r in recordings)
    assert all(r.sensor_size == (240, 180) for r in recordings if r.has_events)
    first = recordings[0]
    assert first.files[0].parent == root / "accordion" and first.recording_id.startswith("accordion/image_000")
    assert {r.class_name for r in recordings} == {"accordion", "crocodile head", "bonsai", "ferry"}


def test_the_split_follows_the_seed_and_a_class_knows_nothing_of_the_others(root):
    before, other = ids(listed(root), "test"), ids(listed(root, seed=1), "test")
    assert before == ids(listed(root), "test") != other
    shutil.rmtree(root / "bonsai")
    assert ids(listed(root), "test") == [name for name in before if not name.startswith("bonsai")]


def test_the_split_is_fixed_for_ever(root):
    """Pinned: another order would make models and scores of different versions test on what they learnt from."""
    assert ids(listed(root, classes=("bonsai", "ferry")), "test") == [
        "bonsai/image_0003",
        "bonsai/image_0004",
        "ferry/image_0001",
        "ferry/image_0007",
    ]


def test_smaller_choices_are_part_of_larger_ones_and_tests_stay(root):
    two, four = (listed(root, images_per_class=number) for number in (2, 4))
    assert len(ids(two, "train")) == 8 and set(ids(two, "train")) < set(ids(four, "train"))
    assert ids(two, "test") == ids(four, "test") and len(ids(two, "test")) == 8
    assert len(ids(listed(root, test_images_per_class=1), "test")) == 4


def test_the_background_is_there_only_when_asked_for(root):
    assert "background" not in {r.class_name for r in listed(root)}
    assert "background" in {r.class_name for r in listed(root, background=True)}


def test_zero_shot_classes_are_those_of_table_5_and_are_only_tested_and_sampled(root):
    assert [n_caltech101.class_name_of(name) for name in n_caltech101.ZERO_SHOT] == TABLE_5
    recordings, ordinary = listed(root, zero_shot=True), listed(root)
    assert {r.class_name for r in recordings if r.parts == (Part("train"),)} == {"accordion", "crocodile head"}
    assert ids(recordings, "test") == [n for n in ids(ordinary, "test") if n.split("/")[0] in ("bonsai", "ferry")]
    labels_only = [r for r in recordings if not r.has_events]
    assert ids(recordings, "condition") == ["condition/bonsai", "condition/ferry"]
    assert [r.class_name for r in labels_only] == ["bonsai", "ferry"] and labels_only[0].files == ()
    with pytest.raises(DataError, match=r"zero_shot needs classes to learn from and some of bonsai, .*are: accordion"):
        listed(root, zero_shot=True, classes=("accordion",))


def test_only_the_zero_shot_classes_are_sampled_and_none_of_them_is_learnt(root, home):
    options = {"root": str(root), "zero_shot": True}
    recordings = run_stage(ingest, dataset=DatasetChoice(name="n_caltech101", options=options))
    encoding = EncodingChoice(name="event_histogram", options={"image_size": (16, 16)})
    windows = Windows(method="whole")
    frames = run_stage(encode, recordings=recordings, encoding=encoding, windows=windows)
    both = {"recordings": recordings, "frames": frames, "condition": ConditionChoice(name="text"), "encoding": encoding}
    learnt = run_stage(condition_frames, **both, seed=0)
    asked = {"poses": recordings, "windows": windows, "count": 6, "order": "random", "views": "labelled", "seed": 0}
    sampled = run_stage(condition_samples, **both, **asked)
    names = [set(read_manifest(manifest).column("prompt")) for manifest in (learnt, sampled)]
    assert names[0] == {"A photo of accordion", "A photo of crocodile head"}
    assert names[1] == {"A photo of bonsai", "A photo of ferry"}


def test_classes_can_be_chosen_by_folder_or_name(root):
    chosen = listed(root, classes=("crocodile head", "bonsai"))
    assert {r.class_name for r in chosen} == {"crocodile head", "bonsai"}
    assert listed(root, classes=("crocodile_head", "bonsai")) == chosen
    with pytest.raises(DataError, match=r"no class 'gorilla'; there are: BACKGROUND_Google, accordion"):
        listed(root, classes=("gorilla",))


def test_all_101_folders_have_readable_names_of_their_own():
    names = [n_caltech101.class_name_of(name) for name in n_caltech101.CLASSES]
    assert len(set(names)) == 101 and not any("_" in name for name in names)
    assert {"airplane", "face", "sea horse", "water lilly"} <= set(names)


def test_the_split_of_est_is_used_as_it_is(tmp_path):
    root = tmp_path / "N-Caltech101"
    for split, count in (("training", 3), ("validation", 1), ("testing", 2)):
        for name in ("accordion", "bonsai", "BACKGROUND_Google"):
            for number in range(count):
                path = root / split / name / f"{name}_{number}.npy"
                path.parent.mkdir(parents=True, exist_ok=True)
                np.save(path, np.zeros((3, 4), np.float32))
    recordings = listed(root, test_fraction=0.9)
    assert ids(recordings, "train") == [f"training/{c}/{c}_{n}" for c in ("accordion", "bonsai") for n in range(3)]
    assert len(ids(recordings, "validation")) == 2 and len(ids(recordings, "test")) == 4
    for folder in ("training", "testing"):
        with pytest.raises(DataError, match=f"{folder}: lies inside the dataset; the root is .*N-Caltech101;"):
            listed(root / folder)


def test_events_of_est_are_columns_with_seconds(tmp_path):
    rows = np.array([[0, 0, 0.000001, -1], [239, 179, 0.25, 1], [17, 5, 0.3, -1]], np.float32)
    for split in ("training", "testing"):
        for name in ("accordion", "bonsai"):
            (tmp_path / split / name).mkdir(parents=True)
            np.save(tmp_path / split / name / f"{name}_0.npy", rows)
    events = n_caltech101.read_events(listed(tmp_path)[0], n_caltech101.Options(root=tmp_path))
    assert (events.x.tolist(), events.y.tolist(), events.p.tolist()) == ([0, 239, 17], [0, 179, 5], [0, 1, 0])
    assert events.t.tolist() == [1, 250_000, 300_000] and events.sensor_size == (240, 180)


def test_events_and_label_of_a_recording(root):
    x, y = [0, 239, 17, 3], [0, 179, 5, 3]
    file = write_atis(root / "bonsai" / "image_0001.bin", [0, 5, 70_000, 8_388_607], x, y, [0, 1, 1, 0])
    options = n_caltech101.Options(root=root)
    recording = next(r for r in listed(root) if r.files == (file,))
    events = n_caltech101.read_events(recording, options)
    assert events.sensor_size == (240, 180)
    assert (events.x.tolist(), events.y.tolist(), events.p.tolist()) == (x, y, [0, 1, 1, 0])
    assert events.t.tolist() == [0, 5, 70_000, 8_388_607]
    assert check_labels(n_caltech101.read_labels(recording, options), "labels").class_names == ("bonsai",)


def test_a_few_events_outside_the_field_are_dropped_and_many_are_an_error(root):
    options = n_caltech101.Options(root=root)
    x, y = [240] + [10] * 199, [0] * 199 + [179]
    write_atis(root / "bonsai" / "image_0001.bin", list(range(200)), x, y, [1] * 200)
    recording = next(r for r in listed(root) if r.recording_id == "bonsai/image_0001")
    events = n_caltech101.read_events(recording, options)
    assert len(events) == 199 and events.t[0] == 1 and events.sensor_size == (240, 180)
    write_atis(root / "bonsai" / "image_0001.bin", list(range(200)), x, [180] * 3 + [9] * 197, [1] * 200)
    with pytest.raises(DataError, match=r"image_0001\.bin: expected events within 240 x 180 px, got 3 of 200 outside"):
        n_caltech101.read_events(recording, options)


def test_extent_is_the_box_of_the_events(root):
    write_atis(root / "bonsai" / "image_0001.bin", [0, 1, 2], [30, 45, 31], [100, 100, 119], [1, 1, 0])
    options = n_caltech101.Options(root=root, sensor="extent")
    recording = next(r for r in n_caltech101.list_recordings(options) if r.recording_id == "bonsai/image_0001")
    events = n_caltech101.read_events(recording, options)
    assert events.sensor_size == (16, 20) and recording.sensor_size is None
    assert (events.x.tolist(), events.y.tolist()) == ([0, 15, 1], [0, 0, 19])


@pytest.mark.parametrize("content", [b"", b"12345678901"], ids=["empty", "cut"])
def test_files_that_are_no_recording(content, root):
    (root / "bonsai" / "image_0001.bin").write_bytes(content)
    recording = next(r for r in listed(root) if r.recording_id == "bonsai/image_0001")
    with pytest.raises(DataError, match=r"image_0001\.bin"):
        n_caltech101.read_events(recording, n_caltech101.Options(root=root))


def assert_refused(root: Path, message: str, shows_tree: bool = True) -> None:
    with pytest.raises(DataError, match=message) as error:
        listed(root)
    assert ("ROOT/\n    accordion/\n      image_0001.bin" in str(error.value)) == shows_tree


def test_a_root_that_is_not_there_or_a_file(root):
    assert_refused(root / "absent", "absent: no such folder")
    assert_refused(root / "ReadMe(Caltech101)-SINAPSE-G.txt", "a file, not a folder")


def test_a_root_one_level_too_high_or_too_low(root):
    assert_refused(root.parent, "not the dataset itself; the root is .*/Caltech101;")
    assert_refused(root / "bonsai", "bonsai: lies inside the dataset; the root is .*/Caltech101;")
    deep = root.parent / "two" / "levels"
    deep.mkdir(parents=True)
    root.rename(deep / "Caltech101")
    assert_refused(root.parent / "two", "not the dataset itself; the root is .*/two/levels/Caltech101;")


def test_a_download_that_is_not_unpacked(tmp_path):
    (tmp_path / "deep" / "deeper").mkdir(parents=True)
    (tmp_path / "deep" / "deeper" / "Caltech101.zip").write_bytes(b"PK")
    assert_refused(tmp_path / "deep" / "deeper", r"archives that are not unpacked \(Caltech101\.zip\)")


def test_folders_that_are_wrong(root, tmp_path):
    (root / "gorilla").mkdir()
    assert_refused(root, "'gorilla' is no class of N-Caltech101")
    (root / "gorilla").rmdir()
    (root / "lamp").mkdir()
    assert_refused(root, r"lamp: expected \*\.bin files, found none", shows_tree=False)
    write_some(root / "lamp" / "image_0001.bin")
    assert_refused(root, "lamp: 1 recordings are too few to split; 2 are needed", shows_tree=False)
    outside = write_some(tmp_path / "outside.bin")
    (root / "lamp" / "image_0002.bin").symlink_to(outside)
    assert_refused(root, r"image_0002\.bin: links to .*outside\.bin, outside the dataset folder", shows_tree=False)


def test_fractions_that_leave_nothing(root):
    with pytest.raises(ValidationError, match="leave nothing to learn from"):
        n_caltech101.Options(root=root, test_fraction=0.5, validation_fraction=0.5)
    with pytest.raises(plugins.PluginError, match="option 'root': field required"):
        plugins.load_options(DatasetChoice(name="n_caltech101"))
