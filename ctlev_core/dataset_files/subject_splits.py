"""Splits of a dataset by the numbers of its subjects."""

from __future__ import annotations

from pydantic import Field, model_validator

from data_contracts.config import Frozen


class SubjectSplit(Frozen):
    """Which subjects are not trained on; a dataset's own options inherit from this."""

    test_subjects: tuple[int, ...] = Field(default=(), description="subjects to test on")
    validation_subjects: tuple[int, ...] = Field(default=(), description="subjects held back from training")
    condition_subjects: tuple[int, ...] = Field(
        default=(), description="subjects of whom only the labels are used, as poses to sample from"
    )

    @model_validator(mode="after")
    def _subjects_are_in_one_split(self) -> SubjectSplit:
        chosen = [*self.test_subjects, *self.validation_subjects, *self.condition_subjects]
        twice = sorted({subject for subject in chosen if chosen.count(subject) > 1})
        if twice:
            raise ValueError(f"subjects {twice} are named more than once among test, validation and condition subjects")
        return self

    def split_of(self, subject: int) -> str:
        """The split of a subject: `train` unless the options name it."""
        named = {
            "test": self.test_subjects,
            "validation": self.validation_subjects,
            "condition": self.condition_subjects,
        }
        return next((split for split, subjects in named.items() if subject in subjects), "train")
