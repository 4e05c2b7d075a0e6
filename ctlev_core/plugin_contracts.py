"""What a plug-in of each kind must have, and what it may have, as Protocols.

A plug-in is a module of `ctlev_core/<kind>/`, found by its name (`ctlev_core.plugins`). Beside the functions below each
has `VERSION` (raise it when its output changes) and `class Options(Frozen)`. Heavy imports (torch, diffusers, numba) go
inside functions, because the plan of an experiment loads every plug-in's options and nothing else.

What only some plug-ins of a kind can do is a Protocol of its own that extends the kind's. A plug-in can do it by having
its functions, and callers ask with `isinstance(module, DatasetWithChunks)`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ctlev_core.body.motion.clip import MotionClip
from ctlev_core.scoring.score_info import ScoreInfo
from data_contracts.config import ConditionChoice, Frozen
from data_contracts.events import Events, SensorSize
from data_contracts.image_rows import Images
from data_contracts.labels import BodyMotions, Conditions, History, ImageTrack, Labels, Recording


@runtime_checkable
class PluginWithFiles(Protocol):
    """A plug-in of any kind that reads files of its own: weights, a body, pictures."""

    def input_files(self, options: Any) -> list[Path]:
        """The files it reads, checked to be there; options that name them put their content into the cache key."""
        ...


@runtime_checkable
class Dataset(Protocol):
    """Where recordings come from. `list_recordings` is cheap and raises before anything long starts."""

    VERSION: int
    Options: type[Frozen]

    def list_recordings(self, options: Any) -> list[Recording]:
        """Every recording of every split, in a stable order."""
        ...

    def read_events(self, recording: Recording, options: Any) -> Events:
        """The events of one recording, checked. Not called where `recording.has_events` is False."""
        ...

    def read_labels(self, recording: Recording, options: Any) -> Labels:
        """The label track of one recording; a class-only dataset returns one row."""
        ...


@runtime_checkable
class DatasetWithChunks(Dataset, Protocol):
    """A dataset whose recordings may be larger than memory."""

    def read_event_chunks(self, recording: Recording, options: Any) -> Iterator[Events]:
        """The events of `read_events` in consecutive chunks."""
        ...


@runtime_checkable
class DatasetWithWindows(Dataset, Protocol):
    """A dataset whose authors cut recordings into windows in a way of their own."""

    def read_windows(self, recording: Recording, options: Any) -> np.ndarray | None:
        """Index ranges [W, 2] int64 into the events of `read_events`, in order; used by the window method `dataset`.

        None: of this recording there are none.
        """
        ...


@runtime_checkable
class DatasetWithWindowLabels(DatasetWithWindows, Protocol):
    """A dataset whose authors also have a rule of their own for the label of a window."""

    def read_window_labels(self, recording: Recording, options: Any) -> Labels | None:
        """One row for each range of `read_windows`; None: the track's labels hold."""
        ...


@runtime_checkable
class DatasetWithSynonyms(Dataset, Protocol):
    """A dataset whose classes have several names, such as the WordNet lemmas of N-ImageNet."""

    def read_synonyms(self, options: Any) -> dict[str, list[str]]:
        """The names of each class that has more than its `class_name`; prompts draw from them."""
        ...


@runtime_checkable
class DatasetWithEventImages(Dataset, Protocol):
    """A dataset that releases finished event images of some recordings."""

    def read_event_images(self, recording: Recording, options: Any) -> ImageTrack:
        """Of a recording with `has_event_images`."""
        ...


@runtime_checkable
class DatasetWithIntensity(Dataset, Protocol):
    """A dataset with grey pictures taken beside the events, what Event-GAN learns from."""

    def read_intensity_frames(self, recording: Recording, options: Any) -> ImageTrack:
        """Of a recording with `has_intensity`."""
        ...


