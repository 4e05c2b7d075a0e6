"""Small decisions the tasks take: which labels to sample from, and what the verdict says."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from ctlev_core import plugins
from ctlev_core.labels.body_views import with_joints
from ctlev_core.labels.rows_to_sample import _from_new_sides, _on_sensor, choose_in_turn
from ctlev_core.metrics import mpjpe2d, mpjpe3d, oks, pck2d
from ctlev_core.report.sections.verdict import verdict
from ctlev_core.scoring.pose import quotients
from ctlev_core.scoring.score_info import lower_is_better
from ctlev_core.scoring.scored_rows import RowScores
from ctlev_core.statistics.paired_differences import Difference
from data_contracts.errors import DataError
from data_contracts.labels import Labels
from data_contracts.manifest import concat_labels


@pytest.mark.parametrize(
    ("count", "expected"), [(3, [1, 3, 5]), (6, [0, 1, 2, 3, 4, 5]), (8, [0, 0, 1, 1, 2, 3, 4, 5])]
)
def test_in_time_moments_keep_their_order_and_are_evenly_spread(count, expected):
    moments = pa.table({"class_name": list("abacbc"), "t_us": [0, 10, 20, 0, 10, 20]})
    assert choose_in_turn(moments, np.arange(6), count, "in_time", seed=0).tolist() == expected


@pytest.mark.parametrize("module", [mpjpe2d, pck2d, mpjpe3d], ids=lambda module: module.__name__.rpartition(".")[2])
def test_scores_of_resampled_rows_are_those_of_their_sums(module):
    """The bootstrap adds up sums; comparing the resampled rows themselves is the slow way to the same numbers."""
    random = np.random.default_rng(0)
    joints2d, joints3d = random.uniform(5, 60, (30, 13, 2)), random.normal([0, 0, 3000], 300, (30, 13, 3))
    visible = random.random((30, 13)) < 0.7
    joints3d[~visible] = np.nan
    labels = Labels(
        ("",) * 30, np.arange(30), joints2d.astype(np.float32), visible, "dhp19", joints3d.astype(np.float32)
    )
    predicted = {
        "joints2d": joints2d + random.normal(0, 3, joints2d.shape),
        "joints3d": np.nan_to_num(joints3d) + random.normal(0, 40, joints3d.shape),
    }
    options = module.Options()
    sums = module.compute_sums(predicted, labels, options)
    for rows in (np.arange(30), random.integers(0, 30, 30), np.array([3, 3, 4])):
        picked = {name: values[rows] for name, values in predicted.items()}
        expected = module.compute(picked, labels.take(rows), options)
        resampled = quotients({name: (total[rows], count[rows]) for name, (total, count) in sums.items()})
        assert resampled == pytest.approx(expected, rel=1e-12)


def bodies(count=4):
    pose = np.zeros((count, 72), np.float32)
    pose[:, 0] = np.pi
    transl = np.tile(np.array([0, 0.2, 3], np.float32), (count, 1))
    return Labels(
        ("walk",) * count,
        np.arange(count),
        smpl_pose=pose,
        smpl_betas=np.zeros((count, 10), np.float32),
        smpl_transl=transl,
        intrinsics=np.tile(np.array([90, 90, 32, 32], np.float32), (count, 1)),
    )


def test_new_views_are_one_for_each_number_whatever_the_order_of_rows():
    seen = _from_new_sides(bodies(), np.array([1, 0, 1, 0]), (64, 64), seed=3)
    roots = seen.smpl_pose[:, :3]
    np.testing.assert_array_equal(roots[[0, 1]], roots[[2, 3]])
    assert np.abs(roots[0] - roots[1]).max() > 0.05 and seen.t_us.tolist() == [0, 1, 2, 3]
    more = _from_new_sides(bodies(6), np.arange(6), (64, 64), seed=3)
    np.testing.assert_array_equal(more.smpl_pose[:4], _from_new_sides(bodies(), np.arange(4), (64, 64), 3).smpl_pose)
    assert with_joints(more, (64, 64), "dhp19").visible.mean() > 0.9


def test_labels_of_another_sensor_are_scaled_into_the_middle():
    """Bodies before a wider and finer sensor keep their place in the view; those of no sensor stay as they are."""
    own, wide = with_joints(bodies(), (64, 64), "smpl"), bodies()
    wide = with_joints(replace(wide, intrinsics=wide.intrinsics * 4 + [0, 0, 72, 0]), (400, 256), "smpl")
    both = concat_labels([own.take([0]), wide.take([1]), own.take([2])])
    moved = _on_sensor(both, np.array([[64, 64], [400, 256], [0, 0]]), (64, 64))
    np.testing.assert_array_equal(moved.joints2d[[0, 2]], own.joints2d[[0, 2]])
    # 400 px become 64, the 256 rows 40.96 in the middle of 64.
    expected = 0.16 * wide.joints2d[1] + [0, (64 - 40.96) / 2]
    np.testing.assert_allclose(moved.joints2d[1], expected, atol=1e-4)
    assert moved.visible.all()
    again = with_joints(replace(moved, joints2d=None), (64, 64), "smpl")  # the intrinsics went along
    np.testing.assert_allclose(again.joints2d, moved.joints2d, atol=1e-3)
    assert _on_sensor(own, np.tile([64, 64], (4, 1)), (64, 64)) is own


def test_new_views_of_labels_without_bodies_are_refused():
    with pytest.raises(DataError, match="needs bodies"):
        _from_new_sides(Labels(("a",), np.zeros(1, np.int64)), np.zeros(1, int), (64, 64), 0)


def row(setting, value, metric="mpjpe2d_px"):
    return {"subject": setting, "group": "all", "metric": metric, "value": value}


SETTINGS = ("recorded", "synthetic", "recorded+synthetic")
ROWS = [row("recorded", 7.0), row("recorded", 7.2), row("synthetic", 8.0), row("recorded+synthetic", 6.3)]


def told(*arguments, **settings):
    """The verdict as one paragraph."""
    return str(verdict(*arguments, **settings))


def test_verdict_averages_seeds_and_says_which_way_is_better():
    text = told(ROWS, SETTINGS)
    assert "recorded 7.100, synthetic 8.000, recorded + synthetic 6.300." in text and "Less is better." in text


@pytest.mark.parametrize(
    ("metric", "difference", "expected"),
    [
        (
            "mpjpe2d_px",
            Difference(-0.8, -1.0, -0.6),
            "helped: 2D joint error (MPJPE) went from 7.100 to 6.300 px, a difference of -0.800 [-1.000, -0.600]",
        ),
        (
            "mpjpe2d_px",
            Difference(0.8, 0.6, 1.0),
            "recorded ones did harm: 2D joint error (MPJPE) went from 7.100 to 6.300 px, a difference of +0.800",
        ),
        (
            "accuracy",
            Difference(0.8, 0.6, 1.0),
            "recorded ones helped: accuracy went from 7.100 to 6.300, a difference of +0.800",
        ),
        (
            "mpjpe2d_px",
            Difference(-0.8, -1.7, 0.1),
            "is undecided: 2D joint error (MPJPE) went from 7.100 to 6.300 px, a difference of -0.800 [-1.700, +0.100]",
        ),
        (
            "mpjpe2d_px",
            Difference(0.0, 0.0, 0.0),
            "Adding synthetic frames to the recorded ones changed nothing: 2D joint error (MPJPE) is 6.300 px.",
        ),
        ("mpjpe2d_px", Difference(-0.8, float("nan"), float("nan")), "too few test recordings to say"),
    ],
)
def test_verdict_claims_only_what_the_interval_of_the_difference_shows(metric, difference, expected):
    rows = [{**one, "metric": metric} for one in ROWS]
    assert expected in told(rows, SETTINGS, difference)


def test_verdict_sets_each_baseline_beside_in_a_sentence_of_its_own():
    rows = [*ROWS, row("gan", 9.0), row("recorded+gan", 6.9), row("esim", 9.5), row("recorded+esim", 6.2)]
    settings = (*SETTINGS, "gan", "esim", "recorded+gan", "recorded+esim")
    beside = {"gan": Difference(-0.6, -0.8, -0.4), "esim": Difference(0.1, -0.1, 0.3)}
    text = told(rows, settings, Difference(-0.8, -1.0, -0.6), beside)
    assert "went from 7.100 to 6.300 px, a difference of -0.800 [-1.000, -0.600]" in text and "9.000" not in text
    assert "the score is 6.900; " in text and "-0.600 [-0.800, -0.400]." in text
    assert "the score is 6.200; which is better is undecided: +0.100 [-0.100, +0.300]." in text


def test_without_both_together_synthetic_data_is_told_beside_real_data():
    rows = [{**one, "metric": "accuracy"} for one in ROWS if one["subject"] != "recorded+synthetic"]
    text = told(rows, SETTINGS, instead=Difference(0.5, 0.25, 0.75))
    assert "Training on synthetic frames instead of recorded ones helped: accuracy went from 7.100 to 8.000, a" in text
    assert "difference of +0.500 [+0.250" in text
    unsure = told(rows, SETTINGS, instead=Difference(0.5, -0.25, 1.25))
    assert "Whether training on synthetic frames instead of recorded ones helped is undecided: accuracy went" in unsure
    assert "instead" not in told(ROWS, SETTINGS, Difference(-0.8, -1.0, -0.6), instead=Difference(0.5, 0.25, 0.75))


def test_directions():
    assert lower_is_better("fd_event_classifier_0123abcd") and lower_is_better("mpjpe2d_px")
    assert not lower_is_better("accuracy") and not lower_is_better("pck_px4")


def test_verdict_without_scores_says_so():
    assert told([], SETTINGS) == "No downstream model was scored."


@pytest.mark.parametrize(("module", "score"), [(mpjpe2d, "mpjpe2d_px"), (oks, "oks_ap25"), (pck2d, "pck_torso0.2")])
def test_the_rows_of_a_metric_are_parts_of_one_of_its_scores(module, score):
    """Joints count alike, so that rows with fewer of them weigh less; another metric's scores are not looked at."""
    random = np.random.default_rng(0)
    joints, visible = random.uniform(5, 60, (30, 13, 2)).astype(np.float32), random.random((30, 13)) < 0.6
    visible[:, :10] |= np.arange(30)[:, None] % 3 == 0
    visible[:, [1, 2, 7, 8]] = True  # shoulders and hips, or there is no torso to measure by
    labels = Labels(("",) * 30, np.arange(30), joints, visible, "dhp19")
    predicted = {"joints2d": joints + random.normal(0, 6, joints.shape)}
    options = module.Options()
    metric = plugins.Plugin("metrics", "m", module, options)
    scores = module.compute(predicted, labels, options)
    found = RowScores(metric, predicted, labels, np.array([])).each_row(scores)
    assert set(found["metric"].to_pylist()) == {score}
    values, weights = (np.array(found[name].to_pylist(), float) for name in ("value", "weight"))
    known = ~np.isnan(values)
    assert np.average(values[known], weights=weights[known]) == pytest.approx(scores[score])
    assert score == next(iter(scores)), "what training sets are compared by"
