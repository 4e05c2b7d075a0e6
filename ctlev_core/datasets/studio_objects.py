"""Drawn objects on a screen before a moving event camera: the studio's set for the text route.

It stands in for N-ImageNet and N-Caltech101, which users must download. Each recording is a drawing of its own
(geometry, light, colours, background) and its own subject. The ordinary classes have several names each, as N-ImageNet
has WordNet's. The held-out classes are for an experiment's `target`, of which the generator learns nothing: ten other
things, which it may know from other pictures, as the paper's generator knows the classes of its Table 5; and, harder,
ten compositions of two things, such as `cat on box`.

Splits: some drawings of each class are learnt from, others tested or kept for validation, and one label-only recording
a class says what is sampled.

Source: the recordings are made as for N-ImageNet (Kim et al., ICCV 2021: a camera that moves in a plane before a
monitor) or N-Caltech101 (Orchard et al., Frontiers in Neuroscience 2015: three saccades of 100 ms); the classes and the
drawings are ours.
"""

from __future__ import annotations

import math
import zlib
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import AfterValidator, Field, field_validator

from ctlev_core.sensor.choice import check_sensor_preset, read_sensor, sensor_preset_files
from ctlev_core.studio.camera_paths import Motion, sample_camera_path
from ctlev_core.studio.objects import COLOURS, NAMES, OBJECTS
from data_contracts.config import ADDED_LATER, Frozen
from data_contracts.errors import DataError
from data_contracts.events import Events
from data_contracts.labels import ImageTrack, Labels, Part, Recording

if TYPE_CHECKING:
    from ctlev_core.studio.moving_screen import MovingScreen

VERSION = 2

CLASSES = tuple(NAMES)
"""The ordinary classes, nouns of `ctlev_core.studio.objects.OBJECTS` with outlines of their own."""

UNSEEN = ("banana", "bird", "book", "bottle", "bridge", "bus", "camera", "hat", "heart", "mushroom")
"""The zero-shot classes: other nouns, which look like none of the ordinary ones. Each has one name."""

COMPOSITIONS = (
    "bird on car",
    "boat with fish",
    "cat on box",
    "cat with ball",
    "cup on book",
    "hat on dog",
    "heart with key",
    "house with star",
    "moon with tower",
    "star on house",
)
"""Harder zero-shot classes, compositions of `ctlev_core.studio.compositions`; two differ in the arrangement alone."""

HELD_OUT = UNSEEN + COMPOSITIONS

SPLIT_NAMES = ("train", "test", "condition", "validation")
"""Their order seeds recordings."""
# Streams of random numbers, each with its own seed.
DRAWING_STREAM, PATH_STREAM, SENSOR_STREAM, NOISE_STREAM = 40, 41, 42, 43
MIN_CONTRAST = 0.8
"""Between an object's colour and the background, in log intensity: what cannot be seen has no class."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
GAMMA = 2.2
_LINEAR = (np.arange(256, dtype=np.float32) / 255) ** GAMMA
AMBIENT = 0.06
"""The room's light on the screen, as a share of white: what black sends, so that contrasts stay below 17."""