@runtime_checkable
class Format(Protocol):
    """A raw event file format.

    `HAS_SIGNATURE` is False where files carry none: `sniff` then takes what is merely plausible, and is asked only
    where no other format knows the file (`ctlev_core.events.files.find_format`).
    """

    VERSION: int
    HAS_SIGNATURE: bool
    SUFFIXES: tuple[str, ...]

    def sniff(self, path: Path) -> bool:
        """Does the content look like this format?"""
        ...

    def read(self, path: Path) -> Events:
        """The whole file, checked with `check_events`."""
        ...

    def read_chunks(self, path: Path, num_events: int) -> Iterator[Events]:
        """The events of `read` in consecutive chunks of about `num_events`, in memory that does not grow with the file.

        Every chunk is checked and has the sensor size of the whole file.
        """
        ...


@runtime_checkable
class FormatWithWriter(Format, Protocol):
    """A format that is written too."""

    def write(self, path: Path, events: Events) -> None:
        """Write one recording, in the form that `read` gives back."""
        ...


@runtime_checkable
class FormatWithCheck(Format, Protocol):
    """A format whose files tell whether they were cut, without being decoded."""

    def check_complete(self, path: Path) -> None:
        """Raise `DataError` where the file is cut, in a time that hardly depends on its length."""
        ...


@runtime_checkable
class MotionFormat(Protocol):
    """A file format of motions: poses over time.

    `HAS_SIGNATURE` has the meaning that it has for a `Format` (`ctlev_core.body.motion.files.find_format`).
    """

    VERSION: int
    HAS_SIGNATURE: bool
    SUFFIXES: tuple[str, ...]

    def sniff(self, path: Path) -> bool:
        """Does the content look like this format?"""
        ...

    def read(self, path: Path) -> MotionClip:
        """Every frame of the file, checked with `check_clip`: metres, y up, the poses those of SMPL's 24 joints."""
        ...


@runtime_checkable
class MotionFormatWithoutRate(MotionFormat, Protocol):
    """A motion format whose files need not say how fast they are; `RATE_HZ` is what it assumes."""

    RATE_HZ: float

    def read(self, path: Path, rate_hz: float = ...) -> MotionClip:
        """As `MotionFormat.read`, at `rate_hz` frames a second where the file does not say."""
        ...


@runtime_checkable
class Encoding(Protocol):
    """Events to arrays, arrays to images and back."""

    VERSION: int
    Options: type[Frozen]

    def encode(self, events: Events, windows: np.ndarray, options: Any) -> np.ndarray:
        """[N, C, H, W] of the event index ranges `windows` [N, 2] int64: uint16 counts, or float32.

        At `image_grid.count_size`: in pixels of the sensor, or with resampling `events` in those of the image. N
        may be 0, which tells how many windows fit into memory.
        """
        ...

    def render_image(self, histogram: np.ndarray, options: Any) -> np.ndarray:
        """Images [N, image height, image width, 3] uint8 of the counts."""
        ...

    def map_points(self, points: np.ndarray, sensor_size: SensorSize, options: Any) -> np.ndarray:
        """Points [..., 2] in sensor pixels to image pixels."""
        ...


@runtime_checkable
class Condition(Protocol):
    """Labels to what the generator is asked for.

    `NEEDS` is what it is made of beside labels: nothing (""), `intensity` (`ConditionOfPairs`), `motion`
    (`ConditionOfMotions`) or `displacement` (`ConditionOfDisplacements`).
    """

    VERSION: int
    NEEDS: str
    Options: type[Frozen]

    def render(self, labels: Labels, image_size: tuple[int, int], options: Any, seeds: Sequence[int]) -> Conditions:
        """One condition a row; `seeds` (one a row) feeds what is drawn at random, for example a class synonym."""
        ...


@runtime_checkable
class ConditionOfClasses(Condition, Protocol):
    """A condition that has something to show of certain classes only."""

    def check_classes(self, class_names: Iterable[str], options: Any) -> None:
        """Raise `DataError` for a class that cannot be shown, before an experiment starts."""
        ...


