"""Made-up recordings are read as the published ones: labels lie in the picture, and events where they say."""

from __future__ import annotations

import numpy as np
import pytest

from ctlev_core import plugins
from ctlev_core.body.layer import load_body
from ctlev_core.stand_ins import datasets
from ctlev_core.stand_ins.making import STAND_INS, make_stand_in, stand_in_place
from data_contracts.config import DatasetChoice
from data_contracts.errors import DataError
from data_contracts.events import check_events
from data_contracts.labels import check_labels

OPTIONS = {"dhp19": {"condition_subjects": [11, 12]}, "event_hpe": {"condition_subjects": [3]}}
SENSORS = {"n_imagenet": (640, 480), "n_caltech101": (240, 180), "dhp19": (346, 260), "cdehp": (1280, 800),
           "event_hpe": (800, 1280)}  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stand_ins")
    return {name: make_stand_in(name, "tiny", folder) for name in (*SENSORS, "amass", "smpl")}


def opened(name, made):
    plugin = plugins.load_options(DatasetChoice(name=name, options={"root": str(made[name]), **OPTIONS.get(name, {})}))
    return plugin.module, plugin.options, plugin.module.list_recordings(plugin.options)


def is_around(places, joints):
    """Which places [N, 2] lie in the box of the joints, made wider by a quarter of its longer side."""
    low, high = joints.min(axis=0), joints.max(axis=0)
    margin = 0.25 * (high - low).max()
    return ((places > low - margin) & (places < high + margin)).all(axis=1)


@pytest.mark.parametrize("name", SENSORS)
def test_recordings_have_the_splits_and_the_sensor_of_the_dataset(name, made):
    module, options, recordings = opened(name, made)
    splits = {part.split for recording in recordings for part in recording.parts}
    assert splits >= {"train", "test"} and ("condition" in splits) == (name in OPTIONS or name == "n_caltech101")
    with_data = [one for one in recordings if one.has_events or one.has_event_images]
    assert {one.sensor_size for one in with_data} == {SENSORS[name]}
    for recording in with_data[:2]:
        labels = check_labels(module.read_labels(recording, options), name)
        if recording.has_events:
            events = check_events(module.read_events(recording, options), name)
            assert len(events) > 10_000 and events.sensor_size == SENSORS[name]
        if labels.joints2d is not None:
            assert labels.visible is not None and labels.visible.mean() > 0.9


@pytest.mark.parametrize("name", ["dhp19", "event_hpe"])
def test_events_lie_on_the_person(name, made):
    module, options, recordings = opened(name, made)
    recording = next(one for one in recordings if one.has_events)
    events, labels = module.read_events(recording, options), module.read_labels(recording, options)
    row = len(labels) // 2
    near, joints = np.abs(events.t - labels.t_us[row]) < 100_000, labels.joints2d[row]
    assert near.sum() > 1000
    assert is_around(np.stack([events.x[near], events.y[near]], axis=1), joints).mean() > 0.95
    assert 0.3 * min(SENSORS[name]) < np.ptp(joints, axis=0).max() < max(SENSORS[name])


def test_event_images_of_cdehp_show_the_person_and_have_grey_pictures(made):
    module, options, recordings = opened("cdehp", made)
    recording = next(one for one in recordings if one.has_event_images)
    images, labels = module.read_event_images(recording, options), module.read_labels(recording, options)
    assert images.t_us.tolist() == labels.t_us.tolist()
    rows, columns = np.nonzero(images.images[5])
    assert len(rows) > 1000 and is_around(np.stack([columns, rows], axis=1), labels.joints2d[5]).mean() > 0.95
    grey = module.read_intensity_frames(recording, options)
    assert grey.images.shape == (datasets.CDEHP_FRAMES // 2, 480, 848)


def test_body_and_motions(made):
    body = load_body(made["smpl"])
    assert body.posedirs is not None and np.allclose(body.v_template, load_body().v_template)
    module, options, recordings = opened("amass", made)
    labels = module.read_labels(recordings[0], options)
    # Seen by the virtual camera, which is in front: 3 m away and more.
    assert len(recordings) == datasets.AMASS_MOTIONS and (labels.smpl_transl[:, 2] > 1).all()


def test_a_stand_in_is_made_once_and_whole(tmp_path, monkeypatch):
    place = make_stand_in("amass", "tiny", tmp_path)
    first = place / "CMU/01/01_01_poses.npz"
    written = first.stat().st_mtime_ns
    assert make_stand_in("amass", "full", tmp_path) == place and first.stat().st_mtime_ns == written

    def fail(root):
        (root / "half").write_text("")
        raise OSError("no more")

    monkeypatch.setattr(datasets, "write_dhp19", fail)
    with pytest.raises(OSError, match="no more"):
        make_stand_in("dhp19", "tiny", tmp_path)
    assert not stand_in_place("dhp19", "tiny", tmp_path).exists() and [path.name for path in tmp_path.iterdir()] == [
        place.name
    ]


def test_equal_recordings_each_time(made, tmp_path):
    for name in ("event_hpe", "n_caltech101"):
        again = make_stand_in(name, "tiny", tmp_path)
        files = sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
        assert files and all((again / file).read_bytes() == (made[name] / file).read_bytes() for file in files)


def test_a_full_disk_is_told_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("", (), {"free": 1e9})())
    with pytest.raises(DataError, match=r"Stable Diffusion v1 of random weights needs 2.4 GB, 1.0 are free"):
        make_stand_in("stable_diffusion", "full", tmp_path)
    assert STAND_INS["stable_diffusion"].megabytes == 2140 and not list(tmp_path.iterdir())
