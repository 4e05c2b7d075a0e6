"""Motions told in words as a dataset: recordings, labels, and the results of other models."""

from typing import Any

import numpy as np
import pytest

from ctlev_core.body.layer import joint_transforms, load_body
from ctlev_core.body.motion import procedural
from ctlev_core.body.motion.clip import resample
from ctlev_core.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from ctlev_core.body.text_to_motion.compose import generate_motion
from ctlev_core.datasets import text_motion
from data_contracts import tables
from data_contracts.config import DatasetChoice
from data_contracts.errors import DataError
from data_contracts.labels import Part, Recording, check_labels
from data_contracts.manifest import labels_of, read_manifest
from tasks.ingest import ingest
from tasks.store import Store

SENTENCES = ("a person walks, then jumps", "someone waves.")


def options(**changes) -> text_motion.Options:
    return text_motion.Options(**{"sentences": SENTENCES, **changes})


def smpl_of(recording: Recording, chosen: text_motion.Options) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pose [N, 72], position [N, 3] and time [N] in microseconds."""
    labels = check_labels(text_motion.read_labels(recording, chosen), recording.recording_id)
    assert labels.smpl_pose is not None and labels.smpl_transl is not None and labels.t_us is not None
    return labels.smpl_pose, labels.smpl_transl, labels.t_us


def joints_of(name: str, count: int = 30) -> np.ndarray:
    rotations, transl = procedural.sample_pose(name, np.arange(count) / 20, np.random.default_rng(3))
    return joint_transforms(load_body(), rotations, np.zeros(10), transl)[1][:, :22]


def write_results(path) -> None:
    motion = np.stack([np.moveaxis(joints_of(name), 0, -1) for name in ("walk", "dance")]).astype(np.float32)
    texts = ["a person walks.", "a person dances"]
    results: Any = {"motion": motion, "text": texts, "lengths": np.array([30, 20])}
    np.save(path, results | {"num_samples": 2, "num_repetitions": 1}, allow_pickle=True)


def test_there_is_a_recording_a_sentence_and_performance():
    recordings = text_motion.list_recordings(options(variations=2))
    assert [recording.recording_id for recording in recordings] == [
        "a_person_walks_then_jumps/0", "a_person_walks_then_jumps/1", "someone_waves/0", "someone_waves/1",
    ]  # fmt: skip
    assert {recording.class_name for recording in recordings} == {"a person walks, then jumps", "someone waves"}
    assert all(r.parts == (Part("condition"),) and not r.has_events and r.files == () for r in recordings)
    with pytest.raises(DataError, match="a pose source has no events"):
        text_motion.read_events(recordings[0], options())


def test_every_example_is_understood_and_named_apart():
    recordings = text_motion.list_recordings(text_motion.Options())
    assert [recording.class_name for recording in recordings] == list(text_motion.EXAMPLES)
    assert len({recording.recording_id for recording in recordings}) == len(text_motion.EXAMPLES)


def test_labels_are_the_motion_before_the_camera():
    chosen = options(rate_hz=10.0, yaw_range_deg=(0, 0), pitch_range_deg=(0, 0))
    recording = text_motion.list_recordings(chosen)[0]
    pose, transl, t_us = smpl_of(recording, chosen)
    clip = resample(generate_motion(SENTENCES[0]), t_us / 1e6)
    np.testing.assert_array_equal(pose[:, 3:], clip.pose[:, 3:].astype(np.float32))
    # From the front: the camera's axes are those of the world turned by half a turn about x.
    moved = np.diff(transl, axis=0)
    np.testing.assert_allclose(moved, np.diff(clip.transl, axis=0) * [1, -1, -1], atol=2e-6)
    facing = matrix_from_axis_angle(pose[:, :3])[:, :, 2]
    assert facing[0] @ [0, 0, -1] > 0.9
    assert np.diff(t_us).min() == 100_000


def test_seed_and_performance_make_other_motions_and_the_same_ones_again():
    recordings = text_motion.list_recordings(options(variations=2))
    poses = [smpl_of(recording, options())[0] for recording in recordings[:2]]
    again = smpl_of(recordings[0], options())[0]
    other = smpl_of(recordings[0], options(seed=1))[0]
    np.testing.assert_array_equal(poses[0], again)
    for changed in (poses[1], other):
        rows = min(len(changed), len(again))
        assert np.abs(changed[:rows, 3:] - again[:rows, 3:]).max() > 0.01


def test_results_of_another_model_take_the_place_of_the_generator(tmp_path):
    write_results(tmp_path / "results.npy")
    np.save(tmp_path / "000021.npy", joints_of("jump"))
    (tmp_path / "000021.txt").write_text("a man leaps#a/DET man/NOUN leap/VERB#0.0#0.0\nanother caption#x#0.0#0.0\n")
    (tmp_path / "results_len.txt").write_text("30\n20\n")
    chosen = options(sentences=(), results=tmp_path, rate_hz=None)
    recordings = text_motion.list_recordings(chosen)
    assert [(r.recording_id, r.class_name) for r in recordings] == [
        ("000021/0", "a man leaps"), ("results/0", "a person walks"), ("results/1", "a person dances"),
    ]  # fmt: skip
    assert recordings[2].files == (tmp_path / "results.npy",)
    pose, positions, t_us = smpl_of(recordings[2], chosen)
    assert len(pose) == 20 and t_us[1] == 50_000
    rotations, transl = procedural.sample_pose("dance", np.arange(20) / 20, np.random.default_rng(3))
    root = axis_angle_from_matrix(rotations[:, 0])
    # Turned with the camera, so compare how far the pelvis turns between frames.
    turned = [matrix_from_axis_angle(vectors) for vectors in (pose[:, :3], root)]
    steps = [np.trace(np.swapaxes(r[:-1], -1, -2) @ r[1:], axis1=1, axis2=2) for r in turned]
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-4)
    moved = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    np.testing.assert_allclose(moved, np.linalg.norm(np.diff(transl, axis=0), axis=1), atol=1e-4)
    only = text_motion.list_recordings(options(sentences=("a person dances",), results=tmp_path / "results.npy"))
    assert [recording.recording_id for recording in only] == ["results/1"]


def test_bad_sentences_and_results_are_named(tmp_path):
    with pytest.raises(DataError, match=r"unknown word 'moonwalks'"):
        text_motion.list_recordings(options(sentences=("a person walks", "a person moonwalks")))
    with pytest.raises(DataError, match="would get the same recording id"):
        text_motion.list_recordings(options(sentences=("A person walks", "a person walks!")))
    with pytest.raises(DataError, match="no such file or folder"):
        text_motion.list_recordings(options(results=tmp_path / "nothing"))
    with pytest.raises(DataError, match="found none"):
        text_motion.list_recordings(options(results=tmp_path))
    write_results(tmp_path / "results.npy")
    with pytest.raises(DataError, match="no motion of the sentence 'a person flies'; there are: a person dances; "):
        text_motion.list_recordings(options(sentences=("a person flies",), results=tmp_path))
    np.save(tmp_path / "vectors.npy", np.zeros((10, 263)))
    with pytest.raises(DataError, match="not a motion file of a known format"):
        text_motion.list_recordings(options(results=tmp_path))


def test_long_sentences_get_short_and_different_ids():
    long = "a person " + ", then ".join(["walks", "jumps"] * 8)
    recordings = text_motion.list_recordings(options(sentences=(long, f"{long} twice")))
    ids = {recording.recording_id for recording in recordings}
    assert len(ids) == 2 and max(map(len, ids)) <= 63


def test_sentences_go_through_the_first_stage(home):
    chosen = DatasetChoice(name="text_motion", options={"sentences": ["a person walks"], "max_moments": 4})
    arguments = {"dataset": chosen}
    recordings = read_manifest(ingest.run(ingest.key(arguments, Store()), arguments)[0])
    labels = labels_of(recordings.attached(tables.LABELS))
    assert recordings.column("splits") == ["condition"] and set(labels.class_names) == {"a person walks"}
    assert labels.smpl_transl is not None and labels.smpl_transl.shape == (4, 3)
