"""Pixel decoder in a whole run: frames of whole counts, labels unchanged, and nothing trained twice."""

import numpy as np
from flow_scripts import artefacts, run_script_here

from ctlev_core import plugins
from ctlev_core.postprocessing.image_counts import estimate_counts, fit_counts
from ctlev_core.provenance.records import read_records, write_provenance
from ctlev_core.seeds import sample_seeds
from ctlev_core.trained_generator import load_generator
from data_contracts.config import EncodingChoice

SMALL = (
    "dataset.options={num_train_recordings: 4, num_test_recordings: 1, num_condition_recordings: 6}",
    "windows.max_windows=2",
    "generator.options={tune: both, num_steps: 2, batch_size: 2}",
    "sampling.num_inference_steps=2",
    "num_synthetic=6",
    "max_attempts=1",
    "baselines={}",
    "oracle=null",
)
DECODER = "num_steps: 4, batch_size: 2, width: 16, depth: 1, time_steps: [500], evaluations: 2"


def run(home, decoder, *further, script="synthesize"):
    asked = (*SMALL, f"pixel_decoder={decoder}", *further)
    options = [word for setting in asked for word in ("--set", setting)]
    return run_script_here(script, "--preset", "pose", *options, home=home)


def test_sampled_frames_become_renderings_of_whole_counts(tmp_path):
    finished = run(tmp_path, f"{{{DECODER}}}")
    assert finished.status == 0, finished.errors
    (smooth,), (drawn,) = artefacts(tmp_path, "sample"), artefacts(tmp_path, "decode_pixels")
    assert drawn.table.equals(smooth.table), "labels, seeds and rejections stay"
    frames = np.asarray(drawn.array("frames"))
    assert frames.shape == smooth.array("frames").shape and frames.any(axis=(1, 2, 3)).all()
    assert (frames != smooth.array("frames")).any(axis=(1, 2, 3)).all()
    (encoded,) = artefacts(tmp_path, "encode")
    encoder = plugins.load_options(EncodingChoice(name="event_histogram", options={"polarity": False}))
    model = fit_counts(np.asarray(encoded.array("histograms")), encoder.options)
    assert estimate_counts(frames, model, seeds=range(len(frames))).is_exact.all(), "each is a rendering of counts"

    # From Python the same frames come, of the same conditions and seeds.
    (tuned,), (asked,) = artefacts(tmp_path, "finetune"), artefacts(tmp_path, "condition_samples")
    roles = [("checkpoint of synthetic", tuned.ref.path), ("frames of synthetic", drawn.ref.path)]
    (tmp_path / "reports" / "mine").mkdir(parents=True)
    write_provenance(tmp_path / "reports" / "mine" / "provenance.json", read_records(roles))
    # Sampled and drawn with the run's own options.
    again = load_generator("mine", home=tmp_path).sample(asked.column("prompt"), images=asked.array("images"))
    assert drawn.column("seed") == sample_seeds(0, len(drawn)), "none was sampled again"
    np.testing.assert_array_equal(again, frames)

    # Drawn in another number of passes: neither the generator nor the decoder is trained again.
    finished = run(tmp_path, f"{{{DECODER}, num_passes: 1}}")
    assert finished.status == 0, finished.errors
    assert len(artefacts(tmp_path, "train_pixel_decoder")) == len(artefacts(tmp_path, "sample")) == 1
    first, other = (np.asarray(each.array("frames")) for each in artefacts(tmp_path, "decode_pixels"))
    assert (first != other).any()


def test_what_does_not_go_together_is_refused_before_anything_runs(tmp_path):
    for decoder, further, message in (
        ("{num_step: 4}", (), "pixel_decoder: unknown option 'num_step'"),
        ("{}", ("sampling.values=nearest",), "pixel_decoder draws the values itself"),
    ):
        finished = run(tmp_path, decoder, *further)
        assert finished.status == 2 and message in finished.errors, finished.errors
    assert not (tmp_path / "artefacts").exists()
