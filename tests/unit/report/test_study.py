"""Studies: presets of several experiments, and the page that tells them as one."""

import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from report_artefacts import TRAINING_SETS, Experiment

from ctlev_core.datasets import studio_objects
from ctlev_core.plugins import PluginError, load_options
from ctlev_core.report.page.html import Animation, Curves, ImageGrid, Step
from ctlev_core.report.page.report_files import publish_report
from ctlev_core.report.page.tables import Table
from ctlev_core.report.sections.score_tables import PairedScores
from ctlev_core.report.studies.run_comparison import read_run
from ctlev_core.report.studies.speed_summary import SpeedSummary, write_speed_summary
from ctlev_core.report.studies.study import (
    Part,
    distances_table,
    study_chapters,
    study_overview,
    study_tables,
    study_verdict,
    study_words,
)
from ctlev_core.report.studies.summary import SUMMARY_FILE, Summary, read_summary, write_summary
from ctlev_core.statistics.paired_differences import Difference
from data_contracts.errors import DataError
from data_contracts.experiment import Experiment as Options
from data_contracts.manifest import Manifest, ManifestRef
from data_contracts.study import Study
from flows.command_line import PRESETS, load_experiment, load_preset
from flows.costs import estimate_costs
from flows.inputs import InputsMissing
from flows.speed_vs_error import speed_vs_error_of
from flows.studies import load_study
from tasks.report import report
from tasks.stage import Output
from tasks.study_report import study_report

PARTS = ("first", "second")


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    """The folders of two reports."""
    folders = []
    for name in PARTS:
        experiment = Experiment(tmp_path_factory.mktemp(name))
        folder = experiment.home / "report"
        folder.mkdir()
        report.function(Output(folder, folder), experiment.inputs)
        folders.append(folder)
    return folders


@pytest.fixture(scope="module")
def published(reports, tmp_path_factory):
    """The folder of reports with a study's."""
    home = tmp_path_factory.mktemp("study")
    publish_study(reports, home)
    return home / "reports"


def publish_study(folders, home):
    made = home / "made"
    made.mkdir()
    manifests = [Manifest(ManifestRef(key="k", path=folder), None, (), ()) for folder in folders]
    shown = {"training_sets": [list(TRAINING_SETS)] * 2, "generator_names": [["synthetic", "gan"]] * 2}
    found = study_report.function(
        Output(made, made), manifests, title="both", notice="Data: `x`.", names=PARTS, **shown
    )
    publish_report(ManifestRef(key="k", path=made), home, "both")
    return found


CHART = Curves("Distance", {"UniPC": ([5.0, 10.0], [8.0, 3.0])}, "evaluations", "distance", caption="Lower is better.")
OTHER = replace(CHART, title="Another")


@pytest.mark.parametrize("charts", [[CHART], [CHART, OTHER], []], ids=["a chart", "two charts", "no chart"])
def test_speed_against_error_is_a_section_with_a_link_to_its_page(reports, tmp_path, charts):
    folder = tmp_path / "speed"
    folder.mkdir()
    training_sets = Table("Every training set", ["sampler", "U-Net"], [["UniPC", "10"]], bold={(0, 0)})
    write_speed_summary(folder, SpeedSummary("second", "Recommended: UniPC.", charts, training_sets))
    (folder / "report.html").write_text("the page")
    pq.write_table(pa.table({"line": ["UniPC"]}), folder / "speed_vs_error.parquet")
    found, home = publish_study([*reports, folder], tmp_path), tmp_path / "reports"
    page = (home / "both.html").read_text()
    texts = ["Quality of the frames</h2>", "Speed against error: 2D pose (second)</h2>"]
    texts += ["Recommended: UniPC."]
    texts += ["Speed against error: distance</h2>", "Lower is better.", "<svg"] if charts else []
    texts += ["Speed against error, every setting: 2D pose (second)</h2>"]
    texts += ["Another</h3>", "<svg", "Costs and errors</h3>"] if OTHER in charts else []
    texts += ["<td", 'href="both/speed_vs_error/']
    place = page.index("<section")  # behind the list of contents
    for text in texts:
        place = page.index(text, place) + 1
    assert page.count('href="both/') == 3
    files = home / "both" / "speed_vs_error"
    assert sorted(path.name for path in files.iterdir()) == ["report.html", "speed_vs_error.parquet"]
    for suffix in ("tex", "md"):
        assert "Speed against error, every setting" in (home / "both" / f"tables.{suffix}").read_text()
    assert "speed_vs_error/speed_vs_error.parquet" in found["file"].to_pylist()


