"""Scores of groups of rows against the metric on those rows alone."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.metrics import mpjpe3d, pck3d
from ctlev_core.plugins import Plugin
from ctlev_core.scoring.scored_rows import RowScores
from ctlev_core.statistics.bootstrap import ratio_bootstrap
from data_contracts.labels import Labels

NUM_RECORDINGS, PER_RECORDING = 40, 3
RECORDINGS = np.repeat([f"r{n:02d}" for n in range(NUM_RECORDINGS)], PER_RECORDING)
WITH_HEADS = RECORDINGS < "r08"
HEAD = JOINT_SETS["dhp19"].joints.index("head")


def bodies():
    """The heads of all but eight recordings are not known."""
    random = np.random.default_rng(0)
    joints = random.normal(0, 300, (len(RECORDINGS), 13, 3)).astype(np.float32)
    predicted = {"joints3d": joints + random.normal(0, 40, joints.shape)}
    joints[~WITH_HEADS, HEAD] = np.nan
    return predicted, Labels(("",) * len(joints), np.arange(len(joints)), joints3d=joints, joint_set="dhp19")


@pytest.mark.parametrize("module", [mpjpe3d, pck3d])
def test_groups_share_what_each_row_adds_to_the_scores(module):
    predicted, labels = bodies()
    compute_sums = Mock(wraps=module.compute_sums)
    shared = SimpleNamespace(compute=module.compute, compute_sums=compute_sums, **of_metrics(module))
    scored = RowScores(Plugin("metrics", "m", shared, module.Options()), predicted, labels, RECORDINGS)
    for members in (np.arange(len(RECORDINGS)), np.arange(5), np.flatnonzero(WITH_HEADS)):
        chosen = {"joints3d": predicted["joints3d"][members]}
        expected = module.compute(chosen, labels.take(members), module.Options())
        assert scored.of(members)[0] == pytest.approx(expected, rel=1e-12)
    compute_sums.assert_called_once()


def of_metrics(module):
    return {name: getattr(module, name) for name in ("VERSION", "INPUT", "SCORES", "Options")}


def test_an_interval_is_over_the_recordings_that_have_something_to_count():
    predicted, labels = bodies()
    options = pck3d.Options(head_threshold=0.5)
    scored = RowScores(Plugin("metrics", "pck3d", pck3d, options), predicted, labels, RECORDINGS)
    scores, low, high = scored.of(np.arange(len(RECORDINGS)))
    sums = pck3d.compute_sums(predicted, labels, options)
    for name, rows in (("pckh3d_pelvis_0.5", WITH_HEADS), ("auc3d_pelvis_150mm", slice(None))):
        pair = tuple(part[rows] for part in sums[name])
        lower, upper = ratio_bootstrap({name: pair}, RECORDINGS[rows])
        assert (low[name], high[name]) == pytest.approx((lower[name], upper[name]), rel=1e-12)
    assert set(low) == set(scores)


def test_rows_without_heads_keep_the_scores_that_need_none():
    predicted, labels = bodies()
    options = pck3d.Options(head_threshold=0.5)
    scored = RowScores(Plugin("metrics", "pck3d", pck3d, options), predicted, labels, RECORDINGS)
    scores, low, _ = scored.of(np.flatnonzero(~WITH_HEADS))
    assert set(scores) == {"pck3d_pelvis_25mm", "pck3d_pelvis_50mm", "auc3d_pelvis_150mm"} == set(low)
    nothing = Labels(("",), np.zeros(1, np.int64), joints3d=labels.joints3d[:1] * np.nan, joint_set="dhp19")
    with pytest.raises(ValueError, match="no joint is known in any of the 1 target rows"):
        RowScores(scored.metric, {"joints3d": predicted["joints3d"][:1]}, nothing, RECORDINGS[:1]).of(np.arange(1))
