"""Baseline: a picture on a monitor before an event camera that makes saccades, as a user of ESIM or v2e would record
it.

Source: N-MNIST and N-Caltech101 (Orchard et al., Converting Static Image Datasets to Spiking Neuromorphic Datasets
Using Saccades, Frontiers in Neuroscience 2015) were recorded so: a pan-tilt unit moves an ATIS along a closed triangle,
three saccades of about 100 ms, before a monitor that shows one picture. Pixels are those of
`ctlev_core.sensor.dvs_pixel`. Nothing is learnt from real frames, but `calibrate` fits to recordings what their makers
could have measured: thresholds, noise, hot pixels, refractory time, size and place of the picture, and whether it is
brighter or darker than its ground.

The default path was measured on 276 recordings of N-MNIST, as that which leaves their events least blurred when it is
taken off them. The two motors do not run together: the tilt ends a saccade when the pan has hardly begun. In these
recordings p = 1 follows the trailing edge of a digit, and noise, nearly all of it p = 1, is what a leak sends: they are
those of a dark digit on a bright ground, `negative`. Whether the monitor showed that, or bright digits and this sensor
leaks towards OFF and calls it 1, events do not tell; it makes no difference to them.

How we differ: the picture moves as on a plane (a pan of a degree or so does that to first order); the monitor does not
flicker; a pixel is silent for its refractory time by ESIM's rule (`ctlev_core.sensor.dvs_pixel`).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field, model_validator

from ctlev_core.render.saccades import NMNIST_PATH_PX, NMNIST_PATH_US, path_frames
from data_contracts.config import Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize
from data_contracts.labels import Conditions

if TYPE_CHECKING:
    from ctlev_core.sensor.options import PixelMaps, SensorOptions

VERSION = 1
WHERE = "generator 'picture_simulator'"
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
BLOCK_VALUES = 1 << 22
"""Pixels of the frames that are held at a time."""


class Options(Frozen):
    """No training options: nothing is trained."""


class SampleOptions(Frozen):
    """Options of the simulation. What is null is calibrated; without recordings it is as in `UNCALIBRATED`."""

    path_us: tuple[int, ...] = Field(
        default=NMNIST_PATH_US,
        description="times of the path's points, from 0 to the end of a recording",
    )
    path_px: tuple[tuple[float, float], ...] = Field(
        default=NMNIST_PATH_PX,
        description="where the picture is then against its start, (x right, y down), smooth in between",
    )
    centre_px: tuple[float, float] | None = Field(
        default=None, description="where the picture's middle is at the start, against the sensor's middle"
    )
    centre_jitter_px: float = Field(default=0.2, ge=0, description="standard deviation of that between recordings")
    picture_share: float | None = Field(
        default=None, gt=0, description="side of the picture as a share of the sensor's shorter side"
    )
    negative: bool | None = Field(default=None, description="the monitor shows the picture's negative")
    flipped: bool | None = Field(default=None, description="p = 1 where light falls instead of rises")
    gamma: float = Field(default=2.2, gt=0, description="of the monitor")
    black: float = Field(default=0.06, ge=1e-3, lt=1, description="light that black sends, as a share of white")
    blur_px: float = Field(default=0.4, ge=0, description="standard deviation of the blur of the optics")
    threshold: float | None = Field(default=None, gt=0, description="log-intensity step of an event, of rising light")
    threshold_off: float | None = Field(default=None, gt=0, description="the same of falling light")
    threshold_spread: float = Field(
        default=0.1, ge=0, lt=0.5, description="standard deviation of thresholds over pixels, as a share of them"
    )
    refractory_us: int | None = Field(default=None, ge=0, description="silence of a pixel after an event")
    leak_rate_hz: float | None = Field(default=None, ge=0, description="noise events a second of one polarity")
    shot_noise_rate_hz: float | None = Field(default=None, ge=0, description="noise events a second of either polarity")
    hot_pixels: tuple[tuple[int, int, float], ...] | None = Field(
        default=None, description="(x, y, Hz) of pixels that fire on their own, as leaks do; those outside are left out"
    )
    rate_spread: float = Field(default=0.5, ge=0, description="log-normal spread of these rates over pixels")
    cutoff_dark_hz: float | None = Field(
        default=None, gt=0, description="bandwidth of a pixel in the dark; null = no low-pass"
    )
    cutoff_bright_hz: float = Field(default=300.0, gt=0, description="the same at white")
    starts_settled: bool = Field(
        default=True, description="pixels start anywhere between their thresholds; else all on the first light"
    )
    sensor_seed: int = Field(default=0, ge=0, description="which sensor of this kind; all recordings are of one")
    max_displacement_px: float = Field(
        default=0.25, gt=0, description="movement between two frames that the sensor sees"
    )
    max_events: int = Field(default=5_000_000, ge=1, description="a row with more is an error")

    @model_validator(mode="after")
    def _path_is_a_path(self) -> SampleOptions:
        times = self.path_us
        if len(times) < 2 or len(self.path_px) != len(times):
            raise ValueError(f"path_us and path_px must be two or more alike, got {len(times)} and {len(self.path_px)}")
        if times[0] != 0 or any(after <= before for before, after in itertools.pairwise(times)):
            raise ValueError(f"path_us must ascend from 0, got {list(times)}")
        return self


UNCALIBRATED = {
    "centre_px": (-2.7, -1.3),
    "picture_share": 28 / 34,
    "negative": False,
    "flipped": False,
    "threshold": 0.42,
    "threshold_off": 0.42,
    "refractory_us": 1780,
    "leak_rate_hz": 0.6,
    "shot_noise_rate_hz": 0.0,
    "hot_pixels": (),
}
"""In place of what neither the user nor a recording says."""


def sample_events(
    conditions: Conditions, sensor_size: SensorSize, options: SampleOptions, *, seeds: Sequence[int]
) -> Iterator[Events]:
    """The events of each row in turn, from 0 to the end of the path.

    Those of row i depend on its picture and on seeds[i] alone.

    Args:
        conditions: N rows with pictures as images [N, S, S, 3] uint8.
        sensor_size: (width, height) px.
        options: see `SampleOptions`.
        seeds: N integers: of the start of the path, the pixels' states and their noise.
    Raises:
        ValueError: there are no pictures, or not one seed a row.
        DataError: while iterating, a row exceeds `max_events`.
    """
    images = conditions.images
    if images is None:
        raise ValueError(f"{WHERE} needs pictures; use condition 'picture'")
    if images.ndim != 4 or images.shape[1] != images.shape[2] or images.shape[3] != 3 or images.dtype != np.uint8:
        raise ValueError(f"{WHERE}: pictures must be [N, S, S, 3] uint8, got {images.shape} {images.dtype}")
    if not len(seeds) == len(images) == len(conditions):
        raise ValueError(f"{WHERE}: {len(conditions)} conditions, {len(images)} pictures and {len(seeds)} seeds")
    if min(sensor_size) < 1:
        raise ValueError(f"sensor_size must be (width, height) of 1 px or more, got {sensor_size}")
    filled = fill(options)
    # Checked now rather than when the first row is asked for.
    return (_record(images[row], row, sensor_size, filled, seed) for row, seed in enumerate(seeds))


def calibrate(
    recordings: Iterable[Events], class_names: Sequence[str], conditions: Conditions, options: SampleOptions
) -> tuple[SampleOptions, dict[str, float]]:
    """Fit what the options leave open to recordings of such pictures; see `ctlev_core.sensor.picture_calibration`.

    Args:
        recordings: whole recordings of the same sensor size, two or more are enough; read one by one.
        class_names: of the recordings.
        conditions: pictures with class names; each recording is compared with pictures of its class.
        options: what is not null in them stays.
    Returns:
        Options without null in what is calibrated, and what was measured.
    Raises:
        DataError: no recording has events.
    """
    from ctlev_core.sensor.picture_calibration import fit

    def simulate(rows: np.ndarray, size: SensorSize, update: dict) -> Iterator[Events]:
        tried = options.model_copy(update=update)
        return sample_events(conditions.take(rows), size, tried, seeds=range(len(rows)))

    given = {name for name in UNCALIBRATED if getattr(options, name) is not None}
    start = {name: getattr(options, name) if name in given else value for name, value in UNCALIBRATED.items()}
    names = conditions.class_names or ("",) * len(conditions)
    found, measured = fit(recordings, class_names, names, simulate, start, given, options.path_us[-1])
    return options.model_copy(update=found), measured


def fill(options: SampleOptions) -> SampleOptions:
    """The options with `UNCALIBRATED` values in the place of null."""
    missing = {name: value for name, value in UNCALIBRATED.items() if getattr(options, name) is None}
    if "threshold_off" in missing and options.threshold is not None:
        missing["threshold_off"] = options.threshold
    return options.model_copy(update=missing)


def _record(image: np.ndarray, row: int, sensor_size: SensorSize, options: SampleOptions, seed: int) -> Events:
    """The events of one picture."""
    from ctlev_core.render.panned_picture import pan
    from ctlev_core.sensor.dvs_pixel import Sensor, join

    times_us, moved_px = path_frames(options.path_us, options.path_px, options.max_displacement_px)
    rng = np.random.default_rng(seed)
    assert options.centre_px is not None and options.picture_share is not None
    start_px = np.array(options.centre_px) + np.array(sensor_size) / 2 + rng.normal(0, options.centre_jitter_px, 2)
    side_px = options.picture_share * min(sensor_size)
    light, background = _light(image, options)
    kind, maps = _sensor(sensor_size, options)  # pyright: ignore[reportArgumentType]  # frozen models have a hash
    sensor = Sensor(
        sensor_size,
        kind,
        maps=maps,
        sensor_seed=options.sensor_seed,
        seed=[int(rng.integers(2**63))],
        max_events=options.max_events,
    )
    block = max(BLOCK_VALUES // (sensor_size[0] * sensor_size[1]), 1)
    chunks = []
    for first in range(0, len(times_us), block):
        part = slice(first, first + block)
        frames = pan(light, background, side_px, sensor_size, start_px + moved_px[part], options.blur_px)
        try:
            chunks.append(sensor.push(frames, times_us[part]))
        except DataError as error:
            raise DataError(f"{WHERE}, row {row}: {error}") from error
    events = join(chunks, sensor_size)
    return Events(events.t, events.x, events.y, 1 - events.p, sensor_size) if options.flipped else events


def _light(image: np.ndarray, options: SampleOptions) -> tuple[np.ndarray, float]:
    """Linear light [S, S] of a picture on the monitor, and that of the ground around it, its border's median."""
    values = 255 - image if options.negative else image
    linear = (np.arange(256) / 255) ** options.gamma
    light = options.black + (1 - options.black) * (linear[values] @ LUMINANCE)
    return light, float(np.median(np.concatenate([light[0], light[-1], light[:, 0], light[:, -1]])))


