"""The figures of the report that say what a base model is worth over the course of a fine-tuning."""

import pytest

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
    # Half an interval of .5 in each, and of two fine-tunings 1.96 times their standard error, sqrt(2) / sqrt(2).
    assert (low, high) == pytest.approx((7 - (0.5**2 + 1.96**2) ** 0.5, 7 + (0.5**2 + 1.96**2) ** 0.5))
    assert distances.series == {PRE_TRAINED: ([30, 300], [1, 0]), RANDOM: ([30, 300], [3, 2])}
    assert learnt.series == {PRE_TRAINED: ([30, 300], [5, 4]), RANDOM: ([30, 300], [7, 6])}
    assert len(base_model_figures([r for r in ROWS if "recorded" not in r["subject"]], OPTIONS, "error_px")) == 2
    assert labels.log_x and (labels.y_label, distances.y_label) == ("error px", "Frechet distance")


@pytest.mark.parametrize("missing", ["few", "random_30"])
def test_one_amount_of_training_is_no_line(missing):
    assert not base_model_figures(ROWS, {name: value for name, value in OPTIONS.items() if name != missing}, "error_px")
