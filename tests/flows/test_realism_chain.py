"""Where realism is lost, from end to end, at its smallest."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from browser import CHROMIUM, check_pages
from flow_scripts import artefacts, run_script

from ctlev_core import plugins
from ctlev_core.generators import controlnet
from ctlev_core.postprocessing.stochastic_rounding import round_frames, training_counts
from ctlev_core.seeds import sample_seeds
from data_contracts.config import EncodingChoice
from data_contracts.manifest import conditions_of
from data_contracts.realism_chain import RealismChain
from flows.command_line import PRESETS, load_preset

# As many test frames as the two-sample test needs in each set.
SETTINGS = (
    "dataset.options.num_test_recordings=24", "oracle=null", "baselines={}", "stochastic_rounding=true",
    "chain.time_steps=[0,300]", "chain.max_evaluations=4", "chain.num_inference_steps=[3]", "chain.num_frames=41",
)  # fmt: skip
OPTIONS = ["--preset", "smoke", *(word for setting in SETTINGS for word in ("--set", setting))]
ROWS = [("recorded", 0, 0), ("autoencoder", 0, 0), ("values", 0, 0), ("counts", 0, 0),
        ("denoised", 0, 0), ("denoised", 300, 4), ("sampled", 3, 3)]  # fmt: skip
pytestmark = pytest.mark.release


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The home of a finished chain."""
    home = tmp_path_factory.mktemp("chain")
    run = run_script("realism_chain", *OPTIONS, home=home, timeout=580)
    assert run.status == 0, run.errors
    assert str(home / "reports" / "smoke_realism_chain.html") in run.output
    return home


def made(home, kind, amount=0):
    """What frames became in a part."""
    for manifest in artefacts(home, "chain_frames"):
        link = json.loads((manifest.ref.path / "run.json").read_text())["arguments"]["link"]
        if (link["kind"], link["amount"]) == (kind, amount):
            return manifest
    raise AssertionError(f"no frames of {kind} {amount}")


def test_every_row_is_measured_against_the_same_frames(finished):
    rows = pq.read_table(finished / "reports" / "smoke_realism_chain.parquet").to_pylist()
    assert list(dict.fromkeys((row["link"], row["amount"], row["evaluations"]) for row in rows)) == ROWS
    areas = {(row["link"], row["amount"]): row for row in rows if row["metric"] == "c2st"}
    for key, row in areas.items():
        assert row["value"] is not None or key == ("recorded", 0), row["note"]
        assert row["difference"] is None
    assert "fewer than 40 frames" in areas["recorded", 0]["note"], "halves of 43 test frames"
    numbers = [row for row in rows if row["metric"] == "active_pixel_share"]
    assert len(numbers) == len(ROWS) and all(row["num_samples"] == 41 for row in numbers)
    recorded, *others = numbers
    for row in others:  # all recordings have this number: the mean of differences is the difference of means
        assert row["difference"] == pytest.approx(row["value"] - recorded["value"])


def test_frames_are_held_out_ones_and_all_rows_are_of_the_same(finished):
    (frames,) = artefacts(finished, "encode")
    row_of = {name: row for row, name in enumerate(frames.column("sample_id"))}
    chosen = made(finished, "autoencoder").column("sample_id")
    assert len(set(chosen)) == 41
    assert {frames.column("split")[row_of[name]] for name in chosen} == {"test"}
    for kind, amount, _ in ROWS[1:]:
        assert made(finished, kind, amount).column("sample_id") == chosen
    recorded = frames.array("frames")[[row_of[name] for name in chosen]]
    # The bundled base_model's patch code is exact but for the rounding of its latents.
    assert np.abs(made(finished, "autoencoder").array("frames")[:].astype(int) - recorded).max() <= 1
    counts, from_0 = (made(finished, *key).array("frames")[:] for key in (("counts", 0), ("denoised", 0)))
    np.testing.assert_array_equal(from_0, counts)


def test_whole_sampling_is_the_generators_own(finished, tmp_path):
    (checkpoint,), (conditions,) = artefacts(finished, "finetune"), artefacts(finished, "condition_some_frames")
    sampled = made(finished, "sampled", 3)
    seeds = sample_seeds(0, len(conditions))
    assert sampled.column("seed") == seeds
    options = controlnet.SampleOptions(scheduler="unipc", timestep_spacing="lu", num_inference_steps=3, palette="grey")
    expected = controlnet.sample(
        checkpoint.ref.path / "checkpoint", conditions_of(conditions), options, seeds=seeds, work=tmp_path
    )
    (frames,) = artefacts(finished, "encode")
    encoder = plugins.load_options(EncodingChoice(name="event_histogram", options={"polarity": False}))
    expected = round_frames(expected, training_counts(frames), encoder, seeds)
    # Another process with another number of threads may sum in another order: few counts go the other way for it.
    assert (expected != sampled.array("frames")[:]).mean() < 0.01
    assert (expected > 0).mean() > 0.05


def test_the_page_says_where_and_shows(finished):
    page = (finished / "reports" / "smoke_realism_chain.html").read_text()
    for expected in (
        "far too small to learn from",
        "Where is realism lost?",
        "denoised from t = 300",
        "sampled in 3 steps",
        "whole counts",
        "data:image/png;base64,",
    ):
        assert expected in page
    assert "Told from recorded frames first: " in page or "In no row are frames told" in page


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_the_page_can_be_read_at_every_width(finished, tmp_path):
    check_pages(finished / "reports", ["smoke_realism_chain.html"], tmp_path)


def test_another_time_step_is_all_that_is_computed_again(finished):
    base = run_script("realism_chain", *OPTIONS, "--dry-run", home=finished).plan
    assert {state for state, _ in base.values()} == {"cached"}
    more = ["--set", "chain.time_steps=[0,300,600]", "--set", "sampling.scheduler=ddim", "--dry-run"]
    plan = run_script("realism_chain", *OPTIONS, *more, home=finished).plan
    assert {label for label, (state, _) in plan.items() if state == "to run"} == {
        "chain_frames: denoised 600",
        "chain_frames: sampled 3",
        "chain_realism: smoke",
        "chain_report: smoke",
    }


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (("generator={name: event_gan}", "sampling={}"), "expected a latent-diffusion generator"),
        (("chain.split=condition",), "chain.split"),
        (("chain.time_steps=[20,20]",), "expected different numbers of 0 to 1000"),
        (("chain.num_inference_steps=[0]",), "num_inference_steps"),
        (("chain.time_steps=[20,1000]",), "chain.time_steps: expected at most 999, as the noise schedule has"),
    ],
)
def test_what_cannot_be_taken_apart_is_refused_before_anything_runs(tmp_path, settings, message):
    words = [word for setting in settings for word in ("--set", setting)]
    run = run_script("realism_chain", "--preset", "smoke", *words, home=tmp_path)
    assert run.status == 2 and run.errors.startswith("error: ") and message in run.errors, run.errors
    assert not (tmp_path / "artefacts").exists()


def test_rows_come_in_the_order_in_which_frames_go_through():
    asked = load_preset(RealismChain, PRESETS, "smoke", ["chain.time_steps=[700,20]"])
    assert [(link.kind, link.amount) for link in asked.links] == [
        ("autoencoder", 0), ("values", 0), ("denoised", 20), ("denoised", 700),
        ("sampled", 20), ("sampled", 100), ("sampled", 1000),
    ]  # fmt: skip
    rounded = load_preset(RealismChain, PRESETS, "smoke", ["stochastic_rounding=true"])
    assert [link.kind for link in rounded.links][:3] == ["autoencoder", "values", "counts"]
