"""The errors a user can do something about. Their messages say what, expected, got and where."""

from __future__ import annotations


class DataError(ValueError):
    """Input data is wrong, missing or damaged."""


class TableVersionError(DataError):
    """A manifest's table has a version that this code does not read: nothing is damaged, but it must be made anew."""


class TrainingError(RuntimeError):
    """Training cannot go on, or saved state does not belong to this run."""
