"""DHP19's raw recordings in the published layout, against the authors' rules."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dhp19_writers import SPECIAL, START, address, busy, matrix, write_aedat, write_vicon

from ctlev_core.dataset_files import dhp19_files
from ctlev_core.datasets import dhp19
from ctlev_core.geometry.camera import project
from data_contracts.errors import DataError
from data_contracts.labels import Part, check_labels


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Subjects 1 and 13, one movement each, 40 events of each camera over 1.6 ms, 1 s of motion capture."""
    for subject in (1, 13):
        records = [(address(0, 1, 1), 1000), (SPECIAL, START), (SPECIAL, START + 1), *busy(160)]
        records.append((SPECIAL, START + 1_000_000))
        write_aedat(tmp_path / f"DVS_movies/S{subject}/session1/mov2.aedat", records)
        write_vicon(tmp_path / f"Vicon_data/S{subject}_1_2.mat")
    (tmp_path / "P_matrices").mkdir()
    for number in (1, 2, 3, 4):
        np.save(tmp_path / f"P_matrices/P{number}.npy", matrix(number))
    (tmp_path / "readme.txt").write_text("about")
    return tmp_path


def options(root: Path, **changes) -> dhp19.Options:
    return dhp19.Options(**({"root": root, "filters": False} | changes))


def first(root: Path, **changes):
    return dhp19.list_recordings(options(root, **changes))[0], options(root, **changes)


def test_one_recording_a_movement_and_camera_split_by_subject(root):
    recordings = dhp19.list_recordings(dhp19.Options(root=root))
    assert [r.recording_id for r in recordings] == [f"S{s}/session1/mov2/cam{c}" for s in (1, 13) for c in (2, 3)]
    assert [r.parts for r in recordings] == [(Part("train"),)] * 2 + [(Part("test"),)] * 2
    assert recordings[0].subject == "S1" and recordings[0].class_name == "session1_mov2"
    assert [path.name for path in recordings[1].files] == ["mov2.aedat", "S1_1_2.mat", "P3.npy"]
    assert all(r.has_events and not r.has_event_images for r in recordings)


def test_movements_are_in_the_order_of_their_numbers_and_can_be_chosen(root):
    for movement in (10, 3):
        write_aedat(root / f"DVS_movies/S1/session1/mov{movement}.aedat", busy(1))
        write_vicon(root / f"Vicon_data/S1_1_{movement}.mat")
    ids = [r.recording_id for r in dhp19.list_recordings(options(root, cameras=(4,), subjects=(1,)))]
    assert ids == [f"S1/session1/mov{m}/cam4" for m in (2, 3, 10)]
    assert len(dhp19.list_recordings(options(root, cameras=(1, 4), movements=(3, 10)))) == 4
    with pytest.raises(DataError, match=r"no movement of the subjects.*asked for, 4 others, the first S1/1/2"):
        dhp19.list_recordings(options(root, sessions=(5,)))
    validation = dhp19.list_recordings(options(root, validation_subjects=(1,), movements=(2,)))
    assert [r.parts[0].split for r in validation] == ["validation"] * 2 + ["test"] * 2


def test_condition_subjects_give_labels_only(root):
    recordings = dhp19.list_recordings(options(root, condition_subjects=(1,)))
    assert [r.parts[0].split for r in recordings] == ["condition"] * 2 + ["test"] * 2
    labels_only = recordings[0]
    assert not labels_only.has_events and [path.name for path in labels_only.files] == ["S1_1_2.mat", "P2.npy"]
    assert len(dhp19.read_labels(labels_only, options(root))) == 100
    with pytest.raises(ValueError, match=r"subjects \[13\] are named more than once"):
        options(root, condition_subjects=(13,))


