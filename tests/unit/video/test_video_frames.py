"""Reading videos, folders and pictures: times, sizes, light, and what is wrong with them."""

import struct

import cv2
import numpy as np
import pytest

from ctlev_core.video.frames import FrameOptions, open_frames
from data_contracts.errors import DataError


def picture(level, size=(32, 24)):
    return np.full((size[1], size[0], 3), level, np.uint8)


def write_video(path, levels, fps=50.0, size=(32, 24)):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, size)
    for level in levels:
        writer.write(picture(level, size))
    writer.release()
    return path


def write_folder(path, levels, times=None, suffix=".png"):
    path.mkdir()
    for number, level in enumerate(levels):
        cv2.imwrite(str(path / f"frame_{number + 8}{suffix}"), picture(level))
    if times is not None:
        (path / "timestamps.txt").write_text("\n".join(map(str, times)) + "\n")
    return path


def test_a_video_has_the_times_of_its_container_and_linear_light(tmp_path):
    levels = [0, 60, 120, 180, 240]
    frames = open_frames(write_video(tmp_path / "a.avi", levels), FrameOptions())
    times, light = zip(*frames, strict=True)
    assert frames.expected == 5 and light[0].shape == (24, 32) and list(times) == [0, 20_000, 40_000, 60_000, 80_000]
    for level, one in zip(levels, light, strict=True):
        assert one.dtype == np.float32 and one.shape == (24, 32)
        np.testing.assert_allclose(one, (level / 255) ** 2.2, atol=0.02)  # the codec rounds
    assert [t for t, _ in frames] == list(times)  # again from the start


def test_options_change_times(tmp_path):
    path = write_video(tmp_path / "a.avi", range(0, 200, 10))
    assert [t for t, _ in open_frames(path, FrameOptions(fps=100))][:3] == [0, 10_000, 20_000]
    assert [t for t, _ in open_frames(path, FrameOptions(slow_motion=4))][:3] == [0, 5_000, 10_000]
    assert len(list(open_frames(path, FrameOptions(start_s=0.1, stop_s=0.2)))) == 6
    with pytest.raises(DataError, match="two frames or more at different times in this stretch, got 0"):
        list(open_frames(path, FrameOptions(start_s=7)))


def test_a_folder_is_read_in_the_order_of_its_numbers_with_its_times(tmp_path):
    folder = write_folder(tmp_path / "imgs", [10, 20, 30, 40], times=[0, 0.1, 0.15, 0.4])
    frames = list(open_frames(folder, FrameOptions(gamma=1.0)))
    assert [t for t, _ in frames] == [0, 100_000, 150_000, 400_000]  # frame_8, 9, 10, 11
    np.testing.assert_allclose([light.mean() for _, light in frames], np.array([10, 20, 30, 40]) / 255, atol=1e-6)
    # vid2e writes the times beside the folder of pictures.
    (folder / "timestamps.txt").rename(tmp_path / "timestamps.txt")
    assert len(list(open_frames(tmp_path, FrameOptions()))) == 4


def test_frames_at_one_time_are_left_out_and_counted(tmp_path):
    folder = write_folder(tmp_path / "f", [10, 20, 30, 40], times=[0, 0.1, 0.1, 0.05])
    frames = open_frames(folder, FrameOptions())
    assert [t for t, _ in frames] == [0, 100_000] and frames.num_skipped == 2


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0, 0.1], r"expected a time for each of 3 pictures, got 2"),
        ([0, "soon", 1], r"expected seconds"),
        ([0, "nan", 1], r"expected finite seconds"),
        (None, r"has no timestamps\.txt .*give fps"),
    ],
)
def test_wrong_times_are_named(tmp_path, times, message):
    folder = write_folder(tmp_path / "f", [10, 20, 30], times=times)
    with pytest.raises(DataError, match=message):
        open_frames(folder, FrameOptions())