@functools.lru_cache(maxsize=4)
def _sensor(sensor_size: SensorSize, options: SampleOptions) -> tuple[SensorOptions, PixelMaps]:
    """The kind of sensor, and the pixels of the one among them that all recordings are made with."""
    from ctlev_core.sensor.options import SensorOptions, sample_pixel_maps

    assert options.threshold is not None and options.threshold_off is not None
    kind = SensorOptions(
        threshold=options.threshold,
        threshold_off=options.threshold_off,
        threshold_sigma=options.threshold_spread * (options.threshold * options.threshold_off) ** 0.5,
        threshold_minimum=min(options.threshold, options.threshold_off) / 4,
        log_floor=1e-3,
        cutoff_dark_hz=options.cutoff_dark_hz,
        cutoff_bright_hz=options.cutoff_bright_hz,
        refractory_us=options.refractory_us or 0,
        leak_rate_hz=options.leak_rate_hz or 0.0,
        shot_noise_rate_hz=options.shot_noise_rate_hz or 0.0,
        shot_noise_rate_bright=1.0,
        rate_spread=options.rate_spread,
        starts_settled=options.starts_settled,
    )
    maps = sample_pixel_maps(sensor_size, kind, options.sensor_seed)
    for x, y, rate_hz in options.hot_pixels or ():
        if 0 <= x < sensor_size[0] and 0 <= y < sensor_size[1]:
            maps.hot_rate_hz[y, x] = rate_hz
    return kind, maps
