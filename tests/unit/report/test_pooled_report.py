"""The page of a study of several numbers of recordings, each with several draws of them."""

import json
import math
import re

import pytest
from pooled_study import DRAWS, NUM_GENERATORS, pooled_groups, write_pooled_study
from report_artefacts import TRAINING_SETS, Experiment

from ctlev_core.plugins import PluginError
from ctlev_core.report.page.tables import split_number
from ctlev_core.report.sections.verdict import in_range
from ctlev_core.statistics.paired_differences import Difference
from ctlev_core.statistics.pooled_scores import DrawsDiffer
from data_contracts.manifest import Manifest, ManifestRef
from data_contracts.study import Study
from flows.studies import load_study
from tasks.report import report
from tasks.stage import Output

COUNTS = (2, 20)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    home = tmp_path_factory.mktemp("pooled")
    return write_pooled_study(home, COUNTS), home / "made"


def test_the_page_begins_with_the_answer_and_shows_each_group_once(study):
    page, _ = study
    texts = ["2 recordings a class: adding synthetic frames to the recorded ones helped: accuracy went from 0.6"]
    texts += ["It did more than augmented copies of the recorded frames do (+", "20 recordings a class: "]
    texts += ["60 test recordings, 3 random draws of the training recordings, 5 fine-tunings", "and 3 training seeds"]
    # In reading order: recorded frames, recorded ones with others, others alone, and what is no test score.
    texts += [">recorded</td>", ">recorded + synthetic</td>", ">recorded + augmented copies</td>"]
    texts += [">recorded + more recorded</td>", ">synthetic</td>", ">more recorded</td>"]
    texts += [
        'title="label agreement of synthetic">synthetic, against their labels</td>',
        "Differences that matter</h2>",
        "<svg",
    ]
    texts += ["How probable is it that the first is better?", "2 recordings a class: asked for"]
    texts += ["20 recordings a class: asked for", "Quality of the frames</h2>"]
    texts += [f'href="numbers/k{count}_{draw}/report.html"' for count in COUNTS for draw in range(DRAWS)]
    place = 0
    for text in texts:
        place = page.index(text, place) + 1
    assert page.count(": asked for, and sampled</h2>") == len(COUNTS)
    assert "Does synthetic data help?" not in page and "Do synthetic frames help?" not in page


def test_tables_are_in_markdown_and_latex_too(study):
    _, folder = study
    for suffix in ("md", "tex"):
        text = (folder / f"tables.{suffix}").read_text()
        for title in ("Scores by training frames", "Differences that matter", "How probable is it"):
            assert title in text
    markdown = (folder / "tables.md").read_text()
    assert "2 recordings a class: adding synthetic frames to the recorded ones helped" in markdown
    rows = [line.split(" | ") for line in markdown.splitlines() if line.startswith("| ")]
    cells = {row[0].strip("| "): [cell.strip(" |*").replace("\\", "") for cell in row[1:]] for row in rows}
    difference = cells["recorded and synthetic frames, against recorded frames alone"]
    scores = [cells[name] for name in ("recorded", "recorded + synthetic")]
    # The first table of differences has been overwritten by that of probabilities, whose rows are called the same.
    assert all(0 < float(cell.removesuffix(" %")) < 100 for cell in difference)
    real, both = (float(split_number(row[0])[0]) for row in scores)
    assert both > real + 0.1
    assert re.search(r"share of the gain .* \d\d % \\\[", markdown)


def test_experiments_in_no_group_are_shown_as_ever(tmp_path):
    experiment = Experiment(tmp_path / "other")
    folder = tmp_path / "report"
    folder.mkdir()
    report.function(Output(folder, folder), experiment.inputs)
    other = Manifest(ManifestRef(key="k", path=folder), None, (), ())
    groups = pooled_groups((2,))
    names = [*groups[0][1], "other0"]
    home = tmp_path / "home"
    home.mkdir()
    shown = {
        "training_sets": [[]] * DRAWS + [list(TRAINING_SETS)],
        "generator_names": [["synthetic"]] * DRAWS + [["synthetic", "gan"]],
    }
    page = write_pooled_study(home, (2,), (other,), names=names, **shown)
    place = 0
    for text in (
        "2 recordings a class: ", "2D pose (other0): Adding synthetic", "Differences that matter</h2>",
        "Do synthetic frames help?</h2>", '<p class="chapter">2D pose (other0)</p>', "Does synthetic data help?</h2>",
        "Asked for, and sampled</h2>", 'href="numbers/other0/report.html"',
    ):  # fmt: skip
        place = page.index(text, place) + 1


