import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import accuracy_score, precision_score, recall_score

from ctlev_core.metrics import classification, frechet, mpjpe2d, oks, pck2d
from ctlev_core.plugins import load_options
from ctlev_core.scoring.scored_rows import RowScores
from ctlev_core.statistics.bootstrap import (
    bootstrap_interval,
    cluster_bootstrap,
    ratio_bootstrap,
    score_text,
)
from data_contracts.config import MetricChoice
from data_contracts.labels import Labels


def pose_labels(joints2d, visible=None, joint_set="dhp19"):
    joints2d = np.asarray(joints2d, np.float32)
    visible = np.ones(joints2d.shape[:2], bool) if visible is None else np.asarray(visible, bool)
    return Labels(("",) * len(joints2d), np.zeros(len(joints2d), np.int64), joints2d, visible, joint_set)


def class_labels(names):
    return Labels(tuple(names), np.zeros(len(names), np.int64))


def certain(names, classes):
    """A prediction that gives each named class probability one."""
    return {"probability": (np.array(names)[:, None] == np.array(classes)).astype(float), "classes": np.array(classes)}


def standing_person():
    """Thirteen joints in which the torso, left shoulder to right hip, is 3-4-5 long: 50 px."""
    joints = np.zeros((1, 13, 2))
    joints[0, 2], joints[0, 5] = (60, 20), (30, 60)
    joints[0, 12] = (10, 100)
    return joints


def test_mpjpe_is_the_mean_over_visible_joints_not_over_rows():
    target = pose_labels([[[0, 0], [10, 0]], [[5, 5], [np.nan, np.nan]]], [[True, True], [True, False]])
    predicted = {"joints2d": np.array([[[3, 4], [10, 0]], [[5, 6], [0, 0]]])}
    assert mpjpe2d.compute(predicted, target, mpjpe2d.Options()) == {"mpjpe2d_px": pytest.approx((5 + 0 + 1) / 3)}
    np.testing.assert_allclose(mpjpe2d.compute_rows(predicted, target, mpjpe2d.Options()), [2.5, 1.0])


def test_rows_without_a_visible_joint_have_no_score():
    target = pose_labels(np.zeros((2, 3, 2)), [[False] * 3, [True] * 3])
    rows = mpjpe2d.compute_rows({"joints2d": np.ones((2, 3, 2))}, target, mpjpe2d.Options())
    assert np.isnan(rows[0]) and rows[1] == pytest.approx(2**0.5)


@pytest.mark.parametrize("metric", [mpjpe2d, pck2d, oks])
def test_pose_metrics_refuse_what_they_cannot_score(metric):
    nothing = pose_labels(np.zeros((2, 13, 2)), np.zeros((2, 13), bool))
    with pytest.raises(ValueError, match="no joint is visible in any of the 2 target rows"):
        metric.compute({"joints2d": np.zeros((2, 13, 2))}, nothing, metric.Options())
    with pytest.raises(ValueError, match=r"must be \(2, 13, 2\), got \(2, 12, 2\)"):
        metric.compute({"joints2d": np.zeros((2, 12, 2))}, pose_labels(np.zeros((2, 13, 2))), metric.Options())
    broken = np.zeros((2, 13, 2))
    broken[1, 3, 0] = np.nan
    with pytest.raises(ValueError, match="predicted joint 3 of row 1"):
        metric.compute({"joints2d": broken}, pose_labels(np.zeros((2, 13, 2))), metric.Options())
    with pytest.raises(ValueError, match="no joints2d"):
        metric.compute({"joints2d": broken}, class_labels(["a", "b"]), metric.Options())


@pytest.mark.parametrize(
    ("normaliser", "threshold", "limit_px", "key"),
    [("px", 4, 4.0, "pck_px4"), ("torso", 0.2, 10.0, "pck_torso0.2"), ("bbox", 0.1, 10.0, "pck_bbox0.1")],
)
def test_pck_threshold_is_inclusive(normaliser, threshold, limit_px, key):
    joints = standing_person()
    options = pck2d.Options(threshold=threshold, normaliser=normaliser)
    predicted = joints.copy()
    predicted[0, 0, 0] += limit_px
    predicted[0, 1, 1] += limit_px * 1.001
    predicted[0, 3] += 1000
    assert pck2d.compute({"joints2d": predicted}, pose_labels(joints), options) == {key: pytest.approx(11 / 13)}


