"""Options of regeneration: an experiment whose synthetic data is made anew, version by version."""

from __future__ import annotations

from pydantic import Field, model_validator

from data_contracts.config import Frozen
from data_contracts.experiment import Experiment


class Gates(Frozen):
    """What a new version must keep to become the latest; null = not asked.

    Preset `pose` has a distance of 1.5 and a label error of 1.1 times that of recorded frames, and none refused.
    """

    max_distance_ratio: float | None = Field(
        default=3.0,
        gt=0,
        description="Frechet distance to the recorded training frames, over that of as many held-out recorded frames",
    )
    max_label_error_ratio: float | None = Field(
        default=1.5,
        gt=0,
        description="error in the first metric, of the model trained on recorded frames, over that on held-out "
        "recorded frames",
    )
    max_memorised_share: float | None = Field(
        default=0.05, ge=0, le=1, description="frames nearer to a training frame than 1 % of recorded frames are"
    )
    max_rejected_share: float | None = Field(
        default=0.05, ge=0, le=1, description="frames that are no event images after `max_attempts`"
    )
    max_c2st: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="area under the ROC curve of a network that tells the frames from held-out recorded ones; 0.5 = "
        "cannot",
    )
    max_realism_distances: dict[str, float] | None = Field(
        default=None,
        description="by name, distances of the report's table of realism from the recorded training frames, such as "
        "isolated_pixel_share or value_js_bits",
    )

    @property
    def need_realism(self) -> bool:
        """Is any gate of the report's table of realism?"""
        return self.max_c2st is not None or bool(self.max_realism_distances)


class Regeneration(Experiment):
    """An experiment, whether each version has poses of its own, and the gates before `latest`."""

    gates: Gates = Gates()
    new_poses: bool = Field(
        default=True, description="choose the labels to sample from anew; otherwise only the noise is new"
    )

    @model_validator(mode="after")
    def _other_poses_can_be_chosen(self) -> Regeneration:
        if self.new_poses and self.labels == "coverage":
            raise ValueError("labels 'coverage' chooses the same poses for every version; set new_poses to false")
        return self

    @model_validator(mode="after")
    def _distances_can_be_measured(self) -> Regeneration:
        measured = self.feature_extractor is not None and any(choice.name == "frechet" for choice in self.distances)
        if self.gates.max_distance_ratio is not None and not measured:
            raise ValueError(
                "gates.max_distance_ratio needs a feature_extractor, and frechet among the distances; "
                "set it to null to do without"
            )
        return self