def test_groups_without_numbers_have_no_chart(tmp_path):
    page = write_pooled_study(
        tmp_path,
        (2, 5),
        pooled=[
            (name.replace(" ", "-", 1).replace("2", "two").replace("5", "five"), members)
            for name, members in pooled_groups((2, 5))
        ],
    )
    assert "two-recordings a class" in page and "<svg" not in page


@pytest.mark.parametrize(
    ("metric", "expected"), [("accuracy", (0.9, 1.0)), ("pck_px10", (0.9, 1.0)), ("mpjpe2d", (0.9, 1.1))]
)
def test_intervals_of_shares_end_where_shares_do(metric, expected):
    found = in_range(Difference(0.98, 0.9, 1.1), metric)
    assert (found.low, found.high) == expected and found.value == 0.98
    assert in_range(Difference(0.02, -0.1, 0.2), "accuracy").low == 0.0
    assert math.isnan(in_range(Difference(0.5, math.nan, math.nan), "accuracy").low)


def test_draws_with_other_test_samples_are_named(tmp_path, monkeypatch):
    import pooled_study

    original, calls = pooled_study.samples_table, []

    def shorter(values):
        calls.append(values)
        return original({name: of[:, : 50 if len(calls) == 2 else 60] for name, of in values.items()})

    monkeypatch.setattr(pooled_study, "samples_table", shorter)
    with pytest.raises(DrawsDiffer, match=r"50 and 60 samples, 10 of them in one alone"):
        write_pooled_study(tmp_path, (2,))


def load(folder, pooled, **changes):
    path = folder / "study.yaml"
    common = {"extends": "smoke", "downstream_seeds": [0, 1], "num_generators": 1}
    parts = {name: {**common, "name": name, **changes.get(name, {})} for name in ("a", "b", "c", "d")}
    path.write_text(json.dumps({"name": "s", "experiments": parts, "pooled": pooled}))
    return load_study(str(path), [])


def test_a_preset_declares_groups(tmp_path):
    study = load(tmp_path, {"2 recordings a class": ["a", "b"], "5 recordings a class": ["c", "d"]})
    assert isinstance(study, Study)
    assert study.pooled == {"2 recordings a class": ("a", "b"), "5 recordings a class": ("c", "d")}
    assert load_study("all_routes", []).pooled == {}


@pytest.mark.parametrize(
    ("pooled", "changes", "message"),
    [
        ({"g": ["a", "z"]}, {}, r"pooled names experiments of the study, a, b, c, d; got \['z'\]"),
        ({"g": ["a", "b"], "h": ["b", "c"]}, {}, r"each experiment once, got \['b'\]"),
        ({"g": ["a"]}, {}, r"'g': expected at least two experiments, got \['a'\]"),
        ({"g": ["a", "b"]}, {"b": {"training_sets": ["recorded"]}}, r"'g': .* must have the same training sets"),
        ({"g": ["a", "b"]}, {"b": {"downstream_seeds": [0]}}, "same number of downstream_seeds, got 2 of a and 1 of b"),
        ({"g": ["a", "b"]}, {"b": {"num_generators": 2}}, "same num_generators, got 1 of a and 2 of b"),
        (
            {"g": ["a", "b"]},
            {name: {"num_generators": NUM_GENERATORS} for name in "ab"},
            "a multiple of num_generators, 5, got 2",
        ),
    ],
)  # fmt: skip
def test_wrong_groups_are_refused(tmp_path, pooled, changes, message):
    with pytest.raises(PluginError, match=message):
        load(tmp_path, pooled, **changes)


def test_a_path_that_may_be_missing_is_null(tmp_path):
    path = tmp_path / "study.yaml"

    def loaded(change, *overrides):
        part = {"extends": "smoke", "name": "a", "set": [change]}
        path.write_text(json.dumps({"name": "s", "paths": {"may": None}, "experiments": {"a": part}}))
        return load_study(str(path), list(overrides)).experiments["a"]

    assert loaded("export={may?}").export is None
    for change, overrides, given in (
        ("export={may}", (), "paths.may"),
        ("export={may?}", ("paths.may=/data",), "/data"),
    ):
        with pytest.raises(PluginError, match=f"experiments.a.export.*'{given}'"):
            loaded(change, *overrides)
    assert loaded("data_notice={may?}", "paths.may=/data").data_notice == "/data"
    with pytest.raises(PluginError, match=r"names no path of this preset; it has may"):
        loaded("export={nonesuch?}")
