"""Generated frames to a plain folder, read back by what strangers have: OpenCV, pandas, `datasets`."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from generated_frames import REJECTED_ROW, make_generated, make_streams, publish
from markdown_it import MarkdownIt

from ctlev_core.export.dataset_card import Card, render_card
from ctlev_core.export.event_dataset import EventDataset
from ctlev_core.provenance.records import read_provenance
from data_contracts import image_folder, tables
from data_contracts.config import cache_material
from data_contracts.errors import DataError, TableVersionError
from data_contracts.image_folder import file_names, read_image_table, write_image_table
from data_contracts.synthesis import Synthesis
from tasks import export_images as task


def export(made, folder, **others):
    return task.write_image_folder(made.artefacts | others, folder, name="walks", notice="Data: a test.")


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_pandas_and_opencv_read_every_image_with_its_label(tmp_path):
    made = make_generated(tmp_path / "home")
    folder = export(made, tmp_path / "mine")
    labels = pandas.read_parquet(folder / "labels.parquet")
    rows = [row for row in range(7) if row != REJECTED_ROW]
    assert labels["sample_id"].tolist() == [f"synthetic/{row:06d}" for row in rows]
    assert labels["file_name"][1] == "images/000/synthetic_000002.png"
    for number, row in enumerate(rows):
        of_row = labels.iloc[number]
        for name, images in (("file_name", made.frames), ("condition_file_name", made.images)):
            image = cv2.imread(str(folder / of_row[name]))[..., ::-1]  # OpenCV has blue first
            np.testing.assert_array_equal(image, images[row])
        assert of_row["class_name"] == made.labels.class_names[row] and of_row["seed"] == 100 + row
        np.testing.assert_array_equal(of_row["joints2d_px"].reshape(13, 2), made.labels.joints2d[row])
        np.testing.assert_array_equal(of_row["smpl_pose_rad"], made.labels.smpl_pose[row])
    assert set(labels["frames_digest"]) == {made.synthetic.digest}
    assert not {"joints3d_mm", "intrinsics_px", "events_file"} & set(labels.columns), "no row has such"
    assert [record.role for record in read_provenance(folder / "provenance.json")] == ["synthetic", "conditions"]
    metadata, table = (pq.read_table(folder / f"{name}.parquet") for name in ("metadata", "labels"))
    assert repr(metadata.drop_columns("label").to_pylist()) == repr(table.to_pylist())  # NaN is unequal to itself
    told = json.loads(metadata.schema.metadata[b"huggingface"])["info"]["features"]["label"]
    assert told == {"names": sorted(set(made.labels.class_names)), "_type": "ClassLabel"}
    assert [told["names"][number] for number in metadata["label"].to_pylist()] == table["class_name"].to_pylist()


def test_datasets_reads_images_and_classes(tmp_path):
    datasets = pytest.importorskip("datasets")
    made = make_generated(tmp_path / "home")
    folder = export(made, tmp_path / "mine")
    rows = datasets.load_dataset("imagefolder", data_dir=str(folder), split="train", cache_dir=str(tmp_path / "cache"))
    assert rows.features["label"].names == sorted(set(made.labels.class_names))
    assert [rows.features["label"].int2str(row["label"]) for row in rows] == rows["class_name"]
    np.testing.assert_array_equal(np.asarray(rows[0]["image"]), made.frames[0])


def test_a_text_route_has_classes_alone(tmp_path):
    folder = export(make_generated(tmp_path / "home", joints=False, images=False), tmp_path / "mine")
    columns = pq.read_schema(folder / "labels.parquet").names
    assert "class_name" in columns and not {"joint_set", "joints2d_px", "condition_file_name"} & set(columns)
    assert not (folder / "conditions").exists()
    text = (folder / "README.md").read_text()
    assert "3 classes, in the column `class_name`: bow (2), jump (1), walk (3)." in text and "Joints" not in text


def test_names_of_classes_are_text_in_the_description(tmp_path):
    table = pq.read_table(export(make_generated(tmp_path / "home"), tmp_path / "mine") / "labels.parquet")
    names = ["_a_ *b*", "`c` <i>d", "[e](f) ~~g~~ &lt;"] * 2
    column = table.schema.get_field_index("class_name")
    card = Card("mine", "", table.set_column(column, "class_name", pa.array(names)), (20, 14), 0, "", [])
    shown = html.unescape(MarkdownIt().enable("strikethrough").render(render_card(card)))
    assert "_a_ *b* (2), `c` <i>d (2)" in shown and "[e](f) ~~g~~ &lt; (2)" in shown


def test_the_description_says_what_it_is_and_its_code_runs(tmp_path, monkeypatch):
    folder = export(make_generated(tmp_path / "home"), tmp_path / "mine")
    text = (folder / "README.md").read_text()
    head = yaml.safe_load(text.split("---\n")[1])
    assert head["task_categories"] == ["keypoint-detection"] and head["size_categories"] == "n<1K"
    for expected in ("6 synthetic event images", "> Data: a test.", "20 x 14 px", " 1 more image", "0 head, 1 right_"):
        assert expected in text
    for name in pq.read_schema(folder / "labels.parquet").names:
        assert f"| `{name}` |" in text
    monkeypatch.chdir(folder)
    for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        if "from datasets" not in code:
            exec(code, {})


def test_datasets_reads_images_and_labels(tmp_path, monkeypatch):
    datasets = pytest.importorskip("datasets", reason="the package `datasets` is not installed")
    made = make_generated(tmp_path / "home")
    folder = export(made, tmp_path / "mine")
    options = {"split": "train", "cache_dir": str(tmp_path / "cache")}
    for rows in (
        datasets.load_dataset("imagefolder", data_dir=str(folder), **options),
        datasets.load_dataset(str(folder), **options),
    ):
        assert rows.num_rows == 6 and rows[5]["class_name"] == made.labels.class_names[6]
        np.testing.assert_array_equal(np.asarray(rows[5]["image"]), made.frames[6])
        np.testing.assert_array_equal(np.asarray(rows[5]["condition"]), made.images[6])
    table = datasets.load_dataset("parquet", data_files=str(folder / "labels.parquet"), **options)
    assert table[5]["file_name"] == "images/000/synthetic_000006.png"


def test_many_images_lie_in_several_folders(tmp_path, monkeypatch):
    monkeypatch.setattr(image_folder, "SHARD_ROWS", 3)
    folder = export(make_generated(tmp_path / "home"), tmp_path / "mine")
    assert {path.name for path in (folder / "images").iterdir()} == {"000", "001", "002"}
    assert len(EventDataset(folder)) == 6
    names = file_names("images", ["a/1", "a/2"], [999, 12_345], ".png")
    monkeypatch.undo()
    assert names != file_names("images", ["a/1", "a/2"], [999, 12_345], ".png")
    assert file_names("images", ["a/1", "b:2"], [999, 12_345], ".png") == ["images/000/a_1.png", "images/012/b_2.png"]
    with pytest.raises(DataError, match="names that differ"):
        file_names("images", ["a/1", "a:1"], [0, 1], ".png")


class Killed(BaseException):
    """Stands for the end of the process."""


def raise_killed(*_):
    raise Killed


@pytest.mark.parametrize("stop_at", range(1, 15))
def test_a_killed_export_is_never_seen_and_goes_on(tmp_path, monkeypatch, stop_at):
    """Killed before the n-th file: nothing under the name asked for, and what was finished is not written again."""
    monkeypatch.setattr(image_folder, "SHARD_ROWS", 3)
    made = make_generated(tmp_path / "home")
    reference = contents(export(made, tmp_path / "reference"))
    written = []

    def write(path, image):
        written.append(path)
        if len(written) == stop_at:
            raise Killed
        write_png(path, image)

    write_png = task._write_png
    monkeypatch.setattr(task, "_write_png", write)
    folder = tmp_path / "mine"
    if stop_at <= 12:  # six images and their conditions
        with pytest.raises(Killed):
            export(made, folder)
        assert not folder.exists()
        with pytest.raises(DataError, match="an export that did not end"):
            EventDataset(tmp_path / ".mine.partial")
    export(made, folder)
    assert contents(folder) == reference
    # Sub-folders hold 2, 3 and 1 images: what lies in a finished one is not written twice.
    finished = [0, 0, 2, 2, 2, 5, 6, 6, 8, 8, 8, 11]
    assert len(written) == (stop_at + 12 - finished[stop_at - 1] if stop_at <= 12 else 12)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["home", "mine", "reference"]


def test_left_overs_of_other_data_are_not_mixed_in(tmp_path, monkeypatch):
    made, other = (make_generated(tmp_path / "home", seed=seed) for seed in (0, 1))
    monkeypatch.setattr(task, "render_card", raise_killed)
    with pytest.raises(Killed):
        export(other, tmp_path / "mine")
    monkeypatch.undo()
    assert (tmp_path / ".mine.partial" / "images" / "000").is_dir()
    assert contents(export(made, tmp_path / "mine")) == contents(export(made, tmp_path / "reference"))


def test_what_is_in_the_way_is_refused_and_kept(tmp_path):
    made, other = (make_generated(tmp_path / "home", seed=seed) for seed in (0, 1))
    folder = export(made, tmp_path / "mine")
    before = contents(folder)
    assert export(made, folder) == folder, "the same again is done already"
    with pytest.raises(DataError, match="holds the export of other data; choose a new folder"):
        export(other, folder)
    assert contents(folder) == before
    hidden = folder / "images" / "000"
    hidden.rename(tmp_path / "hidden")
    with pytest.raises(DataError, match=r"mine: 6 files are missing, such as images/000/.*; remove it to export"):
        export(made, folder)
    (tmp_path / "hidden").rename(hidden)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("mine")
    with pytest.raises(DataError, match="expected a new or an empty folder to export to"):
        export(made, tmp_path / "notes")
    (tmp_path / ".next.partial").mkdir()
    (tmp_path / ".next.partial" / "a.txt").write_text("mine")
    with pytest.raises(DataError, match="move it away"):
        export(made, tmp_path / "next")
    assert (tmp_path / ".next.partial" / "a.txt").read_text() == "mine"
    with pytest.raises(DataError, match="expected a new or an empty folder"):
        export(made, tmp_path / "notes" / "a.txt")
    (tmp_path / "disk").mkdir()
    (tmp_path / "linked").symlink_to(tmp_path / "disk")
    with pytest.raises(DataError, match="is a link or a mount point; export to a new folder inside of it"):
        export(made, tmp_path / "linked")
    with pytest.raises(DataError, match="is no folder that can be written to"):
        export(made, tmp_path / "notes" / "a.txt" / "mine")
    (tmp_path / "empty").mkdir()
    assert len(EventDataset(export(made, tmp_path / "empty"))) == 6
    # While planning there are keys, but no digests yet.
    planned = {role: ref.model_copy(update={"digest": "", "rows": -1}) for role, ref in made.artefacts.items()}
    assert task.check_export_folder(planned, folder) and not task.check_export_folder(planned, tmp_path / "new")
    planned = {role: ref.model_copy(update={"digest": ""}) for role, ref in other.artefacts.items()}
    with pytest.raises(DataError, match="other data"):
        task.check_export_folder(planned, folder)


def test_two_runs_do_not_write_one_folder(tmp_path, monkeypatch):
    made, seen = make_generated(tmp_path / "home"), []
    render_card = task.render_card

    def second(card):
        with pytest.raises(BlockingIOError, match="another run is writing this folder"):
            export(made, tmp_path / "mine")
        seen.append(card)
        return render_card(card)

    monkeypatch.setattr(task, "render_card", second)
    export(made, tmp_path / "mine")
    assert len(seen) == 1 and len(EventDataset(tmp_path / "mine")) == 6


def test_nothing_to_export(tmp_path):
    made = make_generated(tmp_path / "home", count=2)
    frames = tmp_path / "home" / "artefacts" / "sample" / made.synthetic.key
    table = pq.read_table(frames / "manifest.parquet")
    columns = {name: table[name] for name in table.column_names} | {"rejected": ["empty"] * 2}
    refused = publish(tmp_path / "home", "sample", "none", columns, tables.SYNTHETIC, {}, frames=made.frames)
    with pytest.raises(DataError, match="the quality filter rejected all 2 frames"):
        export(made, tmp_path / "mine", synthetic=refused)
    assert not (tmp_path / "mine").exists()


KEY = "streams"


@pytest.mark.parametrize("a_file", [1, 2, 7])
def test_event_streams_come_along(tmp_path, a_file):
    """Each in a file of its own, stretches of images in one file each, or all in one."""
    home = tmp_path / "home"
    made = make_generated(home)
    streams, columns = make_streams(made, home, KEY, a_file=a_file)
    ref = publish(home, "export_events", KEY, columns, tables.EVENT_STREAMS, {"generated": made.synthetic})
    folder = export(made, tmp_path / "mine", **{"event streams": ref})
    dataset = EventDataset(folder)
    rows = [row for row in range(7) if row != REJECTED_ROW]
    for index, row in enumerate(rows):
        events = dataset.read_events(index)
        for column in "txyp":
            np.testing.assert_array_equal(getattr(events, column), getattr(streams[row], column))
    labels = pandas.read_parquet(folder / "labels.parquet")
    expected = {
        1: [f"events/000/synthetic_{row:06d}.parquet" for row in rows],
        2: [f"events/000/synthetic_{row - row % 2:06d}.parquet" for row in rows],
        7: ["events/events.parquet"] * 6,
    }
    assert labels["events_file"].tolist() == expected[a_file]
    assert len([path for path in (folder / "events").rglob("*") if path.is_file()]) == len(set(expected[a_file]))
    assert "Events, as columns t, x, y, p" in (folder / "README.md").read_text()
    with pytest.raises(DataError, match="other data"):
        export(made, folder)  # which would be without events


def test_a_table_that_another_program_wrote_is_read(tmp_path):
    """Rows filtered and columns added with pandas, which also widens types and drops our metadata."""
    folder = export(make_generated(tmp_path / "home"), tmp_path / "mine")
    labels = pandas.read_parquet(folder / "labels.parquet")
    labels["note"] = "good"
    labels["num_attempts"] = labels["num_attempts"].astype("int64")
    labels[labels["class_name"] == "walk"].to_parquet(folder / "labels.parquet")
    assert read_image_table(folder)["class_name"].to_pylist() == ["walk"] * 3
    assert {sample["class_name"] for sample in EventDataset(folder)} == {"walk"}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda t: t.drop_columns(["seed"]), "column 'seed' is missing"),
        (lambda t: t.set_column(0, "file_name", [["../a.png"] * 6]), "leads out of the folder: '../a.png'"),
        (lambda t: t.set_column(0, "file_name", [["/etc/a.png"] * 6]), "leads out of the folder: '/etc/a.png'"),
        (lambda t: t.set_column(t.column_names.index("seed"), "seed", [["x"] * 6]), "column 'seed' is not int64"),
        (lambda t: t.set_column(t.column_names.index("split"), "split", [["all"] * 6]), "expected one of"),
    ],
)
def test_a_broken_table_is_refused(tmp_path, change, expected):
    folder = export(make_generated(tmp_path / "home"), tmp_path / "mine")
    pq.write_table(change(pq.read_table(folder / "labels.parquet")), folder / "labels.parquet")
    with pytest.raises(DataError, match=expected):
        EventDataset(folder)


def test_a_damaged_or_newer_table_is_refused(tmp_path, monkeypatch):
    folder = export(make_generated(tmp_path / "home"), tmp_path / "mine")
    table = read_image_table(folder)
    with monkeypatch.context() as newer:
        newer.setattr(image_folder, "IMAGES", replace(image_folder.IMAGES, version=2))
        write_image_table(folder, table)
    with pytest.raises(TableVersionError, match="table version 2; this code reads version 1"):
        read_image_table(folder)
    for metadata in (b"[]", b"no JSON", b"\xff"):
        pq.write_table(table.replace_schema_metadata({b"ctlev.schema": metadata}), folder / "labels.parquet")
        with pytest.raises(DataError, match=r"labels\.parquet: damaged: "):
            read_image_table(folder)
    pq.write_table(table, folder / "labels.parquet", compression="none", use_dictionary=False)
    content = (folder / "labels.parquet").read_bytes()
    (folder / "labels.parquet").write_bytes(content.replace(b"class_name", b"class\xffname"))
    with pytest.raises(DataError, match=r"labels\.parquet: "):
        read_image_table(folder)
    (folder / "labels.parquet").write_bytes((folder / "labels.parquet").read_bytes()[:-10])
    with pytest.raises(DataError, match="cannot be read as Parquet"):
        read_image_table(folder)


def test_the_folder_asked_for_is_no_matter_of_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    options = json.loads(MINIMAL)
    asked = [Synthesis.model_validate(options | {"export_folder": name}) for name in ("~/mine", "mine")]
    assert [one.export_folder for one in asked] == [tmp_path / "mine"] * 2
    assert cache_material(asked[0]) == cache_material(Synthesis.model_validate(options))


MINIMAL = """{"name": "n", "dataset": {"name": "d"}, "encoding": {"name": "e"}, "condition": {"name": "c"},
"generator": {"name": "g"}, "num_synthetic": 1, "downstream": {"name": "w"}, "metrics": [{"name": "m"}]}"""
