"""Several experiments told as one: what a preset with `experiments` holds."""

from __future__ import annotations

import re
from typing import Literal

from pydantic import Field, field_validator, model_validator

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
    pooled: dict[str, tuple[str, ...]] = Field(
        default_factory=dict,
        description="groups of experiments that differ in their draw of training recordings alone, by what the tables "
        "call them, such as `5 recordings a class`; each group is one column",
    )
    pooled_tests: Literal["same", "own"] = Field(
        "same",
        description="`own`: experiments of a group are tested on recordings of their own, as with other people each; "
        "otherwise other test recordings are an error",
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

    @model_validator(mode="after")
    def _groups_can_be_pooled(self) -> Study:
        members = [name for group in self.pooled.values() for name in group]
        unknown = [name for name in members if name not in self.experiments]
        if unknown:
            raise ValueError(f"pooled names experiments of the study, {', '.join(self.experiments)}; got {unknown}")
        if twice := sorted({name for name in members if members.count(name) > 1}):
            raise ValueError(f"pooled names each experiment once, got {twice} more than once")
        for group, names in self.pooled.items():
            if len(names) < 2:
                raise ValueError(f"pooled, {group!r}: expected at least two experiments, got {list(names)}")
            _check_alike(group, {name: self.experiments[name] for name in names})
        scored = {tuple(metric.model_dump_json() for metric in self.experiments[name].metrics) for name in members}
        if len(scored) > 1:
            raise ValueError("pooled: the groups share a table, and must have the same metrics")
        return self


def _check_alike(group: str, members: dict[str, Experiment]) -> None:
    """Raises ValueError where experiments cannot be told as draws of one."""
    for what, of in (
        ("training sets", lambda one: list(map(str, one.all_training_sets))),
        ("metrics", lambda one: [metric.model_dump() for metric in one.metrics]),
        ("num_generators", lambda one: one.num_generators),
        ("number of downstream_seeds", lambda one: len(one.downstream_seeds)),
    ):
        found = {name: of(member) for name, member in members.items()}
        first = next(iter(found))
        other = next((name for name in found if found[name] != found[first]), None)
        if other is not None:
            raise ValueError(
                f"pooled, {group!r}: experiments must have the same {what}, got {found[first]} of {first} and "
                f"{found[other]} of {other}"
            )
    member = next(iter(members.values()))
    if len(member.downstream_seeds) % member.num_generators:
        raise ValueError(
            f"pooled, {group!r}: the number of downstream_seeds must be a multiple of num_generators, "
            f"{member.num_generators}, got {len(member.downstream_seeds)}"
        )
