"""Scores of classes, calibration and zero-shot accuracy against scikit-learn, loops and counting."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn import metrics as sklearn_metrics

from ctlev_core.metrics import classification, zero_shot
from ctlev_core.scoring.classification import calibrate, class_scores, read_guesses
from ctlev_core.scoring.zero_shot import balanced_accuracy, nearest_seen_classes
from ctlev_core.statistics.bootstrap import cluster_bootstrap
from data_contracts.labels import Labels

ZERO: Any = {"zero_division": 0}


def class_labels(names):
    return Labels(tuple(names), np.zeros(len(names), np.int64))


def random_prediction(seed, truth, classes):
    """Probabilities that lean towards the truth."""
    random = np.random.default_rng(seed)
    logits = random.normal(size=(len(truth), len(classes))) + 1.5 * (np.array(truth)[:, None] == np.array(classes))
    exponential = np.exp(logits)
    return {"probability": exponential / exponential.sum(axis=1, keepdims=True), "classes": np.array(classes)}


@settings(max_examples=40, deadline=None)
@given(st.lists(st.sampled_from("abcde"), min_size=1, max_size=40), st.integers(0, 1000))
def test_every_score_agrees_with_scikit_learn(truth, seed):
    predicted, target = random_prediction(seed, truth, list("dbca")), class_labels(truth)  # the model knows no e
    guesses = read_guesses(predicted, target)
    assert guesses.classes.tolist() == list("dbca") + (["e"] if "e" in truth else [])
    named = guesses.classes[guesses.guess]
    labels = guesses.classes.tolist()
    expected: Any = sklearn_metrics.precision_recall_fscore_support(truth, named, labels=labels, **ZERO)
    found = class_scores(guesses.truth, guesses.guess, len(labels))
    for ours, theirs in zip((found.precision, found.recall, found.f1, found.num_true), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-15)
    macro_f1 = sklearn_metrics.f1_score(truth, named, average="macro", **ZERO)
    scores = classification.compute(predicted, target, classification.Options())
    assert scores["macro_f1"] == pytest.approx(macro_f1)


def test_calibration_by_hand():
    """Bins of a half: 0.5 belongs to the lower one. |1/2 - 0.45| of two rows, |1/2 - 0.8| of two rows."""
    found = calibrate(np.array([0.4, 0.5, 0.6, 1.0]), np.array([1, 0, 0, 1]), 2)
    assert found.count.tolist() == [2, 2]
    np.testing.assert_allclose(found.confidence, [0.45, 0.8])
    np.testing.assert_allclose(found.accuracy, [0.5, 0.5])
    assert found.expected_error == pytest.approx((2 * 0.05 + 2 * 0.3) / 4)
    assert calibrate(np.array([1.0, 1.0]), np.array([1, 1]), 15).expected_error == 0
    assert calibrate(np.array([1.0, 1.0]), np.array([0, 0]), 15).expected_error == 1


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=1, max_size=60), st.integers(1, 20))
def test_calibration_agrees_with_a_loop_over_bins(rows, num_bins):
    confidence, is_right = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    error = 0.0
    for index in range(num_bins):
        low, high = index / num_bins, (index + 1) / num_bins
        inside = (confidence > low) & (confidence <= high)
        if index == 0:
            inside |= confidence == 0
        if inside.any():
            error += inside.mean() * abs(is_right[inside].mean() - confidence[inside].mean())
    found = calibrate(confidence, is_right, num_bins)
    assert found.expected_error == pytest.approx(error, abs=1e-12) and found.count.sum() == len(rows)


def test_a_calibrated_model_has_a_small_error_and_a_boastful_one_a_large():
    random = np.random.default_rng(0)
    confidence = random.uniform(0.5, 1, size=20_000)
    is_right = random.random(20_000) < confidence
    names = np.where(is_right, "a", "b")
    honest = {"probability": np.stack([confidence, 1 - confidence], 1), "classes": np.array(["a", "b"])}
    options = classification.Options(calibration_bins=10)
    # Five bins of 4,000: the mean of five |N(0, 0.43 / 63)| is 0.005.
    assert classification.compute(honest, class_labels(names), options)["calibration_error_ece10"] < 0.012
    boastful = {**honest, "probability": np.tile([1.0, 0.0], (20_000, 1))}
    assert classification.compute(boastful, class_labels(names), options)["calibration_error_ece10"] > 0.2


@pytest.mark.parametrize("metric", [classification, zero_shot])
def test_prepared_scores_of_rows_are_those_of_the_rows(metric):
    truth = list("abcabcabca")
    predicted, target = random_prediction(1, truth, list("abc")), class_labels(truth)
    compute_of = metric.prepare(predicted, target, metric.Options())
    rows = np.array([0, 0, 1, 2, 4, 5, 9, 9])
    chosen = {"probability": predicted["probability"][rows], "classes": predicted["classes"]}
    assert compute_of(rows) == pytest.approx(metric.compute(chosen, target.take(rows), metric.Options()))


@pytest.mark.parametrize("metric", [classification, zero_shot])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("known", "tested"), [("abcde", "abcdf"), ("abc", "ab"), ("ab", "abbbbbbbbbbb")])
def test_many_draws_at_once_have_the_scores_of_one_after_the_other_to_the_last_digit(metric, dtype, known, tested):
    random = np.random.default_rng(0)
    truth = random.choice(list(tested), 80).tolist()
    predicted, target = random_prediction(1, truth, list(known)), class_labels(truth)
    predicted["probability"] = predicted["probability"].astype(dtype)
    compute_of = metric.prepare(predicted, target, metric.Options())
    groups = random.integers(0, 12, 80)
    expected = cluster_bootstrap(lambda rows: compute_of(rows), groups, num_resamples=150, seed=3)
    assert cluster_bootstrap(compute_of, groups, num_resamples=150, seed=3) == expected and expected[0]
    draws = random.multinomial(12, np.full(12, 1 / 12), size=5)
    # Sums of confidences that were float64 would be rounded otherwise.
    is_exact = metric is zero_shot or dtype == np.float32
    assert (compute_of.of_draws(groups, draws) is not None) == is_exact


def test_draws_of_rows_of_one_class_have_the_scores_of_one_after_the_other():
    """A class's own group of rows: which classes are guessed, and count in a macro mean, differs from draw to draw."""
    predicted, target = random_prediction(1, ["k"] * 40, list("abcdefghijklmnopqrst")), class_labels("k" * 40)
    compute_of = classification.prepare(
        {**predicted, "probability": predicted["probability"].astype(np.float32)}, target, classification.Options()
    )
    expected = cluster_bootstrap(lambda rows: compute_of(rows), np.arange(40), num_resamples=100)
    assert cluster_bootstrap(compute_of, np.arange(40), num_resamples=100) == expected