def test_pck_leaves_out_rows_without_a_torso():
    joints = np.concatenate([standing_person(), standing_person()])
    visible = np.ones((2, 13), bool)
    visible[0, 2] = False
    predicted = joints.copy()
    predicted[0] += 1000
    options = pck2d.Options()
    assert pck2d.compute({"joints2d": predicted}, pose_labels(joints, visible), options) == {"pck_torso0.2": 1.0}
    visible[1, 5] = False
    with pytest.raises(ValueError, match="torso length"):
        pck2d.compute({"joints2d": predicted}, pose_labels(joints, visible), options)
    with pytest.raises(ValueError, match="needs a joint set of dhp19"):
        pck2d.compute({"joints2d": predicted}, pose_labels(joints, joint_set="other"), options)


def test_pose_metrics_do_not_change_their_inputs():
    joints = standing_person()
    target, predicted = pose_labels(joints), joints.copy()
    for metric in (mpjpe2d, pck2d):
        metric.compute({"joints2d": predicted}, target, metric.Options())
    assert np.array_equal(predicted, joints) and target.joints2d is not None
    assert np.array_equal(target.joints2d, joints.astype(np.float32))


def test_classification_by_hand():
    scores = classification.compute(
        certain(["a", "a", "b", "b"], ["a", "b", "c"]), class_labels(["a", "b", "b", "c"]), classification.Options()
    )
    # Precision a 1/2, b 1/2, c never predicted 0; recall a 1, b 1/2, c 0.
    assert scores == {
        "accuracy": 0.5,
        "macro_precision": pytest.approx(1 / 3),
        "macro_recall": pytest.approx(0.5),
        "macro_f1": pytest.approx((2 / 3 + 1 / 2 + 0) / 3),
        "chance_accuracy": 0.5,
        "calibration_error_ece15": 0.5,  # always certain, right half of the time
    }


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.sampled_from("abcd"), st.sampled_from("abcde")), min_size=1, max_size=30))
def test_classification_agrees_with_scikit_learn(pairs):
    names, truth = zip(*pairs, strict=True)
    scores = classification.compute(certain(names, list("abcd")), class_labels(truth), classification.Options())
    assert scores["accuracy"] == pytest.approx(accuracy_score(truth, names))
    macro = {"average": "macro", "zero_division": 0}
    assert scores["macro_precision"] == pytest.approx(precision_score(truth, names, **macro))
    assert scores["macro_recall"] == pytest.approx(recall_score(truth, names, **macro))


def test_classification_names_bad_input():
    options = classification.Options()
    predicted = certain(["a", "b"], ["a", "b"])
    with pytest.raises(ValueError, match=r"must be \[1, 2\], got \(2, 2\)"):
        classification.compute(predicted, class_labels(["a"]), options)
    with pytest.raises(ValueError, match="target row 1 has no class name"):
        classification.compute(predicted, class_labels(["a", ""]), options)
    predicted["probability"][1, 0] = np.nan
    with pytest.raises(ValueError, match="row 1 is not finite"):
        classification.compute(predicted, class_labels(["a", "b"]), options)
    with pytest.raises(ValueError, match="no row"):
        classification.compute(
            {"probability": np.zeros((0, 2)), "classes": np.array(["a", "b"])}, class_labels([]), options
        )


def test_frechet_metric_names_its_score():
    a = np.array([[0.0], [2.0]])
    assert frechet.compute(a, a + 3, frechet.Options()) == {"fd": pytest.approx(9.0)}


def test_interval_of_independent_samples_is_that_of_the_normal_approximation():
    values = np.random.default_rng(0).normal(5, 2, size=2000)
    low, high = bootstrap_interval(values)
    half = 1.96 * values.std(ddof=1) / np.sqrt(len(values))
    # 2,000 replicates place a 2.5 % quantile to about 5 % of the half width.
    assert low == pytest.approx(values.mean() - half, abs=0.12 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.12 * half)