def test_the_page_has_every_experiment_its_samples_the_papers_numbers_and_all_distances(published):
    page = (published / "both.html").read_text()
    texts = [
        "Data: <code>x</code>",
        "adding synthetic frames to recorded ones helped in 2 of 2: 2D pose",
        "both minus recorded",
    ]
    texts += ["2D pose (first)</td>", "2D pose (second)</td>", "1. A label"]
    for part in PARTS:
        texts += [
            f'<p class="chapter">2D pose ({part})</p>',
            "Does synthetic data help?</h2>",
            "Asked for, and sampled</h2>",
        ]
        texts += ["Paper, Table 2: 2D pose on DHP19 and CDEHP</h2>"]
    texts += ["Quality of the frames</h2>", "Paper, Table 4", "The same in words</h2>"]
    texts += [
        f"2D pose ({part}): Adding synthetic frames to the recorded ones helped: 2D joint error" for part in PARTS
    ]
    texts += [f'href="both/{part}/report.html"' for part in PARTS]
    place = 0
    for text in texts:
        place = page.index(text, place) + 1
    assert page.count("Do the synthetic frames show their labels?") == 0  # on the experiments' own pages


def test_links_lead_to_the_experiments_own_reports(published, reports):
    for part, folder in zip(PARTS, reports, strict=True):
        for name in ("report.html", "tables.tex", "provenance.json", "scores.parquet", "samples.parquet"):
            assert (published / "both" / part / name).read_bytes() == (folder / name).read_bytes()
        assert not (published / "both" / part / SUMMARY_FILE).exists()
        assert read_run(part, published / "both" / part).scores  # `flows/compare.py` takes the folder


def test_an_experiment_that_trains_on_nothing_synthetic_shows_samples_and_figures(reports):
    def part(training_sets):
        summary = Summary("the verdict", [], ImageGrid("g", []), [replace(CHART, title="By amount")])
        rows = pq.read_table(reports[0] / "scores.parquet").to_pylist()
        paired = PairedScores(pq.read_table(reports[0] / "samples.parquet"))
        return Part("first", rows, training_sets, ["synthetic"], paired, summary)

    for training_sets in (["recorded"], list(TRAINING_SETS)):
        parts = [part(training_sets)]
        tables = study_tables(parts)
        chapter, _ = study_chapters(parts, tables)
        assert chapter.title == "2D pose (first)"
        titles = [section.title for section in chapter.sections]
        assert {"g", "By amount"} <= set(titles)
        told = training_sets != ["recorded"]
        assert bool(tables[0]) == told == any("Paper, Table 2" in title for title in titles)
        assert ("the verdict" in study_words(parts)) == told


