"""The errors a user can do something about. Their messages say what, expected, got and where."""

from __future__ import annotations

from typing import ClassVar

MAX_MESSAGE = 2000
"""Characters of what may list options or files."""


def shortened(text: str, limit: int = MAX_MESSAGE) -> str:
    """At most `limit` characters: the middle is left out, for the place comes first and the cause last."""
    if len(text) <= limit:
        return text
    end = limit // 3
    return f"{text[: limit - end - 5]} ... {text[-end:]}"


class DataError(ValueError):
    """Input data is wrong, missing or damaged."""

    MAX_MESSAGE: ClassVar[int] = 499
    """What a file holds may end up in a message; the first of it says as much as all."""

    def __init__(self, message: str = "") -> None:
        super().__init__(shortened(message, self.MAX_MESSAGE))


class DetailedDataError(DataError):
    """The message lists what was looked for: the expected tree of a dataset, or what each format missed."""

    MAX_MESSAGE: ClassVar[int] = MAX_MESSAGE


class TableVersionError(DataError):
    """A manifest's table has a version that this code does not read: nothing is damaged, but it must be made anew."""


class TrainingError(RuntimeError):
    """Training cannot go on, or saved state does not belong to this run."""
