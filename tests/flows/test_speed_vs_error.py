"""Speed against error from end to end, at its smallest."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from browser import CHROMIUM, check_pages
from flow_scripts import artefacts, plan_script, run_script

from ctlev_core.downstream import classifier
from ctlev_core.generators import controlnet
from ctlev_core.scoring.frechet import frechet_distance
from ctlev_core.seeds import sample_seeds
from data_contracts.labels import Conditions

# So many test recordings that intervals, and with them a recommendation, can be given; nothing that is not measured.
SETTINGS = ("experiment.dataset.options.num_test_recordings=6", "experiment.oracle=null")
OPTIONS = ["--preset", "smoke", *(word for setting in SETTINGS for word in ("--set", setting))]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The home of a finished measurement."""
    home = tmp_path_factory.mktemp("speed")
    finished = run_script("speed_vs_error", *OPTIONS, home=home, timeout=580)
    assert finished.status == 0, finished.errors
    assert str(home / "reports" / "smoke_speed_vs_error.html") in finished.output
    return home


@pytest.fixture(scope="module")
def rows(measured):
    """The table of all measurements."""
    return pq.read_table(measured / "reports" / "smoke_speed_vs_error.parquet").to_pylist()


def timed(home, steps, scheduler, seed=0):
    """The timed samples of one setting."""
    for manifest in artefacts(home, "sample_timed"):
        arguments = json.loads((manifest.ref.path / "run.json").read_text())["arguments"]
        options = arguments["sampling"]["options"]
        if (options["num_inference_steps"], options["scheduler"], arguments["seed"]) == (steps, scheduler, seed):
            return manifest
    raise AssertionError(f"no timed samples of {scheduler} in {steps} steps")


def test_the_page_recommends_and_shows(measured):
    page = (measured / "reports" / "smoke_speed_vs_error.html").read_text()
    for expected in (
        "far too small to learn from",
        "Distance to held-out recorded frames",
        "ddpm in 12 steps: 95 %",
        "Exact score: trajectory",
        "How real do the frames of each setting look?",
        "fewer than 40 frames",
        "networks bfloat16, state float32",
        "data:image/png;base64,",
    ):
        assert expected in page
    assert "Recommended: " in page or "No setting stays within the interval" in page


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_the_page_can_be_read_at_every_width(measured, tmp_path):
    check_pages(measured / "reports", ["smoke_speed_vs_error.html"], tmp_path)


def test_every_setting_is_measured_and_evaluations_are_counted(rows):
    of_generator = [row for row in rows if row["study"] == "generator" and row["metric"] == "controlnet_evaluations"]
    counts = {(row["line"], row["num_inference_steps"]): (row["evaluations"], row["value"]) for row in of_generator}
    assert counts == {
        ("reference", 12): (12, 12),
        ("converged", 16): (16, 16),
        ("UniPC", 3): (3, 3),
        ("UniPC", 6): (6, 6),
        ("DDPM", 3): (3, 3),
        ("UniPC, ControlNet every 2nd", 5): (5, 3),
    }
    with_pixels = {row["line"] for row in rows if row["against"] == "converged solution"}
    assert with_pixels == {"UniPC", "UniPC, ControlNet every 2nd"}, "DDPM draws noise and approaches no solution"
    assert {row["study"] for row in rows} == {"generator", "exact_score", "precision"}
    assert {row["against"] for row in rows if row["metric"].startswith("mpjpe2d")} == {"labels asked for"}


def test_samples_are_those_of_the_experiment(measured, tmp_path):
    """The generator's own `sample`, with the seeds that the rows have in the experiment."""
    (checkpoint,) = artefacts(measured, "finetune")
    (conditions,) = artefacts(measured, "condition_samples")
    samples = timed(measured, 3, "unipc")
    names = conditions.column("sample_id")
    asked = [names.index(name) for name in samples.column("condition_id")]
    assert len(asked) == 6 < len(names)
    seeds = [sample_seeds(0, len(names))[row] for row in asked]
    assert samples.column("seed") == seeds
    prompts = tuple(conditions.column("prompt")[row] for row in asked)
    expected = controlnet.sample(
        checkpoint.ref.path / "checkpoint",
        Conditions(prompts, np.asarray(conditions.array("images")[asked])),
        controlnet.SampleOptions(scheduler="unipc", num_inference_steps=3, palette="grey"),
        seeds=seeds,
        work=tmp_path,
    )
    # Another process with another number of threads may sum in another order: one grey level, or the darkest one.
    difference = np.abs(expected.astype(int) - samples.array("frames"))
    assert (difference > 1).mean() < 1e-3


def test_distances_are_those_of_the_pooled_seeds(measured, rows):
    (frames,) = artefacts(measured, "encode")
    models = {
        manifest.ref.path / "model" for manifest in artefacts(measured, "train_downstream", "downstream/classifier")
    }
    (folder,) = models
    held_out = frames.array("frames")[frames.rows_where(split="test")]
    pictures = np.concatenate([timed(measured, 6, "unipc", seed).array("frames") for seed in (0, 1)])
    expected = frechet_distance(classifier.features(folder, pictures), classifier.features(folder, held_out))
    (found,) = [
        row
        for row in rows
        if (row["line"], row["num_inference_steps"], row["metric"]) == ("UniPC", 6, "fd_event")
        and row["against"] == "held-out recorded frames"
    ]
    # Float32 features of a network, from another process.
    assert found["value"] == pytest.approx(expected, rel=1e-3)
    assert found["low"] < found["value"] < found["high"] and found["num_samples"] == 12


def test_another_line_is_all_that_is_sampled_again(measured):
    base = plan_script("speed_vs_error", *OPTIONS, "--dry-run", home=measured).plan
    assert {state for state, _ in base.values()} == {"cached"}
    line = ["--set", "lines.DDIM={options: {scheduler: ddim}, steps: [4]}"]
    plan = plan_script("speed_vs_error", *OPTIONS, *line, "--dry-run", home=measured).plan
    assert {label for label, (state, _) in plan.items() if state == "to run"} == {
        "sample_timed: DDIM, 4 steps, seed 0",
        "sample_timed: DDIM, 4 steps, seed 1",
        "sampling_errors: smoke",
        "speed_report: smoke",
    }


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("experiment.feature_extractor=null", "feature_extractor is null"),
        ("lines.x={options: {scheduler: euler}, steps: [3]}", "scheduler"),
        ("experiment.generator={name: event_gan}", "experiment.sampling|sampler to compare|scheduler"),
        ("reference.steps=[5, 6]", "reference: expected one number of steps"),
        ("precision.lines={x: {options: {scheduler: ddim}, steps: [3]}}", "expected a scheduler of unipc, deis"),
        ("lines={x: {options: {scheduler: tcd}, steps: [3]}}", "lines.x: expected a solver, got 'tcd'"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_runs(tmp_path, setting, message):
    finished = plan_script("speed_vs_error", "--preset", "smoke", "--set", setting, home=tmp_path)
    assert finished.status == 2
    assert finished.errors.startswith("error: ")
    assert any(part in finished.errors for part in message.split("|")), finished.errors
    assert not (tmp_path / "artefacts").exists()
