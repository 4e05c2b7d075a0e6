"""Motion layers in a whole run: stretches from one another, baselines frame by frame, streams, and from Python."""

import json

import numpy as np
import pytest
from flow_scripts import artefacts, run_script_here

from ctlev_core.events import files as event_files
from ctlev_core.export.event_dataset import EventDataset
from ctlev_core.export.event_sequences import EventSequences
from ctlev_core.plugins import load_options
from ctlev_core.postprocessing.stochastic_rounding import round_frames, training_counts
from ctlev_core.provenance.records import read_records, write_provenance
from ctlev_core.seeds import distinct_seeds
from ctlev_core.trained_generator import load_generator
from flows.command_line import load_experiment

SMALL = (
    "dataset.options={num_train_recordings: 6, num_test_recordings: 1, num_condition_recordings: 3, "
    "recording_duration_us: 140000}",
    "windows={method: duration, duration_us: 20000}",
    "generator.options={tune: both, num_steps: 2, batch_size: 2}",
    "stretch_length=null",
    "motion_layers={context: 4, batch_size: 4, num_steps: 3, learning_rate: 0.01}",
    "pixel_decoder=null",
    "stochastic_rounding=true",
    "sampling={num_inference_steps: 2, palette: red_blue, black_threshold: 0}",
    "baselines={independent: {}}",
    "num_synthetic=10",
    "downstream_seeds=[0]",
)


def run(home, *further, script="synthesize"):
    options = [word for setting in (*SMALL, *further) for word in ("--set", setting)]
    return run_script_here(script, "--preset", "sequences", *options, home=home)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    place = tmp_path_factory.mktemp("home")
    for script in ("synthesize", "baselines", "export_events"):
        finished = run(place, "export={streams: stretches}", script=script)
        assert finished.status == 0, finished.errors
    return place


def test_stretches_of_the_length_of_the_context_are_asked_for(home):
    (asked,) = artefacts(home, "condition_samples")
    moments = [source.rpartition(":") for source in asked.column("source_id")]
    assert len({name for name, *_ in moments}) == 3
    for start in (0, 4, 8):
        part = moments[start : start + 4]
        assert len({name for name, *_ in part}) == 1
        assert set(np.diff([int(moment) for *_, moment in part])) == {20_000}


def test_the_generator_and_its_baseline_share_the_fine_tuning(home):
    (image,), (motion,) = artefacts(home, "finetune"), artefacts(home, "train_motion_layers")
    made = {one.ref.key: one for one in artefacts(home, "sample")}
    assert len(made) == 2
    by_checkpoint = {json.loads((one.ref.path / "run.json").read_text())["arguments"]["checkpoint"]["manifest"]: one
                     for one in made.values()}  # fmt: skip
    own, independent = by_checkpoint[motion.ref.key], by_checkpoint[image.ref.key]
    assert own.column("source_id") == independent.column("source_id")
    assert (np.asarray(own.array("frames")) != np.asarray(independent.array("frames"))).any(axis=(1, 2, 3)).all()
    folder = motion.ref.path / "checkpoint"
    assert (folder / "motion_adapter" / "config.json").is_file()
    for path in (image.ref.path / "checkpoint").rglob("*.safetensors"):
        assert path.read_bytes() == (folder / path.relative_to(image.ref.path / "checkpoint")).read_bytes()


def test_a_second_run_makes_nothing(home):
    before = {path: path.stat().st_mtime_ns for path in home.glob("artefacts/*/*/manifest.parquet")}
    finished = run(home, "export={streams: stretches}", script="export_events")
    assert finished.status == 0, finished.errors
    assert {path: path.stat().st_mtime_ns for path in home.glob("artefacts/*/*/manifest.parquet")} == before


def test_streams_are_those_of_stretches(home):
    (streams,) = artefacts(home, "export_events")
    files = streams.column("file")
    assert [files.index(name) for name in dict.fromkeys(files)] == [0, 4, 8]
    starts = streams.table["t_start_us"].to_numpy()
    for first in (0, 4, 8):
        events = event_files.read_events_file(streams.path(files[first]))
        assert (np.diff(events.t) >= 0).all()
        assert (np.diff(starts[first : first + 4]) > 0).all()


def test_from_python_the_same_frames_come(home, tmp_path):
    (motion,), (asked,) = artefacts(home, "train_motion_layers"), artefacts(home, "condition_samples")
    generator = load_generator(motion.ref.path)
    assert generator.name == "controlnet"
    options = {"num_inference_steps": 2, "palette": "red_blue", "black_threshold": 0}
    asked_for = {"prompts": asked.column("prompt"), "images": asked.array("images")[:], "seed": 0}
    frames = generator.sample(**asked_for, lengths=[4, 4, 2], **options)
    single = generator.sample(**asked_for, **options)
    assert (frames != single).any(axis=(1, 2, 3)).all()
    with pytest.raises(ValueError, match="add up to the 10 rows, got"):
        generator.sample(**asked_for, lengths=[4, 4], **options)
    (image,) = artefacts(home, "finetune")
    with pytest.raises(ValueError, match="lengths are for a generator with motion layers"):
        load_generator(image.ref.path).sample(**asked_for, lengths=[4, 4, 2], **options)
    # Without such layers frames can share their noise.
    images = np.repeat(asked.array("images")[:1], 10, axis=0)
    alike = load_generator(image.ref.path).sample(images=images, lengths=[4, 4, 2], noise="stretches", **options)
    assert [len(np.unique(alike[rows], axis=0)) for rows in (slice(0, 4), slice(4, 8), slice(8, 10))] == [1, 1, 1]
    assert len(np.unique(alike, axis=0)) == 3
    # By the name of a report, with the run's own options.
    made = next(one for one in artefacts(home, "sample") if motion.ref.digest in one.column("checkpoint_digest"))
    roles = [("checkpoint of synthetic", motion.ref.path), ("frames of synthetic", made.ref.path)]
    folder = home / "reports" / "mine"
    folder.mkdir(parents=True)
    write_provenance(folder / "provenance.json", read_records(roles))
    named = load_generator("mine", home=home).sample(**asked_for, lengths=[4, 4, 2])
    np.testing.assert_array_equal(named, frames)


