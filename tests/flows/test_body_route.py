"""The 3D route from end to end, at its smallest: bodies, normal maps, samples, a body regressor and its errors."""

import pyarrow.parquet as pq
from flow_scripts import artefacts, run_script

SETTINGS = (
    "dataset.options={num_train_recordings: 4, num_test_recordings: 4, num_condition_recordings: 0, joint_set: smpl}",
    "poses.options.sentences=[a person walks then jumps]",
    "windows.max_windows=1",
    "generator.options={tune: both, num_steps: 3, batch_size: 2, learning_rate: 1.0e-3}",
    "sampling.num_inference_steps=2",
    "num_synthetic=10",
    "downstream.options={num_steps: 4, batch_size: 4, warmup_steps: 1}",
    "downstream_seeds=[0]",
    "feature_extractor=null",
)


def test_sentences_become_event_frames_in_motion_and_bodies_are_scored(tmp_path):
    options = [word for setting in SETTINGS for word in ("--set", setting)]
    finished = run_script("full_experiment", "--preset", "text_motion", *options, home=tmp_path, timeout=550)
    assert finished.status == 0, finished.errors
    report = (tmp_path / "reports" / "text_motion.html").read_text()
    assert report.count("data:image/webp;base64,") == 1 and "a person walks then jumps" in report
    scores = pq.read_table(tmp_path / "reports" / "text_motion" / "scores.parquet").to_pylist()
    errors = {(row["setting"], row["metric"]): row["value"] for row in scores if row["group"] == "all"}
    for setting in ("real", "synthetic", "real+synthetic"):
        assert 0 < errors[setting, "mpjpe3d_pa_mm"] <= errors[setting, "mpjpe3d_pelvis_mm"] < 2000


FOREIGN = (
    "dataset.options={num_train_recordings: 4, num_test_recordings: 4, num_condition_recordings: 2, joint_set: smpl}",
    "baselines={foreign_poses: {poses: {name: text_motion, options: {camera: centred, sentences: [a person jumps]}}}}",
    "num_synthetic=4",
    *(setting for setting in SETTINGS if setting.startswith(("windows", "generator", "sampling", "down", "feature"))),
)


def test_one_generator_is_asked_for_poses_of_two_origins(tmp_path):
    options = [word for setting in FOREIGN for word in ("--set", setting)]
    finished = run_script("full_experiment", "--preset", "body", *options, home=tmp_path, timeout=550)
    assert finished.status == 0, finished.errors
    assert len(artefacts(tmp_path, "finetune")) == 1
    own, foreign = sorted(artefacts(tmp_path, "sample"), key=lambda made: "person" in made.column("class_name")[0])
    assert set(foreign.column("class_name")) == {"a person jumps"} and len(own) == len(foreign) == 4
    rows = pq.read_table(tmp_path / "reports" / "body" / "scores.parquet").to_pylist()
    trained = {row["setting"]: row["num_train"] for row in rows if row["group"] == "all"}
    real = trained["real"]
    assert trained["real+foreign_poses"] == real + 4 and trained["real+synthetic+foreign_poses"] == real + 8
    page = (tmp_path / "reports" / "body.html").read_text()
    assert "Sampled: foreign_poses" in page and "<td>real+synthetic+foreign_poses</td>" in page