def test_interval_of_copies_does_not_shrink_with_the_number_of_copies():
    """Twenty frames of one recording that are all alike are worth one."""
    values = np.random.default_rng(1).normal(size=30)
    alone = bootstrap_interval(values, seed=3)
    copied = bootstrap_interval(np.repeat(values, 20), np.repeat(np.arange(30).astype(str), 20), seed=3)
    naive = bootstrap_interval(np.repeat(values, 20), seed=3)
    assert copied[1] - copied[0] == pytest.approx(alone[1] - alone[0], rel=0.1)
    assert naive[1] - naive[0] < 0.4 * (copied[1] - copied[0])


@pytest.mark.parametrize("num_groups", [8, 10, 40])
def test_intervals_cover_the_truth_as_often_as_they_say(num_groups):
    hits = 0
    for trial in range(400):
        generator = np.random.default_rng(trial)
        groups = np.repeat(np.arange(num_groups), 5)
        values = generator.normal(size=num_groups)[groups] + generator.normal(size=5 * num_groups)
        low, high = bootstrap_interval(values, groups, num_resamples=400, seed=trial)
        hits += low <= 0 <= high
    # 95 % of 400 is 380, and 3 deviations are 13; percentiles of 8 groups would cover 359.
    assert 367 <= hits <= 393


def test_both_bootstraps_agree_on_a_mean():
    generator = np.random.default_rng(2)
    values, groups = generator.normal(size=100), generator.integers(0, 9, size=100)
    low, high = cluster_bootstrap(lambda rows: {"mean": float(values[rows].mean())}, groups, num_resamples=300, seed=4)
    expected = bootstrap_interval(values, groups, num_resamples=300, seed=4)
    assert (low["mean"], high["mean"]) == pytest.approx(expected, rel=1e-12)


def test_intervals_ignore_rows_without_a_score_and_refuse_to_guess():
    values = np.array([1.0, np.nan, 3.0, np.nan])
    assert bootstrap_interval(values, seed=1) == bootstrap_interval(values[[0, 2]], seed=1)
    assert all(np.isnan(bootstrap_interval(values[:2])))
    assert cluster_bootstrap(lambda rows: {"mean": 0.0}, ["only", "only"]) == ({}, {})
    with pytest.raises(ValueError, match="none of the 2 values"):
        bootstrap_interval(np.full(2, np.nan))
    with pytest.raises(ValueError, match=r"must both be \[N\]"):
        bootstrap_interval(values, ["a"])


def test_replicates_that_cannot_be_scored_are_left_out():
    def compute(rows):
        if 0 not in rows:
            raise ValueError("no joint is visible")
        return {"score": 1.0}

    assert cluster_bootstrap(compute, ["a", "b", "c"]) == ({"score": 1.0}, {"score": 1.0})


def test_replicates_that_are_rarely_of_use_give_no_interval():
    """A score that needs all classes, with a recording each: what is left is the whole set, drawn again."""

    def compute(rows):
        if len(set(rows.tolist())) < 10:
            raise ValueError("a class is missing")
        return {"score": 1.0}

    assert cluster_bootstrap(compute, np.arange(10).astype(str)) == ({}, {})


def test_recordings_with_nothing_to_score_are_not_drawn():
    random = np.random.default_rng(0)
    scored = np.repeat(np.arange(5), 3)
    sums = {"error": (random.normal(10, 1, 15), np.ones(15))}
    padded = {"error": tuple(np.concatenate([values, np.zeros(35)]) for values in sums["error"])}
    groups = np.concatenate([scored, np.arange(5, 40)])
    assert ratio_bootstrap(padded, groups) == ratio_bootstrap(sums, scored)


def test_few_scored_recordings_have_no_interval():
    options = load_options(MetricChoice(name="mpjpe2d"))
    joints = np.random.default_rng(0).uniform(0, 64, (24, 13, 2)).astype(np.float32)
    prediction = {"joints2d": joints + 1}
    recordings, visible = np.repeat(np.arange(6), 4).astype(str), np.ones((24, 13), bool)
    for num_scored, has_interval in ((6, True), (5, True), (4, False)):
        seen = visible & (np.repeat(np.arange(6), 4) < num_scored)[:, None]
        labels = Labels(("a",) * 24, np.arange(24), joints, seen, "dhp19")
        scores, low, high = RowScores(options, prediction, labels, recordings).of(np.arange(24))
        assert scores["mpjpe2d_px"] == pytest.approx(2**0.5) and ("mpjpe2d_px" in low) == has_interval == bool(high)


