"""Kinds of sensors, and the individual ones among them: options, presets, thresholds and rates of each pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError, model_validator

from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.events import SensorSize


class SensorOptions(Frozen):
    """One kind of sensor. The defaults are an ideal one; `PRESETS["noisy"]` is a real one."""

    threshold: float = Field(default=0.2, gt=0, description="Mean log-intensity step of an event.")
    threshold_off: float | None = Field(
        default=None, gt=0, description="The mean step of OFF events where it is another; None = that of ON events."
    )
    threshold_sigma: float = Field(default=0.0, ge=0, description="Standard deviation of the thresholds over pixels.")
    threshold_minimum: float = Field(default=0.05, gt=0, description="No pixel is more sensitive than this.")
    log_floor: float = Field(default=0.02, gt=0, description="Below this intensity the response is linear; white is 1.")
    cutoff_dark_hz: float | None = Field(
        default=None, gt=0, description="Photoreceptor bandwidth in the dark; None = none."
    )
    cutoff_bright_hz: float = Field(default=180.0, gt=0, description="Photoreceptor bandwidth at white.")
    refractory_us: int = Field(default=0, ge=0, description="Time after an event in which a pixel stays silent.")
    leak_rate_hz: float = Field(
        default=0.0,
        ge=0,
        description="ON events a second of a pixel that sees nothing happen; half of them in the first 1 / rate "
        "seconds of a recording that starts settled.",
    )
    shot_noise_rate_hz: float = Field(
        default=0.0, ge=0, description="Noise events a second of a dark pixel, either polarity."
    )
    shot_noise_rate_bright: float = Field(
        default=0.25, ge=0, le=1, description="Share of the shot noise left at white."
    )
    rate_spread: float = Field(default=0.0, ge=0, description="Log-normal spread of leak and shot rates over pixels.")
    hot_pixel_fraction: float = Field(default=0.0, ge=0, le=1, description="Pixels that fire on their own.")
    hot_rate_hz: tuple[float, float] = Field(default=(20.0, 150.0), description="Their rates, uniform in this range.")
    starts_settled: bool = Field(
        default=True, description="False: the first frame is the reference level of every pixel."
    )

    @model_validator(mode="after")
    def _rates_ascend(self) -> SensorOptions:
        low, high = self.hot_rate_hz
        if not 0 <= low <= high:
            raise ValueError(f"hot_rate_hz must be two rates, the lower first, got {self.hot_rate_hz}")
        return self

    @model_validator(mode="after")
    def _thresholds_are_not_below_the_least(self) -> SensorOptions:
        for name, mean in (("threshold", self.threshold), ("threshold_off", self.threshold_off)):
            if mean is not None and mean < self.threshold_minimum:
                least = f"threshold_minimum, {self.threshold_minimum:g}"
                raise ValueError(f"{name} must be at least {least}, got {mean:g}: lower that too")
        return self


PRESETS = {
    # What ESIM assumes: nothing but thresholds, and the first frame as the reference.
    "ideal": SensorOptions(starts_settled=False),
    # v2e's preset of this name: a trace of mismatch, no noise, no lag.
    "clean": SensorOptions(threshold_sigma=0.02),
    "noisy": SensorOptions(
        threshold=0.25,
        threshold_sigma=0.035,
        cutoff_dark_hz=20.0,
        refractory_us=500,
        leak_rate_hz=0.25,
        shot_noise_rate_hz=0.6,
        rate_spread=0.5,
        hot_pixel_fraction=0.0034,
    ),
    # A DAVIS346 indoors. Thresholds, mismatch, refractory time, bandwidth (300 Hz at white, 20/275 of it in the dark)
    # and the linear part below 20/255 are v2e's for this camera; 0.1 Hz of leak is the typical rate named there. Shot
    # noise lies between v2e's presets `clean` (0) and `noisy` (5 Hz); spread and hot pixels are our choice.
    "dvs346": SensorOptions(
        threshold=0.2,
        threshold_sigma=0.03,
        log_floor=20 / 255,
        cutoff_dark_hz=300 * 20 / 275,
        cutoff_bright_hz=300.0,
        refractory_us=500,
        leak_rate_hz=0.1,
        shot_noise_rate_hz=1.0,
        rate_spread=0.5,
        hot_pixel_fraction=0.0008,
    ),
    # A DVXplorer indoors: what `ctlev_core.sensor.calibration` estimates, on the base `noisy`, from one recording of
    # 0.59 s of a person before such a camera, 320 x 240 px. Measured are leak, shot noise, its spread over pixels, hot
    # pixels, and the shortest interval, which is this sensor's period of readout rather than the silence of a pixel.
    # Thresholds, bandwidth and `log_floor` cannot be told from events and are those of `noisy`.
    "dvxplorer": SensorOptions(
        threshold=0.25,
        threshold_sigma=0.035,
        cutoff_dark_hz=20.0,
        refractory_us=197,
        leak_rate_hz=0.01,
        shot_noise_rate_hz=0.081,
        shot_noise_rate_bright=1.0,
        rate_spread=1.84,
        hot_pixel_fraction=0.00078,
        hot_rate_hz=(34.0, 498.0),
    ),
}


@dataclass(frozen=True, eq=False)
class PixelMaps:
    """What distinguishes the pixels of one sensor, all [H, W] float64.

    Attributes:
        threshold_on: log-intensity step of an ON event.
        threshold_off: log-intensity step of an OFF event, positive.
        leak: fall of the reference level, log intensity per second.
        shot_noise_rate_hz: noise events a second in the dark.
        hot_rate_hz: ON events a second of a hot pixel, 0 elsewhere.
    """

    threshold_on: np.ndarray
    threshold_off: np.ndarray
    leak: np.ndarray
    shot_noise_rate_hz: np.ndarray
    hot_rate_hz: np.ndarray


def sample_pixel_maps(sensor_size: SensorSize, options: SensorOptions, seed: int | list[int]) -> PixelMaps:
    """The pixels of the sensor `seed`: the same sensor has the same mismatch and hot pixels for ever."""
    rng = np.random.default_rng(seed)
    shape = sensor_size[::-1]

    def thresholds(mean: float) -> np.ndarray:
        return np.maximum(rng.normal(mean, options.threshold_sigma, shape), options.threshold_minimum)

    def rates(mean: float) -> np.ndarray:
        # exp(-s^2 / 2) keeps the mean of the log-normal at 1.
        return mean * np.exp(rng.normal(-(options.rate_spread**2) / 2, options.rate_spread, shape))

    threshold_on = thresholds(options.threshold)
    threshold_off = thresholds(options.threshold_off or options.threshold)
    leak, shot_noise_rate_hz = rates(options.leak_rate_hz) * threshold_on, rates(options.shot_noise_rate_hz)
    hot = rng.choice(math.prod(shape), round(options.hot_pixel_fraction * math.prod(shape)), replace=False)
    hot_rate_hz = np.zeros(shape)
    hot_rate_hz.ravel()[hot] = rng.uniform(*options.hot_rate_hz, len(hot))
    return PixelMaps(threshold_on, threshold_off, leak, shot_noise_rate_hz, hot_rate_hz)


def read_preset(path: Path) -> SensorOptions:
    """A kind of sensor from a YAML file of `SensorOptions`, such as `ctlev_core.sensor.calibration` writes.

    Raises:
        DataError: the file cannot be read, is not a table of options, or an option is unknown or out of range.
    """
    import yaml

    from data_contracts.yaml_text import load_yaml

    try:
        content = load_yaml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DataError(f"{path}: not a sensor preset: {error}") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: a sensor preset must be a table of options, got {type(content).__name__}")
    try:
        return SensorOptions(**content)
    except (ValidationError, TypeError) as error:
        raise DataError(f"{path}: not a sensor preset: {error}") from error