def test_the_verdict_begins_with_what_helped_in_how_many_experiments():
    class Paired:
        def __init__(self, *found):
            self.found = found

        def difference(self, before, after, metric):
            assert (before, after) == ("recorded", "recorded+synthetic")
            return Difference(*self.found) if self.found else None

    def part(name, metric, *found):
        rows = [
            {
                "metric": metric,
                "subject": "recorded",
                "task": "test",
                "group": "all",
                "value": 6.0,
                "low": None,
                "high": None,
            }
        ]
        return Part(name, rows, ["recorded", "recorded+synthetic"], [], Paired(*found), Summary("told.", [], None, []))

    parts = [
        part("a", "mpjpe2d_px", -0.3, -0.5, -0.1),  # an error that fell
        part("b", "accuracy", 0.1, 0.05, 0.15),  # a share that rose
        part("c", "accuracy", -0.1, -0.15, -0.05),
        part("d", "mpjpe3d_mm", -3.0, -9.0, 3.0),
        part("e", "mpjpe2d_px", -0.3, float("nan"), float("nan")),  # too few recordings for an interval
        part("f", "accuracy"),
    ]
    others = study_words(parts).split("\n\n")
    assert study_verdict(parts) == (
        "By 95 % intervals, adding synthetic frames to recorded ones helped in 2 of 4: 2D pose (a), Object "
        "recognition (b); it did harm in 1 of 4: Object recognition (c); it made no difference that can be told in "
        "1 of 4: 3D body (d)."
    )
    assert len(others) == 6 and others[0] == "2D pose (a): told."
    assert study_verdict(parts[3:]) == ""  # one alone needs no summing up
    table = study_overview([*parts, replace(parts[0], training_sets=["recorded"])])
    assert [row[:2] for row in table.rows[:2]] == [
        ["2D pose (a)", "2D joint error (MPJPE), px ↓"],
        ["Object recognition (b)", "accuracy ↑"],
    ]
    assert [row[2:] for row in table.rows[:2]] == [
        ["6.000", "", "", "-0.300 [-0.500, -0.100]"],
        ["6.000", "", "", "+0.100 [+0.050, +0.150]"],
    ]
    assert table.rows[5][5] == "" and len(table.rows) == len(parts)
    # Both numbers of what helped, the difference alone of what did harm, neither where it cannot be told.
    assert table.bold == {(0, 4), (0, 5), (1, 4), (1, 5), (2, 5)}


def test_distances_stand_beside_each_other_by_experiment(reports):
    parts = []
    for name, folder, factor in zip(PARTS, reports, (1, 2), strict=True):
        rows = pq.read_table(folder / "scores.parquet").to_pylist()
        rows = [{**row, "value": factor * row["value"]} for row in rows]
        # A further distance of the same part is another score, no other training.
        rows += [
            {**row, "metric": f"{row['metric']}_infinity", "value": 0.0} for row in rows if row["task"] == "distance"
        ]
        parts.append(type("Part", (), {"name": name, "heading": name, "rows": rows}))
    table = distances_table(parts)
    assert table.columns == ["frames", "first ↓", "second ↓"]
    (row,) = table.rows
    assert [row[0], row[1][:5], row[2][:5]] == ["synthetic", "9.000", "18.00"]


def test_summaries_come_back_as_they_were(tmp_path):
    rng = np.random.default_rng(0)
    colour, grey = rng.integers(0, 256, (5, 7, 3), np.uint8), rng.integers(0, 256, (4, 6), np.uint8)
    steps = [Step("1", colour, "see", follows=True), Step("2", "“a cat”", "read")]
    grid = ImageGrid("grid", [("a", [colour, colour]), ("b", [grey])], column_labels=["x", "y"], caption="c")
    curves = Curves(
        "c", {"a": ([0.0, 1.0], [2.0, 3.0])}, "x", "y", log_x=True, spans={"a": ([1.0, np.nan], [3.0, 4.0])}
    )
    animation = Animation("m", [("run", np.stack([colour] * 3))], 8.0, "moves")
    write_summary(tmp_path, Summary("so", steps, grid, [curves, animation]))
    back = read_summary(tmp_path)
    chart, moving = back.figures
    assert (chart.series, chart.x_label, chart.log_x) == ({"a": [[0, 1], [2, 3]]}, "x", True)
    np.testing.assert_array_equal(chart.spans["a"], curves.spans["a"])
    assert (moving.title, moving.rate_hz, moving.caption, moving.clips[0][0]) == ("m", 8.0, "moves", "run")
    np.testing.assert_array_equal(moving.clips[0][1], animation.clips[0][1])
    assert (back.verdict, back.steps[1], back.steps[0].follows) == ("so", steps[1], True)
    assert (back.grid.title, back.grid.caption, list(back.grid.column_labels)) == ("grid", "c", ["x", "y"])
    np.testing.assert_array_equal(back.steps[0].picture, colour)
    for (name, images), (expected_name, expected) in zip(back.grid.rows, grid.rows, strict=True):
        assert name == expected_name
        for image, picture in zip(images, expected, strict=True):
            np.testing.assert_array_equal(image, picture)