def test_what_is_no_video_is_refused(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"nothing of a video" * 50)
    (tmp_path / "a.png").write_bytes(b"nothing of a picture")
    (tmp_path / "empty").mkdir()
    for name, message in (
        ("a.mp4", "not a video that OpenCV can read"),
        ("a.png", "not a picture that OpenCV can read"),
        ("empty", "holds no pictures"),
        ("b.mp4", "nothing there"),
    ):
        with pytest.raises(DataError, match=message):
            open_frames(tmp_path / name, FrameOptions())


def test_a_video_that_was_cut_is_refused_and_can_be_read_up_to_there(tmp_path):
    whole = write_video(tmp_path / "a.avi", [0, 200] * 60)
    content = whole.read_bytes()
    (tmp_path / "cut.avi").write_bytes(content[: len(content) // 2])
    frames = open_frames(tmp_path / "cut.avi", FrameOptions())
    with pytest.raises(DataError, match=r"cut\.avi: ends after frame \d+ of 120"):
        list(frames)
    assert len(list(open_frames(tmp_path / "cut.avi", FrameOptions(stop_s=0.5)))) == 26


def test_frames_of_several_sizes_are_refused(tmp_path):
    folder = write_folder(tmp_path / "f", [10, 20])
    cv2.imwrite(str(folder / "frame_99.png"), picture(5, (40, 24)))
    with pytest.raises(DataError, match=r"one size, got 40 x 24 px at frame 2 after 32 x 24"):
        list(open_frames(folder, FrameOptions(fps=30)))


def test_pictures_cover_the_sensor_and_are_cut_about_their_middle(tmp_path):
    wide = np.zeros((20, 60, 3), np.uint8)
    wide[:, 20:40] = 255
    folder = tmp_path / "f"
    folder.mkdir()
    for name in ("1", "2"):
        cv2.imwrite(str(folder / f"{name}.png"), wide)
    for size in ((10, 10), (40, 40)):
        _, light = next(iter(open_frames(folder, FrameOptions(size=size, fps=1))))
        assert light.shape == size[::-1]
        np.testing.assert_allclose(light, 1, atol=1e-6)


def test_a_pixel_that_covers_several_has_the_mean_of_their_light(tmp_path):
    """Not that of display levels: of black and white as much as of 8 bits as of floats, .5 and not .22."""
    board = np.indices((48, 64)).sum(axis=0) % 2
    for name, levels in (("bytes", (255 * board).astype(np.uint8)), ("words", (65535 * board).astype(np.uint16))):
        (tmp_path / name).mkdir()
        for row in ("1", "2"):
            assert cv2.imwrite(str(tmp_path / name / f"{row}.png"), levels)
        light = next(iter(open_frames(tmp_path / name, FrameOptions(size=(32, 24), fps=10))))[1]
        np.testing.assert_allclose(light, 0.5, atol=1e-6)


def element(name, content):
    """An element of Matroska."""
    return bytes.fromhex(name) + struct.pack(">Q", len(content) | 1 << 56) + content


def number(value):
    return value.to_bytes(8, "big")


def test_a_video_of_a_varying_rate_is_whole_and_so_are_its_labels(tmp_path):
    """OpenCV makes a number of frames of the duration and a rate that it guesses: 1,260 here, of 160."""
    times_ms = [round(1000 * frame / 60) for frame in range(60)] + [1000 + 200 * frame for frame in range(100)]
    clusters = b""
    for row, time_ms in enumerate(times_ms):
        picture = cv2.imencode(".jpg", np.full((24, 32, 3), row, np.uint8))[1].tobytes()
        block = element("a3", b"\x81" + struct.pack(">h", 0) + b"\x80" + picture)
        clusters += element("1f43b675", element("e7", number(time_ms)) + block)
    size = element("e0", element("b0", number(32)) + element("ba", number(24)))
    codec = b"".join(element(name, number(1)) for name in ("d7", "73c5", "83")) + element("86", b"V_MJPEG")
    duration = element("4489", struct.pack(">d", times_ms[-1] + 200.0))
    info = element("2ad7b1", number(1_000_000)) + duration + element("4d80", b"x") + element("5741", b"x")
    versions = [("4286", 1), ("42f7", 1), ("42f2", 4), ("42f3", 8), ("4287", 4), ("4285", 2)]
    head = b"".join(element(name, number(value)) for name, value in versions) + element("4282", b"matroska")
    tracks = element("1654ae6b", element("ae", codec + size))
    whole = element("1a45dfa3", head) + element("18538067", element("1549a966", info) + tracks + clusters)
    (tmp_path / "a.mkv").write_bytes(whole)
    frames = open_frames(tmp_path / "a.mkv", FrameOptions())
    assert np.allclose([t_us for t_us, _ in frames], 1000 * np.array(times_ms), atol=1100)
    assert frames.num_stored == 0 and frames.num_seen_to_end == len(times_ms)
    (tmp_path / "cut.mkv").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match="the file is cut or damaged"):
        list(open_frames(tmp_path / "cut.mkv", FrameOptions()))


@pytest.mark.parametrize(
    ("start_s", "stop_s", "count"), [(0.0, None, 20), (0.2, None, 10), (0.0, 0.1, 6), (0.1, 0.2, 6)]
)
def test_how_many_frames_a_stretch_has_is_known_before(tmp_path, start_s, stop_s, count):
    write_video(tmp_path / "a.avi", [10] * 20)
    write_folder(tmp_path / "f", [10] * 20)
    for name, rate in (("a.avi", {}), ("f", {"fps": 50.0})):
        frames = open_frames(tmp_path / name, FrameOptions(start_s=start_s, stop_s=stop_s, **rate))
        assert frames.expected == count == len(list(frames))


@pytest.mark.parametrize("far_s", [1e308, float("inf")])
def test_a_stretch_may_begin_or_end_as_late_as_a_float_can_say(tmp_path, far_s):
    write_video(tmp_path / "a.avi", [10] * 4)
    frames = open_frames(tmp_path / "a.avi", FrameOptions(stop_s=far_s))
    assert frames.expected == 4 == len(list(frames))
    frames = open_frames(tmp_path / "a.avi", FrameOptions(start_s=far_s))
    assert frames.expected == 0
    with pytest.raises(DataError, match="two frames or more at different times in this stretch, got 0"):
        list(frames)


@pytest.mark.parametrize("options", [{"fps": 1e-300}, {"fps": 5e-324}, {"fps": 1e-12}, {"slow_motion": 1e-300}])
def test_frames_later_than_the_clock_of_a_sensor_are_refused(tmp_path, options):
    write_video(tmp_path / "a.avi", [10] * 20)
    with pytest.raises(DataError, match=r"a.avi: frame \d+ is \S+ s after the first, expected at most 9.01e\+09 s"):
        list(open_frames(tmp_path / "a.avi", FrameOptions(**options)))
    folder = write_folder(tmp_path / "f", [10, 20], [0, 1e300])
    with pytest.raises(DataError, match="frame 1 is 1e"):
        list(open_frames(folder, FrameOptions()))


@pytest.mark.parametrize("asked", [{"fps": 5.0}, {"slow_motion": 10.0}, {"start_s": 0.1}, {"stop_s": 0.1}])
def test_a_still_picture_has_times_of_its_own(tmp_path, asked):
    assert cv2.imwrite(str(tmp_path / "a.png"), picture(100))
    with pytest.raises(DataError, match="seen in saccades of their own times; leave out"):
        open_frames(tmp_path / "a.png", FrameOptions(**asked))


def test_sixteen_bits_and_floats(tmp_path):
    folder = tmp_path / "f"
    folder.mkdir()
    for name in ("1", "2"):
        cv2.imwrite(str(folder / f"{name}.png"), np.full((20, 20), 32768, np.uint16))
    _, light = next(iter(open_frames(folder, FrameOptions(fps=1))))
    np.testing.assert_allclose(light, (32768 / 65535) ** 2.2, rtol=1e-4)
    floats = tmp_path / "g"
    floats.mkdir()
    for name in ("1", "2"):
        cv2.imwrite(str(floats / f"{name}.hdr"), np.full((20, 20, 3), 3.5, np.float32))
    _, light = next(iter(open_frames(floats, FrameOptions(fps=1))))
    np.testing.assert_allclose(light, 3.5, rtol=0.01)


@pytest.mark.parametrize("channels", [(), (1,), (3,), (4,)])
def test_floating_point_tiffs_of_grey_colours_and_alpha_are_light(tmp_path, channels):
    level = np.full((20, 20, *channels), 0.25, np.float32)
    assert cv2.imwrite(str(tmp_path / "a.tiff"), level)
    _, light = next(iter(open_frames(tmp_path / "a.tiff", FrameOptions())))
    np.testing.assert_allclose(light, 0.25, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.int8, np.int16, np.int32])