@runtime_checkable
class ConditionThatTurns(Condition, Protocol):
    """A condition whose images are not turned as pictures are: their colours are directions."""

    def turn(self, images: np.ndarray, turns: np.ndarray, options: Any) -> np.ndarray:
        """Square images [B, S, S, 3] in `turns` [B] quarter turns against the clock."""
        ...


@runtime_checkable
class ConditionOfPairs(Protocol):
    """A condition made of the grey pictures taken at a window's start and end: `NEEDS = "intensity"`."""

    VERSION: int
    NEEDS: str
    Options: type[Frozen]

    def render(
        self, labels: Labels, image_size: tuple[int, int], options: Any, seeds: Sequence[int], pairs: np.ndarray
    ) -> Conditions:
        """As `Condition.render`; `pairs` [N, H, W, 2] uint8 are the pictures, in image pixels."""
        ...


@runtime_checkable
class ConditionOfMotions(Protocol):
    """A condition that is what a body does around the moment it is labelled at: `NEEDS = "motion"`."""

    VERSION: int
    NEEDS: str
    Options: type[Frozen]

    def render(
        self, labels: Labels, image_size: tuple[int, int], options: Any, seeds: Sequence[int], motions: BodyMotions
    ) -> Conditions:
        """As `Condition.render`; row i of `motions` is the body of row i of `labels`."""
        ...


@runtime_checkable
class ConditionOfDisplacements(Protocol):
    """A condition that shows where joints come from and go to: `NEEDS = "displacement"`."""

    VERSION: int
    NEEDS: str
    Options: type[Frozen]

    def render(
        self, labels: Labels, image_size: tuple[int, int], options: Any, seeds: Sequence[int], displacements: np.ndarray
    ) -> Conditions:
        """As `Condition.render`; `displacements` [N, 2, J, 2] px to `options.reach_us` before and after, NaN = unknown.

        Images are in the pixels of the labels.
        """
        ...


@runtime_checkable
class Generator(Protocol):
    """Learns frames from conditions, then makes new frames for new conditions."""

    VERSION: int
    Options: type[Frozen]
    SampleOptions: type[Frozen]

    def base_model_folders(self, options: Any) -> list[Path]:
        """The folders of the pre-trained weights, checked to be there; their content enters the cache key."""
        ...

    def train(
        self, frames: Images, conditions: Conditions, options: Any, *, seed: int, out: Path, work: Path
    ) -> History:
        """Write a checkpoint folder to `out`; keep resumable state in `work`."""
        ...

    def sample(
        self, checkpoint: Path, conditions: Conditions, options: Any, *, seeds: Sequence[int], work: Path
    ) -> np.ndarray:
        """Frames [N, H, W, 3] uint8; row i depends on conditions[i] and seeds[i] alone."""
        ...


@runtime_checkable
class GeneratorInShards(Generator, Protocol):
    """A generator whose frames lie in files of `diffusion.sampling.shards` first, which several machines may write."""

    def sample_shards(
        self, checkpoint: Path, conditions: Conditions, options: Any, *, seeds: Sequence[int], work: Path, only: slice
    ) -> None:
        """Write those that `only` names of the files which `sample`, called with the same, would write and join."""
        ...


@runtime_checkable
class GeneratorFromWeights(Generator, Protocol):
    """A generator whose base model has a size and perhaps colours of its own."""

    def check_fit(self, options: Any, image_size: tuple[int, int] | None, condition: ConditionChoice) -> None:
        """Raise `DataError` unless images of `image_size` px (None = not known yet) and conditions fit its weights."""
        ...


@runtime_checkable
class GeneratorOfLatents(Generator, Protocol):
    """A generator that learns from latents of frames, which may be encoded before, once for several trainings."""

    def latent_options(self, options: Any) -> Any:
        """`LatentOptions` of the stage that encodes them; None: each training does so itself."""
        ...

    def train_from_latents(
        self,
        frames: Images,
        conditions: Conditions,
        options: Any,
        *,
        latents: Any,
        seed: int,
        out: Path,
        work: Path,
    ) -> History:
        """As `train`, with the same result; `latents` are those of the frames."""
        ...


