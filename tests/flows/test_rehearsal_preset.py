"""The preset `rehearsal` is `paper` in small: the same experiments, which with tiny networks run to the end."""

from __future__ import annotations

import math
import re

import pyarrow.parquet as pq
import pytest
from flow_scripts import run_script, run_script_here

from ctlev_core.report.studies.paper_numbers import TABLES
from flows.studies import load_study

TINY = ("--preset", "rehearsal", "--set", "stand_ins=tiny")
AMOUNTS = {
    "num_synthetic", "num_recorded", "max_attempts", "downstream_seeds", "num_steps", "batch_size", "num_processes",
    "gradient_accumulation", "gradient_checkpointing", "num_inference_steps", "max_windows", "images_per_class",
    "test_images_per_class",
}  # fmt: skip
"""Options that say how much and not what."""
OWN = {"name", "data_notice", "trusted", "image_size"}
"""Options that differ because of the stand-ins."""


def leaves(value, name=""):
    """(dotted name, value) of everything in nested options."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from leaves(item, f"{name}.{key}" if name else key)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for number, item in enumerate(value):
            yield from leaves(item, f"{name}.{number}")
    else:
        yield name, value


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    return tmp_path_factory.mktemp("rehearsal")


@pytest.mark.slow
def test_it_differs_from_the_paper_in_amounts_alone(home, monkeypatch):
    monkeypatch.setenv("CTLEV_HOME", str(home))
    rehearsal = load_study("rehearsal", ["stand_ins=tiny"])
    places = sorted(path.name for path in (home / "stand_ins").iterdir())
    given = {re.sub(r"(-tiny)?-v\d+$", "", name): home / "stand_ins" / name for name in places}
    given["inception"] /= "inception.pt"
    given["smpl"] /= "basicModel_m_lbs_10_207_0_v1.0.0.pkl"
    trusted = [f"experiments.{name}.feature_extractor.options.trusted=true" for name in rehearsal.experiments]
    sizes = [f"experiments.{name}.encoding.options.image_size=[64, 64]" for name in rehearsal.experiments]
    paper = load_study("paper", [*(f"paths.{name}={place}" for name, place in given.items()), *trusted, *sizes])
    assert list(rehearsal.experiments) == list(paper.experiments)
    for name, experiment in paper.experiments.items():
        theirs, ours = (dict(leaves(one.model_dump(mode="json"))) for one in (experiment, rehearsal.experiments[name]))
        different = {key for key in theirs.keys() | ours.keys() if theirs.get(key) != ours.get(key)}
        assert {key.rpartition(".")[2] for key in different} <= AMOUNTS
        assert len(different) > 5


@pytest.mark.slow
def test_a_dry_run_lists_the_stages_and_makes_what_is_missing_once(home):
    planned = run_script_here("full_experiment", *TINY, "--dry-run", home=home)
    assert planned.status == 0, planned.errors
    again = run_script_here("full_experiment", *TINY, "--dry-run", home=home)
    assert "making a stand-in" not in again.errors and again.plan == planned.plan
    # One of words and four of conditions; three Event-GANs.
    assert len(set(re.findall(r"finetune: .* ([0-9a-f]{32})$", planned.output, re.MULTILINE))) == 8


@pytest.mark.slow
def test_own_files_are_taken_where_they_are_given(home, tmp_path):
    refused = run_script_here(
        "full_experiment", *TINY, "--set", f"paths.dhp19={tmp_path / 'none'}", "--dry-run", home=home
    )
    assert refused.status == 2 and str(tmp_path / "none") in refused.errors and "pose_dhp19" in refused.errors


def test_an_unknown_size_is_refused(home):
    refused = run_script_here(
        "full_experiment", "--preset", "rehearsal", "--set", "stand_ins=huge", "--dry-run", home=home
    )
    assert refused.status == 2 and "stand_ins must be one of full, tiny, got 'huge'" in refused.errors


@pytest.mark.release
@pytest.mark.timeout(2400)
def test_it_ends_in_a_report_with_every_table_and_figure_of_the_paper(home):
    finished = run_script("full_experiment", *TINY, home=home)
    assert finished.status == 0, finished.errors
    page = (home / "reports" / "rehearsal.html").read_text()
    for table in TABLES:
        assert table.title in page
    tables = (home / "reports" / "rehearsal" / "tables.md").read_text()
    study = load_study("rehearsal", ["stand_ins=tiny"])
    for name, experiment in study.experiments.items():
        folder = home / "reports" / "rehearsal" / name
        scores = pq.read_table(folder / "scores.parquet").to_pydict()
        assert set(map(str, experiment.all_training_sets)) <= set(scores["subject"])
        assert set(experiment.generator_names) <= set(scores["subject"])
        assert all(map(math.isfinite, scores["value"]))
        own_page = (folder / "report.html").read_text()
        # Conditions beside frames of each generator: pictures that are in the page.
        assert (
            own_page.count("data:image/") > len(experiment.generator_names) and f"({name.replace('_', ' ')})" in tables
        )
    again = run_script_here("full_experiment", *TINY, "--dry-run", home=home)
    assert {state for state, _ in again.plan.values()} == {"cached"}