@pytest.mark.parametrize(
    "damage", ["", "{}", '{"verdict": "v", "steps": [], "grid": {"rows": [["a", [{"png": "AA"}]]]}}']
)
def test_damaged_summaries_are_refused(tmp_path, damage):
    (tmp_path / SUMMARY_FILE).write_text(damage)
    with pytest.raises(DataError, match=r"summary\.json: is not the summary of a report"):
        read_summary(tmp_path)


def test_the_bundled_study_is_made_of_its_presets():
    study = load_study("all_routes", ["experiments.pose.num_synthetic=5"])
    assert isinstance(study, Study)
    pose = load_experiment("pose", [])
    assert study.experiments["pose"] == pose.model_copy(update={"num_synthetic": 5})
    for name in ("pose_cdehp", "body", "objects", "zero_shot"):
        assert study.experiments[name] == load_experiment(name, [])
    assert load_study("pose", []) == pose


def test_the_demo_trains_once_what_its_experiments_share():
    study = load_study("demo", [])
    assert isinstance(study, Study)
    pose, cdehp, base_model, body, motion, objects, zero_shot = study.experiments.values()
    assert pose.baselines.items() <= body.baselines.items() and pose.baselines == cdehp.baselines
    for one, other in ((pose, base_model), (body, motion)):
        for name in ("dataset", "windows", "encoding", "condition", "generator", "downstream", "downstream_seeds",
                     "feature_extractor", "seed"):  # fmt: skip
            assert getattr(one, name) == getattr(other, name)
        assert other.training_sets == ("recorded",)  # trained for `one`
    assert body.baselines["out_of_domain_poses"].generator == body.generator
    alike = {"random_50": {"random_init": True, "num_steps": 50}, "random_150": {"random_init": True},
             "base_model_50": {"num_steps": 50}}  # fmt: skip
    for name, changes in alike.items():
        baseline = base_model.baselines[name]
        assert baseline.generator.options == base_model.generator.options | changes
        assert (baseline.condition, baseline.sampling) == (base_model.condition, base_model.sampling)
    assert load_options(pose.dataset) == load_options(body.dataset)  # one says what is the other's default
    for name in ("windows", "encoding", "num_synthetic", "feature_extractor", "seed", "max_attempts"):
        assert getattr(pose, name) == getattr(body, name)
    for name in ("dataset", "windows", "encoding", "condition", "generator", "feature_extractor", "seed"):
        assert getattr(objects, name) == getattr(zero_shot, name)
    assert objects.feature_extractor == objects.downstream
    learnt = studio_objects.list_recordings(studio_objects.Options(**objects.dataset.options))
    assert {recording.class_name for recording in learnt}.isdisjoint(zero_shot.target.options["classes"])
    assert len(zero_shot.target.options["classes"]) == 10


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"experiments": [1]}, "experiments must be a mapping of names to options"),
        ({"experiments": {"a": 3}}, "experiments must be a mapping of names to options"),
        ({"experiments": {}}, "experiments"),
        ({"experiments": {"a": {"extends": "nonesuch"}}}, r"experiments\.a extends an unknown preset 'nonesuch'"),
        ({"experiments": {"a": {"extends": "smoke", "set": "x=1"}}}, "set must be a list of texts"),
        (
            {"experiments": {"a": {"extends": "smoke", "set": ["seed"]}}},
            "'seed' is neither key=value nor one of `sets`",
        ),
        ({"experiments": {"a": {"extends": "smoke", "set": ["seeds=1"]}}}, "seeds"),
        ({"experiments": {"a": {"extends": "smoke"}, "b": {"extends": "smoke"}}}, "need different names"),
        (
            {"experiments": {"a": {"extends": "smoke", "set": ["windows.count=1"]}}},
            r"unknown option 'experiments\.a\.windows\.count'; known: method, num_events",
        ),
        ({"experiments": {"../a": {"extends": "smoke"}}}, "names of folders"),
        ({"experiments": {"a": {"extends": "smoke", "set": ["dataset.options.colour=1"]}}}, "unknown option 'colour'"),
    ],
)
def test_wrong_studies_are_refused(tmp_path, content, message):
    path = tmp_path / "study.yaml"
    path.write_text(json.dumps({"name": "s", **content}))
    with pytest.raises(PluginError, match=message):
        load_study(str(path), [])


