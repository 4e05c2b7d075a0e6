"""Baseline: SMPL-ESIM records a moving body and sends the pictures through an ideal event camera.

Source: ControlEvents (Hu et al., WACV 2026) compares with the SMPL-ESIM of Xue et al. (Event-based Non-Rigid
Reconstruction from Contours, BMVC 2022; E-LnR, IJCV 2024), a simulator that renders an SMPL body in motion and derives
events as ESIM does (Rebecq et al., ESIM: an Open Event Camera Simulator, CoRL 2018); EventHands (Rudnev et al., ICCV
2021) does the same for hands. Common to them: a textured mesh moves before a still background, pictures are rendered
closely in time, and each pixel sends an event wherever its log intensity, linear between pictures, is a threshold away
from that of its last event. All of that is here. By default there is no noise, no mismatch of thresholds and no lag in
it, and nothing is learnt from real data: that is the point of the comparison. With `sensor_preset` the same pictures go
through a camera that has all of them, as v2e's does (Hu et al., CVPRW 2021). As in ControlEvents the poses are the ones
that the other generators get.

How we differ:

- People, light and background are procedural (`ctlev_core.studio.scene`) in place of scanned textures and photographs,
  and the body is the bundled one unless a licensed SMPL file is given.
- The next picture is due when something may have moved by `max_displacement_px`, as with ESIM's sampling by optic flow.
  There the flow is that of the last picture; here it is a bound over the interval to come. Between key poses joints
  turn at constant speed.
- Time is in whole microseconds, and the image is its own linear intensity: no exposure, no blur, no gamma.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import AfterValidator, Field

from ctlev_core.body.smpl_files import given_body_file
from ctlev_core.sensor.choice import check_sensor_preset, read_sensor, sensor_preset_files
from ctlev_core.sensor.options import PRESETS, SensorOptions
from data_contracts.config import ADDED_LATER, RUN_SETTING, Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events, SensorSize
from data_contracts.labels import BodyMotions, Conditions, check_body_motions

if TYPE_CHECKING:
    from ctlev_core.body.layer import BodyModel
    from ctlev_core.studio.moving_body import MovingBody

VERSION = 1
MIN_INTERVAL_US, MAX_INTERVAL_US = 100, 20_000
"""Pictures are at most so close and so far apart; ESIM's examples have a minimum of 20 to 30 pictures a second."""
PLAIN_ALBEDO = 0.5


class Options(Frozen):
    """No training options: nothing is trained."""


class SampleOptions(Frozen):
    """Options of the simulation."""

    threshold: float = Field(
        default=0.2, gt=0, description="log-intensity step of an event, of either polarity; that of ESIM's Python code"
    )
    sensor_preset: Annotated[str, AfterValidator(check_sensor_preset)] | None = Field(
        default=None,
        json_schema_extra=ADDED_LATER,
        description="a camera with noise, lag and mismatch of thresholds, which hold in place of `threshold`: "
        "a key of `ctlev_core.sensor.dvs_pixel.PRESETS`, or a YAML file such as calibration writes; null = ESIM's",
    )
    sensor_seed: int = Field(
        default=0,
        ge=0,
        json_schema_extra=ADDED_LATER,
        description="which camera of that kind, with its own hot pixels; all rows are of one",
    )
    max_displacement_px: float = Field(
        default=0.5, gt=0, description="movement between two pictures; lambda = 0.5 is the default of ESIM's code"
    )
    textured: bool = Field(
        default=True, description="clothes, skin and a background with stains; else a grey body before a plain wall"
    )
    max_events: int = Field(
        default=5_000_000, ge=1, description="a row with more is an error: 65 MB, and far beyond any window"
    )
    body: Path | None = Field(
        default=None,
        json_schema_extra=RUN_SETTING,
        description="SMPL file (.pkl, .npz) of the motions' body; the bundled body when null",
    )


def input_files(options: SampleOptions) -> list[Path]:
    """The files of body and sensor where they are given; their content enters the cache key.

    Raises:
        DataError: no such file, or one that describes no sensor.
    """
    files = given_body_file(options.body, "generator 'smpl_esim'")
    if options.sensor_preset is None:
        return files
    read_sensor(options.sensor_preset)
    return [*files, *sensor_preset_files(options.sensor_preset)]