def test_pixels_with_a_sign_are_no_light(tmp_path, dtype):
    folder = tmp_path / "f"
    folder.mkdir()
    for number in range(4):
        level = np.full((20, 20), 100, np.uint8 if number < 3 else dtype)
        assert cv2.imwrite(str(folder / f"{number}.tiff"), level)
    message = rf"f: expected pixels of 8 or 16 bits without a sign, .*, got {np.dtype(dtype)} in frame 3"
    with pytest.raises(DataError, match=message):
        list(open_frames(folder, FrameOptions(fps=10.0, start_s=0.1)))


@pytest.mark.parametrize(("suffix", "codec"), [(".mpg", "MPG2"), (".avi", "MPG2"), (".avi", "PIM1")])
def test_the_last_frame_of_mpeg_has_no_time_and_is_there(tmp_path, suffix, codec):
    path = tmp_path / f"a{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 25.0, (64, 48))
    for level in range(0, 200, 4):
        writer.write(picture(level, (64, 48)))
    writer.release()
    times, light = zip(*open_frames(path, FrameOptions()), strict=True)
    assert len(times) == 50 and times[-1] - times[-2] == 40_000
    assert (np.diff([one.mean() for one in light]) >= 0).all()


def test_a_video_without_frames_says_so(tmp_path):
    with pytest.raises(DataError, match="expected two frames or more at different times, got 0"):
        list(open_frames(write_video(tmp_path / "a.avi", []), FrameOptions()))


