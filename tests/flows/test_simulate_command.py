"""`ctlev simulate`: every format, a preview, and refusals that leave nothing behind."""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from ctlev_core import read_events, simulate_video
from ctlev_core.plugin_contracts import FormatWithWriter
from ctlev_core.plugins import PluginError, load, names
from flows.cli import app
from flows.simulate import find_writer

WRITTEN = [name for name in names("formats") if isinstance(load("formats", name), FormatWithWriter)]


def invoke(*arguments):
    result = CliRunner().invoke(app, ["simulate", *map(str, arguments)])
    return result.exit_code, result.stdout, result.stderr


def write_video(path, num_frames, left=4):
    """A bright square that moves over a dark ground from `left` px on, 30 frames a second."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    for number in range(num_frames):
        frame = np.full((48, 64, 3), 30, np.uint8)
        frame[14:34, left + 3 * number : left + 20 + 3 * number] = 220
        writer.write(frame)
    writer.release()
    return path


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("video") / "square.avi", 12)


@pytest.fixture(scope="module")
def short_video(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("video") / "square.avi", 4, left=34)


def test_a_video_becomes_events_and_a_preview(video, tmp_path):
    status, output, errors = invoke(video, tmp_path / "a.parquet", "--sensor", "ideal", "--preview", tmp_path / "a.png")
    assert status == 0, errors
    events = read_events(tmp_path / "a.parquet")
    assert events.sensor_size == (64, 48) and f"{len(events)} events of 64 x 48 px in 0.367 s" in output
    # The front edge brightens, the rear one darkens; both move to the right, row for row of the square.
    assert set(np.unique(events.y[events.p == 1]).tolist()) >= set(range(16, 32))
    for polarity, start in ((1, 24), (0, 4)):
        x, t = events.x[events.p == polarity], events.t[events.p == polarity]
        assert np.median(x[t < 60_000]) == pytest.approx(start + 3, abs=4)
        assert np.median(x[t > 300_000]) == pytest.approx(start + 30, abs=4)
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture is not None and picture.shape == (96, 6 * 64, 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.parquet", "a.png"]


def test_python_gives_the_same_events(video, tmp_path):
    assert invoke(video, tmp_path / "a.parquet", "--seed", 3, "--size", "32x24", "--slow-motion", 2)[0] == 0
    written = read_events(tmp_path / "a.parquet")
    made = simulate_video(video, size=(32, 24), seed=3, slow_motion=2)
    assert len(made) > 0 and made.sensor_size == (32, 24)
    for name in "txyp":
        np.testing.assert_array_equal(getattr(made, name), getattr(written, name))


@pytest.mark.parametrize("name", WRITTEN)
def test_every_format_that_is_written_holds_the_same_events(short_video, tmp_path, name):
    output, size = tmp_path / f"a{load('formats', name).SUFFIXES[0]}", (240, 180) if name == "atis" else (346, 260)
    asked = ("--format", name, "--sensor", "clean", "--size", f"{size[0]}x{size[1]}")
    status, _, errors = invoke(short_video, output, *asked)
    assert status == 0, errors
    made, written = simulate_video(short_video, sensor="clean", size=size), read_events(output)
    assert len(written) == len(made)
    np.testing.assert_array_equal(written.t, made.t)


def test_a_format_that_cannot_hold_the_events_says_so_of_the_file_asked_for(video, tmp_path):
    status, _, errors = invoke(video, tmp_path / "a.bin")
    assert status == 2 and f"{tmp_path}/a.bin: the format states no sensor size" in errors
    assert not list(tmp_path.iterdir())


def test_the_suffix_says_the_format(tmp_path):
    for suffix, name in (
        (".parquet", "parquet"),
        (".raw", "evt3"),
        (".npz", "npz"),
        (".csv", "csv"),
        (".dat", "dat"),
        (".aedat", "aedat2"),
        (".aedat3", "aedat3"),
        (".aedat4", "aedat4"),
    ):
        assert find_writer(tmp_path / f"a{suffix}") == name


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{missing}", "{out}.parquet"], "got nothing there"),
        (["{video}", "{out}.mp3"], r"no format is written with the suffix '.mp3'; known: "),
        (["{video}", "{out}.parquet", "--format", "evt9"], "unknown plug-in 'evt9'"),
        (["{video}", "{out}.parquet", "--sensor", "dvs364"], "expected one of ideal"),
        (["{video}", "{out}/in/a.parquet"], "there is no folder"),
        (["{video}", "{out}.parquet", "--size", "346"], "must be WIDTHxHEIGHT"),
        (["{video}", "{out}.parquet", "--interpolation", "magic"], "must be flow or fade"),
        (["{video}", "{out}.parquet", "--fps", "-3"], "fps must be a number above 0"),
        (["{video}", "{out}.parquet", "--max-displacement-px", "0"], "max_displacement_px must be above 0"),
        (["{video}", "{out}.parquet", "--start", "50"], "two frames or more"),
        (["{video}", "{out}.parquet", "--start", "inf"], "two frames or more"),
        (["{video}", "{out}.parquet", "--fps", "1e-300"], "s after the first, expected at most"),
    ],
)
def test_what_cannot_be_done_is_said_and_leaves_nothing(video, tmp_path, arguments, message):
    given = {"video": video, "missing": tmp_path / "no.mp4", "out": tmp_path / "a"}
    status, _, errors = invoke(*(argument.format(**given) for argument in arguments))
    assert status == 2 and message in " ".join(errors.replace("│", " ").split())
    assert not list(tmp_path.iterdir())


def test_times_in_microseconds_do_not_fill_the_memory_with_noise(tmp_path):
    folder = tmp_path / "f"
    folder.mkdir()
    for number in range(3):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((48, 64), 60 + 40 * number, np.uint8))
    (folder / "timestamps.txt").write_text("0\n33333\n66667\n")  # us, read as s
    arguments = folder, tmp_path / "a.parquet", "--size", "346x260"
    status, _, errors = invoke(*arguments)
    assert status == 2 and not (tmp_path / "a.parquet").exists()
    assert "frame 1 is 33333 s after the one before" in errors and "in seconds?" in errors
    assert invoke(*arguments, "--noise", "0")[0] == 0


def test_a_format_without_a_writer_is_read_only(tmp_path, monkeypatch):
    monkeypatch.delattr(load("formats", "aedat4"), "write")
    with pytest.raises(PluginError, match="format 'aedat4' is read only"):
        find_writer(tmp_path / "a.aedat4", "aedat4")
    with pytest.raises(PluginError, match=r"no format is written with the suffix '\.aedat4'"):
        find_writer(tmp_path / "a.aedat4")


def test_what_is_there_stays_unless_it_may_be_replaced(video, tmp_path):
    output = tmp_path / "a.parquet"
    output.write_text("mine")
    status, _, errors = invoke(video, output)
    assert status == 2 and "is there already; --overwrite replaces it" in errors and output.read_text() == "mine"
    assert invoke(video, output, "--overwrite")[0] == 0 and len(read_events(output)) > 0


def test_a_still_picture_and_a_folder(tmp_path):
    rng = np.random.default_rng(0)
    picture = cv2.resize(rng.integers(0, 255, (9, 9, 3), np.uint8), (68, 68), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    status, _, errors = invoke(tmp_path / "a.png", tmp_path / "still.npz")
    assert status == 0, errors
    events = read_events(tmp_path / "still.npz")
    assert events.sensor_size == (68, 68) and events.t[-1] <= 307_500 and len(events) > 1000
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number in range(4):
        cv2.imwrite(str(folder / f"{number}.png"), np.roll(picture, 2 * number, axis=1))
    assert invoke(folder, tmp_path / "folder.npz")[0] == 2
    assert invoke(folder, tmp_path / "folder.npz", "--fps", 100)[0] == 0
    assert read_events(tmp_path / "folder.npz").t[-1] <= 30_000


@pytest.mark.parametrize("name", WRITTEN)
def test_each_event_is_marked_in_every_format(short_video, tmp_path, name):
    """In the file where it can hold the marks, else beside it; the events are those without marks."""
    output, size = tmp_path / f"a{load('formats', name).SUFFIXES[0]}", (240, 180) if name == "atis" else (346, 260)
    status, text, errors = invoke(short_video, output, "--format", name, "--size", f"{size[0]}x{size[1]}", "--marks")
    assert status == 0, errors
    made = simulate_video(short_video, size=size, marks=True)
    assert made.signal is not None and 0 < made.signal.sum() < len(made)
    if name == "parquet":
        signal = read_events(output).signal
    elif name == "csv":
        rows = output.read_text().splitlines()[1:]
        assert rows[0] == "t,x,y,p,signal"
        signal = np.array([row.endswith(",1") for row in rows[1:]])
    else:
        signal = np.load(tmp_path / "a.signal.npy")
        assert signal.dtype == np.bool_ and f"signal or noise: {tmp_path}/a.signal.npy" in text
    np.testing.assert_array_equal(signal, made.signal)
    plain, written = simulate_video(short_video, size=size), read_events(output)
    assert plain.signal is None
    for column in "txyp":
        np.testing.assert_array_equal(getattr(made, column), getattr(plain, column))
    np.testing.assert_array_equal(written.t, plain.t)
    again = invoke(short_video, output, "--format", name, "--marks")
    assert again[0] == 2 and "is there already" in again[2]


def test_marks_of_no_events_are_written_too(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number in range(3):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((20, 20, 3), 90, np.uint8))
    for suffix in ("parquet", "npz"):
        status, _, errors = invoke(folder, tmp_path / f"a.{suffix}", "--fps", 30, "--sensor", "ideal", "--marks")
        assert status == 0, errors
    assert np.load(tmp_path / "a.signal.npy").shape == (0,)
    signal = read_events(tmp_path / "a.parquet").signal
    assert signal is None or len(signal) == 0


def test_labels_are_carried_along(video, tmp_path):
    """The square's box lies where its events are, at every time that is asked for."""
    rows = [f"{k},1,square,{4 + 3 * k},14,20,20" for k in range(12)]
    (tmp_path / "in.csv").write_text("frame,instance,category,x,y,width,height\n" + "\n".join(rows))
    asked = ("--sensor", "ideal", "--size", "32x24", "--labels", tmp_path / "in.csv", "--label-rate", 300)
    status, text, errors = invoke(video, tmp_path / "a.parquet", *asked)
    assert status == 0 and f"labels: {tmp_path}/a.labels.json" in text, errors
    table, events = json.loads((tmp_path / "a.labels.json").read_text()), read_events(tmp_path / "a.parquet")
    assert len(table["images"]) == len(table["annotations"]) == 111 and table["categories"][0]["name"] == "square"
    for one in table["annotations"][1:-1]:
        near = np.abs(events.t - one["t_us"]) < 4000
        left, top, width, height = one["bbox"]
        assert (np.abs(events.x[near & (events.p == 1)] + 0.5 - left - width) < 2.5).mean() > 0.9
        assert (np.abs(events.y[near] + 0.5 - top - height / 2) < height / 2 + 1.5).mean() > 0.95
    plain = simulate_video(video, sensor="ideal", size=(32, 24))
    np.testing.assert_array_equal(events.t, plain.t)


