"""What lies between two frames, and the events that come of it, beside a scene of which every frame is known."""

import numpy as np
import pytest
from moving_scene import SIZE, SPEED_PX_S, frames, light, share_found

from ctlev_core.sensor.dvs_pixel import PRESETS, join, simulate_events
from ctlev_core.video.frames import FrameOptions, Frames
from ctlev_core.video.interpolation import Fading, Flow, num_steps
from ctlev_core.video.simulation import VideoSimulation

INTERVAL_S = 1 / 60


class Known(Frames):
    """Frames that are in memory."""

    def __init__(self, times, pictures):
        self.times, self.pictures, self.num_skipped, self.expected, self.size = times, pictures, 0, len(times), None

    def __iter__(self):
        return iter(zip(self.times.tolist(), self.pictures, strict=True))


def simulate(times, pictures, **more):
    chunks = list(VideoSimulation(Known(times, pictures), PRESETS["ideal"], **more))
    return join(chunks, SIZE)


def test_flow_draws_what_is_between_nearer_than_fading():
    first, second, truth = light(0), light(INTERVAL_S), light(INTERVAL_S / 2)
    inside = (slice(8, -8), slice(10, -10))
    errors = {}
    for interpolator in (Flow(), Fading()):
        drawn = interpolator.between(first, second).at(0.5)
        assert drawn.dtype == np.float32 and drawn.shape == first.shape
        errors[type(interpolator).__name__] = float(np.sqrt(np.mean((drawn - truth)[inside] ** 2)))
    assert errors["Flow"] < 0.35 * errors["Fading"]


def test_flow_measures_how_far_things_move():
    between = Flow().between(light(0), light(INTERVAL_S))
    assert between.displacement_px == pytest.approx(np.hypot(*SPEED_PX_S) * INTERVAL_S, rel=0.25)


@pytest.mark.parametrize("interpolator", [Flow(), Fading()])
def test_both_ends_are_the_frames_themselves(interpolator):
    first, second = light(0), light(INTERVAL_S)
    between = interpolator.between(first, second)
    np.testing.assert_array_equal(between.at(0.0), first)
    np.testing.assert_allclose(between.at(1.0), second, atol=1e-6)


def test_where_nothing_moves_nothing_is_drawn():
    still = light(0)
    assert Flow().between(still, still.copy()).displacement_px == 0
    # A lamp that is turned up is no movement, as far as flow can tell; the levels between are those of a fade.
    dark, bright = np.full((40, 40), 0.2, np.float32), np.full((40, 40), 0.4, np.float32)
    np.testing.assert_allclose(Flow().between(dark, bright).at(0.5), 0.3, atol=0.01)


def test_tiny_pictures_fade():
    small = np.zeros((4, 4), np.float32)
    assert Flow().between(small, small + 1).displacement_px == 0


def test_number_of_steps():
    assert [num_steps(moved, 0.5, 10) for moved in (0, 0.4, 0.5, 0.51, 3.0, 99)] == [1, 1, 1, 2, 6, 10]


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
