"""The configuration of one experiment: what a preset file holds."""

from __future__ import annotations

import re
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from data_contracts.config import (
    ADDED_LATER,
    ConditionChoice,
    DatasetChoice,
    DownstreamChoice,
    EncodingChoice,
    Frozen,
    GeneratorChoice,
    MetricChoice,
    SamplingChoice,
    Windows,
)
from data_contracts.event_export import EventExport
from data_contracts.labels import SPLITS, HeldOut
from data_contracts.training_sets import (
    LABEL_CONSISTENT,
    ORACLE,
    RECORDED,
    SOURCES,
    SYNTHETIC,
    TrainingSet,
    TrainingSource,
)

TrainedOn = Literal["recorded", "synthetic", "recorded+synthetic"]
LabelOrder = Literal["random", "in_time", "stretches"]
View = Literal["labelled", "new"]
LabelChoice = Literal["random", "coverage", "hard"]
NAME_PATTERN = r"^[A-Za-z0-9_-][A-Za-z0-9._-]*$"


class Baseline(Frozen):
    """Another generator to compare with, from the same frames and the same labels to sample from.

    What is left out is the experiment's own: with `poses` alone it is the same generator, asked for other poses. A
    `condition` or `generator` without a `name` is the experiment's own with the options that are given changed, and its
    `sampling` too: `{generator: {options: {random_init: true}}}` is the same fine-tuning from random weights.
    """

    condition: ConditionChoice
    generator: GeneratorChoice
    sampling: dict[str, Any] = Field(default_factory=dict, description="SampleOptions of the generator")
    motion_layers: dict[str, Any] | None = Field(
        None,
        json_schema_extra=ADDED_LATER,
        description="options of layers that make consecutive frames from one another, as `motion_layers` of the "
        "experiment, which is not inherited; null = none",
    )
    student: dict[str, Any] | None = Field(
        None,
        json_schema_extra=ADDED_LATER,
        description="options of a distillation, as `student` of the experiment, which is not inherited; null = none",
    )
    poses: DatasetChoice | None = Field(
        None, description="another dataset whose poses it is asked for; None = those of the experiment"
    )
    labels: LabelChoice | None = Field(
        None, description="which labels it is asked for, as `labels` of the experiment; None = as that"
    )
    temporal_order: Literal[False] | None = Field(
        None,
        json_schema_extra=ADDED_LATER,
        description="false = labels at random, where those of the experiment follow one another in time; its sampling "
        "has noise 'independent'; None = as the experiment",
    )
    part: str | None = Field(
        None,
        description="the dataset of a union that it learns from, and whose labels it is asked for; tested on all; "
        "None = every one",
    )

    @property
    def sampling_choice(self) -> SamplingChoice:
        """The generator's sampling options as a plug-in choice."""
        return SamplingChoice(name=self.generator.name, options=self.sampling)


def _completed(baseline: Any, own: dict[str, Any]) -> Any:
    """A baseline as a preset has it, with what it leaves out.

    Args:
        baseline: its options; anything else is left to validation.
        own: condition, generator and sampling of the experiment.
    """
    if not isinstance(baseline, dict):
        return baseline
    generator = baseline.get("generator", {})
    same_generator = isinstance(generator, dict) and "name" not in generator
    made = dict(baseline)
    for key, theirs in own.items():
        given = baseline.get(key, {})
        is_own = same_generator if key == "sampling" else isinstance(given, dict) and "name" not in given
        if is_own:
            made[key] = _merged(theirs, given)
    return made


def _merged(values: Any, changes: Any) -> Any:
    """Nested mappings with single values changed; neither argument is."""
    if not isinstance(values, dict) or not isinstance(changes, dict):
        return changes
    return values | {key: _merged(values.get(key), value) for key, value in changes.items()}


class Oracle(Frozen):
    """Other recordings to train on: of the very poses, say, that synthetic frames are sampled from."""

    dataset: DatasetChoice = Field(description="its training recordings are used; it needs a test recording too")
    windows: Windows | None = Field(None, description="how they are cut; None = as those of the experiment")


