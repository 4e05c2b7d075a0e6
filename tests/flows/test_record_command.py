"""`ctlev record`: what is written is read back by other readers, and agrees with itself."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from ctlev_core.events import files as event_files
from ctlev_core.studio.labelled_recordings import BOX
from ctlev_core.video.coco_masks import read_runs
from flows import record
from flows.record import record_people

SMALL = ("sensor_size=[48, 36]", "recording_duration_us=50_000")


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    folder = tmp_path_factory.mktemp("record") / "people"
    assert record_people(folder, 2, SMALL, split="condition", rate_hz=100.0) == 0
    return folder


def test_files_agree(people):
    table = json.loads((people / "labels.json").read_text())
    assert [video["name"] for video in table["videos"]] == sorted(
        path.name for path in people.iterdir() if path.is_dir()
    )
    assert len(table["images"]) == 2 * 6 and len(table["categories"][0]["keypoints"]) == 13
    by_image = {annotation["image_id"]: annotation for annotation in table["annotations"]}
    for video in table["videos"]:
        folder = people / video["name"]
        events, maps = event_files.read_events_file(folder / "events.parquet"), np.load(folder / "maps.npz")
        of_events, boxes = np.load(folder / "event_labels.npz"), np.load(folder / "boxes.npy")
        assert events.sensor_size == (48, 36) and maps["t_us"].tolist() == list(range(0, 50_001, 10_000))
        assert all(len(of_events[name]) == len(events) > 0 for name in ("instance", "depth", "flow", "signal"))
        np.testing.assert_array_equal(events.signal, of_events["signal"])
        assert boxes.dtype == BOX and set(boxes["t"]) <= set(maps["t_us"].tolist())
        images = [image for image in table["images"] if image["video_id"] == video["id"]]
        assert [image["t_us"] for image in images] == maps["t_us"].tolist()
        for row, image in enumerate(images):
            annotation, mask = by_image[image["id"]], maps["instance"][row] > 0
            np.testing.assert_array_equal(read_runs(annotation["segmentation"], (48, 36)), mask)
            assert annotation["area"] == mask.sum() and (mask == (maps["depth"][row] > 0)).all()
            left, top, width, height = annotation["bbox"]
            assert mask[top : top + height, left : left + width].sum() == mask.sum()
            assert all(mask[edge].any() for edge in ((top,), (top + height - 1,)))
            np.testing.assert_allclose([boxes[row][name] for name in "xywh"], annotation["bbox"])
            points = np.reshape(annotation["keypoints"], (13, 3))
            inside = points[points[:, 2] > 0][:, :2]
            assert annotation["num_keypoints"] == len(inside) > 5
            # Joints lie within the body.
            assert ((inside >= (left - 2, top - 2)) & (inside <= (left + width + 2, top + height + 2))).all()
        camera = json.loads((folder / "camera.json").read_text())
        assert camera["size"] == [48, 36] and np.shape(camera["K"]) == (3, 3)


def test_the_same_is_written_again(people, tmp_path):
    assert record_people(tmp_path / "again", 2, SMALL, split="condition", rate_hz=100.0) == 0

    def digests(folder):
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        return {path.relative_to(folder): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}

    assert digests(people) == digests(tmp_path / "again")


def test_events_in_another_format(tmp_path):
    assert record_people(tmp_path / "raw", 1, SMALL, split="test", rate_hz=20.0, suffix=".raw") == 0
    (path,) = (tmp_path / "raw").glob("*/events.raw")
    assert len(event_files.read_events_file(path)) == len(np.load(path.with_name("event_labels.npz"))["signal"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"overrides": ("sensor_sise=[8, 8]",)}, "unknown option 'sensor_sise'; did you mean 'sensor_size'?"),
        ({"overrides": ("num_train_recordings=3",)}, "is given by the number of recordings, --split and --rate"),
        ({"rate_hz": 0.0}, "option 'label_rate_hz': input should be greater than 0, got 0.0"),
        ({"suffix": ".mp4"}, "no format is written with the suffix '.mp4'"),
        ({"rate_hz": 10_000.0, "overrides": ("sensor_size=[1280, 720]", "recording_duration_us=1_000_000")}, "GiB"),
    ],
)
def test_wrong_input_is_named_and_leaves_nothing(tmp_path, capsys, changes, message):
    given = {"overrides": SMALL} | changes
    overrides = given.pop("overrides")
    assert record_people(tmp_path / "out", 1, overrides, **given) == 2
    assert message in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_an_interrupted_run_leaves_nothing(tmp_path, capsys, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("flows.record.write_labelled", interrupt)
    assert record_people(tmp_path / "out", 1, SMALL) == 130
    assert "interrupted; nothing was written" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_what_is_there_is_kept_unless_told(people, capsys):
    before = sorted(people.iterdir())
    assert record_people(people, 1, SMALL) == 2
    assert "--overwrite replaces it" in capsys.readouterr().err and sorted(people.iterdir()) == before


def test_what_is_of_this_command_is_replaced_and_nothing_else(tmp_path, capsys):
    own, other = tmp_path / "own", tmp_path / "other"
    assert record_people(own, 2, SMALL, rate_hz=20.0) == record_people(own, 1, SMALL, rate_hz=20.0, overwrite=True) == 0
    assert len([path for path in own.iterdir() if path.is_dir()]) == 1
    other.mkdir()
    (other / "labels.json").write_text("mine")
    for folder in (other, other / "labels.json"):
        assert record_people(folder, 1, SMALL, overwrite=True) == 2
        assert "folders that `ctlev record` made, and this is none" in capsys.readouterr().err
    assert (other / "labels.json").read_text() == "mine" and sorted(tmp_path.iterdir()) == [other, own]


def test_two_at_once_do_not_mix_and_the_folder_we_are_in_is_one_that_is_there(tmp_path, capsys, monkeypatch):
    folder, seconds = tmp_path / "out", []
    write = record.write_labelled

    def meet(*arguments, **options):
        if not seconds:
            seconds.append(None)
            seconds[0] = record_people(folder, 1, SMALL, rate_hz=20.0)
        return write(*arguments, **options)

    monkeypatch.setattr(record, "write_labelled", meet)
    assert record_people(folder, 2, SMALL, rate_hz=20.0) == 0 and seconds == [2]
    assert "out: another process is recording into this folder" in capsys.readouterr().err
    named = json.loads((folder / "labels.json").read_text())["videos"]
    assert {video["name"] for video in named} == {path.name for path in folder.iterdir() if path.is_dir()}
    assert len(named) == 2 and list(tmp_path.iterdir()) == [folder]
    monkeypatch.chdir(folder)
    assert record_people(Path("."), 1, SMALL) == 2 and "out: is there already" in capsys.readouterr().err


def test_what_a_killed_process_left_is_not_mixed_in(tmp_path):
    left = tmp_path / ".partial-out"
    (left / "condition_left").mkdir(parents=True)
    (left / "labels.json").write_text("half")
    assert record_people(tmp_path / "out", 1, SMALL, rate_hz=20.0) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]
    assert not (tmp_path / "out" / "condition_left").exists()


@pytest.mark.parametrize("overwrite", [False, True])
def test_what_others_wrote_stays_however_the_folder_is_named(tmp_path, capsys, monkeypatch, overwrite):
    (tmp_path / "mine").write_text("mine")
    assert record_people(tmp_path / "new" / "..", 1, SMALL, overwrite=overwrite) == 2
    write = record.write_labelled

    def write_late(*arguments, **options):
        (tmp_path / "out").mkdir(exist_ok=True)
        (tmp_path / "out" / "mine").write_text("mine")
        return write(*arguments, **options)

    monkeypatch.setattr(record, "write_labelled", write_late)
    assert record_people(tmp_path / "out", 1, SMALL, rate_hz=20.0, overwrite=overwrite) == 2
    assert capsys.readouterr().err.count("--overwrite replaces") == 2
    assert [path.read_text() for path in (tmp_path / "mine", tmp_path / "out" / "mine")] == ["mine"] * 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "out"]
