"""The report of a tiny experiment: its page, its tables, and where its numbers come from."""

from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from report_artefacts import TRAINING_SETS, Experiment

from ctlev_core.provenance.records import read_provenance
from ctlev_core.provenance.scores import PAIRED_SAMPLES, SCORE_LINEAGE
from ctlev_core.report.page.report_files import publish_report
from ctlev_core.report.sections import pictures
from ctlev_core.report.sections.pictures import evenly_by_class, runs, sample_grid, steps
from ctlev_core.report.studies.run_comparison import compare_runs, read_run
from data_contracts.manifest import ManifestRef
from data_contracts.tables import check_table
from tasks.report import report
from tasks.stage import Output


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    return Experiment(tmp_path_factory.mktemp("home"))


@pytest.fixture(scope="module")
def published(experiment):
    """The folder of reports."""
    folder = experiment.home / "made"
    folder.mkdir()
    report.function(Output(folder, folder), experiment.inputs)
    publish_report(ManifestRef(key="k", path=folder), experiment.home, "tiny")
    return experiment.home / "reports"


def test_the_page_says_first_what_data_it_is_then_the_verdict_then_what_was_done(published):
    page = (published / "tiny.html").read_text()
    texts = (
        "Data: <code>made up",
        "Adding synthetic frames to the recorded ones helped",
        "What was done",
        "1. A label",
    )
    places = [page.index(text) for text in texts]
    places += [
        page.index(f"{text}</h2>")
        for text in ("Does synthetic data help?", "where does it help?", "by the amount of synthetic data")
    ]
    places += [page.index(f"{text}</h2>") for text in ("Asked for, and sampled", "What was made from what")]
    folded = ("Where the time went", "The paper&#39;s own numbers, on other data")
    places += [page.index(f"{text}</h2></summary>") for text in folded]
    assert places == sorted(places)
    for expected in ("recorded+oracle", "synthetic ones give 50 [", "15.00 on them with shuffled labels"):
        assert expected in page
    assert "http://" not in page and "https://" not in page


def test_every_number_can_be_traced(published, experiment):
    folder = published / "tiny"
    scores = check_table(pq.read_table(folder / "scores.parquet"), SCORE_LINEAGE, "scores").to_pylist()
    assert {row["subject"] for row in scores} >= set(TRAINING_SETS)
    records = {record.digest: record for record in read_provenance(folder / "provenance.json")}
    for row in scores:
        assert records[row["score_digest"]].stage == "score_model"
        assert [records[digest].role for digest in row["training_digests"]] == ["frames"]
        assert [records[digest].role for digest in row["recordings_digests"]] == ["recordings"]
        assert row["model_digest"] in records and row["data_digest"] in records
    samples = check_table(pq.read_table(folder / "samples.parquet"), PAIRED_SAMPLES, "samples")
    assert len(samples) == len(TRAINING_SETS) * 2 * 6 and len(set(samples["samples_digest"].to_pylist())) == 1


def test_tables_hold_what_the_page_holds(published):
    markdown, latex = ((published / "tiny" / name).read_text() for name in ("tables.md", "tables.tex"))
    for text in ("Does synthetic data help?", "Beside the baselines", "How far from recorded frames?", "Does it copy?"):
        assert text in markdown and text in latex
    assert latex.count("{table}") == 2 * latex.count(r"\toprule") and "Data: `made up`." in markdown


def test_more_recorded_frames_are_shown(experiment, tmp_path):
    report.function(Output(tmp_path, tmp_path), replace(experiment.inputs, oracle=experiment.frames))
    page = (tmp_path / "report.html").read_text()
    assert page.count(">GAN</span>") == 1 and "recorded, same moment" in page
    roles = [record.role for record in read_provenance(tmp_path / "provenance.json")]
    assert "frames of gan" in roles and len(roles) == len(set(roles))


def test_a_report_differs_from_itself_in_nothing(published):
    scores, *others = compare_runs(read_run("a", published / "tiny"), read_run("b", published / "tiny"))
    assert not scores.bold and all(not table.rows for table in others)
    assert {row[-1] for row in scores.rows} == {"paired", "intervals"}
    named = [(str(row[0]), str(row[1])) for row in scores.rows]
    assert len(set(named)) == len(named), "what differs is not called the same"