@runtime_checkable
class GeneratorOfNames(Generator, Protocol):
    """A generator that reads words, and can tell which names are alike to it."""

    def embed_names(self, checkpoint: Path, names: Sequence[str]) -> np.ndarray:
        """[N, D] vectors of N names, to be compared by their cosines."""
        ...


@runtime_checkable
class EventGenerator(Protocol):
    """Simulates events instead of frames, and learns nothing; its events are encoded as the recorded ones are."""

    VERSION: int
    Options: type[Frozen]
    SampleOptions: type[Frozen]

    def sample_events(
        self, conditions: Conditions, sensor_size: SensorSize, options: Any, *, seeds: Sequence[int]
    ) -> Iterator[Events]:
        """The events of each row in turn, from its first key pose to its last.

        Those of row i depend on row i of `conditions` and seeds[i] alone. A row may have no events.
        """
        ...


@runtime_checkable
class CalibratedEventGenerator(EventGenerator, Protocol):
    """A simulator that can be fitted to the training recordings of an experiment."""

    def calibrate(
        self, recordings: Iterable[Events], class_names: Sequence[str], conditions: Conditions, options: Any
    ) -> tuple[Any, dict[str, float]]:
        """`SampleOptions` in which nothing is left open, and what they were made of, by name with units.

        `recordings` are read one by one and `class_names` are theirs; `conditions` are those that will be simulated,
        with their class names. What the user has set stays. Deterministic.
        """
        ...


@runtime_checkable
class Downstream(Protocol):
    """A model of the task the synthetic data is for.

    `PREDICTS` are those of the following that `predict` returns, N rows each: `joints2d` [N, J, 2] px; `joints3d`
    [N, J, 3] mm, camera frame; `smpl`, that is `smpl_pose` [N, 72] rad, `smpl_betas` [N, 10] and `smpl_transl`
    [N, 3] m, camera frame; `classes`, that is `probability` [N, K] and `classes` [K], the names of its columns, and of
    binary classifiers also `binary_probability` [N, K], of each class by its own. None: the model has features alone.
    A metric that compares something else is refused where it is planned.
    """

    VERSION: int
    PREDICTS: tuple[str, ...]
    Options: type[Frozen]

    def train(
        self,
        frames: Images,
        labels: Labels,
        options: Any,
        *,
        seed: int,
        out: Path,
        work: Path,
        parts: Sequence[int] = (),
        groups: Sequence[str] = (),
    ) -> History:
        """Write a model folder to `out`; keep resumable state in `work`.

        `parts` are the rows of each training set, in order (empty: there is one set), and `groups` the subject or
        recording of each row (empty: each row is its own): what mixing and validation go by.
        """
        ...

    def predict(self, model: Path, frames: Images) -> Mapping[str, np.ndarray]:
        """Named predictions, one row a frame."""
        ...


@runtime_checkable
class DownstreamOfSequences(Downstream, Protocol):
    """A model that can look at several frames of a recording at once. It has both functions, and they are called."""

    def train_sequences(
        self,
        frames: Images,
        labels: Labels,
        options: Any,
        *,
        seed: int,
        out: Path,
        work: Path,
        parts: Sequence[int],
        groups: Sequence[str],
        recordings: Sequence[str],
    ) -> History:
        """As `train`; `recordings` name that of each row, whose rows follow one another in time.

        A stretch of rows is one recording where names, groups and parts stay the same. Empty: each row is its own.
        """
        ...

    def predict_sequences(self, model: Path, frames: Images, recordings: Sequence[str]) -> Mapping[str, np.ndarray]:
        """As `predict`, with the recording of each row; still one row a frame."""
        ...


@runtime_checkable
class DownstreamOfRecordings(Downstream, Protocol):
    """A model that learns from single frames, and whose answers about the frames of a recording may be joined."""

    def predict_recordings(self, model: Path, frames: Images, recordings: Sequence[str]) -> Mapping[str, np.ndarray]:
        """As `predict`, with the recording of each row; still one row a frame."""
        ...


