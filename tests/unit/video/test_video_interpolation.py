"""What lies between two frames, and the events that come of it, beside a scene of which every frame is known."""

import tracemalloc

import cv2
import numpy as np
import pytest
from moving_scene import SIZE, SPEED_PX_S, frames, light, share_found

from ctlev_core.sensor.dvs_pixel import PRESETS, Sensor, join, simulate_events
from ctlev_core.video.frames import FrameOptions, Frames, open_frames
from ctlev_core.video.interpolation import Fading, Flow, num_steps
from ctlev_core.video.simulation import VideoSimulation
from data_contracts.errors import DataError

INTERVAL_S = 1 / 60


class Known(Frames):
    """Frames that are in memory."""

    def __init__(self, times, pictures):
        self.times, self.pictures, self.expected = times, pictures, len(times)

    def __iter__(self):
        return iter(zip(self.times.tolist(), self.pictures, strict=True))


def simulate(times, pictures, **more):
    chunks = list(VideoSimulation(Known(times, pictures), PRESETS["ideal"], **more))
    return join(chunks, SIZE)


def draw(between, first, second, share):
    """The whole frame at a share of the time."""
    frame = (1 - share) * first + share * second
    values = between.at(share)
    assert values.dtype == np.float32 and values.shape == between.moving.shape
    frame.reshape(-1)[between.moving] = values
    return frame


def test_flow_draws_what_is_between_nearer_than_fading():
    first, second, truth = light(0), light(INTERVAL_S), light(INTERVAL_S / 2)
    inside = (slice(8, -8), slice(10, -10))
    errors = {}
    for interpolator in (Flow(), Fading()):
        drawn = draw(interpolator.between(first, second), first, second, 0.5)
        errors[type(interpolator).__name__] = float(np.sqrt(np.mean((drawn - truth)[inside] ** 2)))
    assert errors["Flow"] < 0.35 * errors["Fading"]


def test_flow_measures_how_far_things_move():
    between = Flow().between(light(0), light(INTERVAL_S))
    assert between.displacement_px == pytest.approx(np.hypot(*SPEED_PX_S) * INTERVAL_S, rel=0.25)


@pytest.mark.parametrize("interpolator", [Flow(), Fading()])
def test_both_ends_are_the_frames_themselves(interpolator):
    first, second = light(0), light(INTERVAL_S)
    between = interpolator.between(first, second)
    for share, frame in ((0.0, first), (1.0, second)):
        np.testing.assert_array_equal(between.at(share), frame.reshape(-1)[between.moving])


def test_where_nothing_moves_nothing_is_drawn():
    still = light(0)
    assert Flow().between(still, still.copy()).displacement_px == 0
    # A lamp that is turned up is no movement, as far as flow can tell; the levels between are those of a fade.
    dark, bright = np.full((40, 40), 0.2, np.float32), np.full((40, 40), 0.4, np.float32)
    np.testing.assert_allclose(draw(Flow().between(dark, bright), dark, bright, 0.5), 0.3, atol=0.01)


def test_tiny_pictures_fade():
    small = np.zeros((4, 4), np.float32)
    assert Flow().between(small, small + 1).displacement_px == 0


def test_number_of_steps():
    assert [num_steps(moved, 0.5, 10) for moved in (0, 0.4, 0.5, 0.51, 3.0, 99)] == [1, 1, 1, 2, 6, 10]
    assert num_steps(5.0, 5e-324, 10) == 10


def test_events_of_a_video_with_flow_are_nearer_to_those_of_the_scene():
    times, dense = frames(4000)
    reference = simulate_events(dense, times, PRESETS["ideal"], sensor_seed=0, seed=[0, 1])
    video = frames(60)
    found = {
        name: share_found(simulate(*video, interpolator=interpolator), reference, 1000)
        for name, interpolator in (("flow", Flow()), ("fade", Fading()))
    }
    assert found["flow"] > 0.75 and found["flow"] > found["fade"] + 0.2, found


def test_events_of_a_dense_video_are_those_of_the_sensor_alone():
    times, dense = frames(2000, duration_s=0.05)
    expected = simulate_events(dense, times, PRESETS["ideal"], sensor_seed=3, seed=[3, 1])
    events = simulate(times, dense, seed=3, interpolator=Fading())
    for name in "txyp":
        np.testing.assert_array_equal(getattr(events, name), getattr(expected, name))