def sample_events(
    conditions: Conditions, sensor_size: SensorSize, options: SampleOptions, *, seeds: Sequence[int]
) -> Iterator[Events]:
    """The events of each row in turn, from its first key pose to its last, before a sensor of `sensor_size`.

    Those of row i depend on row i of the motions and on seeds[i] alone. A body that the camera does not see, or that
    keeps still, sends no events. The caller picks the window and encodes it as real events are.

    Args:
        conditions: N rows with motions; their images are not used.
        sensor_size: (width, height) px, of the sensor that the motions' intrinsics are for.
        options: see `SampleOptions`.
        seeds: N integers: of the person's looks, the light and the background.
    Yields:
        Valid events on the motions' clock, each within [t_us[i, 0], t_us[i, -1]].
    Raises:
        ValueError: there are no motions, or not one seed a row.
        DataError: motions are malformed, the body file is wrong, or (while iterating) a row exceeds `max_events`.
    """
    from ctlev_core.body.layer import load_body

    motions = conditions.motions
    if motions is None:
        raise ValueError("generator 'smpl_esim' needs the motions of bodies; use condition 'body_motion'")
    if not len(seeds) == len(motions) == len(conditions):
        raise ValueError(f"{len(conditions)} conditions but {len(motions)} motions and {len(seeds)} seeds")
    if min(sensor_size) < 1:
        raise ValueError(f"sensor_size must be (width, height) of 1 px or more, got {sensor_size}")
    check_body_motions(motions, "generator 'smpl_esim'")
    body = load_body(options.body)
    # Checked now rather than when the first row is asked for.
    return (_record(motions, row, sensor_size, options, seed, body) for row, seed in enumerate(seeds))


def _record(
    motions: BodyMotions, row: int, sensor_size: SensorSize, options: SampleOptions, seed: int, body: BodyModel
) -> Events:
    """The events of one row."""
    from ctlev_core.sensor.adaptive_rendering import RenderingOptions, simulate_rendered

    scene = _scene(motions, row, sensor_size, options, seed, body)
    start_us, stop_us = (int(time_us) for time_us in motions.t_us[row, [0, -1]])
    try:
        events, _ = simulate_rendered(
            scene,
            0,
            stop_us - start_us,
            _sensor(options),
            RenderingOptions(
                max_displacement_px=options.max_displacement_px,
                min_interval_us=MIN_INTERVAL_US,
                max_interval_us=MAX_INTERVAL_US,
            ),
            sensor_seed=seed if options.sensor_preset is None else options.sensor_seed,
            seed=seed,
            speed_bound=scene.speed_bound,
            background=scene.background,
            max_events=options.max_events,
        )
    except DataError as error:
        raise DataError(f"generator 'smpl_esim', row {row}: {error}") from error
    return replace(events, t=events.t + start_us)


def _sensor(options: SampleOptions) -> SensorOptions:
    if options.sensor_preset is not None:
        return read_sensor(options.sensor_preset)
    threshold = options.threshold
    return PRESETS["ideal"].model_copy(update={"threshold": threshold, "threshold_minimum": threshold})


def _scene(
    motions: BodyMotions, row: int, sensor_size: SensorSize, options: SampleOptions, seed: int, body: BodyModel
) -> MovingBody:
    """A random person in the motion of a row, before its camera; time 0 is the first key pose.

    The clock starts anew because seconds in floating point lose microseconds on a clock that has run for long.
    """
    from ctlev_core.body.rotations import matrix_from_axis_angle
    from ctlev_core.geometry.camera import camera_from_intrinsics
    from ctlev_core.studio.moving_body import MovingBody
    from ctlev_core.studio.scene import sample_background, sample_light, sample_subject

    rng = np.random.default_rng(seed)
    subject = replace(sample_subject(rng, colour=False, body=body), betas=motions.smpl_betas[row])
    light = sample_light(rng)
    background = sample_background(rng, sensor_size, colour=False)
    if not options.textured:
        subject = replace(subject, albedo=np.full_like(subject.albedo, PLAIN_ALBEDO))
        background = np.full_like(background, background.mean())
    return MovingBody(
        subject,
        1e-6 * (motions.t_us[row] - motions.t_us[row, 0]),
        matrix_from_axis_angle(motions.smpl_pose[row].reshape(-1, 24, 3)),
        motions.smpl_transl[row].astype(np.float64),
        camera_from_intrinsics(motions.intrinsics[row], sensor_size),
        background,
        light,
        body,
    )