def test_frames_are_read_as_sequences(home):
    for made in artefacts(home, "sample"):
        sequences = EventSequences(EventDataset(made.ref.path, rejected=True), 4)
        assert len(sequences) == 2 and sequences[1]["image"].shape == (4, 3, 64, 64)


def test_what_does_not_go_together_is_refused_before_anything_runs(tmp_path):
    for further, message in (
        ("motion_layers={contxt: 4}", "motion_layers: unknown option 'contxt'"),
        ("temporal_order=false", "motion_layers make frames that follow one another"),
        ("windows.max_windows=2", "windows.max_windows"),
        ("generator.options.lora_rank=4", "motion_layers: expected a generator that is trained whole"),
        ("baselines={other: {motion_layers: {contxt: 4}}}", "baselines.other.motion_layers: unknown option 'contxt'"),
    ):
        finished = run(tmp_path, further)
        assert finished.status == 2 and message in finished.errors, finished.errors
    assert not (tmp_path / "artefacts").exists()


def test_noise_of_stretches_without_motion_layers(home):
    """The generator makes each frame by itself, of noise that it shares with its stretch; a baseline has the layers."""
    own = ("motion_layers=null", "stretch_length=4", "sampling.noise=stretches")
    layers = "{motion_layers: {context: 4, batch_size: 4, num_steps: 3, learning_rate: 0.01}"
    before = {one.ref.key for one in artefacts(home, "sample")}
    baseline = f"baselines={{layers: {layers}, sampling: {{noise: independent}}}}}}"
    for script in ("synthesize", "baselines"):
        finished = run(home, *own, baseline, script=script)
        assert finished.status == 0, finished.errors
    # The baseline is what the experiment's own generator was in the runs above.
    assert len(artefacts(home, "finetune")) == len(artefacts(home, "train_motion_layers")) == 1
    (made,) = (one for one in artefacts(home, "sample") if one.ref.key not in before)
    seeds = made.column("seed")
    assert [len(set(seeds[rows])) for rows in (slice(0, 4), slice(4, 8), slice(8, 10))] == [1, 1, 1]
    assert len(set(seeds)) == 3 and set(made.column("num_attempts")) == {1}
    # What is rounded at random is another sensor's noise in each frame.
    assert run(home, *own, "stochastic_rounding=false").status == 0
    (expected,) = (one for one in artefacts(home, "sample") if one.ref.key not in before | {made.ref.key})
    (encoded,) = artefacts(home, "encode")
    counts, encoding = training_counts(encoded), load_options(load_experiment("sequences", []).encoding)
    own_seeds = distinct_seeds(seeds)
    assert len(set(own_seeds)) == 10
    rounded = round_frames(np.asarray(expected.array("frames")), counts, encoding, own_seeds)
    np.testing.assert_array_equal(made.array("frames")[:], rounded)


def test_labels_that_do_not_follow_one_another_are_refused(home):
    """Four moments, evenly spread over three recordings, lie farther apart than frames."""
    further = ("motion_layers=null", "stretch_length=null", "sampling.noise=stretches", "num_synthetic=4")
    finished = run(home, *further)
    assert finished.status == 2
    assert "none of 4 labels to sample from follows another by 20008 us" in finished.errors
    assert "finetune" not in finished.errors, "before anything is learnt"


@pytest.mark.parametrize(
    ("further", "message"),
    [
        (("motion_layers=null", "sampling.noise=stretches"), "sampling.noise 'stretches' is for frames that follow"),
        (("motion_layers=null", "stretch_length=4"), "stretch_length is of labels that follow one another"),
        (("motion_layers=null", "baselines={other: {motion_layers: {}}}"), "motion_layers make frames that follow"),
    ],
)
def test_stretches_need_an_order_in_time(tmp_path, further, message):
    finished = run(tmp_path, "temporal_order=false", "sequence_length=null", *further)
    assert finished.status == 2 and message in finished.errors, finished.errors


def test_noise_of_the_pixel_decoder_moves_and_trains_nothing_anew(home):
    own = ("motion_layers=null", "stretch_length=4", "sampling.noise=stretches", "stochastic_rounding=false")
    small = "previous_frame: true, num_steps: 2, batch_size: 2, width: 16, depth: 1, evaluations: 2, max_frames: 8"
    for moves in ("false", "true"):
        finished = run(home, *own, f"pixel_decoder={{{small}, moving_noise: {moves}}}")
        assert finished.status == 0, finished.errors
    assert len(artefacts(home, "train_pixel_decoder")) == 1
    still, moving = (np.asarray(one.array("frames")[:]) for one in artefacts(home, "decode_pixels"))
    assert (still != moving).any(axis=(1, 2, 3)).all()
    refused = run(home, *own, "pixel_decoder={moving_noise: true}")
    assert refused.status == 2 and "moving_noise needs previous_frame: true" in refused.errors
