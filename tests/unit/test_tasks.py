"""Small decisions the tasks take: which labels to sample from, and what the verdict says."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctlev_core.verdict import lower_is_better, verdict
from tasks.condition import balanced_choice


@given(st.lists(st.sampled_from("abc"), min_size=1, max_size=30), st.integers(1, 60), st.integers(0, 1000))
def test_balanced_choice_takes_turns_and_uses_every_row_before_any_twice(names, count, seed):
    chosen = balanced_choice(tuple(names), count, seed)
    assert len(chosen) == count
    per_class = Counter(names[row] for row in chosen)
    assert max(per_class.values()) - min(per_class.values() if len(per_class) == len(set(names)) else [0]) <= 1
    for name in set(names):
        uses = Counter(int(row) for row in chosen if names[row] == name)
        available = names.count(name)
        assert not uses or max(uses.values()) <= -(-sum(uses.values()) // available)


def test_balanced_choice_of_more_rows_starts_with_the_same_rows():
    names = ("a", "b") * 10
    np.testing.assert_array_equal(balanced_choice(names, 6, 3), balanced_choice(names, 12, 3)[:6])


def row(setting, value, low=None, high=None, metric="mpjpe2d_px", seed=0):
    return {
        "setting": setting,
        "group": "all",
        "metric": metric,
        "value": value,
        "low": low,
        "high": high,
        "seed": seed,
    }


SETTINGS = ("real", "synthetic", "real+synthetic")


def test_verdict_says_better_only_with_its_certainty():
    rows = [row("real", 7.0, 6.8, 7.2), row("synthetic", 8.0, 7.0, 9.0), row("real+synthetic", 6.3, 6.1, 6.5)]
    text = verdict(rows, SETTINGS)
    assert "real 7.000, synthetic 8.000, real+synthetic 6.300" in text and "lower is better" in text
    assert "10.0% better; the intervals do not overlap" in text
    overlapping = [*rows[:2], row("real+synthetic", 6.3, 6.1, 6.9)]
    assert "10.0% better; the intervals overlap, so this alone decides nothing" in verdict(overlapping, SETTINGS)


@pytest.mark.parametrize(("metric", "expected"), [("accuracy", "worse"), ("mpjpe2d_px", "better")])
def test_verdict_knows_which_way_is_better(metric, expected):
    rows = [row("real", 0.8, metric=metric), row("real+synthetic", 0.6, metric=metric)]
    assert f"25.0% {expected}" in verdict(rows, SETTINGS)


def test_directions():
    assert lower_is_better("fd_event_classifier_0123abcd") and lower_is_better("mpjpe2d_px")
    assert not lower_is_better("accuracy") and not lower_is_better("pck_px4")


def test_verdict_without_scores_says_so():
    assert verdict([], SETTINGS) == "No downstream model was scored."
