"""The errors a user can do something about. Their messages say what, expected, got and where."""

from __future__ import annotations

MAX_MESSAGE = 2000
"""Characters. What a file holds may end up in a message; a few lines of it say as much as all."""


def shortened(text: str, limit: int = MAX_MESSAGE) -> str:
    """At most `limit` characters: the middle is left out, for the place comes first and the cause last."""
    if len(text) <= limit:
        return text
    end = limit // 3
    return f"{text[: limit - end - 5]} ... {text[-end:]}"


class DataError(ValueError):
    """Input data is wrong, missing or damaged."""

    def __init__(self, message: str = "") -> None:
        super().__init__(shortened(message))


class TableVersionError(DataError):
    """A manifest's table has a version that this code does not read: nothing is damaged, but it must be made anew."""


class TrainingError(RuntimeError):
    """Training cannot go on, or saved state does not belong to this run."""
