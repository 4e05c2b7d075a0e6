"""The figures of the report that say what a base model is worth over the course of a fine-tuning."""

import pytest
from scipy import stats

from ctlev_core.report.sections.training_curves import PRE_TRAINED, RANDOM, base_model_figures


def row(training_set, metric, value, task="pose2d", group="all", low=None, high=None):
    return {
        "subject": training_set,
        "metric": metric,
        "value": value,
        "task": task,
        "group": group,
        "low": low,
        "high": high,
    }


OPTIONS = {
    "synthetic": {"num_steps": 300, "random_init": False},
    "few": {"num_steps": 30, "random_init": False},
    "random_300": {"num_steps": 300, "random_init": True},
    "random_30": {"num_steps": 30, "random_init": True},
    "event_gan": {"num_steps": 999},
}
ROWS = [
    row("recorded", "error_px", 5.0),
    row("label agreement of synthetic", "error_px", 6.0, low=5.5, high=6.5),
    row("label agreement of synthetic", "error_px", 8.0, low=7.5, high=8.5),
    row("label agreement of synthetic", "error_px", 99.0, group="class walk"),
    row("label agreement of few", "error_px", 9.0),
    row("label agreement of random_300", "error_px", 8.5),
    row("label agreement of random_30", "error_px", 14.0),
    *(row(f"recorded+{name}", "error_px", 4.0 + number) for number, name in enumerate(OPTIONS)),
    row("shuffled label agreement of synthetic", "error_px", 20.0),
    row("label agreement of event_gan", "error_px", 1.0),
    *(row(name, "kid_event_x", 0.5, task="distance") for name in OPTIONS),
    *(row(name, "fd_event_x", float(number), task="distance") for number, name in enumerate(OPTIONS)),
]


def test_lines_are_means_over_fine_tunings_by_steps_and_start():
    labels, distances, learnt = base_model_figures(ROWS, OPTIONS, "error_px")
    assert labels.series == {PRE_TRAINED: ([30, 300], [9, 7]), RANDOM: ([30, 300], [14, 8.5])}
    low, high = (ends[1] for ends in labels.spans[PRE_TRAINED])
    # Half an interval of .5 in each, and two fine-tunings whose standard error is 1: nearly all of it is of theirs.
    of_recordings = (0.5 / stats.norm.ppf(0.975)) ** 2
    half = stats.t.ppf(0.975, (of_recordings + 1) ** 2) * (of_recordings + 1) ** 0.5
    assert (low, high) == pytest.approx((7 - half, 7 + half))
    assert distances.series == {PRE_TRAINED: ([30, 300], [1, 0]), RANDOM: ([30, 300], [3, 2])}
    assert learnt.series == {PRE_TRAINED: ([30, 300], [5, 4]), RANDOM: ([30, 300], [7, 6])}
    assert len(base_model_figures([r for r in ROWS if "recorded" not in r["subject"]], OPTIONS, "error_px")) == 2
    assert labels.log_x and (labels.y_label, distances.y_label) == ("error px", "Frechet distance")


def test_generators_that_differ_in_more_than_steps_and_start_are_no_points():
    others = {"no_rotation": OPTIONS["synthetic"] | {"rot90_probability": 0.0}}
    alike = {name: chosen | {"rot90_probability": 0.4} for name, chosen in OPTIONS.items()}
    labels, *_ = base_model_figures(
        [*ROWS, row("label agreement of no_rotation", "error_px", 1.0)], alike | others, "error_px"
    )
    assert labels.series == {PRE_TRAINED: ([30, 300], [9, 7]), RANDOM: ([30, 300], [14, 8.5])}


@pytest.mark.parametrize("missing", ["few", "random_30"])
def test_one_amount_of_training_is_no_line(missing):
    assert not base_model_figures(ROWS, {name: value for name, value in OPTIONS.items() if name != missing}, "error_px")