@pytest.mark.parametrize(
    "wrong", [{"fps": 0}, {"fps": float("nan")}, {"slow_motion": -1}, {"start_s": -1}, {"start_s": 2, "stop_s": 1}]
)
def test_options_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match=r"must be"):
        FrameOptions(**wrong)


@pytest.mark.parametrize("max_displacement_px", [1e-9, 5e-324])
def test_a_still_picture_has_a_frame_a_microsecond_at_most(tmp_path, max_displacement_px):
    assert cv2.imwrite(str(tmp_path / "a.png"), picture(100))
    frames = open_frames(tmp_path / "a.png", FrameOptions(), max_displacement_px)
    times = [t_us for (t_us, _), _ in zip(frames, range(4), strict=False)]
    assert times == [0, 1, 2, 3] and frames.expected == 307_501


def test_a_still_picture_makes_a_closed_path_of_saccades(tmp_path):
    level = np.linspace(20, 230, 68 * 68).reshape(68, 68).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), level)
    frames = open_frames(tmp_path / "a.png", FrameOptions(gamma=1.0), max_displacement_px=0.5)
    times, light = zip(*frames, strict=True)
    assert frames.is_dense and times[0] == 0 and times[-1] == 307_500 and len(times) == frames.expected > 60
    np.testing.assert_allclose(light[0], level / 255, atol=1e-6)
    # Columns differ by 1 / 255 px, rows by 68 times as much: a path of twice N-MNIST's is seen in the mean.
    assert np.abs(light[30] - light[0]).max() > 0.02
    np.testing.assert_allclose(light[-1][10:-10, 10:-10], light[0][10:-10, 10:-10], atol=0.02)
