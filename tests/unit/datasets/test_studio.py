"""The studio: splits, reproducibility, and labels that lie where the events are."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from ctlev_core.body.layer import joint_transforms
from ctlev_core.body.motion.keyframes import HELD_OUT, SEEN, UNSEEN
from ctlev_core.datasets import studio
from ctlev_core.geometry.joint_sets import JOINT_SETS, SMPL_TO_DHP19
from ctlev_core.sensor.dvs_pixel import PRESETS, EventBudgetError, simulate_events
from data_contracts.config import cache_material
from data_contracts.errors import DataError
from data_contracts.events import check_events
from data_contracts.labels import Part, check_image_track, check_labels

OPTIONS = studio.Options(num_train_recordings=24, num_test_recordings=40, num_condition_recordings=26)
RECORDINGS = studio.list_recordings(OPTIONS)


def changed(**changes):
    return studio.Options(**OPTIONS.model_dump() | changes)


def of_split(split):
    return [recording for recording in RECORDINGS if recording.parts[0].split == split]


def same_events(first, second):
    return len(first) == len(second) and all(
        np.array_equal(getattr(first, name), getattr(second, name)) for name in ("t", "x", "y", "p")
    )


def test_splits_share_no_subject_and_held_out_motions_are_in_tests_alone():
    splits = ("train", "test", "condition")
    subjects = {split: {r.subject for r in of_split(split)} for split in splits}
    assert subjects["train"] == {f"subject{i}" for i in range(4)}
    assert subjects["test"] == {"subject4", "subject5"}
    assert len(subjects["condition"]) == 26 and not subjects["condition"] & (subjects["train"] | subjects["test"])
    motions = {split: {r.class_name for r in of_split(split)} for split in splits}
    assert motions == {"train": set(SEEN), "test": set(SEEN + UNSEEN + HELD_OUT), "condition": set(UNSEEN)}
    assert len({r.recording_id for r in RECORDINGS}) == len(RECORDINGS) == 90
    # Every training subject performs every motion.
    assert len({(r.subject, r.class_name) for r in of_split("train")}) == 16


def test_validation_recordings_show_further_people_and_change_no_others():
    more = changed(num_validation_recordings=30)
    recordings = studio.list_recordings(more)
    assert recordings[: len(RECORDINGS)] == RECORDINGS
    added = recordings[len(RECORDINGS) :]
    assert {r.parts for r in added} == {(Part("validation"),)} and len(added) == 30
    assert {r.subject for r in added} == {"subject6", "subject7"}
    assert {r.class_name for r in added} == set(SEEN + UNSEEN)
    assert len(studio.read_events(added[0], more)) > 0
    assert "num_validation_recordings" not in cache_material(OPTIONS)


def test_tests_can_show_the_people_and_motions_of_training():
    alike = changed(in_distribution_tests=True)
    recordings = studio.list_recordings(alike)
    training, tests = (
        [recording for recording in recordings if recording.parts[0].split == split] for split in ("train", "test")
    )
    assert {(r.subject, r.class_name) for r in tests} == {(f"{r.subject}_again", r.class_name) for r in training}
    assert [r.recording_id for r in training] == [r.recording_id for r in of_split("train")]
    first, again = studio.read_labels(training[0], alike), studio.read_labels(tests[0], alike)
    np.testing.assert_array_equal(first.smpl_betas[0], again.smpl_betas[0])  # the same person
    assert not np.array_equal(first.joints2d, again.joints2d)  # who moves otherwise
    assert "in_distribution_tests" in cache_material(alike)
    assert "in_distribution_tests" not in cache_material(OPTIONS)  # recordings made before keep their keys


def test_condition_people_can_be_recorded_for_training():
    recorded = changed(record_conditions=True, num_train_recordings=0, num_test_recordings=1, num_cameras=2)
    recordings = [r for r in studio.list_recordings(recorded) if r.recording_id.startswith("condition/")]
    assert [r.recording_id for r in recordings] == [r.recording_id for r in of_split("condition")]
    assert all(r.has_events and r.parts[0].split == "train" for r in recordings)
    for recording, label_only in zip(recordings[:3], of_split("condition")[:3], strict=True):
        labels, asked = studio.read_labels(recording, recorded), studio.read_labels(label_only, OPTIONS)
        shared = np.isin(labels.t_us, asked.t_us)
        assert shared.sum() >= 3  # 5 ms against 20.8 ms: 0, 125 and 250 ms at least
        np.testing.assert_array_equal(labels.joints2d[shared], asked.joints2d[np.isin(asked.t_us, labels.t_us)])
        assert len(check_events(studio.read_events(recording, recorded), recording.recording_id)) > 100


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


@pytest.mark.parametrize("split", ["train", "condition"])
def test_intensity_frames_are_pictures_in_time(split):
    assert not any(recording.has_intensity for recording in RECORDINGS)
    options = changed(intensity_rate_hz=40.0, brightness=(0.5, 0.5))
    recording = next(r for r in studio.list_recordings(options) if r.parts[0].split == split)
    assert recording.has_intensity
    track = check_image_track(studio.read_intensity_frames(recording, options), "test")
    assert track.images.shape == (11, 64, 64) and track.t_us.tolist() == list(range(0, 250_001, 25_000))
    # Something moves, and half the light is half the intensity.
    assert np.abs(np.diff(track.images.astype(int), axis=0)).max() > 20
    bright = studio.read_intensity_frames(recording, changed(intensity_rate_hz=40.0)).images
    assert np.abs(2.0 * track.images - bright).max() <= 1.5
    with pytest.raises(DataError, match="intensity_rate_hz"):
        studio.read_intensity_frames(RECORDINGS[0], OPTIONS)


def test_condition_recordings_are_tracks_of_labels():
    joints, shapes = [], []
    for recording in of_split("condition"):
        labels = check_labels(studio.read_labels(recording, OPTIONS), recording.recording_id)
        np.testing.assert_array_equal(labels.t_us, np.rint(np.linspace(0, 250_000, 13)))  # 50 Hz, both ends
        assert labels.visible.mean() > 0.8
        joints.append(labels.joints2d)
        shapes.append(labels.smpl_betas[0])
    assert np.std([track[0] for track in joints], axis=0).mean() > 2
    assert np.median([np.ptp(track, axis=0).max() for track in joints]) > 2  # they move
    assert len(np.unique(shapes, axis=0)) == len(shapes)
    with pytest.raises(DataError, match="has no events"):
        studio.read_events(of_split("condition")[0], OPTIONS)
    coarse = changed(condition_rate_hz=1.0)
    assert studio.read_labels(studio.list_recordings(coarse)[-1], coarse).t_us.tolist() == [0, 250_000]


def test_cameras_stand_around_the_same_performance():
    options = changed(num_cameras=4, num_sensors=1)
    views = studio.list_recordings(options)[4:8]
    assert [view.recording_id for view in views] == [f"train/subject0_run_00001_cam{i}" for i in range(4)]
    assert len(studio.list_recordings(options)) == 4 * (24 + 40) + 26
    labels = [studio.read_labels(view, options) for view in views]
    records = [studio.read_scene(view, options) for view in views]
    for track, record in zip(labels[1:], records[1:], strict=True):
        assert np.array_equal(track.t_us, labels[0].t_us)
        np.testing.assert_allclose(track.smpl_pose[:, 3:], labels[0].smpl_pose[:, 3:], atol=1e-5)
        # One rigid motion carries what one camera sees to what the other sees: all distances, over time too, agree.
        points, first = (each.joints3d.reshape(-1, 3).astype(np.float64) for each in (track, labels[0]))
        np.testing.assert_allclose(
            np.linalg.norm(points[::7, None] - points[::7], axis=-1),
            np.linalg.norm(first[::7, None] - first[::7], axis=-1),
            atol=0.01,
        )
        assert np.abs(track.joints2d[0] - labels[0].joints2d[0]).max() > 3
        # The lamp stands where it is.
        lamps = [each._painter.camera.R.T @ each._painter.light.direction for each in (record, records[0])]
        np.testing.assert_allclose(*lamps, atol=1e-12)
        assert np.array_equal(record._painter.subject.albedo, records[0]._painter.subject.albedo)
    # From the front, the right, the back and the left: a quarter of the range each.
    yaw_deg = [
        np.rad2deg(np.arctan2(-record._painter.camera.R[2, 0], -record._painter.camera.R[2, 2])) for record in records
    ]
    assert sorted(np.floor(np.mod(yaw_deg, 360) / 90)) == [0, 1, 2, 3]


def test_each_camera_has_a_sensor_of_its_own():
    """Pixels that are busy at the left edge, where nobody is: the same ones in each recording of a camera."""
    options = changed(num_cameras=2, num_sensors=1, noise=8.0)
    busy = []
    for recording in studio.list_recordings(options)[:4]:
        events = studio.read_events(recording, options)
        counts = np.bincount(events.y.astype(int) * 64 + events.x, minlength=4096)
        busy.append(frozenset(np.flatnonzero(counts.reshape(64, 64)[:, :5] >= 10)))

    def overlap(first, second):
        return len(busy[first] & busy[second]) / len(busy[first] | busy[second])

    assert overlap(0, 2) > 0.5 < overlap(1, 3) and overlap(0, 1) < 0.2 > overlap(2, 3)


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_every_sensor_preset_records(preset):
    options = changed(sensor_preset=preset)
    events = studio.read_events(studio.list_recordings(options)[1], options)
    assert len(check_events(events, preset)) > 500


def test_a_sensor_from_a_file_is_an_input(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text("threshold: 0.31\nleak_rate_hz: 2.0\n")
    options = changed(sensor_preset=str(path))
    recordings = studio.list_recordings(options)
    assert recordings[0].files == (path,) and recordings[-1].files == () and not RECORDINGS[0].files
    first = studio.read_events(recordings[1], options)
    path.write_text("threshold: 0.11\n")
    assert len(studio.read_events(recordings[1], options)) > 1.5 * len(first)
    path.write_text("threshold: -1\n")
    with pytest.raises(DataError, match=r"camera\.yaml"):
        studio.list_recordings(options)
    with pytest.raises(DataError, match=r"other\.yaml"):
        studio.list_recordings(changed(sensor_preset=str(tmp_path / "other.yaml")))
    with pytest.raises(ValueError, match=r"clean, noisy, dvs346"):
        changed(sensor_preset="loud")


def test_noise_is_a_matter_of_degree():
    """Corners, where nobody is: silent without noise, and twice the noise sends twice the events."""
    counts = []
    for noise in (0.0, 1.0, 2.0):
        options = changed(noise=noise)
        total = 0
        for recording in of_split("train")[:6]:
            events = studio.read_events(recording, options)
            total += np.count_nonzero((events.x < 6) | (events.x >= 58))
        counts.append(total)
    assert counts[0] < 0.1 * counts[1] and 1.5 < counts[2] / counts[1] < 2.6


@pytest.mark.parametrize("motion", ["run", "punch", "spin_kick"])
def test_pictures_show_what_the_labels_say(motion):
    """Between key poses too, where pictures go straight and labels follow the curve: within a millimetre."""
    options = changed(label_rate_hz=800.0)
    recording = next(r for r in of_split("test") if r.class_name == motion)
    labels, record = studio.read_labels(recording, options), studio.read_scene(recording, options)
    painter = record._painter
    rotations, transl = record.poses_at(1e-6 * labels.t_us)
    _, joints = joint_transforms(painter.body, rotations, painter.subject.betas, transl)
    seen = 1000 * (joints @ painter.camera.R.T + painter.camera.translation)[:, list(SMPL_TO_DHP19)]
    assert np.linalg.norm(seen - labels.joints3d, axis=-1).max() < 1.0


def test_people_are_as_large_as_asked_for():
    spread = []
    for focal in (0.75, 1.5):
        options = changed(focal_per_side=(focal, focal))
        labels = studio.read_labels(RECORDINGS[0], options)
        spread.append(np.ptp(labels.joints2d[0, :, 1]))
    assert spread[1] / spread[0] == pytest.approx(2, rel=1e-4)


def test_events_are_nearly_those_of_many_more_pictures():
    options = changed(sensor_preset="ideal", sensor_size=(96, 96))
    recording = studio.list_recordings(options)[1]
    events = studio.read_events(recording, options)
    record, t_us = studio.read_scene(recording, options), np.arange(0, 250_001, 250)
    dense = simulate_events(record.render_frames(1e-6 * t_us), t_us, PRESETS["ideal"], sensor_seed=0, seed=0)
    assert len(events) == pytest.approx(len(dense), rel=0.1)
    counts = [np.bincount(e.y.astype(int) * 96 + e.x, minlength=96 * 96) for e in (events, dense)]
    assert np.abs(counts[0] - counts[1]).sum() < 0.15 * len(dense)


def test_too_many_events_are_an_error_that_says_where():
    with pytest.raises(EventBudgetError, match=r"'train/subject0_walk_00000'.*max_events = 100 ") as caught:
        studio.read_events(RECORDINGS[0], changed(max_events=100))
    assert 0 < len(caught.value.events) <= 100


LIKE = {
    "dhp19": {"sensor_size": (346, 260), "num_cameras": 4, "recording_duration_us": 30_000},
    "cdehp": {"sensor_size": (1280, 800), "intensity_rate_hz": 60.0, "recording_duration_us": 10_000},
    "smpl": {"sensor_size": (256, 256), "intensity_rate_hz": 25.0, "recording_duration_us": 40_000},
}


@pytest.mark.parametrize("joint_set", LIKE)
def test_recordings_like_those_of_real_datasets(joint_set):
    options = studio.Options(
        joint_set=joint_set, num_train_recordings=1, num_test_recordings=1, num_condition_recordings=1,
        max_displacement_px=2.0, **LIKE[joint_set],
    )  # fmt: skip
    recordings = studio.list_recordings(options)
    assert len(recordings) == 2 * options.num_cameras + 1
    for recording in (recordings[options.num_cameras - 1], recordings[-1]):
        labels = check_labels(studio.read_labels(recording, options), recording.recording_id)
        assert labels.joint_set == joint_set and labels.joints2d.shape[1] == len(JOINT_SETS[joint_set].joints)
        if recording.has_intensity:
            track = check_image_track(studio.read_intensity_frames(recording, options), recording.recording_id)
            assert track.images.shape[1:] == options.sensor_size[::-1]
        if recording.has_events:
            events = check_events(studio.read_events(recording, options), recording.recording_id)
            assert events.sensor_size == options.sensor_size and len(events) > 1000


@pytest.mark.parametrize(
    "wrong",
    [{"focal_per_side": (2.0, 1.0)}, {"distance_m": (0.0, 1.0)}, {"brightness": (0.5, 1.5)}, {"sensor_size": (0, 4)}],
    ids=str,
)
def test_ranges_are_checked(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        studio.Options(**wrong)


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
        replace(RECORDINGS[0], recording_id=f"{RECORDINGS[0].recording_id}_cam0"),
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