def test_the_four_pictures_are_of_median_activity(experiment):
    frames, made = experiment.frames, experiment.generated[0]
    label, real, new, synthetic = steps(frames, experiment.frame_conditions, experiment.conditions, made, "skeleton")
    # Picture i has i + 1 active rows; the middle one of 6 training frames is the third, that of 12 made the sixth.
    np.testing.assert_array_equal(real.picture, frames.array("frames")[2])
    np.testing.assert_array_equal(label.picture, experiment.frame_conditions.array("images")[2])
    np.testing.assert_array_equal(synthetic.picture, made.array("frames")[5])
    np.testing.assert_array_equal(new.picture, experiment.conditions.array("images")[5])
    assert "a skeleton" in label.sentence and "20 ms, white" in real.sentence
    assert [step.follows for step in (label, real, new, synthetic)] == [False, True, False, True]


def test_grids_show_the_real_frame_of_the_same_moment(experiment):
    grid = sample_grid(experiment.conditions, {"synthetic": experiment.generated[0]}, [experiment.frames])
    labels = [label for label, _ in grid.rows]
    assert labels == ["condition", "recorded, same moment", "synthetic"]
    real = dict(grid.rows)["recorded, same moment"]
    # Every condition names recording r0, of which there is one frame.
    assert all(np.array_equal(image, experiment.frames.array("frames")[0]) for image in real)
    assert "Grey" not in grid.caption
    without = sample_grid(experiment.conditions, {"synthetic": experiment.generated[0]}, [])
    assert [label for label, _ in without.rows] == ["condition", "synthetic"]


@pytest.mark.parametrize("num_classes", [1, 3, 10, 24])
def test_classes_that_take_turns_are_all_seen(num_classes):
    """Evenly spread rows of 480 are 48 apart: all of one class where 24 or 3 take turns."""
    names = [f"class {row % num_classes}" for row in range(480)]
    chosen = evenly_by_class(names, 10)
    assert len({names[row] for row in chosen}) == min(num_classes, 10) and len(set(chosen)) == 10
    assert (np.diff(chosen) > 0).all() and chosen[0] < 60 and chosen[-1] > 400
    assert evenly_by_class(names[:7], 10).tolist() == list(range(7))


def test_frames_of_words_stand_beside_real_ones_of_their_class(experiment):
    class Words:
        def has_array(self, name):
            return False

        def column(self, name):
            return {"class_name": ["x", "y", "x"], "source_id": ["w:0"] * 3, "split": ["test"] * 3}[name]

        def array(self, _):
            return np.arange(3, dtype=np.uint8)[:, None, None, None] * np.ones((1, 4, 4, 3), np.uint8)

        def rows_where(self, split):
            return np.arange(3)

        def __len__(self):
            return 3

    class Real(Words):
        held_out = "test"

        def column(self, name):
            columns = {"sample_id": ["r0", "r1", "r2"], "recording_id": ["r"] * 3, "class_name": ["y", "x", "z"]}
            return columns.get(name, [0] * 3)

    rows = dict(sample_grid(Words(), {"synthetic": Words()}, [Real()]).rows)
    assert [int(image[0, 0, 0]) for image in rows["recorded, same class"]] == [1, 0, 1]  # of x there is one only
    assert "recorded, same class" not in dict(sample_grid(Words(), {"synthetic": Words()}, [experiment.frames]).rows)


def test_runs_are_rows_that_follow_in_the_time_of_one_recording():
    sources = ["a:0", "a:100", "a:200", "b/c:50", "b/c:150", "b/c:20", "d", "d", "a:300"]
    found = [(name, rows.tolist(), step) for name, rows, step in runs(sources)]
    assert found == [("a", [0, 1, 2], 100.0), ("b/c", [3, 4], 100.0)]


def test_moments_that_no_real_frame_shows_are_grey():
    frames = np.zeros((2, 4, 4, 3), np.uint8)
    columns = {
        "sample_id": ["made0", "made1"], "condition_id": ["asked0", "asked1"], "source_id": ["a:5", "a:50"],
        "class_name": ["x", "y"], "recording_id": ["a", "b"], "t_start_us": [0, 0], "t_end_us": [10, 90],
    }  # fmt: skip

    class Frames:
        def has_array(self, name):
            return False

        def column(self, name):
            return columns[name]

        def array(self, _):
            return frames

        def __len__(self):
            return 2

    grid = sample_grid(Frames(), {"synthetic": Frames()}, [Frames()])
    (label, (first, second)), _ = grid.rows
    # Recording a is seen until 10 us; at 50 us there is no frame of it, but one of b.
    assert label == "recorded, same moment" and not first.any() and (second == 128).all() and "Grey" in grid.caption


def test_colours_of_event_images_are_told_by_what_is_drawn():
    image = np.zeros((4, 4, 3), np.uint8)
    assert "white" in pictures.colours_in_words(image)
    image[0, 0, 0] = 255
    assert "red where it got brighter" in pictures.colours_in_words(image)
    image[1, 1, 1] = 255
    assert "each part of that time" in pictures.colours_in_words(image)
