"""What an experiment did and what came out, in sentences for a reader who knows nothing of events."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from ctlev_core.report.sections.score_tables import trained_rows
from ctlev_core.report.sections.verdict import Verdict
from data_contracts.training_sets import RECORDED, SYNTHETIC, with_recorded

_MODELS = {"pose2d": "A model that finds joints in the image", "classifier": "A classifier of what is to be seen"}
_MODELS |= {"smpl_regressor": "A model that finds the pose of the body in space"}
_SETS = {RECORDED: "on the recorded frames", SYNTHETIC: "on the synthetic ones", with_recorded(SYNTHETIC): "on both"}
_MEANINGS = {
    "good": "For this task and this amount of recorded data, synthetic frames are worth adding.",
    "bad": "As they are, the synthetic frames do more harm than good. Whether they show their labels, and how far they "
    "are from recorded ones, is below.",
    "open": "This run shows neither a benefit nor a harm. More test recordings and more trainings make the interval "
    "narrower.",
}
_MEANINGS_INSTEAD = _MEANINGS | {
    "good": "For this task, the synthetic frames are worth more than the recorded ones.",
    "bad": "For this task, the synthetic frames are worth less than the recorded ones, whose place they took. Whether "
    "they show their labels, and how far they are from recorded ones, is below.",
}
"""Where nothing was trained on both together."""


def plain_words(
    rows: Sequence[dict[str, Any]], verdict: Verdict, num_learnt: int, num_made: int, seen: str
) -> list[tuple[str, str]]:
    """(heading, paragraphs) of each part.

    Args:
        rows: of the table `scores`.
        verdict: of the experiment.
        num_learnt: recorded frames that the generator learnt from.
        num_made: frames that it made.
        seen: what a condition is: `a skeleton: where the joints of a body are`.
    """
    made = (
        f"An event camera reports, pixel by pixel, when it gets brighter or darker. A generator learnt from "
        f"{num_learnt:,} recorded event images and what is known of each ({seen}). It then made {num_made:,} synthetic "
        "event images."
    )
    trained = [row for row in trained_rows(rows) if row["group"] == "all"]
    sets = [told for name, told in _SETS.items() if any(row["subject"] == name for row in trained)]
    parts = []
    if sets:
        model = _MODELS.get(trained[0]["task"], "A model")
        seeds = len({row["seed"] for row in trained})
        times = "" if seeds == 1 else f", {seeds} times each,"
        joined = f"{', '.join(sets[:-1])} and {sets[-1]}" if len(sets) > 1 else sets[0]
        made += (
            f"\n\n{model} was trained {joined}{times} and tested on {trained[0]['num_samples']:,} recorded images that "
            "nothing was trained on."
        )
    parts.append(("What was done", made))
    answer = verdict.answer
    if answer is not None:
        together = any(row["subject"] == with_recorded(SYNTHETIC) for row in trained)
        meanings = _MEANINGS if together else _MEANINGS_INSTEAD
        parts += [("How sure is that?", _certainty(answer.low, answer.tone)), ("What it means", meanings[answer.tone])]
    return parts


def _certainty(low: float, tone: str) -> str:
    if math.isnan(low):
        return "There is no interval: the test recordings are too few. The difference may be chance."
    interval = "The brackets hold the 95 % interval, over test recordings and trainings."
    if tone == "open":
        return f"{interval} It contains 0: the difference may be chance."
    return f"{interval} It does not contain 0: chance alone seldom gives such a difference."
