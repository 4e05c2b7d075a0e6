"""Options of the `studio` dataset: how many recordings, of whom, seen by what kind of sensor, how difficult."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from ctlev_core.sensor.choice import check_sensor_preset
from data_contracts.config import ADDED_LATER, Frozen


class Options(Frozen):
    """Options of the studio. The defaults are a small set that is made in a few minutes on one core."""

    seed: int = Field(default=0, ge=0, description="Everything in the studio follows from it.")
    sensor_size: tuple[int, int] = Field(default=(64, 64), description="(width, height) px.")
    num_train_recordings: int = Field(default=600, ge=0, description="Performances of subjects 0 to 3, SEEN motions.")
    num_test_recordings: int = Field(
        default=300, ge=0, description="Performances of subjects 4 and 5, all motions in turn."
    )
    num_validation_recordings: int = Field(
        default=0,
        ge=0,
        json_schema_extra=ADDED_LATER,
        description="Performances of as many other subjects as are tested, the motions of test recordings but those "
        "that only they show: to choose options by (`evaluate_on: validation`).",
    )
    num_condition_recordings: int = Field(
        default=1200, ge=0, description="Label-only recordings of random people, UNSEEN motions."
    )
    record_conditions: bool = Field(
        default=False,
        description="Record events of the people of split `condition` too, as training data: the most that synthetic "
        "data of their poses can give.",
    )
    num_cameras: int = Field(
        default=1,
        ge=1,
        le=16,
        description="Still cameras around each performance with events, a recording each; DHP19 has 4.",
    )
    recording_duration_us: int = Field(default=250_000, ge=10_000, description="Length of a recording.")
    label_rate_hz: float = Field(
        default=200.0, gt=0, le=10_000, description="Labels a second; DHP19's motion capture has 100."
    )
    condition_rate_hz: float = Field(
        default=50.0, gt=0, le=10_000, description="Labels a second, at least two, of a label-only recording."
    )
    intensity_rate_hz: float | None = Field(
        default=None,
        gt=0,
        le=10_000,
        description="Grey pictures a second, of label-only recordings too; None = none, as in DHP19.",
    )
    max_displacement_px: float = Field(
        default=0.5,
        gt=0,
        description="Movement between frames that the sensor sees; half of it costs double.",
    )
    max_events: int = Field(default=20_000_000, ge=1, description="A recording with more is an error.")
    num_train_subjects: int = Field(default=4, ge=1, description="Subjects 0 .. n - 1.")
    num_test_subjects: int = Field(default=2, ge=1, description="The subjects after those.")
    in_distribution_tests: bool = Field(
        default=False,
        json_schema_extra=ADDED_LATER,
        description="Tests show the subjects and motions of training recordings, in other performances; of a perfect "
        "generator `c2st` is then 0.5.",
    )
    num_sensors: int = Field(
        default=2, ge=1, description="Individual sensors of each camera, with their own mismatch and hot pixels."
    )
    sensor_preset: Annotated[str, AfterValidator(check_sensor_preset)] = Field(
        default="noisy",
        description="A key of `ctlev_core.sensor.dvs_pixel.PRESETS`, or a YAML file such as calibration writes.",
    )
    noise: float = Field(
        default=1.0, ge=0, description="Factor on the sensor's mismatch, leak, shot noise and number of hot pixels."
    )
    joint_set: Literal["dhp19", "cdehp", "smpl"] = Field(
        default="dhp19",
        description="13 markers in the order of DHP19 or of CDEHP, or the 24 joints of SMPL as Event-HPE has them.",
    )
    occlusion: bool = Field(
        default=False, description="Joints that the body itself hides are not visible; markers' labels do not say."
    )
    yaw_range_deg: tuple[float, float] = Field(
        default=(0.0, 360.0),
        description="From where cameras look at people who face +z, 0 = from the front; several share the range.",
    )
    distance_m: tuple[float, float] = Field(default=(3.2, 4.0), description="Of a camera from the person.")
    focal_per_side: tuple[float, float] = Field(
        default=(1.5, 1.5), description="Focal length over the shorter side of the sensor; above 2 people are cropped."
    )
    brightness: tuple[float, float] = Field(
        default=(1.0, 1.0), description="Of a recording's light; 0.1 = a dim room, where pixels are slow and noisy."
    )
    textured: bool = Field(default=True, description="False: grey people before a plain wall, as in naive simulations.")

    @model_validator(mode="after")
    def _ranges_ascend(self) -> Options:
        for name, least, most in (
            ("yaw_range_deg", -720.0, 720.0),
            ("distance_m", 0.5, 100.0),
            ("focal_per_side", 0.1, 20.0),
            ("brightness", 0.01, 1.0),
        ):
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                raise ValueError(
                    f"{name} must be two numbers from {least:g} to {most:g}, the lower first, got ({low:g}, {high:g})"
                )
        if min(self.sensor_size) < 1:
            raise ValueError(f"sensor_size must be (width, height) of 1 px or more, got {self.sensor_size}")
        return self
