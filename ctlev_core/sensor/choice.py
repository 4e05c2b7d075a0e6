"""The sensor of a simulated dataset: a preset by name or file, with more or less of a real sensor's faults."""

from __future__ import annotations

import math
from pathlib import Path

from ctlev_core.sensor.options import PRESETS, SensorOptions, read_preset

SUFFIXES = (".yaml", ".yml")


def check_sensor_preset(preset: str) -> str:
    """The name itself, for the validator of an option; whether a file is there is seen when it is read.

    Raises:
        ValueError: neither a key of `PRESETS` nor the path of a YAML file.
    """
    if preset not in PRESETS and not preset.endswith(SUFFIXES):
        raise ValueError(f"expected one of {', '.join(PRESETS)}, or a file with suffix {' or '.join(SUFFIXES)}")
    return preset


def sensor_preset_files(preset: str) -> tuple[Path, ...]:
    """The files that the sensor depends on, for `Recording.files`: none where it is a key of `PRESETS`."""
    return () if preset in PRESETS else (Path(preset),)


def read_sensor(preset: str, noise: float = 1.0) -> SensorOptions:
    """The kind of sensor that a preset and a factor on its faults make.

    Args:
        preset: a key of `PRESETS`, or the path of a YAML file as `read_preset` takes it.
        noise: factor on mismatch of thresholds, leak, shot noise and the number of hot pixels; 0 = none of them.
    Raises:
        ValueError: an unknown preset, or a factor that is below 0 or not finite.
        DataError: as `read_preset`.
    """
    if not (math.isfinite(noise) and noise >= 0):
        raise ValueError(f"sensor: noise must be a factor of 0 or more, got {noise}")
    files = sensor_preset_files(check_sensor_preset(preset))
    options = read_preset(files[0]) if files else PRESETS[preset]
    return options.model_copy(
        update={
            "threshold_sigma": noise * options.threshold_sigma,
            "leak_rate_hz": noise * options.leak_rate_hz,
            "shot_noise_rate_hz": noise * options.shot_noise_rate_hz,
            "hot_pixel_fraction": min(noise * options.hot_pixel_fraction, 1.0),
        }
    )
