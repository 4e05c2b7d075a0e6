"""A video before a simulated event camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ctlev_core.progress import ProgressBar
from ctlev_core.sensor.dvs_pixel import Sensor
from ctlev_core.sensor.options import SensorOptions
from ctlev_core.video.frames import Frames
from ctlev_core.video.interpolation import Fading, Flow, Interpolator, num_steps
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize

Interpolation = Literal["flow", "fade"]
MAX_STEPS = 200
"""Between two frames; so many are enough for 100 px."""
MAX_NOISE_EVENTS = 10**8
"""Between two frames, whose events lie in memory together: 7 GB."""


@dataclass
class VideoSimulation:
    """A simulated event camera that watches a video; iterate over it for the events, in chunks of a frame's time.

    Attributes:
        frames: the video.
        sensor: kind of camera.
        seed: of the pixels' mismatch and of noise.
        interpolator: what lies between two frames.
        max_displacement_px: the farthest that anything moves between two drawn frames.
        marks: whether events are marked as signal or noise (`Events.signal`).
        last_light: [H, W] the frame that the latest events follow.
        size, num_frames, num_drawn, num_events, duration_us: what has been seen, known while iterating.
    """

    frames: Frames
    sensor: SensorOptions
    seed: int = 0
    interpolator: Interpolator = field(default_factory=Flow)
    max_displacement_px: float = 1.0
    marks: bool = False
    size: SensorSize | None = field(default=None, init=False)
    num_frames: int = field(default=0, init=False)
    num_drawn: int = field(default=0, init=False)
    num_events: int = field(default=0, init=False)
    duration_us: int = field(default=0, init=False)
    last_light: np.ndarray | None = field(default=None, init=False)
    _noise_rate_hz: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        if not self.max_displacement_px > 0:
            raise ValueError(f"max_displacement_px must be above 0, got {self.max_displacement_px}")

    def __iter__(self) -> Iterator[Events]:
        """The events of each interval between two frames, times in us from the first frame on.

        Raises:
            DataError: see `ctlev_core.video.frames.open_frames`; or two frames are so far apart that noise alone sends
                more than `MAX_NOISE_EVENTS` in between.
        """
        camera: Sensor | None = None
        self.last_light, self.duration_us = None, 0
        with ProgressBar(desc="simulate", total=self.frames.expected or None, unit="frame") as bar:
            for t_us, light in self.frames:
                if camera is None:
                    self.size = light.shape[1], light.shape[0]
                    camera = Sensor(
                        self.size, self.sensor, sensor_seed=self.seed, seed=[self.seed, 1], marks=self.marks
                    )
                    self.num_frames = self.num_drawn = self.num_events = 0
                    maps = camera.maps
                    rates_hz = maps.leak / maps.threshold_on + maps.shot_noise_rate_hz + maps.hot_rate_hz
                    self._noise_rate_hz = float(rates_hz.sum())
                events = self._seen(camera, t_us, light)
                self.num_events += len(events)
                yield events
                self.last_light, self.duration_us = light, t_us
                self.num_frames += 1
                bar.update()

    def _seen(self, camera: Sensor, t_us: int, light: np.ndarray) -> Events:
        """The events from the last frame to this one."""
        if self.last_light is None or self.frames.is_dense:
            self.num_drawn += 1
            return camera.push(light[None], np.array([t_us], np.int64))
        span_us = t_us - self.duration_us
        self._check_span(span_us)
        between = self.interpolator.between(self.last_light, light)
        steps = num_steps(between.displacement_px, self.max_displacement_px, min(MAX_STEPS, span_us))
        shares = np.arange(1, steps) / steps
        times = self.duration_us + np.rint(shares * span_us).astype(np.int64)
        self.num_drawn += steps
        drawn = (between.at(share) for share in shares.tolist())
        return camera.push_between(between.moving, drawn, times, light, t_us)

    def _check_span(self, span_us: int) -> None:
        """Times in another unit than seconds would fill the memory with noise."""
        num_noise = self._noise_rate_hz * 1e-6 * span_us
        if num_noise > MAX_NOISE_EVENTS:
            raise DataError(
                f"video: frame {self.num_frames} is {1e-6 * span_us:.6g} s after the one before, in which noise alone "
                f"sends up to {num_noise:.2g} events, expected at most {MAX_NOISE_EVENTS:.0e}. Are the times of the "
                f"frames in seconds? Else take a camera with less noise, or fewer pixels"
            )


def interpolator_of(name: Interpolation) -> Interpolator:
    """The interpolator of a name."""
    return Flow() if name == "flow" else Fading()