def test_experiments_that_do_not_go_together_are_named_and_not_printed(tmp_path):
    path = tmp_path / "study.yaml"
    experiments = {place: {"extends": "smoke", "name": place} for place in ("a", "b")}
    path.write_text(json.dumps({"name": "s", "experiments": experiments, "pooled": {"both": ["a", "c"]}}))
    with pytest.raises(PluginError) as raised:
        load_study(str(path), [])
    assert "pooled" in str(raised.value) and "option ''" not in str(raised.value)
    assert len(str(raised.value)) < 300 and "got {" not in str(raised.value)


SPEED = {
    "experiment": "a",
    "reference": {"options": {"scheduler": "ddpm"}, "steps": [12]},
    "converged": {"steps": [16]},
    "lines": {"UniPC": {"steps": [3, 6]}},
}


def load_measured(folder, speed, overrides=(), **parts):
    path = folder / "study.yaml"
    parts = {name: {"extends": "smoke", "name": name} | part for name, part in ({"a": {}, "b": {}} | parts).items()}
    path.write_text(json.dumps({"name": "s", "experiments": parts, "speed_vs_error": speed}))
    return load_study(str(path), list(overrides))


def test_a_study_measures_the_generator_of_one_of_its_experiments(tmp_path):
    study = load_measured(tmp_path, SPEED, ["speed_vs_error.num_images=5", "experiments.a.sampling.palette=rgb"])
    measured = speed_vs_error_of(study)
    assert measured.experiment == study.experiments["a"] and measured.title == "a"
    assert measured.options.num_images == 5
    points = [(training_set.line, training_set.num_inference_steps) for training_set, _ in measured.points()]
    assert points == [("reference", 12), ("converged", 16), ("UniPC", 3), ("UniPC", 6)]
    assert {choice.options["palette"] for _, choice in measured.points()} == {"rgb"}
    assert speed_vs_error_of(load_measured(tmp_path, SPEED, ["speed_vs_error=null"])) is None
    assert speed_vs_error_of(load_study("all_routes", [])) is None


@pytest.mark.parametrize(
    ("changes", "part", "message"),
    [
        ({"experiment": "smoke"}, {}, r"speed_vs_error\.experiment: .* of the study, a, b; got 'smoke'"),
        ({"steps": 3}, {}, r"unknown option 'speed_vs_error\.steps'; known: experiment, num_images"),
        ({"reference": {"steps": [1, 2]}}, {}, "reference: expected one number of steps"),
        ({"lines": {"x": {"options": {"scheduler": "euler"}, "steps": [3]}}}, {}, "scheduler"),
        ({}, {"feature_extractor": None}, "a: frames are compared in features, and feature_extractor is null"),
        (
            {},
            {"generator": {"name": "smpl_esim"}, "condition": {"name": "body_motion"}, "sampling": {}},
            "a: generator 'smpl_esim' has no sampler to compare",
        ),
    ],
)
def test_what_cannot_be_measured_is_refused(tmp_path, changes, part, message):
    with pytest.raises(PluginError, match=message):
        load_measured(tmp_path, SPEED | changes, a=part)


def test_no_experiment_takes_the_folder_of_speed_against_error(tmp_path):
    with pytest.raises(PluginError, match="no experiment can be called 'speed_vs_error'"):
        load_measured(tmp_path, None, speed_vs_error={})


def test_the_papers_study_says_everything_that_is_missing_at_once():
    with pytest.raises(InputsMissing) as raised:
        load_study("paper", [])
    message = str(raised.value)
    values = yaml.safe_load((PRESETS / "paper.yaml").read_text())
    for name in values["paths"]:
        assert f"paths.{name}" in message
    assert message.count("paths.inception") == 1  # all six need it
    assert "  - recognition, zero_shot, pose_dhp19, pose_both, pose_cdehp, body: torchscript" in message
    assert "extracted_train/" in message  # the expected tree
    assert list(raised.value.asked.experiments) == list(values["experiments"])