@pytest.mark.parametrize("kind", ["ideal", "noisy"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_frame_with_some_pixels_seen_between_is_as_all_frames_pushed(kind, dtype):
    rng = np.random.default_rng(5)
    times = np.array([0, 900, 2500, 4000, 9000, 30_000], np.int64)
    first, last = rng.uniform(0.05, 1, (2, *SIZE[::-1])).astype(dtype)
    moving = np.sort(rng.choice(first.size, 500, replace=False))
    # Others change linearly: light, not its logarithm, which the sensor joins; so they stay as they are here.
    last.reshape(-1)[np.setdiff1d(np.arange(first.size), moving)] = np.delete(first.reshape(-1), moving)
    pushed = np.repeat(first[None], len(times), axis=0)
    drawn = rng.uniform(0.05, 1, (4, 500)).astype(dtype)
    pushed[1:5].reshape(4, -1)[:, moving] = drawn
    pushed[5] = last
    whole, some = (Sensor(SIZE, PRESETS[kind], sensor_seed=1, seed=[2]) for _ in range(2))
    expected = whole.push(pushed, times)
    some.push(first[None], times[:1])
    found = some.push_between(moving, drawn, times[1:5], last, int(times[5]))
    assert len(found) == len(expected) > 1000 and some.num_events == len(found)
    for events in (found, expected):
        assert (np.diff(events.t) >= 0).all()
    order = [np.lexsort((one.p, one.x, one.y, one.t)) for one in (found, expected)]
    for name in "txyp":
        np.testing.assert_array_equal(getattr(found, name)[order[0]], getattr(expected, name)[order[1]])
    # And both go on alike.
    again = (np.array([31_000], np.int64), first[None])
    after = [sensor.push(again[1], again[0]) for sensor in (whole, some)]
    for name in "txyp":
        np.testing.assert_array_equal(getattr(after[0], name), getattr(after[1], name))


def test_pixels_seen_between_are_checked():
    sensor = Sensor((3, 2), PRESETS["ideal"], sensor_seed=0, seed=0)
    frame, moving, times = np.full((2, 3), 0.5), np.array([1, 4]), np.array([10], np.int64)
    with pytest.raises(ValueError, match="needs a frame before"):
        sensor.push_between(moving, np.ones((1, 2)), times, frame, 20)
    sensor.push(frame[None], np.array([0], np.int64))
    for drawn, drawn_us, last, message in (
        (np.array([[1.0, np.nan]]), times, frame, "finite and not negative"),
        (np.ones((1, 2)), np.array([30], np.int64), frame, "must increase"),
        (np.ones((1, 2)), times, -frame, "finite and not negative"),
    ):
        with pytest.raises(DataError, match=message):
            sensor.push_between(moving, drawn, drawn_us, last, 20)
    assert len(sensor.push_between(moving, np.array([[2.0, 0.1]]), times, frame, 20)) > 0
    with pytest.raises(ValueError, match="argument"):
        sensor.push_between(moving, np.ones((2, 2)), np.array([30], np.int64), frame, 40)


def test_a_cut_takes_the_memory_of_one_frame(tmp_path):
    """Between two frames that have nothing in common 200 are drawn, each forgotten before the next."""
    rng = np.random.default_rng(0)
    (tmp_path / "f").mkdir()
    for name in "12":
        levels = cv2.resize(rng.integers(0, 256, (12, 16, 3), dtype=np.uint8), (320, 240))
        assert cv2.imwrite(str(tmp_path / "f" / f"{name}.png"), levels)
    frames = open_frames(tmp_path / "f", FrameOptions(fps=1))
    simulation = VideoSimulation(frames, PRESETS["ideal"], max_displacement_px=0.2)
    some = iter(simulation)
    next(some)
    tracemalloc.start()
    try:
        events = next(some)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert simulation.num_drawn > 100 and len(events) > 0
    of_events = sum(getattr(events, name).nbytes for name in "txyp")
    assert peak < 40 * 320 * 240 * 4 + 12 * of_events, "not that of all that was drawn"


def test_a_simulation_counts_and_can_be_repeated():
    simulation = VideoSimulation(Known(*frames(60)), PRESETS["noisy"], seed=1)
    first = [len(chunk) for chunk in simulation]
    assert simulation.num_events == sum(first) > 0 and simulation.size == SIZE
    assert simulation.num_frames == 13 and simulation.num_drawn > 13 and simulation.duration_us == 200_000
    assert [len(chunk) for chunk in simulation] == first


def test_displacement_must_be_positive():
    with pytest.raises(ValueError, match="max_displacement_px"):
        VideoSimulation(Known(*frames(60)), PRESETS["ideal"], max_displacement_px=0)


def test_options_of_frames_are_those_of_a_camera():
    with pytest.raises(ValueError, match="size"):
        FrameOptions(size=(0, 5))
