"""A sensor before a scene that is rendered only as often as it moves.

Between two frames the sensor takes the log intensity as linear, so the error of an event's time is that of the chord. A
frame is asked for when something may have moved by `max_displacement_px` since the last one (where the scene knows a
bound of its speed), or where the chord between two frames misses the one in their middle by more than `tolerance`
(where it does not). A still scene costs a frame every `max_interval_us`, and there is nothing to gain from fewer.

Source: Rebecq et al., ESIM: an open event camera simulator, CoRL 2018, section 3 (both ways of choosing the next time;
there the speed is that of the last frame, here a bound over the interval to come, so that a burst is not overlooked).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from ctlev_core.sensor.dvs_pixel import EventBudgetError, Sensor, SensorOptions, join
from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events


@dataclass(frozen=True, eq=False)
class Patch:
    """The part of a picture that is not background.

    Attributes:
        left: px, column of its first pixel.
        top: px, row of its first pixel.
        intensity: [h, w] linear, non-negative.
    """

    left: int
    top: int
    intensity: np.ndarray


Render = Callable[[float], "np.ndarray | Patch"]
"""The scene at a time in seconds: linear intensity [H, W], or a patch of it before the background."""
SpeedBound = Callable[[float, float], float]
"""Two times in seconds to a speed in px/s that nothing in the picture exceeds between them."""


class RenderingOptions(Frozen):
    """When to ask for the next frame."""

    max_displacement_px: float = Field(default=0.25, gt=0, description="with a speed bound: movement between frames")
    tolerance: float = Field(
        default=0.05, gt=0, description="without one: log intensity by which the chord may miss the middle frame"
    )
    min_interval_us: int = Field(default=100, ge=1, description="frames are never closer, whatever moves")
    max_interval_us: int = Field(default=20_000, ge=1, description="frames are never farther apart, whatever rests")


def simulate_rendered(
    render: Render,
    start_us: int,
    stop_us: int,
    sensor_options: SensorOptions,
    options: RenderingOptions,
    *,
    sensor_seed: int | list[int],
    seed: int | list[int],
    speed_bound: SpeedBound | None = None,
    background: np.ndarray | None = None,
    max_events: int | None = None,
    marks: bool = False,
) -> tuple[Events, np.ndarray]:
    """The events of a rendered scene, and the times at which it was rendered.

    The same seeds are the same sensor and the same noise as in `simulate_events`. Pixels that did not change are not
    computed: the sensor looks at each of them, and no more.

    Args:
        render: the scene; called in any order of times between start and stop, once for each.
        start_us: of the recording; not negative.
        stop_us: its end; the last frame is then.
        sensor_options: the kind of sensor.
        options: how densely to render.
        sensor_seed: which sensor of that kind.
        seed: of this recording's noise.
        speed_bound: how fast anything moves; without it pictures are compared instead.
        background: [H, W] what there is around a `Patch`; needed where `render` returns one.
        max_events: budget; None = as many as there are.
        marks: whether events are marked as signal or noise (`Events.signal`).
    Returns:
        Events, and [F] int64, us: when frames were rendered, in ascending order.
    Raises:
        DataError: stop does not come after start, pictures of different sizes, a patch that does not fit the background
            or comes without one, a speed that is negative or not finite, or what `Sensor.push` refuses.
        EventBudgetError: there are more than `max_events`; it carries those of the frames before.
    """
    if not 0 <= start_us < stop_us:
        raise DataError(f"rendering: expected 0 <= start < stop, got {start_us} and {stop_us} us")
    canvas = _Canvas(render, background)
    if speed_bound is None:
        frames = _by_pictures(canvas, start_us, stop_us, sensor_options.log_floor, options)
    else:
        frames = _by_speed(canvas, start_us, stop_us, speed_bound, options)
    sensor: Sensor | None = None
    chunks: list[Events] = []
    times_us = []
    for time_us, frame in frames:
        size = (frame.shape[1], frame.shape[0])
        # The budget is counted here: a sensor with one keeps a copy of its state for every portion of frames.
        sensor = sensor or Sensor(size, sensor_options, sensor_seed=sensor_seed, seed=seed, marks=marks)
        chunks.append(sensor.push(frame[None], np.array([time_us])))
        if max_events is not None and sensor.num_events > max_events:
            message = f"rendering: more than max_events = {max_events} events by t = {time_us} us of {stop_us} us"
            raise EventBudgetError(message, join(chunks[:-1], size))
        times_us.append(time_us)
    assert sensor is not None  # there are at least the frames at start and stop
    return join(chunks, sensor.sensor_size), np.array(times_us, np.int64)


class _Canvas:
    """Full pictures of a scene that may give patches."""

    def __init__(self, render: Render, background: np.ndarray | None) -> None:
        self._render = render
        self._background = background

    def __call__(self, time_us: int) -> np.ndarray:
        picture = self._render(1e-6 * time_us)
        if not isinstance(picture, Patch):
            if picture.ndim != 2:
                raise DataError(f"rendering: expected a picture [H, W] at {time_us} us, got {picture.shape}")
            return picture
        patch, shape = picture.intensity, None if self._background is None else self._background.shape
        bottom, right = (end + length for end, length in zip((picture.top, picture.left), patch.shape, strict=True))
        fits = shape is not None and min(picture.top, picture.left) >= 0 and bottom <= shape[0] and right <= shape[1]
        if self._background is None or not fits:
            raise DataError(
                f"rendering: a patch of {patch.shape} at row {picture.top}, column {picture.left} does not fit a "
                f"background of {shape} at {time_us} us"
            )
        full = self._background.copy()
        full[picture.top : bottom, picture.left : right] = patch
        return full


def _by_speed(
    canvas: _Canvas, start_us: int, stop_us: int, speed_bound: SpeedBound, options: RenderingOptions
) -> Iterator[tuple[int, np.ndarray]]:
    time_us = start_us
    yield time_us, canvas(time_us)
    while time_us < stop_us:
        interval_us = min(options.max_interval_us, stop_us - time_us)
        while interval_us > options.min_interval_us:
            speed_px_s = speed_bound(1e-6 * time_us, 1e-6 * (time_us + interval_us))
            if not 0.0 <= speed_px_s < math.inf:
                raise DataError(f"rendering: the speed bound must be finite and >= 0, got {speed_px_s} at {time_us} us")
            if speed_px_s * interval_us <= 1e6 * options.max_displacement_px:
                break
            # A shorter interval may have a lower bound, so it is not shortened at once as far as this one asks.
            allowed_us = math.floor(1e6 * options.max_displacement_px / speed_px_s)
            # And always by something: the product above may round to more where the quotient here rounds to the same.
            interval_us = max(min(allowed_us, interval_us - 1), interval_us // 2, options.min_interval_us)
        time_us = min(time_us + interval_us, stop_us)
        yield time_us, canvas(time_us)


def _by_pictures(
    canvas: _Canvas, start_us: int, stop_us: int, log_floor: float, options: RenderingOptions
) -> Iterator[tuple[int, np.ndarray]]:
    """Halve intervals until the chord is good; frames that wait for their turn are as many as halvings."""
    time_us, frame = start_us, canvas(start_us)
    yield time_us, frame
    while time_us < stop_us:
        end_us = min(time_us + options.max_interval_us, stop_us)
        waiting = [(end_us, canvas(end_us))]
        while waiting:
            end_us, end_frame = waiting[-1]
            middle_us = (time_us + end_us) // 2
            if end_us - time_us >= 2 * options.min_interval_us:
                middle = canvas(middle_us)
                if middle.shape != frame.shape or end_frame.shape != frame.shape:
                    raise DataError(f"rendering: pictures of {frame.shape} and {middle.shape}, {end_frame.shape}")
                chord = 0.5 * (_log_response(frame, log_floor) + _log_response(end_frame, log_floor))
                if np.abs(_log_response(middle, log_floor) - chord).max() > options.tolerance:
                    waiting.append((middle_us, middle))
                    continue
                yield middle_us, middle
            yield end_us, end_frame
            time_us, frame = waiting.pop()


def _log_response(intensity: np.ndarray, log_floor: float) -> np.ndarray:
    """As the sensor's: log, below the floor its tangent."""
    above = np.maximum(intensity, log_floor)
    return np.log(above) + np.minimum(intensity - log_floor, 0.0) / log_floor