def test_logits_and_repeated_classes_are_refused():
    with pytest.raises(ValueError, match=r"probability of row 1 must lie in \[0, 1\], got \[2.5, -1.0\]"):
        predicted = {"probability": np.array([[0.5, 0.5], [2.5, -1.0]]), "classes": np.array(["a", "b"])}
        classification.compute(predicted, class_labels("ab"), classification.Options())
    with pytest.raises(ValueError, match="classes must differ"):
        predicted = {"probability": np.array([[0.5, 0.5]]), "classes": np.array(["a", "a"])}
        classification.compute(predicted, class_labels("a"), classification.Options())


def test_zero_shot_by_hand():
    """Three bonsais, two found; five others, one taken for a bonsai."""
    truth = ["bonsai"] * 3 + ["ferry"] * 5
    guess = ["bonsai", "bonsai", "other", "bonsai", "other", "other", "other", "other"]
    probability = (np.array(guess)[:, None] == np.array(["bonsai", "other"])).astype(float)
    predicted = {"probability": probability, "classes": np.array(["bonsai", "other"])}
    found = zero_shot.compute(predicted, class_labels(truth), zero_shot.Options(classes=("bonsai",)))
    expected = pytest.approx((2 / 3 + 4 / 5) / 2)
    assert found == {"binary_accuracy_mean": expected, "binary_accuracy_bonsai": expected}
    # The model has never heard of ferries.
    both = zero_shot.compute(predicted, class_labels(truth), zero_shot.Options())
    assert both["binary_accuracy_ferry"] == 0.5


