"""How training and test data of a report were kept apart, told from the recordings themselves."""

from __future__ import annotations

from collections.abc import Sequence


def told_split(splits: Sequence[str]) -> str:
    """A sentence for the first line of a report.

    Args:
        splits: of each recording, the splits its parts belong to, joined by +.
    """
    parts = [set(each.split("+")) for each in splits]
    tested = [part for part in parts if "test" in part]
    shared = sum("train" in part for part in tested)
    if not tested:
        return ""
    if not shared:
        return "Tested on whole recordings, of which nothing was learnt."
    if shared == len(tested):
        return (
            "Every tested recording is split in time: learnt from one part, tested on another. Scores say how well "
            "windows of the same recordings are told apart, not how well unseen recordings would be."
        )
    return f"Of {len(tested)} tested recordings {shared} are split in time, and also learnt from."
