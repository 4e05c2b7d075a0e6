"""The 3D route from end to end, at its smallest: bodies, normal maps, samples, a body regressor and its errors."""

import pyarrow.parquet as pq
import pytest
from flow_scripts import artefacts, run_script_here

from ctlev_core.report.page import display_names

SMALL = (
    "windows.max_windows=1",
    "generator.options={tune: both, num_steps: 3, batch_size: 2, learning_rate: 1.0e-3}",
    "sampling.num_inference_steps=2",
    "pixel_decoder={num_steps: 2, batch_size: 2, width: 16, depth: 1, time_steps: [500], evaluations: 2}",
    "downstream.options={num_steps: 4, batch_size: 4, warmup_steps: 1}",
    "downstream_seeds=[0]",
    "feature_extractor=null",
)


def run(preset, home, num_label_only, *settings):
    """The experiment on a few bodies, so many of them without events; returns the report's page and its scores."""
    counts = f"num_train_recordings: 4, num_test_recordings: 4, num_condition_recordings: {num_label_only}"
    asked = (f"dataset.options={{{counts}, joint_set: smpl}}", *settings, *SMALL)
    options = [word for setting in asked for word in ("--set", setting)]
    finished = run_script_here("full_experiment", "--preset", preset, *options, home=home)
    assert finished.status == 0, finished.errors
    scores = pq.read_table(home / "reports" / preset / "scores.parquet").to_pylist()
    return (home / "reports" / f"{preset}.html").read_text(), scores


@pytest.mark.slow
def test_sentences_become_event_frames_in_motion_and_bodies_are_scored(tmp_path):
    sentences = "poses.options.sentences=[a person walks then jumps]"
    report, scores = run("text_motion", tmp_path, 0, sentences, "num_synthetic=10")
    assert report.count("data:image/webp;base64,") == 1 and "a person walks then jumps" in report
    errors = {(row["subject"], row["metric"]): row["value"] for row in scores if row["group"] == "all"}
    for setting in ("recorded", "synthetic", "recorded+synthetic"):
        assert 0 < errors[setting, "mpjpe3d_pa_mm"] <= errors[setting, "mpjpe3d_pelvis_mm"] < 2000


@pytest.mark.slow
def test_one_generator_is_asked_for_poses_of_two_origins(tmp_path):
    foreign = "{poses: {name: text_motion, options: {camera: centred, sentences: [a person jumps]}}}"
    page, rows = run("body", tmp_path, 2, f"baselines={{out_of_domain_poses: {foreign}}}", "num_synthetic=4")
    assert len(artefacts(tmp_path, "finetune")) == 1
    own, foreign = sorted(artefacts(tmp_path, "sample"), key=lambda made: "person" in made.column("class_name")[0])
    assert set(foreign.column("class_name")) == {"a person jumps"} and len(own) == len(foreign) == 4
    trained = {row["subject"]: row["num_train"] for row in rows if row["group"] == "all"}
    real = trained["recorded"]
    assert (
        trained["recorded+out_of_domain_poses"] == real + 4
        and trained["recorded+synthetic+out_of_domain_poses"] == real + 8
    )
    assert "Sampled: synthetic (other motions)" in page
    assert display_names.set_name("recorded+synthetic+out_of_domain_poses") in page
