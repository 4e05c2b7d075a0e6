"""The studio: splits, reproducibility, and labels that lie where the events are."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from ctlev_core.body.keyframes import HELD_OUT, SEEN, UNSEEN
from ctlev_core.datasets import studio
from data_contracts.errors import DataError
from data_contracts.events import check_events
from data_contracts.labels import check_labels

OPTIONS = studio.Options(num_train_recordings=24, num_test_recordings=40, num_condition_recordings=26)
RECORDINGS = studio.list_recordings(OPTIONS)


def of_split(split):
    return [recording for recording in RECORDINGS if recording.parts[0].split == split]


def same_events(first, second):
    return len(first) == len(second) and all(
        np.array_equal(getattr(first, name), getattr(second, name)) for name in ("t", "x", "y", "p")
    )


def test_splits_share_no_subject_and_held_out_motions_are_in_tests_alone():
    subjects = {split: {r.subject for r in of_split(split)} for split in studio.SPLIT_NAMES}
    assert subjects["train"] == {f"subject{i}" for i in range(4)}
    assert subjects["test"] == {"subject4", "subject5"}
    assert len(subjects["condition"]) == 26 and not subjects["condition"] & (subjects["train"] | subjects["test"])
    motions = {split: {r.class_name for r in of_split(split)} for split in studio.SPLIT_NAMES}
    assert motions == {"train": set(SEEN), "test": set(SEEN + UNSEEN + HELD_OUT), "condition": set(UNSEEN)}
    assert len({r.recording_id for r in RECORDINGS}) == len(RECORDINGS) == 90
    # Every training subject performs every motion.
    assert len({(r.subject, r.class_name) for r in of_split("train")}) == 16


def test_recording_ids_say_what_they_are():
    assert RECORDINGS[5].recording_id == "train/subject1_run_00005"
    assert all(recording.has_events == (recording.parts[0].split != "condition") for recording in RECORDINGS)


def test_a_recording_depends_on_nothing_but_seed_and_index():
    chosen = [RECORDINGS[i] for i in (7, 30, 2)]
    alone = [studio.read_events(recording, OPTIONS) for recording in chosen]
    with ThreadPoolExecutor(3) as threads:
        together = list(threads.map(lambda recording: studio.read_events(recording, OPTIONS), chosen[::-1]))
    assert all(same_events(a, b) for a, b in zip(alone, together[::-1], strict=True))
    more = OPTIONS.model_copy(update={"num_train_recordings": 100})
    assert same_events(studio.read_events(chosen[0], more), alone[0])
    other_seed = OPTIONS.model_copy(update={"seed": 1})
    assert not same_events(studio.read_events(chosen[0], other_seed), alone[0])


def test_recordings_of_one_motion_and_subject_differ():
    first, second = RECORDINGS[0], RECORDINGS[16]
    assert (first.subject, first.class_name) == (second.subject, second.class_name)
    assert (
        np.abs(studio.read_labels(first, OPTIONS).joints2d[0] - studio.read_labels(second, OPTIONS).joints2d[0]).max()
        > 3
    )


@pytest.mark.parametrize("recording", RECORDINGS[:4] + RECORDINGS[24:64:5], ids=lambda r: r.recording_id)
def test_events_and_labels_keep_their_contracts(recording):
    events = check_events(studio.read_events(recording, OPTIONS), recording.recording_id)
    labels = check_labels(studio.read_labels(recording, OPTIONS), recording.recording_id)
    assert events.sensor_size == (64, 64) and events.t[-1] <= OPTIONS.recording_duration_us
    assert labels.t_us.tolist() == list(range(0, 250_001, 5000)) and labels.joint_set == "dhp19"
    assert set(labels.class_names) == {recording.class_name}
    assert labels.visible.mean() > 0.8
    # A window of 700 events, the size the experiments use, spans a part of the recording.
    assert 700 < len(events) < 20_000


def test_events_are_where_the_labels_are():
    """Without noise, events lie on the body: within a hand's breadth (8 px are 30 cm) of a limb."""
    options = OPTIONS.model_copy(update={"sensor_preset": "ideal", "textured": False})
    limbs = [
        (0, 1),
        (0, 2),
        (1, 3),
        (2, 4),
        (3, 7),
        (4, 8),
        (1, 5),
        (2, 6),
        (5, 9),
        (6, 10),
        (9, 11),
        (10, 12),
        (1, 2),
        (5, 6),
    ]
    close = []
    for recording in of_split("train")[:6]:
        events, labels = studio.read_events(recording, options), studio.read_labels(recording, options)
        row = np.abs(events.t[:, None] - labels.t_us).argmin(axis=1)
        joints = labels.joints2d[row].astype(float)
        start, end = joints[:, [a for a, _ in limbs]], joints[:, [b for _, b in limbs]]
        point = np.stack([events.x, events.y], axis=1)[:, None] + 0.5
        along = np.sum((point - start) * (end - start), -1) / np.maximum(np.sum((end - start) ** 2, -1), 1e-9)
        nearest = start + np.clip(along, 0, 1)[..., None] * (end - start)
        close.append(np.linalg.norm(point - nearest, axis=-1).min(axis=1) < 8)
    assert np.concatenate(close).mean() > 0.99


