"""What readers of a score need to know: which direction is better, what it is the mean of, and whether it is a share.

Each metric says so of its own scores, in `SCORES`; tables, verdicts, gates and the choice of frames read it here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache


@dataclass(frozen=True)
class ScoreInfo:
    """About the scores whose names begin in a certain way.

    Attributes:
        start: how their names begin; of several that fit a name the longest holds.
        lower_is_better: errors and distances want to be small.
        meaning: what the score is, in words without a verb; empty where its name says it.
        is_share: it lies in 0 to 1.
        is_reference: what guessing gets, which others are read beside: neither more nor less of it is better.
    """

    start: str
    lower_is_better: bool = False
    meaning: str = ""
    is_share: bool = False
    is_reference: bool = False


@lru_cache(maxsize=4096)  # a report of a thousand classes asks once a cell, and each look goes to the disk
def find_score(name: str) -> ScoreInfo:
    """What the metrics say of a score; of a name that none of them knows, that higher is better."""
    from ctlev_core import plugins

    declared = [info for metric in plugins.names("metrics") for info in plugins.load("metrics", metric).SCORES]
    fitting = [info for info in declared if name.startswith(info.start)]
    return max(fitting, key=lambda info: len(info.start), default=ScoreInfo(name))


def lower_is_better(name: str) -> bool:
    """Whether a small score is a good one."""
    return find_score(name).lower_is_better