def test_a_path_that_is_given_is_no_longer_missing(tmp_path):
    (tmp_path / "body.npz").touch()
    with pytest.raises(InputsMissing) as raised:
        load_study("paper", [f"paths.smpl={tmp_path / 'body.npz'}"])
    assert "paths.smpl" not in str(raised.value)
    parts = raised.value.asked.experiments
    # What is drawn, recorded, learnt and measured is one body.
    body, recorded = parts["body"], parts["body"].baselines["smpl_esim"]
    metric = next(metric for metric in body.metrics if metric.name == "pve")
    learnt = (body.condition.options, body.downstream.options, metric.options)
    for options in (*learnt, recorded.condition.options, recorded.sampling):
        assert options["body"] == str(tmp_path / "body.npz")
    # Table 5 is of binary classifiers, Table 1 of one of all classes.
    assert parts["zero_shot"].downstream.options["binary"] == "balanced"
    assert "binary" not in parts["recognition"].downstream.options
    # The same lines of the file serve several experiments, and each has a ControlNet of its own.
    controlnets = {name: part.generator.options["controlnet"] for name, part in parts.items() if "pose" in name}
    assert set(controlnets.values()) == {"paths.controlnet_openpose"}
    assert parts["body"].generator.options["controlnet"] == "paths.controlnet_normal"
    # The row of AMASS's poses is the same generator, asked for others.
    assert parts["body"].baselines["amass_poses"].generator == parts["body"].generator
    with pytest.raises(PluginError, match="has no such path; it has stable_diffusion, "):
        load_study("paper", ["paths.nonesuch=1"])


def test_costs_are_those_of_the_operations():
    with pytest.raises(InputsMissing) as raised:
        load_study("paper", [])
    costs = {name: estimate_costs(part) for name, part in raised.value.asked.experiments.items()}
    # 512 frames a step; TFLOP of Stable Diffusion v1.4 at 512 px: U-Net 0.803, ControlNet 0.283, decoder 2.515.
    text, pose = costs["recognition"], costs["pose_dhp19"]
    assert (text.images_trained, pose.images_trained) == (15625 * 512, 11719 * 512)
    assert text.training_s == pytest.approx(15625 * 512 * 2.41 / 168, rel=3e-3)
    assert pose.training_s == pytest.approx(11719 * 512 * 2.27 / 168, rel=3e-3)
    assert text.sampling_s == pytest.approx(650_000 * (1000 * 0.803 + 2.515) / 330, rel=3e-3)
    assert pose.sampling_s == pytest.approx(5000 * (1000 * (0.803 + 0.283) + 2.515) / 330, rel=3e-3)
    assert pose.frames_bytes == 5000 * 512 * 512 * 3 // 5
    assert estimate_costs(load_experiment("pose", [])) is None


def test_costs_of_smaller_images_and_guidance_are_between_the_counted_ones():
    asked = (
        "generator.options.base_model=FOLDER",
        "generator={name: stable_diffusion, options: {base_model: x}}",
        "condition={name: text}",
    )

    def seconds(*more):
        experiment = load_preset(Options, PRESETS, "pose", [*asked, "sampling={}", *more])
        return estimate_costs(experiment)

    large, small = (seconds(f"encoding.options.image_size=[{side}, {side}]") for side in (512, 256))
    assert small.training_s / large.training_s == pytest.approx(0.537 / 2.41, rel=3e-3)
    between = seconds("encoding.options.image_size=[384, 384]")
    assert small.training_s < between.training_s < large.training_s
    guided = seconds("encoding.options.image_size=[512, 512]", "sampling={guidance_scale: 7.5}")
    # In float32, the default of sampling, tensor cores stand idle.
    assert guided.sampling_s - large.sampling_s == pytest.approx(800 * 20 * 0.803 / 50, rel=3e-3)
    half = seconds("encoding.options.image_size=[512, 512]", "sampling={precision: bfloat16}")
    assert large.sampling_s / half.sampling_s == pytest.approx(330 / 50)


def test_only_the_full_experiment_takes_a_study():
    with pytest.raises(
        PluginError,
        match=r"'all_routes' is a study .* name one of its parts instead: pose, pose_cdehp, body, ",
    ):
        load_experiment("all_routes", [])