def test_the_recordings_the_authors_removed_are_left_out(root):
    for movement in (3, 4):
        write_aedat(root / f"DVS_movies/S4/session3/mov{movement}.aedat", busy(1))
        write_vicon(root / f"Vicon_data/S4_3_{movement}.mat")
    ids = [r.recording_id for r in dhp19.list_recordings(options(root, subjects=(4,)))]
    assert ids == ["S4/session3/mov3/cam2", "S4/session3/mov3/cam3"]


def test_events_are_upright_and_start_with_the_motion_capture(root):
    corners = [(0, 0, 1), (345, 0, 0), (0, 259, 1), (345, 259, 0)]
    records = [(SPECIAL, START), (SPECIAL, START), (SPECIAL, START + 1_000_000)]
    # Bits as ImportAedatDataVersion1or2.m reads them: y 22..30, x 12..21, polarity 11, camera 0..3.
    records += [
        ((259 - y) << 22 | (345 - x) << 12 | p << 11 | 3, START + 10 + i) for i, (x, y, p) in enumerate(corners)
    ]
    records.sort(key=lambda record: record[1])
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", records)
    events = dhp19.read_events(*first(root))  # camera 2 is channel 3
    assert [*zip(events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True)] == corners
    assert events.t.tolist() == [10, 11, 12, 13] and events.sensor_size == (346, 260)


@pytest.mark.parametrize(("camera", "channel"), [(1, 1), (2, 3), (3, 2), (4, 0)])
def test_each_camera_has_its_channel(root, camera, channel):
    records = [(SPECIAL, START), (SPECIAL, START), *busy(8), (SPECIAL, START + 1_000_000)]
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", records)
    events = dhp19.read_events(*first(root, cameras=(camera,)))
    assert events.t.tolist() == [1 + 10 * channel, 41 + 10 * channel]


def test_events_outside_the_sensor_and_picture_samples_are_dropped(root):
    good = address(3, 5, 6)
    outside = [good | 0x200 << 12, 260 << 22 | 3, good | 0x4, 1 << 31 | good]
    records = [
        (SPECIAL, START),
        *[(a, START + 5) for a in [*outside, good]],
        (SPECIAL, START + 10),
        (SPECIAL, START + 11),
    ]
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", records)
    events = dhp19.read_events(*first(root))
    assert (events.x.tolist(), events.y.tolist()) == ([5], [6])


def test_filters_see_the_four_cameras_as_one_picture(root):
    """An isolated event is noise; one beside it is not. A seam between two channels is a neighbourhood."""
    isolated, beside = (address(3, 0, 100), START + 100), (address(2, 345, 101), START + 50)
    records = [(SPECIAL, START), beside, isolated, (SPECIAL, START + 999), (SPECIAL, START + 1000)]
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", records)
    assert len(dhp19.read_events(*first(root))) == 1
    assert dhp19.read_events(*first(root, filters=True)).t.tolist() == [100]
    with pytest.raises(DataError, match=r"S1/session1/mov2/cam3: expected a recording, got no events of this camera"):
        dhp19.read_events(dhp19.list_recordings(options(root))[1], options(root, filters=True))


SPANS = [
    ([], (1000, 9000)),
    ([2000], (2000, 5000)),
    ([7000], (4000, 7000)),
    ([2000, 2001], (2000, 5000)),
    ([7000, 7001], (4000, 7000)),
    ([2000, 2001, 8000], (2000, 8000)),
    ([2000, 2000, 2000, 2001], (2000, 5000)),
    ([2000, 2000, 2000, 2001, 8000], (2000, 8000)),
]


@pytest.mark.parametrize(("special", "expected"), SPANS)
def test_start_and_stop_follow_the_authors_cases(special, expected, monkeypatch):
    monkeypatch.setattr(dhp19_files, "VICON_PERIOD_US", 1000)
    stamp = np.array([1000, 3000, 9000])
    assert dhp19_files.recorded_span(stamp, np.array(special, int), 3, "x") == expected