def test_zero_shot_of_binary_classifiers_asks_each_of_them():
    """Two of a fair half are called at once, or none: the highest of all says nothing about that."""
    truth = ["bonsai", "bonsai", "ferry", "ferry", "pagoda"]
    binary = np.array([[0.9, 0.8], [0.4, 0.3], [0.6, 0.7], [0.2, 0.1], [0.45, 0.55]])
    predicted = {
        "probability": binary / binary.sum(axis=1, keepdims=True),
        "binary_probability": binary,
        "classes": np.array(["bonsai", "ferry"]),
    }
    found = zero_shot.compute(predicted, class_labels(truth), zero_shot.Options())
    assert found == {
        "binary_accuracy_bonsai": pytest.approx((1 / 2 + 2 / 3) / 2),
        "binary_accuracy_ferry": pytest.approx((1 / 2 + 1 / 3) / 2),
        "binary_accuracy_pagoda": 0.5,
        "binary_accuracy_mean": pytest.approx((7 / 12 + 5 / 12 + 1 / 2) / 3),
    }
    rows = zero_shot.compute_rows(predicted, class_labels(truth), zero_shot.Options())
    assert rows.mean() == pytest.approx(found["binary_accuracy_mean"])
    with pytest.raises(ValueError, match="binary_probability must be"):
        zero_shot.compute({**predicted, "binary_probability": binary[:, :1]}, class_labels(truth), zero_shot.Options())


def test_zero_shot_is_the_mean_over_balanced_draws():
    random = np.random.default_rng(2)
    truth = np.array(["a"] * 30 + ["b"] * 70 + ["c"] * 70)
    called = random.random(170) < np.where(truth == "a", 0.8, 0.3)
    draws = []
    for seed in range(300):
        others = np.random.default_rng(seed).permutation(np.flatnonzero(truth != "a"))[:30]
        rows = np.concatenate([np.flatnonzero(truth == "a"), others])
        draws.append(np.mean(called[rows] == (truth[rows] == "a")))
    assert balanced_accuracy(truth == "a", called) == pytest.approx(np.mean(draws), abs=3 * np.std(draws) / 300**0.5)


@pytest.mark.parametrize("classes", [(), ("a", "c")])
def test_the_mean_of_zero_shot_rows_is_the_score(classes):
    names = [*"aaaaabbbc", "d"]
    predicted, target = random_prediction(3, names, list("abcd")), class_labels(names)
    options = zero_shot.Options(classes=classes)
    rows = zero_shot.compute_rows(predicted, target, options)
    assert rows.shape == (10,) and rows.min() >= 0
    assert rows.mean() == pytest.approx(
        zero_shot.compute(predicted, target, options)["binary_accuracy_mean"], abs=1e-14
    )
    if not classes:
        # A right row of class c, alone in it: all of c's positives, and its share of the others' negatives, 1 / 5 of
        # those of a, 1 / 7 of those of b, 1 / 9 of those of d; of 2 x 4 halves.
        sure = {"probability": np.eye(4)[["abcd".index(name) for name in names]], "classes": np.array(list("abcd"))}
        assert zero_shot.compute_rows(sure, target, options)[8] == pytest.approx(10 / 8 * (1 + 1 / 5 + 1 / 7 + 1 / 9))


def test_zero_shot_names_what_is_missing():
    predicted, target = random_prediction(0, list("aab"), list("ab")), class_labels("aab")
    with pytest.raises(ValueError, match="no target row is of class pagoda"):
        zero_shot.compute(predicted, target, zero_shot.Options(classes=("a", "pagoda")))
    with pytest.raises(ValueError, match="class 'a' has 2 of 2 rows"):
        zero_shot.prepare(predicted, target, zero_shot.Options(classes=("a",)))(np.array([0, 1]))
    with pytest.raises(ValueError, match="needs positives and negatives, got 2 and 0"):
        balanced_accuracy(np.ones(2, bool), np.ones(2, bool))


def test_nearest_seen_class_by_cosine():
    seen = np.array([[3.0, 0], [0, 0.1], [4, 4], [1, 1]])
    names = ["x", "y", "both", "the same"]
    found = nearest_seen_classes(np.array([[9.0, 1], [-1, 0], [2, 2]]), seen, names, count=2)
    assert [[name for name, _ in row] for row in found] == [
        ["x", "both"],
        ["y", "both"],
        ["both", "the same"],
    ]
    assert found[0][0][1] == pytest.approx(9 / 82**0.5) and found[2][0][1] == pytest.approx(1)
    assert found[1][0][1] == pytest.approx(0, abs=1e-15)
    with pytest.raises(ValueError, match="unseen embedding of row 1 is zero or not finite"):
        nearest_seen_classes(np.array([[1.0, 0], [0, 0]]), seen, names)
    with pytest.raises(ValueError, match="a name each"):
        nearest_seen_classes(seen, seen, names[:2])