class Experiment(Frozen):
    """One experiment: data, generator, how much to sample, and what to train and score with it.

    `baselines` are rows of the tables: a baseline `X` adds the training sets `X` and `recorded+X` beside `synthetic`
    and `recorded+synthetic`, where those are asked for; `oracle` adds `oracle` and `recorded+oracle`, `scaling`,
    `keep_fraction` and `mixtures` the training sets named in their descriptions. `sampling` are the generator's
    `SampleOptions`. `feature_extractor` is the classifier, trained on recorded frames, in whose features recorded and
    synthetic frames are compared; None leaves the comparison out.
    """

    name: str = Field(pattern=NAME_PATTERN, description="names the experiment and its report")
    data_notice: str = Field("", description="first line of the report: what data this is")
    seed: int = Field(0, ge=0, description="seed of conditions, fine-tuning and sampling")
    dataset: DatasetChoice
    poses: DatasetChoice | None = Field(
        None, description="another dataset whose poses (recordings of split `condition`) are sampled from instead"
    )
    target: DatasetChoice | None = Field(
        None,
        description="another dataset that the generator learns nothing of, such as classes it has never seen: its "
        "labels are sampled, its training recordings are the training set `recorded`, its test recordings are tested",
    )
    temporal_order: bool = Field(
        False, description="labels to sample from follow one another in time; else classes in turn and at random"
    )
    stretch_length: int | None = Field(
        None,
        gt=1,
        json_schema_extra=ADDED_LATER,
        description="labels to sample from are stretches of so many consecutive moments each; needs temporal_order; "
        "null = the context of motion layers, and without them moments evenly spread over all",
    )
    view: View = Field(
        "labelled", description="bodies to sample from as their own camera sees them, or from new, random sides"
    )
    labels: LabelChoice = Field(
        "random",
        json_schema_extra=ADDED_LATER,
        description="which label-only poses are sampled: random ones, classes and recordings in turn; `coverage`, each "
        "the farthest from the recorded training poses and those chosen before; or `hard`, of the quarter whose "
        "nearest recorded poses have the largest errors in a two-fold cross-validation of the downstream model on "
        "training frames",
    )
    windows: Windows = Windows()
    evaluate_on: HeldOut = Field(
        "test",
        json_schema_extra=ADDED_LATER,
        description="recordings that models are scored on and frames compared with: options are chosen on "
        "`validation`, with which nothing of the test recordings is encoded; `test` is for the last run",
    )
    num_recorded: int | None = Field(
        None,
        ge=1,
        description="training frames that generator and downstream models learn from, spread evenly over subjects and "
        "classes; null = all",
    )
    encoding: EncodingChoice
    condition: ConditionChoice
    base_model: dict[str, Any] | None = Field(
        None,
        description="options of pre-training (flows/presets/pretraining): a base model is made of pictures first, and "
        "generators that name no `base_model` start from it",
    )
    generator: GeneratorChoice
    sampling: dict[str, Any] = Field(default_factory=dict, description="SampleOptions of the generator")
    num_synthetic: int = Field(gt=0, description="synthetic frames to sample, of the generator and of each baseline")
    max_attempts: int = Field(
        3,
        ge=1,
        description="samplings of a frame, until it passes postprocessing/quality_filter.py; 1 = count rejections only",
    )
    stochastic_rounding: bool = Field(
        False,
        description="sampled frames become, by stochastic rounding, renderings of whole event counts, as recorded ones "
        "are; of event histograms only",
    )
    pixel_decoder: dict[str, Any] | None = Field(
        None,
        description="options of a decoder that draws the pixel values of sampled images as recorded ones have "
        "them, whole event counts and the noise of the sensor; {} = its defaults; of diffusion generators, whose "
        "frames are then not rounded; null = none",
    )
    num_generators: int = Field(
        1,
        ge=1,
        description="fine-tunings, each with a seed and synthetic frames of its own, of the generator and of each "
        "baseline; the downstream seeds take turns with them",
    )
    motion_layers: dict[str, Any] | None = Field(
        None,
        json_schema_extra=ADDED_LATER,
        description="options of layers that make consecutive frames from one another; {} = their defaults; of the "
        "experiment's own diffusion generator, while baselines may have their own; needs temporal_order; null = none",
    )
    student: dict[str, Any] | None = Field(
        None,
        json_schema_extra=ADDED_LATER,
        description="options of a distillation: frames are sampled from a student that in few evaluations of the "
        "network imitates what the generator samples; {} = their defaults; of the experiment's own diffusion "
        "generator, while baselines may have their own; null = none",
    )
    oracle: Oracle | None = Field(
        None, description="recordings of the sampled poses: the most that synthetic frames can give"
    )
    scaling: tuple[float, ...] = Field(
        (),
        description="train on recorded frames and these shares of the synthetic ones too, as training sets "
        "`recorded+S@SHARE`; also of baselines that are asked for `labels` of their own",
    )
    keep_fraction: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="train also on this share of the synthetic frames, those whose labels a model trained on recorded "
        "frames finds best: training sets `label_consistent` and `recorded+label_consistent`",
    )
    baselines: dict[str, Baseline] = Field(default_factory=dict, description="other generators, by a name of each")
    mixtures: tuple[str, ...] = Field(
        (),
        description="further training sets, of frames of several generators, such as `recorded+synthetic+event_gan`",
    )
    downstream: DownstreamChoice
    training_sets: tuple[TrainedOn, ...] = Field(("recorded", "synthetic", "recorded+synthetic"), min_length=1)
    downstream_seeds: tuple[int, ...] = Field((0,), min_length=1, description="one training per training set and seed")
    metrics: tuple[MetricChoice, ...] = Field(min_length=1)
    feature_extractor: DownstreamChoice | None = None
    distances: tuple[MetricChoice, ...] = Field(
        (MetricChoice(name="frechet"), MetricChoice(name="kid"), MetricChoice(name="mmd")),
        min_length=1,
        description="metrics of the features of two sets of frames",
    )
    sequence_length: int | None = Field(
        None,
        ge=3,
        le=64,
        json_schema_extra=ADDED_LATER,
        description="frames of a stretch: recorded and synthetic stretches of consecutive frames are compared, and "
        "shown in motion; needs temporal_order and windows of equal duration, all of them; null = none",
    )
    export: EventExport | None = Field(None, description="also write the synthetic frames as event streams")
    realism_reference: DatasetChoice | None = Field(
        None, description="recordings that the experiment's own are compared with, number by number, in the report"
    )

    @model_validator(mode="before")
    @classmethod
    def _baselines_are_like_the_experiment(cls, values: Any) -> Any:
        """What a baseline leaves out is the experiment's own; sampling options only where the generator is."""
        if not isinstance(values, dict) or not isinstance(values.get("baselines"), dict):
            return values
        own = {key: values[key] for key in ("condition", "generator", "sampling") if key in values}
        baselines = {name: _completed(baseline, own) for name, baseline in values["baselines"].items()}
        return {**values, "baselines": baselines}

    @field_validator("baselines")
    @classmethod
    def _names_are_free(cls, baselines: dict[str, Baseline]) -> dict[str, Baseline]:
        for name in baselines:
            if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or name in (*SOURCES, *SPLITS):
                raise ValueError(
                    f"a baseline's name is made of a-z, 0-9 and _, and is not {' or '.join((*SOURCES, *SPLITS))}, "
                    f"got {name!r}"
                )
        return baselines

    @field_validator("metrics", "distances", "downstream_seeds")
    @classmethod
    def _nothing_is_there_twice(cls, asked: tuple[Any, ...]) -> tuple[Any, ...]:
        for number, one in enumerate(asked):
            if one in asked[:number]:
                raise ValueError(f"expected each once, got {getattr(one, 'name', one)!r} twice with the same options")
        return asked

    @field_validator("scaling")
    @classmethod
    def _shares_are_shares(cls, scaling: tuple[float, ...]) -> tuple[float, ...]:
        if any(not 0 < share < 1 for share in scaling) or len(set(scaling)) < len(scaling):
            raise ValueError(
                f"scaling are different shares between 0 and 1, got {scaling}; all frames are a training set"
            )
        return scaling

    @model_validator(mode="after")
    def _only_histograms_hold_counts(self) -> Experiment:
        if self.stochastic_rounding and self.encoding.name != "event_histogram":
            raise ValueError(f"stochastic_rounding needs encoding 'event_histogram', got {self.encoding.name!r}")
        return self

    @model_validator(mode="after")
    def _stretches_are_asked_for(self) -> Experiment:
        for name, one in self.baselines.items():
            if one.temporal_order is not None and not self.temporal_order:
                raise ValueError(f"baselines.{name}.temporal_order: that of the experiment is false, leave it out")
        for name in (None, *self.baselines):
            one = self if name is None else self.baselines[name]
            if self.in_temporal_order(name):
                continue
            where = "" if name is None else f"baselines.{name}."
            if one.motion_layers is not None:
                raise ValueError(
                    f"{where}motion_layers make frames that follow one another: set temporal_order to true"
                )
            if one.sampling.get("noise") == "stretches":
                raise ValueError(
                    f"{where}sampling.noise 'stretches' is for frames that follow one another: set temporal_order to "
                    "true, or noise to 'independent'"
                )
        if self.stretch_length is not None and not self.temporal_order:
            raise ValueError("stretch_length is of labels that follow one another: set temporal_order to true")
        return self

    def in_temporal_order(self, baseline: str | None) -> bool:
        """Whether the labels that a baseline, or the experiment's own generator, is asked for follow one another."""
        own = None if baseline is None else self.baselines[baseline].temporal_order
        return self.temporal_order if own is None else own

    @model_validator(mode="after")
    def _students_make_single_frames(self) -> Experiment:
        for name, one in (("", self), *((f"baselines.{name}.", one) for name, one in self.baselines.items())):
            if one.student is not None and one.motion_layers is not None:
                raise ValueError(f"{name}student: a generator with motion layers cannot be distilled, leave out one")
        return self

    @model_validator(mode="after")
    def _sequences_are_consecutive(self) -> Experiment:
        if self.sequence_length is None:
            return self
        wrong = {
            "temporal_order must be true": not self.temporal_order,
            "windows.method must be 'duration'": self.windows.method != "duration",
            "windows.max_windows must be null": self.windows.max_windows is not None,
            "windows.anchor must be 'first_event'": self.windows.anchor != "first_event",
            "num_recorded must be null": self.num_recorded is not None,
        }
        if any(wrong.values()):
            told = ", ".join(name for name, is_wrong in wrong.items() if is_wrong)
            raise ValueError(f"sequence_length compares consecutive frames: {told}")
        return self

    @model_validator(mode="after")
    def _parts_are_known(self) -> Experiment:
        known = {RECORDED, *self.generator_names, *([ORACLE] if self.oracle else [])}
        for mixture in self.mixtures:
            parts = mixture.split("+")
            if len(parts) < 2 or len(set(parts)) < len(parts) or not set(parts) <= known:
                raise ValueError(f"mixtures join different ones of {', '.join(sorted(known))} by +, got {mixture!r}")
        return self

    @model_validator(mode="after")
    def _baselines_learn_from_parts_that_there_are(self) -> Experiment:
        parts = self.dataset.options.get("parts", {}) if self.dataset.name == "union" else {}
        for name, baseline in self.baselines.items():
            if baseline.part is None:
                continue
            if baseline.part not in parts:
                known = f"one of {', '.join(parts)}" if parts else "a dataset that is a union"
                raise ValueError(f"baselines.{name}.part: expected {known}, got {baseline.part!r}")
            if baseline.poses or self.poses or self.target:
                raise ValueError(f"baselines.{name}.part: it is asked for labels of that part; leave out other poses")
        return self

    @model_validator(mode="after")
    def _chosen_labels_are_poses_of_this_experiment(self) -> Experiment:
        chosen = {"labels": self.labels} | {f"baselines.{n}.labels": b.labels for n, b in self.baselines.items()}
        for option, labels in chosen.items():
            if labels in (None, "random"):
                continue
            if self.temporal_order or self.view == "new":
                raise ValueError(f"{option} {labels!r}: leave out temporal_order, and view 'new'")
            if self.target is not None:
                raise ValueError(f"{option} {labels!r} goes by recorded frames of the dataset; leave out target")
        for name, baseline in self.baselines.items():
            if baseline.part is not None and self.labels_of(name) != "random":
                raise ValueError(
                    f"baselines.{name}.part: its labels are chosen at random, got {self.labels_of(name)!r}"
                )
        return self

    def labels_of(self, baseline: str) -> LabelChoice:
        """Which labels a baseline is asked for."""
        return self.baselines[baseline].labels or self.labels

    @property
    def sampling_choice(self) -> SamplingChoice:
        """The generator's sampling options as a plug-in choice."""
        return SamplingChoice(name=self.generator.name, options=self.sampling)

    @property
    def rounding(self) -> EncodingChoice | None:
        """The encoding whose levels sampled frames are rounded to, if any."""
        return self.encoding if self.stochastic_rounding else None

    @property
    def choices(self) -> list[Any]:
        """Every plug-in the experiment names."""
        chosen = [self.dataset, self.encoding, self.condition, self.generator, self.sampling_choice, self.downstream]
        more = None if self.oracle is None else self.oracle.dataset
        others = (self.poses, self.target, self.feature_extractor, self.realism_reference, more)
        optional = [choice for choice in others if choice]
        baselines = self.baselines.values()
        compared = [c for b in baselines for c in (b.condition, b.generator, b.sampling_choice, b.poses) if c]
        return [*chosen, *optional, *compared, *self.metrics, *self.distances]

    @property
    def tested_dataset(self) -> DatasetChoice:
        """Whose recordings downstream models are tested on."""
        return self.target or self.dataset

    @property
    def generator_names(self) -> list[str]:
        """What the rows of each generator are called: `synthetic` is the experiment's own."""
        return ["synthetic", *self.baselines]

    @property
    def all_training_sets(self) -> list[TrainingSet]:
        """What downstream models are trained on, in the order of the tables."""
        makers = list(self.generator_names)
        makers += [LABEL_CONSISTENT] * (self.keep_fraction is not None) + [ORACLE] * (self.oracle is not None)
        asked = [TrainingSet.parse(name) for name in self.training_sets]
        found = [training_set.with_generator(name) for training_set in asked for name in makers]
        scaled = [SYNTHETIC, *(name for name, baseline in self.baselines.items() if baseline.labels is not None)]
        shares = [TrainingSource(name, share) for name in scaled for share in sorted(self.scaling)]
        found += [TrainingSet((TrainingSource(RECORDED), source)) for source in shares]
        return list(dict.fromkeys([*found, *map(TrainingSet.parse, self.mixtures)]))