class Options(Frozen):
    """Options of the drawn objects. The defaults take about a minute to make on one core."""

    seed: int = Field(default=0, ge=0, description="everything follows from it")
    sensor_size: tuple[Annotated[int, Field(ge=16)], Annotated[int, Field(ge=16)]] = Field(
        default=(64, 64), description="(width, height) px"
    )
    classes: tuple[str, ...] = Field(default=(), description="these, ordinary or held out; empty = all ordinary ones")
    num_train_per_class: int = Field(default=50, ge=0, description="recordings to learn from; the paper has 100")
    num_test_per_class: int = Field(default=25, ge=0, description="recordings to test")
    num_validation_per_class: int = Field(
        default=0,
        ge=0,
        json_schema_extra=ADDED_LATER,
        description="recordings to choose options by (`evaluate_on: validation`)",
    )
    recording_duration_us: int = Field(default=300_000, ge=10_000, description="once along the path")
    motion: Motion = Field(default="saccades", description="of the camera: saccades, square, circle or drift")
    motion_extent: float = Field(
        default=0.06, gt=0, le=0.5, description="how far the camera moves, as a share of the sensor's shorter side"
    )
    object_size: tuple[float, float] = Field(
        default=(0.55, 0.85), description="smallest and largest, as a share of the sensor's shorter side"
    )
    sensor_preset: Annotated[str, AfterValidator(check_sensor_preset)] = Field(
        default="noisy",
        description="a key of `ctlev_core.sensor.dvs_pixel.PRESETS`, or a YAML file with a sensor's options",
    )
    num_sensors: int = Field(default=2, ge=1, description="individual sensors of that kind, with their own mismatch")
    noise: float = Field(
        default=1.0, ge=0, le=100, description="factor on mismatch, leak, shot noise and hot pixels; 0 = none"
    )
    intensity_rate_hz: float | None = Field(
        default=None, gt=0, le=10_000, description="grey pictures a second beside the events; None = none"
    )
    max_displacement_px: float = Field(
        default=0.5,
        gt=0,
        description="movement between frames that the sensor sees; 0.7 % of the events of an event image are others "
        "than with 0.05 px, half of that with 0.25 px",
    )

    @field_validator("classes")
    @classmethod
    def _classes_are_known(cls, classes: tuple[str, ...]) -> tuple[str, ...]:
        unknown = [name for name in classes if name not in (*CLASSES, *HELD_OUT)]
        if unknown:
            raise ValueError(f"no class {unknown[0]!r}; there are: {', '.join((*CLASSES, *HELD_OUT))}")
        if len(set(classes)) < len(classes):
            raise ValueError("a class is named twice")
        return classes

    @field_validator("object_size")
    @classmethod
    def _sizes_ascend(cls, sizes: tuple[float, float]) -> tuple[float, float]:
        if not 0.1 <= sizes[0] <= sizes[1] <= 1:
            raise ValueError("expected two shares from 0.1 to 1, the lower first")
        return sizes


def list_recordings(options: Options) -> list[Recording]:
    """Every recording, split by split and class by class; a recording is its own subject.

    Raises:
        DataError: the sensor file cannot be read.
    """
    read_sensor(options.sensor_preset, options.noise)
    counts = (options.num_train_per_class, options.num_test_per_class, 1, options.num_validation_per_class)
    return [
        _recording(split, class_name, index, options)
        for split, count in zip(SPLIT_NAMES, counts, strict=True)
        for class_name in options.classes or CLASSES
        for index in range(count)
    ]


def read_synonyms(options: Options) -> dict[str, list[str]]:
    """Names to draw from, by class name, of the chosen ordinary classes; the held-out ones have one name only."""
    chosen = options.classes or CLASSES
    return {name: NAMES[name] for name in chosen if name in NAMES}


def read_labels(recording: Recording, options: Options) -> Labels:
    """One row: the class, at time 0."""
    return Labels(class_names=(recording.class_name,), t_us=np.zeros(1, np.int64))


def read_events(recording: Recording, options: Options) -> Events:
    """The events of one time along the camera's path; time 0 is its start.

    Raises:
        DataError: the recording is not one of this set with these options, or carries labels only.
    """
    from ctlev_core.sensor.adaptive_rendering import RenderingOptions, simulate_rendered

    screen = moving_screen(recording, options)
    entropy = _entropy(recording, options)
    sensor = int(np.random.default_rng([*entropy, SENSOR_STREAM]).integers(options.num_sensors))
    events, _ = simulate_rendered(
        screen,
        0,
        options.recording_duration_us,
        read_sensor(options.sensor_preset, options.noise),
        RenderingOptions(max_displacement_px=options.max_displacement_px),
        sensor_seed=[options.seed, SENSOR_STREAM, sensor],
        seed=[*entropy, NOISE_STREAM],
        speed_bound=screen.speed_bound,
    )
    return events


def read_intensity_frames(recording: Recording, options: Options) -> ImageTrack:
    """The screen as an ideal camera beside the sensor sees it: linear intensity, white is 255.

    Raises:
        DataError: as `read_events`; or the options ask for no pictures.
    """
    if options.intensity_rate_hz is None:
        raise DataError(f"studio_objects recording {recording.recording_id!r}: intensity_rate_hz asks for no pictures")
    screen = moving_screen(recording, options)
    count = int(1e-6 * options.recording_duration_us * options.intensity_rate_hz + 1e-6) + 1
    times_s = np.arange(count) / options.intensity_rate_hz
    images = np.stack([np.rint(255 * screen(time_s)).astype(np.uint8) for time_s in times_s])
    return ImageTrack(images, np.rint(1e6 * times_s).astype(np.int64))