def test_a_clock_that_overflows_goes_on(root):
    top = 2**32 - 40
    stamps = [top, top + 10, top + 20, top + 30, 5, 15]
    records = [(SPECIAL, top + 10), (SPECIAL, top + 10)] + [(address(3, 5, 6), t) for t in stamps]
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", records[2:4] + records[:2] + records[4:])
    assert dhp19.read_events(*first(root)).t.tolist() == [10, 20, 35, 45]


def test_a_clock_that_starts_anew_counts_up_to_there_as_in_the_authors_code(root):
    stamps = [8000, 8010, 8020, 8030, 5, 15]
    records = [(address(3, 5, 6), t) for t in stamps]
    triggers = [(SPECIAL, 8010), (SPECIAL, 8010)]
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", [records[0], *triggers, *records[1:]])
    assert dhp19.read_events(*first(root)).t.tolist() == [0, 10, 20]


def test_times_that_go_back_are_refused(root):
    records = [(SPECIAL, START), *[(address(3, 5, 6), START + t) for t in (5, 9, 7, 11)], (SPECIAL, START + 1)]
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", records)
    with pytest.raises(DataError, match=r"DHP19 S1/session1/mov2/cam2: t decreases at event 2: 9 us, then 7 us"):
        dhp19.read_events(*first(root))


def test_a_recording_with_a_damaged_clock_is_refused(root):
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", [(SPECIAL, START + i) for i in range(700)] + busy(4))
    with pytest.raises(DataError, match=r"mov2\.aedat: expected at most 5 special events, got 700"):
        dhp19.read_events(*first(root))


def test_a_recording_without_events_is_an_error(root):
    path = write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", [(SPECIAL, START)])
    with pytest.raises(DataError, match=r"mov2\.aedat: expected events of four cameras, got 1 special events"):
        dhp19.read_events(*first(root))
    write_aedat(path, [(SPECIAL, START), (SPECIAL, START), (SPECIAL, START + 9), *busy(4)])
    assert len(dhp19.read_events(*first(root, cameras=(4,)))) == 1
    write_aedat(path, [(SPECIAL, START), (SPECIAL, START), (SPECIAL, START + 9), *busy(4, start=START + 10)])
    with pytest.raises(DataError, match=r"mov2/cam2: expected a recording, got no events of this camera among 0"):
        dhp19.read_events(*first(root))


def slow_windows(stream, num_rows, channel, size):
    """The authors' loop: ranges of one channel and last_k, k from 1."""
    ranges, rows, counter, own, begin, last_k = [], [], 0, 0, 0, 1
    for t, c in zip(stream.t.tolist(), stream.channel.tolist(), strict=True):
        counter += 1
        own += c == channel
        if counter >= size:
            k = int(np.floor(t * 1e-4 + 0.5)) + 1  # uint32 * double rounds in MATLAB
            if k > num_rows:
                break
            ranges.append([begin, own])
            rows.append((last_k, k))
            last_k, counter, begin = k, 0, own
    return ranges, rows


