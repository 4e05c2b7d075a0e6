"""The DVS pixel: from linear intensity over time to events, with the faults of a real sensor.

Each pixel compares its logarithmic, low-passed photocurrent with the level of its last event, its reference. The model:

    response        log(intensity), below `log_floor` its tangent; linear in time between two frames
    photoreceptor   one-pole low-pass; its bandwidth grows linearly with intensity, from `cutoff_dark_hz` to
                    `cutoff_bright_hz` at white; constant over an interval between two frames, at its mean intensity
    events          whenever the low-passed response is a threshold away from the reference, as often as it takes; each
                    moves the reference by that threshold. Times are the exact crossings under these assumptions
    refractory      an event less than `refractory_us` after the last one that was sent is dropped. The reference moves
                    all the same, and a dropped event does not extend the silence. ESIM's rule; v2e leaves the reference
                    where it is, and so sends the change later; a pixel of silicon starts again from the light at the
                    end of the silence
    leak            the reference falls at a constant rate, which a pixel in still light turns into ON events
    shot noise      a Poisson process; its rate falls linearly with intensity; either polarity; the reference stays
    hot pixels      a Poisson process of ON events, added to that
    signal          what is neither shot noise nor of a hot pixel nor a leak event; and an ON event is one of those if
                    leak did more than half of the way from the last event to the threshold (`marks`)

Every random number comes from a counter-based generator of the pixel's own, seeded by (seed, pixel). So the events are
the same bit for bit however the frames are cut into chunks, and a frame between two equal ones changes nothing.

Source: Lichtsteiner et al., A 128x128 120 dB 15 us latency asynchronous temporal contrast vision sensor, JSSC 2008;
noise after Hu et al., v2e, CVPRW 2021; linear interpolation and the refractory rule after Rebecq et al., ESIM, CoRL
2018. Unlike v2e, times are crossings rather than spread evenly over the frame, the low-pass is solved rather than
stepped, and noise does not depend on the frame rate.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np

from ctlev_core.events.decoding import event_chunks
from ctlev_core.sensor import columns as sensor_columns
from ctlev_core.sensor import kernels
from ctlev_core.sensor.options import PRESETS, PixelMaps, SensorOptions, read_preset, sample_pixel_maps
from data_contracts.errors import DataError
from data_contracts.events import EVENT_DTYPES, Events, SensorSize, check_events

__all__ = [
    "PRESETS", "EventBudgetError", "PixelMaps", "Sensor", "SensorOptions", "read_preset", "sample_pixel_maps",
    "simulate_events",
]  # fmt: skip

PIECE_FRAMES = 64
"""`simulate_events` goes through a recording in chunks of so many frames."""


class EventBudgetError(DataError):
    """More events than asked for at most; `events` are those up to the last chunk that was within the budget."""

    def __init__(self, message: str, events: Events) -> None:
        super().__init__(message)
        self.events = events

    def __reduce__(self) -> tuple:
        return type(self), (str(self), self.events)  # exceptions are pickled with their message alone


class Sensor:
    """A sensor that is shown frames one after the other, in any portions, and sends the same events.

    Args:
        sensor_size: (width, height) px.
        options: the kind of sensor.
        sensor_seed: which one of that kind: thresholds, rates, hot pixels.
        seed: of this recording: noise and reference levels.
        max_events: budget of the whole recording; None = as many as there are. May be changed at any time.
        maps: the pixels, where they are known already; None = those of `sensor_seed`.
        marks: say of each event whether it is signal or noise (`Events.signal`).
    """

    def __init__(
        self,
        sensor_size: SensorSize,
        options: SensorOptions,
        *,
        sensor_seed: int | list[int],
        seed: int | list[int],
        max_events: int | None = None,
        maps: PixelMaps | None = None,
        marks: bool = False,
    ) -> None:
        self.sensor_size = sensor_size
        self.options = options
        self.maps = sample_pixel_maps(sensor_size, options, sensor_seed) if maps is None else maps
        self.max_events = max_events
        self.marks = marks
        self.num_events = 0
        """Events sent so far."""
        self.num_frames = 0
        """Frames seen so far."""
        self._traits = kernels.PixelTraits(
            self.maps.threshold_on.ravel(),
            self.maps.threshold_off.ravel(),
            1e-6 * self.maps.leak.ravel(),
            1e-6 * self.maps.shot_noise_rate_hz.ravel(),
            1e-6 * self.maps.hot_rate_hz.ravel(),
        )
        self._physics = kernels.Physics(
            options.log_floor,
            options.cutoff_dark_hz or 0.0,
            options.cutoff_bright_hz,
            options.shot_noise_rate_bright,
            float(options.refractory_us),
        )
        self._seed = np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]
        planes = {name: np.zeros(sensor_size[0] * sensor_size[1]) for name in kernels.PixelState._fields}
        planes["reference_us"] = planes["reference_us"][: None if marks else 0]
        self._state = kernels.PixelState(**planes | {"random": planes["random"].astype(np.uint64)})
        self._frame = np.zeros(0, np.float32)
        self._first_t_us = self._last_t_us = 0
        # Rows for the events of one interval: exact time, pixel, polarity.
        self._rows = (np.empty(4096), np.empty(4096, np.int32), np.empty(4096, np.uint8))

    def push(self, intensity: np.ndarray, t_us: np.ndarray) -> Events:
        """The events from the last frame pushed before to the last one of these; the very first frame sends none.

        Args:
            intensity: [T, H, W] linear, non-negative, white = 1; computed in float64, whatever its dtype.
            t_us: [T] int64, times of the frames, increasing, later than all before, not negative.
        Returns:
            Events in the order of their time, rounded to whole microseconds, those of one microsecond and interval
            in raster order. An event within half a microsecond of a frame has that frame's time.
        Raises:
            DataError: shapes disagree, times do not increase, or an intensity is negative or not finite.
            EventBudgetError: `max_events` would be exceeded.
            After either, the sensor is as it was before this call: nothing is lost, and it can go on.
        """
        return self.push_exact(intensity, t_us)[0]

    def push_exact(self, intensity: np.ndarray, t_us: np.ndarray) -> tuple[Events, np.ndarray]:
        """As `push`, and the times before rounding: [N] float64, us after the very first frame of this sensor."""
        intensity = _check_frames(intensity, t_us, self.sensor_size, self._last_t_us if self.num_frames else None)
        before = self._snapshot() if self.max_events is not None else None
        found = []
        for frame, time_us in zip(intensity.reshape(len(t_us), -1), t_us.tolist(), strict=True):
            if self.num_frames == 0:
                self._start(frame, time_us)
            else:
                found.append(self._advance(frame, time_us))
            if before is not None and self.num_events > (self.max_events or 0):
                self._restore(before)
                raise EventBudgetError(
                    f"sensor: more than max_events = {self.max_events} events by t = {time_us} us (frame "
                    f"{before[0] + len(found)}); the sensor is as before these {len(t_us)} frames",
                    self._join([])[0],
                )
        return self._join(found)

    def push_between(
        self, moving: np.ndarray, drawn: Iterable[np.ndarray], drawn_us: np.ndarray, intensity: np.ndarray, time_us: int
    ) -> Events:
        """The events from the last frame pushed before to one more, of which some pixels are known in between too.

        The same as `push` of all frames in between, if in those the logarithm of every other pixel changes linearly;
        but others are looked at once. The order of events of one microsecond may differ.

        Args:
            moving: [K] int64 pixels, row by row of the frame, ascending.
            drawn: S times [K], intensity of those pixels at the times in between; one after another, so that memory is
                that of one.
            drawn_us: [S] int64, increasing, after the last frame and before `time_us`.
            intensity: [H, W] the frame.
            time_us: its time.
        Raises:
            DataError: as `push`; but where a later one of `drawn` is wrong the pixels are beyond those before it.
            ValueError: this is the first frame, there is a budget of events, or `drawn` are not as many as times.
        """
        if self.num_frames == 0 or self.max_events is not None:
            raise ValueError("sensor: push_between needs a frame before, and no max_events")
        times = np.append(drawn_us, np.int64(time_us))
        if len(drawn_us) == 0 or len(moving) == 0:
            return self.push(intensity[None], times[-1:])
        frame = self._like_the_last(
            _check_frames(intensity[None], times[-1:], self.sensor_size, self._last_t_us).reshape(-1)
        )
        _check_times(times, self._last_t_us)
        before, begin_us, count = self._frame[moving], float(self._last_t_us - self._first_t_us), 0
        for values, time in zip(itertools.chain(drawn, [frame[moving]]), times, strict=True):
            one = _check_frames(np.asarray(values)[None, None], time[None], (len(moving), 1), None)[0, 0]
            one, end_us = np.array(one, frame.dtype), float(time - self._first_t_us)
            count = self._advance_chosen(before, one, moving, begin_us, end_us, count)
            before, begin_us = one, end_us
        others = np.ones(len(frame), bool)
        others[moving] = False
        (still,) = np.nonzero(others)
        begin_us, end_us = (float(time - self._first_t_us) for time in (self._last_t_us, time_us))
        count = self._advance_chosen(self._frame[still], frame[still], still, begin_us, end_us, count)
        self.num_events += count
        return self._join([self._sorted(frame, time_us, count)])[0]

    def _advance_chosen(
        self, before: np.ndarray, after: np.ndarray, chosen: np.ndarray, begin_us: float, end_us: float, count: int
    ) -> int:
        """Rows filled once those pixels have gone on."""
        number = 0
        while True:
            number, count, needed = kernels.advance_chosen(
                before, after, chosen, begin_us, end_us, self._traits, self._physics, self._state, number,
                self._rows[0], self._rows[1], self._rows[2], count,
            )  # fmt: skip
            if number == len(chosen):
                return count
            self._rows = tuple(_enlarged(column, needed) for column in self._rows)

    def _start(self, frame: np.ndarray, time_us: int) -> None:
        settled = self.options.starts_settled
        kernels.start(frame, self._traits, self._physics, settled, self._seed, self._state)
        # Copies, because the caller may render into the same array again.
        self._frame, self._first_t_us, self._last_t_us, self.num_frames = frame.copy(), time_us, time_us, 1

    def _advance(self, frame: np.ndarray, time_us: int) -> list[np.ndarray]:
        """Columns t, x, y, p and exact times of the events since the last frame."""
        begin_us, end_us = (float(time - self._first_t_us) for time in (self._last_t_us, time_us))
        frame = self._like_the_last(frame)
        pixel, count = 0, 0
        while True:
            pixel, count, needed = kernels.advance(
                self._frame, frame, begin_us, end_us, self._traits, self._physics, self._state, pixel,
                self._rows[0], self._rows[1], self._rows[2], count,
            )  # fmt: skip
            if pixel == len(frame):
                break
            if self.max_events is not None and self.num_events + needed > self.max_events:
                break  # `push_exact` puts everything back
            self._rows = tuple(_enlarged(column, needed) for column in self._rows)
        self.num_events += needed
        return self._sorted(frame, time_us, count)

    def _like_the_last(self, frame: np.ndarray) -> np.ndarray:
        """The frame in the dtype of the last one; where they differ, both in float64 from here on."""
        if frame.dtype != self._frame.dtype:
            frame, self._frame = frame.astype(np.float64), self._frame.astype(np.float64)
        return frame

    def _sorted(self, frame: np.ndarray, time_us: int, count: int) -> list[np.ndarray]:
        """Columns of the rows that are filled, in the order of time; the frame is the last one from here on."""
        begin_us = float(self._last_t_us - self._first_t_us)
        exact_us, pixels, polarity = (column[:count] for column in self._rows)
        span_us = time_us - self._last_t_us
        if span_us <= 4 * count + 4096:
            order = sensor_columns.order_of_stamps(exact_us, begin_us, np.empty(span_us + 2, np.int64))
        else:
            order = np.argsort(np.floor(exact_us - begin_us + 0.5), kind="stable")
        columns = _empty_columns(count, marks=self.marks)
        sensor_columns.write_columns(
            exact_us, pixels, polarity, order, begin_us, self._last_t_us, self.sensor_size[0], *columns[:5]
        )
        if self.marks:
            columns[5][:] = polarity[order] < kernels.NOISE
        self._frame, self._last_t_us = frame.copy(), time_us
        self.num_frames += 1
        return columns

    def _join(self, found: list[list[np.ndarray]]) -> tuple[Events, np.ndarray]:
        found = found or [_empty_columns(0, marks=self.marks)]
        t, x, y, p, exact_us, *signal = (np.concatenate(column) for column in zip(*found, strict=True))
        events = Events(t, x, y, p, self.sensor_size, signal=signal[0] if self.marks else None)
        return check_events(events, "sensor"), exact_us

    def _snapshot(self) -> tuple:
        state = kernels.PixelState(*(plane.copy() for plane in self._state))
        return self.num_frames, self.num_events, state, self._frame, self._first_t_us, self._last_t_us

    def _restore(self, snapshot: tuple) -> None:
        self.num_frames, self.num_events, self._state = snapshot[:3]
        self._frame, self._first_t_us, self._last_t_us = snapshot[3:]


def simulate_events(
    intensity: np.ndarray,
    t_us: np.ndarray,
    options: SensorOptions,
    *,
    sensor_seed: int | list[int],
    seed: int | list[int],
    max_events: int | None = None,
) -> Events:
    """The events a sensor sends while it watches `intensity`.

    Args:
        intensity: [T, H, W] linear, non-negative, white = 1.
        t_us: [T] int64, times of the frames, increasing, not negative.
        options: the kind of sensor.
        sensor_seed: which one of that kind: thresholds, rates, hot pixels.
        seed: of this recording: noise and reference levels.
        max_events: budget; None = as many as there are.
    Returns:
        Events in the order of their time, each within [t_us[0], t_us[-1]].
    Raises:
        DataError: shapes disagree, times do not increase, or an intensity is negative or not finite.
        EventBudgetError: there are more than `max_events`; it carries those of the frames before.
    """
    if intensity.ndim != 3 or 0 in intensity.shape:
        raise DataError(f"sensor: intensity must be [T, H, W] with T, H, W >= 1, got {intensity.shape}")
    size = (intensity.shape[2], intensity.shape[1])
    intensity = _check_frames(intensity, t_us, size, None)
    sensor = Sensor(size, options, sensor_seed=sensor_seed, seed=seed, max_events=max_events)
    chunks: list[Events] = []
    for first in range(0, len(t_us), PIECE_FRAMES):
        try:
            chunks.append(sensor.push(intensity[first : first + PIECE_FRAMES], t_us[first : first + PIECE_FRAMES]))
        except EventBudgetError as error:
            raise EventBudgetError(f"{error}; `events` of this error are those before", join(chunks, size)) from None
    return join(chunks, size)


def join(chunks: list[Events], sensor_size: SensorSize) -> Events:
    """One recording of successive chunks; none give an empty one."""
    return event_chunks.concatenate(chunks or [event_chunks.empty_events(sensor_size)])


def _check_frames(intensity: np.ndarray, t_us: np.ndarray, sensor_size: SensorSize, last_us: int | None) -> np.ndarray:
    """The frames, contiguous and in float32 or float64, or a `DataError`."""
    shape = (len(intensity), sensor_size[1], sensor_size[0])
    if intensity.shape != shape or 0 in shape:
        raise DataError(f"sensor: intensity must be [T, {shape[1]}, {shape[2]}] with T >= 1, got {intensity.shape}")
    if t_us.shape != (len(intensity),) or t_us.dtype != np.int64:
        raise DataError(f"sensor: t_us must be [{len(intensity)}] int64, got {t_us.shape} {t_us.dtype}")
    _check_times(t_us, last_us)
    dtype = np.float32 if intensity.dtype == np.float32 else np.float64
    intensity = np.ascontiguousarray(intensity, dtype)
    bad = sensor_columns.first_bad(intensity.reshape(-1))
    if bad < intensity.size:
        frame, y, x = (int(index) for index in np.unravel_index(bad, shape))
        raise DataError(
            f"sensor: intensity must be finite and not negative, got {intensity[frame, y, x]} at frame {frame}, "
            f"x = {x}, y = {y}"
        )
    return intensity


def _check_times(t_us: np.ndarray, last_us: int | None) -> None:
    late = t_us[1:] <= t_us[:-1]
    if t_us[0] < 0 or late.any():
        frame = int(np.argmax(late)) + 1 if late.any() else 0
        raise DataError(f"sensor: frame times must increase from 0 or later, got t = {t_us[frame]} us at frame {frame}")
    if last_us is not None and t_us[0] <= last_us:
        raise DataError(f"sensor: frame times must increase, got t = {t_us[0]} us after the frame of {last_us} us")


def _empty_columns(count: int, *, marks: bool) -> list[np.ndarray]:
    """The columns of `Events`, that of exact times, and with `marks` that of signal."""
    return [np.empty(count, dtype) for dtype in (*EVENT_DTYPES.values(), np.float64, *([np.bool_] if marks else []))]


def _enlarged(column: np.ndarray, needed: int) -> np.ndarray:
    larger = np.empty(max(needed + 1, 2 * len(column)), column.dtype)
    larger[: len(column)] = column
    return larger
