"""The configuration of one experiment: what a preset file holds."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from data_contracts.config import (
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

Setting = Literal["real", "synthetic", "real+synthetic"]
PoseOrder = Literal["random", "in_time"]
PoseViews = Literal["labelled", "new"]


class Experiment(Frozen):
    """One experiment: data, generator, how much to sample, and what to train and score with it.

    `sampling` are the generator's `SampleOptions`. `feature_extractor` is the classifier, trained on real frames, in
    whose features real and synthetic frames are compared; None leaves the comparison out.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9._-]+$", description="names the experiment and its report")
    data_notice: str = Field("", description="first line of the report: what data this is")
    seed: int = Field(0, ge=0, description="seed of conditions, fine-tuning and sampling")
    dataset: DatasetChoice
    poses: DatasetChoice | None = Field(
        None, description="another dataset whose poses (recordings of split `condition`) are sampled from instead"
    )
    pose_order: PoseOrder = Field(
        "random", description="of the labels to sample from: classes in turn and at random, or as they follow in time"
    )
    pose_views: PoseViews = Field(
        "labelled", description="bodies to sample from as their own camera sees them, or from new, random sides"
    )
    windows: Windows = Windows()
    encoding: EncodingChoice
    condition: ConditionChoice
    generator: GeneratorChoice
    sampling: dict[str, Any] = Field(default_factory=dict, description="SampleOptions of the generator")
    num_synthetic: int = Field(gt=0, description="synthetic frames to sample")
    downstream: DownstreamChoice
    settings: tuple[Setting, ...] = Field(("real", "synthetic", "real+synthetic"), min_length=1)
    downstream_seeds: tuple[int, ...] = Field((0,), min_length=1, description="one training per setting and seed")
    metrics: tuple[MetricChoice, ...] = Field(min_length=1)
    feature_extractor: DownstreamChoice | None = None

    @property
    def sampling_choice(self) -> SamplingChoice:
        """The generator's sampling options as a plug-in choice."""
        return SamplingChoice(name=self.generator.name, options=self.sampling)

    @property
    def choices(self) -> list[Any]:
        """Every plug-in the experiment names."""
        chosen = [self.dataset, self.encoding, self.condition, self.generator, self.sampling_choice, self.downstream]
        optional = [choice for choice in (self.poses, self.feature_extractor) if choice]
        return [*chosen, *optional, *self.metrics]
