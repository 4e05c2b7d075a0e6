"""Several experiments told as one: what a preset with `experiments` holds."""

from __future__ import annotations

import re

from pydantic import Field, field_validator

from data_contracts.config import Frozen
from data_contracts.experiment import NAME_PATTERN, Experiment
from data_contracts.speed_vs_error import SpeedVsErrorOptions

SPEED_VS_ERROR = "speed_vs_error"
"""Folder of the page on speed against error, beside those of the experiments."""


class Study(Frozen):
    """Experiments that run side by side and share one page, such as the three routes of the paper."""

    name: str = Field(pattern=NAME_PATTERN, description="names the study and its page")
    data_notice: str = Field("", description="first line of the page: what data this is")
    experiments: dict[str, Experiment] = Field(min_length=1, description="by a name of each, in reading order")
    speed_vs_error: SpeedVsErrorOptions | None = Field(
        None, description="also sample with several solvers and numbers of steps from the generator of an experiment"
    )

    @field_validator("experiments")
    @classmethod
    def _names_name_folders(cls, experiments: dict[str, Experiment]) -> dict[str, Experiment]:
        wrong = [name for name in experiments if not re.match(NAME_PATTERN, name)]
        if wrong:
            raise ValueError(f"names of experiments become names of folders, made of A-Z a-z 0-9 . _ -, got {wrong}")
        if SPEED_VS_ERROR in experiments:
            raise ValueError(f"no experiment can be called {SPEED_VS_ERROR!r}: a page of another kind has that folder")
        names = [experiment.name for experiment in experiments.values()]
        if len(set(names)) < len(names):
            raise ValueError(f"the experiments of a study need different names, got {names}")
        return experiments