def test_what_is_read_is_not_written_over(tmp_path):
    video = write_video(tmp_path / "square.avi", 3)
    before = video.read_bytes()
    (tmp_path / "link.avi").symlink_to(video)
    for arguments in ((video, "--format", "evt2"), (tmp_path / "a.parquet", "--preview", tmp_path / "link.avi")):
        status, _, errors = invoke(video, *arguments, "--overwrite")
        assert status == 2 and "is what is read; choose another name to write to" in errors
    assert video.read_bytes() == before and not (tmp_path / "a.parquet").exists()


def test_a_preview_that_is_no_picture_is_refused_before_anything_is_simulated(video, tmp_path):
    status, _, errors = invoke(video, tmp_path / "a.parquet", "--preview", tmp_path / "a.xyz")
    assert status == 2 and "no picture is written with the suffix '.xyz'; take .png or .jpg" in errors
    assert not list(tmp_path.iterdir())


def test_wrong_labels_leave_nothing(video, tmp_path, monkeypatch):
    (tmp_path / "in.csv").write_text("frame,instance,x,y,width,height\n12,1,1,2,3,4\n")
    status, _, errors = invoke(video, tmp_path / "a.parquet", "--labels", tmp_path / "in.csv")
    assert status == 2 and "in.csv: labels of frame 12, expected frames 0 to 11" in errors
    # A container may count a frame more than it has, so this one is found at the end alone.
    monkeypatch.setattr("ctlev_core.video.label_files.check_frames", lambda *_: None)
    status, _, errors = invoke(video, tmp_path / "a.raw", "--labels", tmp_path / "in.csv", "--marks")
    assert status == 2 and "in.csv: labels of frame 12, expected frames 0 to 11" in errors
    status, _, errors = invoke(video, tmp_path / "a.parquet", "--labels", tmp_path / "in.csv", "--label-rate", 0)
    assert status == 2 and "label_rate_hz must be above 0" in errors
    assert [path.name for path in tmp_path.iterdir()] == ["in.csv"]


def test_what_lies_beside_older_events_goes_with_them(video, tmp_path):
    output, marks = tmp_path / "a.raw", tmp_path / "a.signal.npy"
    assert invoke(video, output, "--marks")[0] == 0 and marks.exists()
    assert invoke(video, output, "--overwrite")[0] == 0 and not marks.exists()
    np.save(marks, np.ones(3, bool))
    status, _, errors = invoke(video, tmp_path / "a.parquet")
    assert status == 2 and "a.signal.npy: is there already" in errors and marks.exists()
    status, _, errors = invoke(video, tmp_path / "b.raw", "--label-rate", 5)
    assert status == 2 and "--label-rate is of labels, and none are given" in errors
