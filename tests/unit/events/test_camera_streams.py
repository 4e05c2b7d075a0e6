"""Frames and inertial measurements beside events: files of iniVation's own library are read as it wrote them."""

from pathlib import Path

import numpy as np
import pytest
from davis_recording import SIZE, START, library, measured, pictures, write_davis

import ctlev_core as ctlev
from ctlev_core.video.frames import FrameOptions, open_frames
from data_contracts.errors import DataError

RECORDED = Path(__file__).parents[4] / "shared/real/events/person/tonic_sample.aedat4"


@pytest.fixture
def written(tmp_path):
    return write_davis(tmp_path / "recording.aedat4")


def test_frames_and_their_times(written):
    frames = list(ctlev.read_frames(written))
    # The library notes when an exposure begins; a frame's time is its middle.
    assert [frame.t - START for frame in frames] == [2000, 27_000, 52_000, 77_000, 102_000, 125_000]
    assert [frame.exposure_us for frame in frames] == [4000] * 5 + [0]
    for frame, picture in zip(frames, pictures(), strict=True):
        np.testing.assert_array_equal(frame.pixels, picture)


def test_inertial_measurements(written):
    imu, rows = ctlev.read_imu(written), measured()
    np.testing.assert_array_equal(imu.t, START + 500 * np.arange(700))
    np.testing.assert_array_equal(np.column_stack([imu.temperature, imu.acceleration]), rows[:, :4])
    np.testing.assert_array_equal(np.column_stack([imu.rotation, imu.magnetic_field]), rows[:, 4:])


def test_events_beside_them_are_read_as_before(written):
    events = ctlev.read_events(written)
    assert len(events) == 100 and events.t[0] == START and events.sensor_size == SIZE


def test_frames_are_a_video_in_linear_light(written):
    shown = list(open_frames(written, FrameOptions()))
    assert [time for time, _ in shown] == [0, 25_000, 50_000, 75_000, 100_000, 123_000]
    np.testing.assert_allclose(shown[1][1], pictures()[1] / 255, atol=1e-6)
    colours = pictures()[5] / 255 @ np.array([0.2126, 0.7152, 0.0722])
    np.testing.assert_allclose(shown[5][1], colours, atol=1e-6)
    curved = list(open_frames(written, FrameOptions(gamma=2.2)))
    np.testing.assert_allclose(curved[1][1], (pictures()[1] / 255) ** 2.2, atol=1e-5)


def test_a_simulated_camera_watches_the_recorded_frames(written):
    events = ctlev.simulate_video(written, sensor="ideal")
    assert events.sensor_size == SIZE and len(events) > 100 and events.t[-1] <= 123_000


@pytest.mark.parametrize("read", [lambda path: list(ctlev.read_frames(path)), ctlev.read_imu], ids=["frames", "imu"])
def test_cut_files_are_refused(written, read):
    content = written.read_bytes()
    for end in (40, len(content) // 3, len(content) // 2):
        written.write_bytes(content[:end])
        with pytest.raises(DataError, match="not a complete AEDAT 4 file"):
            read(written)


def test_damaged_files_are_read_or_refused(written):
    """Whatever a wrong byte does to the decoder."""
    content, random = written.read_bytes(), np.random.default_rng(2)
    for _ in range(12):
        damaged = bytearray(content)
        for place in random.integers(20, len(content), 3):
            damaged[place] = random.integers(256)
        written.write_bytes(damaged)
        for read in (lambda path: list(ctlev.read_frames(path)), ctlev.read_imu):
            try:
                read(written)
            except DataError as error:
                assert str(written) in str(error)


def test_files_without_such_streams_are_refused(tmp_path):
    dv, path = library(), tmp_path / "events.aedat4"
    config = dv.io.MonoCameraWriter.Config("DVXplorer_1")
    config.addEventStream(SIZE)
    dv.io.MonoCameraWriter(str(path), config)
    with pytest.raises(DataError, match="expected one stream of frames, got 0"):
        next(ctlev.read_frames(path))
    with pytest.raises(DataError, match="expected one stream of inertial measurements, got 0"):
        ctlev.read_imu(path)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "a.csv").write_text("0 1 2 1\n")
    for name, found in (("a.csv", "another file"), ("b.aedat4", "nothing there"), ("", "a folder")):
        with pytest.raises(DataError, match=f"AEDAT 4 files, got {found}"):
            ctlev.read_imu(tmp_path / name)


@pytest.mark.skipif(not RECORDED.is_file(), reason="the recording of a person is not on this machine")
def test_a_recorded_person():
    imu, events = ctlev.read_imu(RECORDED), ctlev.read_events(RECORDED)
    assert len(imu) > 400 and abs(int(imu.t[0]) - int(events.t[0])) < 5000
    # A camera at rest feels one g and turns less than two degrees a second.
    assert abs(np.linalg.norm(imu.acceleration, axis=1).mean() - 1) < 0.1
    assert np.abs(imu.rotation.mean(axis=0)).max() < 2
    with pytest.raises(DataError, match="frames"):
        next(ctlev.read_frames(RECORDED))