@pytest.mark.parametrize("seed", range(4))
def test_windows_close_when_the_four_cameras_together_have_enough_events(root, seed):
    random = np.random.default_rng(seed)
    times = START + 1 + np.cumsum(random.choice([1, 5_000, 20_000], 150))
    # Channel 3 is silent for a while: its windows there are empty, and still counted.
    channels = np.where(np.arange(150) // 30 == 1, 0, random.integers(0, 4, 150))
    records = [(address(int(c), 100, 100), int(t)) for c, t in zip(channels, times, strict=True)]
    records = [(SPECIAL, START), (SPECIAL, START), *records, (SPECIAL, int(times[-1]) + 1)]
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", records)
    vicon = write_vicon(root / "Vicon_data/S1_1_2.mat", rows=60)
    recording, chosen = first(root, events_per_window=10)
    ranges = dhp19.read_windows(recording, chosen)
    stream = dhp19_files.read_stream(recording.files[0], 60, False)
    expected, rows = slow_windows(stream, 60, 3, 10)
    assert ranges.tolist() == expected and ranges.dtype == np.int64
    assert len(expected) < 15, "the motion capture should have ended first"
    assert any(start == stop for start, stop in expected)
    of_camera_3 = dhp19.list_recordings(chosen)[1]
    assert len(dhp19.read_windows(of_camera_3, chosen)) == len(ranges)
    labels = dhp19.read_window_labels(recording, chosen)
    camera = dhp19.read_camera(recording, chosen)
    means = np.stack([vicon[last - 1 : k].mean(axis=0) for last, k in rows])
    np.testing.assert_allclose(labels.joints2d, project(camera, means / 1000), atol=1e-4)


@pytest.mark.parametrize(("end_us", "count"), [(594_999, 2), (595_000, 1), (600_000, 1)])
def test_the_last_window_is_that_whose_end_is_nearest_a_row(root, end_us, count):
    """60 rows: 594,999 us is nearest the last one, row 59; from 595,000 us on it would be row 60."""
    times = [START + t for t in (5, 100_000, 200_000, end_us)]
    records = [(SPECIAL, START), (SPECIAL, START), *[(address(3, 9, 9), t) for t in times], (SPECIAL, START + 900_000)]
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", records)
    vicon = write_vicon(root / "Vicon_data/S1_1_2.mat", rows=60)
    recording, chosen = first(root, events_per_window=2)
    assert len(dhp19.read_windows(recording, chosen)) == count
    labels = dhp19.read_window_labels(recording, chosen)
    camera = dhp19.read_camera(recording, chosen)
    expected = project(camera, np.stack([vicon[:11].mean(axis=0), vicon[10:].mean(axis=0)])[:count] / 1000)
    np.testing.assert_allclose(labels.joints2d, expected, atol=1e-4)


def test_a_window_ends_with_the_thirty_thousandth_event_after_filtering(root):
    records = busy(120_001, step=7)
    records = [(SPECIAL, START), (SPECIAL, START), *records, (SPECIAL, START + 10_000_000)]
    write_aedat(root / "DVS_movies/S1/session1/mov2.aedat", records)
    write_vicon(root / "Vicon_data/S1_1_2.mat", rows=1000)
    recording, chosen = first(root)
    assert dhp19.read_windows(recording, chosen).tolist() == [[7500 * i, 7500 * (i + 1)] for i in range(4)]
    # Each pixel has 30,000 events, which makes it hot.
    assert dhp19.read_windows(recording, dhp19.Options(root=root)).shape == (0, 2)


def test_labels_are_the_motion_capture_seen_by_the_camera(root):
    shoulder = np.full((100, 3), np.nan)
    vicon = write_vicon(root / "Vicon_data/S1_1_2.mat", shoulderR=shoulder)
    recording, chosen = first(root)
    labels = check_labels(dhp19.read_labels(recording, chosen), "x")
    assert labels.joint_set == "dhp19" and labels.t_us.tolist()[:3] == [0, 10_000, 20_000]
    u, v, w = np.einsum("ij,nkj->ikn", matrix(2), np.concatenate([vicon, np.ones((100, 13, 1))], axis=2))
    expected = np.stack([u / w, 260 - v / w], axis=-1).transpose(1, 0, 2)
    seen = np.arange(13) != 1
    np.testing.assert_allclose(labels.joints2d[:, seen], expected[:, seen], rtol=1e-5)
    assert labels.visible[:, seen].all()
    assert (
        np.isnan(labels.joints2d[:, 1]).all()
        and np.isnan(labels.joints3d[:, 1]).all()
        and not labels.visible[:, 1].any()
    )
    camera = dhp19.read_camera(recording, chosen)
    again = labels.joints3d[:, seen].astype(float) @ camera.K.T
    np.testing.assert_allclose(again[..., :2] / again[..., 2:], expected[:, seen], rtol=1e-5)
