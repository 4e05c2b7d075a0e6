"""3D errors on poses whose error is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.metrics import mpjpe3d
from data_contracts.labels import Labels


def labels(joints3d, joint_set="dhp19"):
    joints3d = np.asarray(joints3d, np.float32)
    return Labels(("",) * len(joints3d), np.zeros(len(joints3d), np.int64), joints3d=joints3d, joint_set=joint_set)


def poses(count=3, joint_set="dhp19"):
    random = np.random.default_rng(0)
    return 300 * random.normal(size=(count, len(JOINT_SETS[joint_set].joints), 3)) + [100, 0, 3000]


@pytest.mark.parametrize("joint_set", sorted(JOINT_SETS))
def test_a_shift_counts_in_the_camera_frame_alone(joint_set):
    target = poses(joint_set=joint_set)
    scores = mpjpe3d.compute({"joints3d": target + np.array([30, 40, 0])}, labels(target, joint_set), mpjpe3d.Options())
    assert list(scores) == ["mpjpe3d_pelvis_mm", "mpjpe3d_pa_mm", "mpjpe3d_mm"]
    # float32 labels at 3 m are good to 0.1 um.
    assert scores["mpjpe3d_mm"] == pytest.approx(50, abs=1e-3)
    assert scores["mpjpe3d_pelvis_mm"] < 1e-3 and scores["mpjpe3d_pa_mm"] < 1e-3


def test_a_turn_counts_from_the_pelvis_and_not_after_procrustes():
    target = poses()
    turned = 1.5 * target @ Rotation.from_euler("y", 90, degrees=True).as_matrix().T
    scores = mpjpe3d.compute({"joints3d": turned}, labels(target), mpjpe3d.Options())
    assert scores["mpjpe3d_pelvis_mm"] > 300 and scores["mpjpe3d_pa_mm"] < 1e-3


def test_one_wrong_joint_of_thirteen():
    target = poses(1)
    wrong = target.copy()
    wrong[0, 0, 2] += 130
    options = mpjpe3d.Options(alignment="none")
    assert next(iter(mpjpe3d.compute({"joints3d": wrong}, labels(target), options))) == "mpjpe3d_mm"
    np.testing.assert_allclose(mpjpe3d.compute_rows({"joints3d": wrong}, labels(target), options), [10], atol=1e-4)


def test_unknown_joints_do_not_count_and_unknown_hips_leave_no_pelvis():
    target = poses(2)
    target[0, 3] = np.nan
    target[1, 5] = np.nan  # a hip
    predicted = {"joints3d": np.nan_to_num(target) + np.array([0, 0, 10])}
    rows = mpjpe3d.compute_rows(predicted, labels(target), mpjpe3d.Options())
    assert rows[0] < 1e-3 and np.isnan(rows[1])
    rows = mpjpe3d.compute_rows(predicted, labels(target), mpjpe3d.Options(alignment="none"))
    np.testing.assert_allclose(rows, [10, 10], atol=1e-3)


def test_an_alignment_that_no_row_has_is_left_out_and_missed_if_chosen():
    target = poses(2)
    target[:, 5] = np.nan  # a hip
    predicted, known = {"joints3d": np.nan_to_num(target)}, labels(target)
    scores = mpjpe3d.compute(predicted, known, mpjpe3d.Options(alignment="none"))
    assert list(scores) == ["mpjpe3d_mm", "mpjpe3d_pa_mm"]
    with pytest.raises(ValueError, match="none of the 2 target rows has what alignment 'pelvis' needs"):
        mpjpe3d.compute(predicted, known, mpjpe3d.Options())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p, t: ({"joints3d": p[:, :5]}, t), r"must be \(3, 13, 3\), got \(3, 5, 3\)"),
        (lambda p, t: ({"joints3d": np.where(p > 0, p, np.inf)}, t), "not a finite position"),
        (lambda p, t: ({"joints3d": p}, replace(t, joints3d=None)), "no joints3d"),
        (lambda p, t: ({"joints3d": p}, replace(t, joints3d=np.full_like(t.joints3d, np.nan))), "no joint is known"),
        (lambda p, t: ({"joints3d": p}, replace(t, joint_set="hands")), "no hips to align by"),
    ],
)
def test_what_cannot_be_scored_is_said(change, message):
    target = poses()
    predicted, asked = change(target, labels(target))
    with pytest.raises(ValueError, match=message):
        mpjpe3d.compute(predicted, asked, mpjpe3d.Options())