def test_an_experiment_is_left_out_without_the_folder_it_needs(tmp_path):
    preset = tmp_path / "two.yaml"
    preset.write_text(
        "name: two\ndata_notice: Simulated.\npaths: {images: null}\nexperiments:\n"
        "  always: {extends: smoke, name: a}\n"
        "  recorded: {extends: smoke, name: b, only_with: [images], set: ['data_notice={images}']}\n"
    )
    study = load_study(str(preset), [])
    assert list(study.experiments) == ["always"]
    assert study.data_notice == "Simulated. Left out: `recorded`, which needs --set paths.images=...."
    assert load_study(str(preset), ["paths.images=x"]).experiments["recorded"].data_notice == "x"
    with pytest.raises(PluginError, match=r"experiments.recorded.seed=1: Left out: `recorded`, which needs"):
        load_study(str(preset), ["experiments.recorded.seed=1"])


@pytest.mark.parametrize("wanted", ["images", "[pictures]", "[1]"])
def test_only_with_names_paths_of_the_preset(tmp_path, wanted):
    preset = tmp_path / "one.yaml"
    preset.write_text(
        f"name: one\npaths: {{images: null}}\nexperiments:\n  a: {{extends: smoke, only_with: {wanted}}}\n"
    )
    with pytest.raises(PluginError, match=r"experiments.a: only_with must be a list of the preset's paths, images"):
        load_study(str(preset), [])


def test_demo_has_real_recordings_where_they_are_given():
    assert "real_digits" not in load_study("demo", []).experiments
    given = ["paths.nmnist=/nowhere", "paths.images=/nowhere"]
    with pytest.raises(InputsMissing, match="/nowhere"):
        load_study("demo", given)


def write_study(folder, experiments, sets="{}"):
    path = folder / "study.yaml"
    path.write_text(f"name: one\nsets: {sets}\nexperiments:\n{experiments}")
    return str(path)


def test_for_makes_an_experiment_of_each_combination(tmp_path):
    study = load_study(
        write_study(
            tmp_path,
            "  n{count}_{seed}: {for: {count: [3, 4], seed: [0, 7]}, extends: smoke, name: 'run_{count}_{seed}',\n"
            "    set: ['num_synthetic={count}', 'seed={seed}']}\n  plain: {extends: smoke, name: plain}\n",
        ),
        ["experiments.n4_7.num_generators=2"],
    )
    made = {name: (one.name, one.num_synthetic, one.seed) for name, one in study.experiments.items()}
    assert made == {
        "n3_0": ("run_3_0", 3, 0), "n3_7": ("run_3_7", 3, 7), "n4_0": ("run_4_0", 4, 0), "n4_7": ("run_4_7", 4, 7),
        "plain": ("plain", study.experiments["plain"].num_synthetic, 0),
    }  # fmt: skip
    assert [name for name, one in study.experiments.items() if one.num_generators == 2] == ["n4_7"]


@pytest.mark.parametrize(
    ("experiments", "message"),
    [
        ("  n{a}: {for: {a: [1], b: [1, 2]}, extends: smoke}\n", r"two experiments are called 'n1'.*\{a\} and \{b\}"),
        ("  n: {for: 3, extends: smoke}\n", r"experiments.n: for must map names to lists, got 3"),
        ("  n{a}: {for: {a: 3}, extends: smoke}\n", r"for must map names to lists"),
    ],
)
def test_wrong_repetitions_are_refused(tmp_path, experiments, message):
    with pytest.raises(PluginError, match=message):
        load_study(write_study(tmp_path, experiments), [])


def test_experiments_take_groups_of_options_by_name(tmp_path):
    few = "{few: [num_synthetic=3, seed=5]}"
    parts = "  a: {extends: smoke, set: [few, seed=6]}\n  b: {extends: smoke, name: b, set: [seed=6, few]}\n"
    study = load_study(write_study(tmp_path, parts, few), [])
    assert {name: (one.num_synthetic, one.seed) for name, one in study.experiments.items()} == {
        "a": (3, 6),
        "b": (3, 5),
    }
    with pytest.raises(PluginError, match=r"experiments.a: set: 'fwe' is neither key=value nor one of `sets`"):
        load_study(write_study(tmp_path, "  a: {extends: smoke, set: [fwe]}\n", few), [])
    with pytest.raises(PluginError, match=r"sets must map names to lists"):
        load_study(write_study(tmp_path, "  a: {extends: smoke}\n", "{few: 3}"), [])