@runtime_checkable
class FeatureExtractor(Downstream, Protocol):
    """A model in whose features images are compared."""

    def features(self, model: Path, frames: Images) -> np.ndarray:
        """Features [N, D] float32 of frames [N, H, W, 3] uint8."""
        ...


@runtime_checkable
class NamedFeatureExtractor(FeatureExtractor, Protocol):
    """An extractor that learns nothing; by its checksum it knows what scores in its features may be called."""

    def name_score(self, model: Path, score: str) -> str:
        """Of a metric's score, such as `fd`: `fid` where the features are those it is defined with."""
        ...


@runtime_checkable
class Metric(Protocol):
    """A score. `INPUT` names what it compares: `joints2d`, `joints3d`, `smpl`, `classes` or `features`.

    `SCORES` says of each of its scores, by how their names begin, whether lower is better, and what it means.
    """

    VERSION: int
    INPUT: str
    SCORES: tuple[ScoreInfo, ...]
    Options: type[Frozen]

    def compute(self, predicted: Any, target: Any, options: Any) -> dict[str, float]:
        """Named scores; units in the names."""
        ...


@runtime_checkable
class MetricOfSkeletons(Metric, Protocol):
    """A metric that needs certain joints: hips to align by, or a head to measure with."""

    def check_joint_set(self, joint_set: str, options: Any) -> None:
        """Raise `ValueError` for a joint set, a key of `geometry.joint_sets.JOINT_SETS` or empty, without them."""
        ...


@runtime_checkable
class MetricOnSensor(Metric, Protocol):
    """A metric of `joints2d` that is given predictions and labels in px of the sensor rather than of the image."""

    IN_SENSOR_PX: bool


@runtime_checkable
class MetricOfRows(Metric, Protocol):
    """A metric that is a mean over rows, so that two models can be compared row by row."""

    def compute_rows(self, predicted: Any, target: Any, options: Any) -> np.ndarray:
        """One score a row [N], NaN where a row has none."""
        ...


@runtime_checkable
class PreparedMetric(Metric, Protocol):
    """A metric that can look at all rows once and then score any of them quickly."""

    def prepare(self, predicted: Any, target: Any, options: Any) -> Callable[[np.ndarray], dict[str, float]]:
        """From row numbers to what `compute` returns for those rows.

        One of `ctlev_core.statistics.bootstrap.ScoresOfDraws` is not called for each of many resamplings.
        """
        ...


@runtime_checkable
class MetricOfSums(Metric, Protocol):
    """A metric whose scores are quotients of sums over rows, so that resampling rows need not compare them again."""

    def compute_sums(self, predicted: Any, target: Any, options: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """For each score of `compute`, by name, numerators [N] and denominators [N] of the rows."""
        ...


BY_KIND: dict[str, tuple[type, ...]] = {
    "datasets": (Dataset,),
    "formats": (Format,),
    "motions": (MotionFormat,),
    "encodings": (Encoding,),
    "conditions": (Condition, ConditionOfPairs, ConditionOfMotions, ConditionOfDisplacements),
    "generators": (Generator, EventGenerator),
    "downstream": (Downstream,),
    "metrics": (Metric,),
}
"""Every module of a kind keeps one of these; the other Protocols are for those that can do more."""


def missing_names(kind: str, module: ModuleType) -> tuple[str, list[str]]:
    """The Protocol that a module of a kind comes nearest to, and the names that it lacks of it; none: it keeps it."""
    lacking = {
        protocol.__name__: [name for name in _members(protocol) if not hasattr(module, name)]
        for protocol in BY_KIND[kind]
    }
    name = min(lacking, key=lambda name: len(lacking[name]))
    return name, lacking[name]


def _members(protocol: type) -> list[str]:
    names = {name for part in protocol.__mro__ for name in (*vars(part), *inspect.get_annotations(part))}
    return sorted(name for name in names if not name.startswith("_"))