def moving_screen(recording: Recording, options: Options) -> MovingScreen:
    """What the sensor sees: the drawing of this recording, and the camera's path before it.

    Raises:
        DataError: the recording is not one of this set with these options, or carries labels only.
    """
    from ctlev_core.studio.moving_screen import MovingScreen

    entropy = _entropy(recording, options)
    if not recording.has_events:
        raise DataError(f"studio_objects recording {recording.recording_id!r} carries labels only")
    width, height = options.sensor_size
    extent_px = options.motion_extent * min(width, height)
    path = sample_camera_path(
        np.random.default_rng([*entropy, PATH_STREAM]), options.motion, extent_px, 1e-6 * options.recording_duration_us
    )
    # The screen is finer than the sensor, so that edges move evenly; on a large sensor it needs less of that.
    texels_per_px = 4 if min(width, height) <= 160 else 3
    margin_px = math.ceil(extent_px / 2)
    size = (width + 2 * margin_px) * texels_per_px, (height + 2 * margin_px) * texels_per_px
    visible = min(width, height) / (min(width, height) + 2 * margin_px)
    rng = np.random.default_rng([*entropy, DRAWING_STREAM])
    low, high = (visible * share for share in options.object_size)
    screen = _draw_screen(recording.class_name, size, (low, high), rng)
    return MovingScreen(screen, texels_per_px, options.sensor_size, path)


def _draw_screen(
    class_name: str, size: tuple[int, int], size_range: tuple[float, float], rng: np.random.Generator
) -> np.ndarray:
    """Linear intensity [h, w] of a drawing in the middle of a screen of `size` (width, height)."""
    from ctlev_core.studio.compositions import parse_composition
    from ctlev_core.studio.object_drawing import draw_composition, draw_object
    from ctlev_core.studio.scene import sample_background

    canvas = (sample_background(rng, size, colour=True) ** (1 / GAMMA) * 255).astype(np.uint8)
    colours = _visible_colours(canvas)
    if class_name in OBJECTS:
        picture = draw_object(class_name, str(rng.choice(colours)), canvas, rng, size_range, supersampling=1)
    else:
        # Two of one colour would lose the outline they share.
        first, second = (str(colour) for colour in rng.choice(colours, 2, replace=False))
        composition = parse_composition(class_name)
        picture = draw_composition(composition, (first, second), canvas, rng, size_range, supersampling=1)
    return _luminance(picture)


def _luminance(colour: np.ndarray) -> np.ndarray:
    """Linear intensity [...] in (0, 1] of colours [..., 3] uint8 on the screen."""
    return AMBIENT + (1 - AMBIENT) * (_LINEAR[colour] @ LUMINANCE)


def _visible_colours(canvas: np.ndarray) -> list[str]:
    """Colours that stand out from the mean of a background [h, w, 3] uint8; there are two or more for any."""
    level = _luminance(canvas).mean()
    contrasts = {name: np.log(_luminance(np.array(colour)) / level) for name, colour in COLOURS.items()}
    return [name for name, contrast in contrasts.items() if abs(contrast) >= MIN_CONTRAST]


def _recording(split: str, class_name: str, index: int, options: Options) -> Recording:
    name = f"{split}/{class_name.replace(' ', '_')}_{index:05d}"
    has_events = split != "condition"
    return Recording(
        recording_id=name,
        subject=name,
        parts=(Part(split),),
        class_name=class_name,
        sensor_size=options.sensor_size,
        has_events=has_events,
        has_intensity=has_events and options.intensity_rate_hz is not None,
        files=sensor_preset_files(options.sensor_preset) if has_events else (),
    )


def _entropy(recording: Recording, options: Options) -> list[int]:
    """What seeds a recording: the set's seed, the split, the class and the index within both; not the other classes.

    Raises:
        DataError: there is no such recording with these options.
    """
    split, class_name = recording.recording_id.partition("/")[0], recording.class_name
    index = recording.recording_id.rpartition("_")[2]
    known = split in SPLIT_NAMES and class_name in (options.classes or CLASSES) and index.isdecimal()
    if not known or recording != _recording(split, class_name, int(index), options):
        raise DataError(f"studio_objects with these options has no recording {recording.recording_id!r}")
    return [options.seed, SPLIT_NAMES.index(split), zlib.crc32(class_name.encode()), int(index)]