def test_labels_do_not_depend_on_their_rate():
    fine = studio.read_labels(RECORDINGS[1], OPTIONS)
    coarse = studio.read_labels(RECORDINGS[1], OPTIONS.model_copy(update={"label_rate_hz": 50.0}))
    np.testing.assert_allclose(coarse.joints2d, fine.joints2d[::4], atol=1e-4)


def test_frames_are_intensities_in_time():
    frames, t_us = studio.read_frames(RECORDINGS[0], OPTIONS)
    assert frames.shape == (63, 64, 64) and frames.dtype == np.float32 and t_us[1] == 4000
    assert frames.min() > 0 and frames.max() <= 1
    assert np.abs(np.diff(frames, axis=0)).max() > 0.05


def test_condition_recordings_are_one_visible_moment():
    joints = []
    for recording in of_split("condition"):
        labels = check_labels(studio.read_labels(recording, OPTIONS), recording.recording_id)
        assert labels.t_us.tolist() == [0] and labels.visible.mean() > 0.8
        joints.append(labels.joints2d[0])
    assert np.std(joints, axis=0).mean() > 2
    with pytest.raises(DataError, match="labels only"):
        studio.read_events(of_split("condition")[0], OPTIONS)


def test_other_sensor_sizes_and_durations():
    options = OPTIONS.model_copy(update={"sensor_size": (96, 72), "recording_duration_us": 20_000})
    recording = studio.list_recordings(options)[0]
    events = studio.read_events(recording, options)
    assert events.sensor_size == (96, 72) and (events.t <= 20_000).all() and events.x.max() > 64


def test_unknown_recordings_are_refused():
    wrong = [
        replace(RECORDINGS[0], recording_id="train/subject0_walk_x"),
        replace(RECORDINGS[0], recording_id="train/subject1_walk_00000"),
        replace(RECORDINGS[0], subject="subject5"),
        replace(RECORDINGS[0], recording_id="nothing"),
    ]
    for recording in wrong:
        with pytest.raises(DataError, match="has no recording"):
            studio.read_labels(recording, OPTIONS)


def test_sensors_differ_but_stay_themselves():
    """Hot pixels are the same ones in all recordings of a sensor: two sensors, two sets."""
    always = []
    for recording in of_split("train")[:8]:
        events = studio.read_events(recording, OPTIONS)
        counts = np.bincount(events.y.astype(int) * 64 + events.x, minlength=4096)
        corner = counts.reshape(64, 64)[:, :8]
        always.append(frozenset(np.flatnonzero(corner.ravel() >= 6)))
    groups = [{i for i in range(8) if always[i] & always[first]} for first in range(8) if always[first]]
    assert groups and all(len(group) >= 2 for group in groups)


def test_importing_the_plugin_is_cheap():
    code = "import sys; import ctlev_core.datasets.studio, ctlev_core.conditions.skeleton, ctlev_core.conditions.text;"
    code += "print([name for name in ('torch', 'numba', 'cv2', 'scipy') if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_joints_that_the_body_hides_can_be_left_out():
    hidden = OPTIONS.model_copy(update={"occlusion": True})
    visible, in_sight = (
        np.concatenate([studio.read_labels(recording, options).visible for recording in of_split("condition")])
        for options in (OPTIONS, hidden)
    )
    assert not (in_sight & ~visible).any() and 0.4 < in_sight.sum() / visible.sum() < 0.95