def test_the_interval_of_a_score_that_grows_as_rows_repeat_has_the_score_in_it():
    """The share of the most frequent of ten values that are all as frequent: resampled, one is always more frequent."""
    values = np.repeat(np.arange(10), 3)

    def compute(rows):
        return {"largest": float(np.bincount(values[rows]).max() / len(rows))}

    low, high = cluster_bootstrap(compute, np.arange(30), seed=1)
    assert low["largest"] <= 0.1 < high["largest"] < 0.2


def test_a_replicate_is_whole_groups_one_after_the_other():
    groups = np.random.default_rng(1).permutation(np.repeat(["a", "b", "c", "d"], [1, 4, 2, 5]))
    members = [np.flatnonzero(groups == name) for name in "abcd"]
    replicates = []

    def compute(rows):
        replicates.append(rows)
        return {"rows": 1.0}

    cluster_bootstrap(compute, groups, num_resamples=50, seed=2)
    np.testing.assert_array_equal(replicates[0], np.arange(12))
    assert len(replicates) == 51
    for rows in replicates[1:]:
        counts = [np.count_nonzero(rows == own[0]) for own in members]
        assert sum(counts) == 4
        expected = [np.tile(own, count) for own, count in zip(members, counts, strict=True)]
        np.testing.assert_array_equal(rows, np.concatenate(expected))


def test_intervals_of_quotients_are_those_of_resampled_rows():
    """Some rows have nothing to count, and one score can be counted in two recordings alone: others leave it empty."""
    random = np.random.default_rng(3)
    groups = random.integers(0, 7, 60).astype(str)
    counts = random.integers(0, 3, 60).astype(float)
    rare = np.where(np.isin(groups, ["2", "5"]), 1.0, 0.0)
    sums = {"often": (random.random(60) * counts, counts), "rarely": (random.random(60) * rare, rare)}

    def compute(rows):
        if not all(count[rows].any() for _, count in sums.values()):
            raise ValueError("nothing to score")
        return {name: total[rows].sum() / count[rows].sum() for name, (total, count) in sums.items()}

    expected = cluster_bootstrap(compute, groups, num_resamples=200, seed=5)
    found = ratio_bootstrap(sums, groups, num_resamples=200, seed=5)
    assert found[0] == pytest.approx(expected[0], rel=1e-12) and found[1] == pytest.approx(expected[1], rel=1e-12)
    assert ratio_bootstrap(sums, np.full(60, "one")) == ({}, {}) == ratio_bootstrap({}, groups)
    nothing = {"never": (np.zeros(60), np.zeros(60))}
    assert ratio_bootstrap(nothing, groups) == ({}, {})


@pytest.mark.parametrize(
    ("numbers", "signed", "text"),
    [
        ((6.5412, 5.9318, 7.2171), False, "6.541 [5.932, 7.217]"),
        ((279.572, 254.748, 306.019), False, "279.6 [254.7, 306.0]"),
        ((-25.336, -38.124, -13.222), True, "-25.34 [-38.12, -13.22]"),
        ((0.0312, 0.0061, 0.0562), True, "+0.031 [+0.006, +0.056]"),
        ((9.99961, 9.0, 9.99961), False, "10.00 [9.00, 10.00]"),
        ((9.5, 8.0, 10.0), False, "9.50 [8.00, 10.00]"),
        ((123456.7, None, None), False, "123457"),
        ((0.0, float("nan"), float("nan")), False, "0.000"),
        ((0.00062, 0.00041, 0.00083), False, "0.000620 [0.000410, 0.000830]"),
        ((0.00142, 0.0004, 0.0031), False, "0.00142 [0.00040, 0.00310]"),
        ((-0.0004, -0.4, 0.3), False, "0.000 [-0.400, 0.300]"),
        ((float("nan"),), False, "nan"),
        ((float("inf"), 1.0, float("inf")), False, "inf [1.000, inf]"),
    ],
)
def test_scores_are_told_with_four_digits(numbers, signed, text):
    assert score_text(*numbers, signed=signed) == text
