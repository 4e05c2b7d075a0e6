"""OKS, PCK in 2D and 3D, AUC, DHP19's protocol and vertex errors against published values, loops and closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ctlev_core.body.layer import load_body, pose_vertices
from ctlev_core.geometry.joint_sets import JOINT_SETS
from ctlev_core.metrics import mpjpe2d, oks, pck2d, pck3d, pve
from data_contracts.labels import Labels


def labels2d(joints2d, visible=None, joint_set="dhp19"):
    joints2d = np.asarray(joints2d, np.float32)
    visible = np.ones(joints2d.shape[:2], bool) if visible is None else np.asarray(visible, bool)
    return Labels(("",) * len(joints2d), np.zeros(len(joints2d), np.int64), joints2d, visible, joint_set)


def labels3d(joints3d, joint_set="smpl"):
    joints3d = np.asarray(joints3d, np.float32)
    return Labels(("",) * len(joints3d), np.zeros(len(joints3d), np.int64), joints3d=joints3d, joint_set=joint_set)


def labels_smpl(pose, betas, transl):
    arrays = (np.asarray(array, np.float32) for array in (pose, betas, transl))
    names = ("smpl_pose", "smpl_betas", "smpl_transl")
    return Labels(("",) * len(pose), np.zeros(len(pose), np.int64), **dict(zip(names, arrays, strict=True)))


def people(count, joint_set="dhp19", seed=0):
    random = np.random.default_rng(seed)
    return 40 * random.normal(size=(count, len(JOINT_SETS[joint_set].joints), 2)) + 150


# --- 2D error as DHP19 computes it


def test_dhp19_example_joint():
    """S16, session 2, movement 1, index 24, camera 2: the head's label pixel is (45, 124), the highest (32, 132)."""
    label, highest = np.array([45.73, 124.21]), np.array([32.5, 132.5])
    target, predicted = labels2d([[label]], joint_set=""), {"joints2d": highest[None, None]}
    found = mpjpe2d.compute(predicted, target, mpjpe2d.Options(protocol="dhp19"))
    assert found == {"mpjpe2d_dhp19_px": pytest.approx(15.264, abs=5e-4)}
    exact = mpjpe2d.compute(predicted, target, mpjpe2d.Options())
    assert exact == {"mpjpe2d_px": pytest.approx(np.linalg.norm(np.float32(label) - highest), rel=1e-7)}


def test_known_joints_count_although_they_are_occluded():
    joints = np.zeros((1, 3, 2))
    joints[0, 2] = np.nan
    target = labels2d(joints, [[True, False, False]])
    predicted = {"joints2d": np.array([[[3, 4], [0, 1], [9, 9]]])}
    assert mpjpe2d.compute(predicted, target, mpjpe2d.Options()) == {"mpjpe2d_px": 5}
    assert mpjpe2d.compute(predicted, target, mpjpe2d.Options(joints="known")) == {"mpjpe2d_known_px": 3}
    with pytest.raises(ValueError, match="no joint is known in any of the 1 target rows"):
        mpjpe2d.compute(predicted, labels2d(np.full((1, 3, 2), np.nan)), mpjpe2d.Options(joints="known"))


# --- keypoint similarity


def coco_similarity(predicted, label, visible, sigmas, area):
    """The sum of COCO's computeOks, joint by joint."""
    terms = []
    for point, true, seen, sigma in zip(predicted, label, visible, sigmas, strict=True):
        if seen:
            squared = (point[0] - true[0]) ** 2 + (point[1] - true[1]) ** 2
            terms.append(np.exp(-squared / (2 * sigma) ** 2 / (area + np.spacing(1)) / 2))
    return sum(terms) / len(terms)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(0, 40))
def test_similarity_agrees_with_a_loop_over_joints(seed, error_px):
    random = np.random.default_rng(seed)
    target, visible = people(6, seed=seed).astype(np.float32).astype(np.float64), random.random((6, 13)) < 0.8
    predicted = target + error_px * random.normal(size=target.shape)
    sigmas = [0.079, 0.079, 0.079, 0.072, 0.072, 0.107, 0.107, 0.062, 0.062, 0.087, 0.087, 0.089, 0.089]
    expected = []
    for row in range(6):
        seen = target[row][visible[row]]
        area = 0.53 * np.prod(seen.max(axis=0) - seen.min(axis=0)) if len(seen) else 0.0
        expected.append(coco_similarity(predicted[row], target[row], visible[row], sigmas, area) if area else np.nan)
    labels, options = labels2d(target, visible), oks.Options()
    np.testing.assert_allclose(oks.compute_rows({"joints2d": predicted}, labels, options), expected, rtol=1e-12)
    scored = [value for value in expected if not np.isnan(value)]
    assert oks.compute({"joints2d": predicted}, labels, options) == {
        "oks_ap25": pytest.approx(np.mean(np.array(scored) >= 0.25)),
        "oks_ap50": pytest.approx(np.mean(np.array(scored) >= 0.5)),
        "oks_mean": pytest.approx(np.mean(scored)),
    }


def test_similarity_of_perfect_collapsed_and_distant_poses():
    target = people(4)
    perfect = oks.compute({"joints2d": np.float32(target)}, labels2d(target), oks.Options())
    assert perfect == {"oks_ap25": 1, "oks_ap50": 1, "oks_mean": 1}
    collapsed = oks.compute({"joints2d": np.full_like(target, 150.0)}, labels2d(target), oks.Options())
    assert 0 < collapsed["oks_mean"] < 0.5
    assert oks.compute({"joints2d": target + 1e6}, labels2d(target), oks.Options())["oks_mean"] == 0


def test_frames_without_an_area_are_left_out():
    target = people(3)
    visible = np.ones((3, 13), bool)
    target[0, :, 1] = 7.0  # flat
    visible[1] = False
    rows = oks.compute_rows({"joints2d": target}, labels2d(target, visible), oks.Options())
    np.testing.assert_array_equal(np.isnan(rows), [True, True, False])
    with pytest.raises(ValueError, match="in none of the 1 target rows do the visible joints span an area"):
        oks.compute({"joints2d": target[:1]}, labels2d(target[:1]), oks.Options())
    for joint_set, message in (("", "joint set whose joints have sigmas, got ''"), ("smpl", "whose .*collar.* have")):
        with pytest.raises(ValueError, match=message):
            poses = people(1, joint_set or "dhp19")
            oks.compute({"joints2d": poses}, labels2d(poses, joint_set=joint_set), oks.Options())
    with pytest.raises(ValueError, match="similarities lie above 0"):
        oks.Options(thresholds=(0.5, 50))


# --- fractions of correct joints


@pytest.mark.parametrize(
    ("joint_set", "length"), [("dhp19", 50.0), ("cdehp", 50.0), ("openpose", 50.0), ("smpl", 60.0)]
)
def test_pckh_counts_joints_within_half_a_head(joint_set, length):
    """The head is 30 px above and 40 px beside the middle of the shoulders; SMPL's neck is 30 px below the head."""
    names = JOINT_SETS[joint_set].joints
    joints = np.zeros((1, len(names), 2))
    joints[0, names.index("left_shoulder")], joints[0, names.index("right_shoulder")] = (20, 30), (60, 30)
    if joint_set == "smpl":
        joints[0, names.index("neck")] = (0, 30)
    predicted = joints.copy()
    predicted[0, 0, 0] += length / 2
    predicted[0, 1, 0] += length / 2 + 0.01
    options = pck2d.Options(normaliser="head", threshold=0.5)
    found = pck2d.compute({"joints2d": predicted}, labels2d(joints, joint_set=joint_set), options)
    assert found == {"pck_head0.5": pytest.approx(1 - 1 / len(names))}
    with pytest.raises(ValueError, match="the head needs a joint set of"):
        pck2d.compute({"joints2d": predicted}, labels2d(joints, joint_set="hands"), options)


def errors_along_x(errors_mm):
    """Labels and predictions of one frame a joint apart by the given distances."""
    target = np.zeros((1, len(errors_mm), 3))
    predicted = target.copy()
    predicted[0, :, 0] = errors_mm
    return {"joints3d": predicted}, labels3d(target, "")


def test_auc_and_pck_of_the_example_with_ties():
    """Errors of 0, 10, .. 50, 100 and 160 mm: the curve's area is 2/3; the tie at 50 mm is correct."""
    predicted, target = errors_along_x([0, 10, 20, 30, 40, 50, 100, 160])
    found = pck3d.compute(predicted, target, pck3d.Options(alignment="none"))
    assert found == {"pck3d_25mm": 0.375, "pck3d_50mm": 0.75, "auc3d_150mm": pytest.approx(200 / 300, rel=1e-15)}


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0, 400), min_size=1, max_size=30), st.floats(1, 300))
def test_auc_is_the_integral_of_pck(errors_mm, auc_max_mm):
    options = pck3d.Options(alignment="none", auc_max_mm=auc_max_mm)
    predicted, target = errors_along_x(errors_mm)
    # The curve is a staircase, so the midpoint rule with 20,000 steps is wrong by at most half a step a joint.
    limits = (np.arange(20_000) + 0.5) * auc_max_mm / 20_000
    curve = (np.array(errors_mm)[:, None] <= limits).mean()
    assert pck3d.compute(predicted, target, options)[f"auc3d_{auc_max_mm:g}mm"] == pytest.approx(curve, abs=3e-5)


TABLE_3 = {  # MPJPE mm, PCK@25 %, PCK@50 %, AUC %
    "recorded": (27.30, 46.05, 95.02, 81.79),
    "Event-GAN": (29.43, 35.61, 91.79, 80.37),
    "SMPL-ESIM": (53.53, 5.84, 42.54, 36.44),
    "ours, Event-HPE poses": (25.13, 54.97, 96.45, 83.24),
    "ours, AMASS poses": (28.32, 45.11, 92.59, 81.12),
    "ours both + recorded": (18.65, 79.37, 99.66, 87.57),
}


@pytest.mark.parametrize("row", TABLE_3)
def test_the_paper_s_auc_is_the_one_over_150_mm(row):
    """The least AUC that errors of a mean can have is 1 - mean / 150, and they have it if none exceeds 150 mm."""
    mpjpe_mm, pck25, pck50, auc = TABLE_3[row]
    lowest = 100 * (1 - mpjpe_mm / 150)
    if row == "SMPL-ESIM":
        assert auc < lowest - 25  # impossible whatever the errors are
        return
    assert auc == pytest.approx(lowest, abs=0.011)  # both are rounded to 0.01
    # Errors that have these fractions, spread over each interval as the mean asks: the same AUC comes out of `pck3d`.
    share = np.diff([0, pck25, pck50, 100]) / 100
    low, high = share @ [0, 25, 50], share @ [25, 50, 150]
    assert low < mpjpe_mm < high
    place = (mpjpe_mm - low) / (high - low)
    counts = np.round(10_000 * share).astype(int)
    errors_mm = np.repeat([0.01, 25.01, 50.01] + place * np.array([24.98, 24.98, 99.98]), counts)
    found = pck3d.compute(*errors_along_x(errors_mm), pck3d.Options(alignment="none"))
    got = [100 * found[name] for name in ("pck3d_25mm", "pck3d_50mm", "auc3d_150mm")]
    assert got == pytest.approx([pck25, pck50, auc], abs=0.03)


def test_pck3d_follows_its_alignment_and_measures_heads():
    random = np.random.default_rng(0)
    target = 300 * random.normal(size=(5, 24, 3))
    neck, head = (JOINT_SETS["smpl"].joints.index(name) for name in ("neck", "head"))
    target[:, head] = target[:, neck] + [0, 100, 0]  # a head of 200 mm
    turned = target @ Rotation.from_euler("z", 30, degrees=True).as_matrix().T + [0, 0, 500]
    options = pck3d.Options(alignment="procrustes", head_threshold=0.5)
    found = pck3d.compute({"joints3d": turned}, labels3d(target), options)
    assert list(found) == ["pck3d_pa_25mm", "pck3d_pa_50mm", "auc3d_pa_150mm", "pckh3d_pa_0.5"]
    assert min(found.values()) == pytest.approx(1, abs=1e-5)
    shifted = {"joints3d": target + np.array([0, 0, 90])}
    options = pck3d.Options(alignment="none", head_threshold=0.5, thresholds_mm=(100,))
    assert pck3d.compute(shifted, labels3d(target), options) == {
        "pck3d_100mm": 1,
        "auc3d_150mm": pytest.approx(0.4, abs=1e-5),
        "pckh3d_0.5": 1,
    }
    assert pck3d.compute(shifted, labels3d(target), pck3d.Options())["pck3d_pelvis_25mm"] == 1


def test_pck3d_refuses_what_it_cannot_measure():
    target = np.zeros((2, 24, 3))
    target[:, 1] = np.nan  # a hip
    with pytest.raises(ValueError, match=r"none of the 2 target rows has what pck3d_pelvis_25mm, .* needs"):
        pck3d.compute({"joints3d": np.zeros((2, 24, 3))}, labels3d(target), pck3d.Options())
    with pytest.raises(ValueError, match=r"what pckh3d_0\.5 needs"):
        # All joints in one place: no head.
        options = pck3d.Options(alignment="none", head_threshold=0.5)
        pck3d.compute({"joints3d": np.zeros((2, 24, 3))}, labels3d(np.zeros((2, 24, 3))), options)


# --- vertices


def bodies(count, seed=0):
    random = np.random.default_rng(seed)
    pose = 0.4 * random.normal(size=(count, 72))
    return pose, random.normal(size=(count, 10)), random.normal(size=(count, 3)) + np.array([0, 0, 3])


def predicted_bodies(pose, betas, transl):
    return {"smpl_pose": pose, "smpl_betas": betas, "smpl_transl": transl}


def test_a_shift_counts_in_the_camera_frame_alone():
    pose, betas, transl = (np.float32(array) for array in bodies(3))
    moved = predicted_bodies(pose, betas, np.float64(transl) + np.array([0.03, 0.04, 0]))
    found = pve.compute(moved, labels_smpl(pose, betas, transl), pve.Options())
    assert list(found) == ["pve_pelvis_mm", "pve_pa_mm", "pve_mm"]
    assert found["pve_mm"] == pytest.approx(50, abs=1e-6)
    assert max(found["pve_pelvis_mm"], found["pve_pa_mm"]) < 1e-6


def test_vertex_errors_agree_with_a_loop_over_bodies():
    """Forty rows, more than are posed at once; a slow loop with SciPy's rotations."""
    target, predicted = bodies(40, 1), bodies(40, 2)
    labels = labels_smpl(*target)
    expected = {"pve_pelvis_mm": [], "pve_mm": []}
    for row in range(40):
        vertices, hips = [], []
        for pose, betas, transl in (predicted, [array.astype(np.float32) for array in target]):
            rotations = Rotation.from_rotvec(pose[row].astype(np.float64).reshape(24, 3)).as_matrix()[None]
            posed, joints = pose_vertices(load_body(), rotations, betas[row].astype(np.float64), np.zeros((1, 3)))
            vertices.append(posed[0].astype(np.float64) + transl[row])
            hips.append(joints[0, 1:3].mean(axis=0) + transl[row])
        difference = vertices[0] - vertices[1]
        expected["pve_mm"].append(1000 * np.linalg.norm(difference, axis=1).mean())
        expected["pve_pelvis_mm"].append(1000 * np.linalg.norm(difference - hips[0] + hips[1], axis=1).mean())
    found = pve.compute(predicted_bodies(*predicted), labels, pve.Options(alignment="none"))
    assert next(iter(found)) == "pve_mm"
    for name, rows in expected.items():
        assert found[name] == pytest.approx(np.mean(rows), rel=1e-6)  # float32 vertices
    rows = pve.compute_rows(predicted_bodies(*predicted), labels, pve.Options())
    np.testing.assert_allclose(rows, expected["pve_pelvis_mm"], rtol=1e-6)
    assert found["pve_pa_mm"] < found["pve_pelvis_mm"]


def test_a_body_turned_by_exactly_pi_is_the_same_either_way_round():
    pose, betas, transl = bodies(2)
    pose[:, :3] = [np.pi, 0, 0], [0, -np.pi, 0]
    opposite = pose.copy()
    opposite[:, :3] *= -1
    found = pve.compute(predicted_bodies(opposite, betas, transl), labels_smpl(pose, betas, transl), pve.Options())
    # float32 labels: pi is wrong by 9e-8 rad, at 1 m.
    assert max(found.values()) < 1e-3


def test_bodies_that_cannot_be_compared_are_named():
    pose, betas, transl = bodies(2)
    labels = labels_smpl(pose, betas, transl)
    with pytest.raises(ValueError, match="the predicted bodies have no smpl_betas"):
        pve.compute({"smpl_pose": pose, "smpl_transl": transl}, labels, pve.Options())
    with pytest.raises(ValueError, match=r"predicted smpl_pose must be \(2, 72\), got \(2, 69\)"):
        pve.compute(predicted_bodies(pose[:, 3:], betas, transl), labels, pve.Options())
    broken = betas.copy()
    broken[1, 4] = np.inf
    with pytest.raises(ValueError, match="predicted smpl_betas of row 1 is not finite"):
        pve.compute(predicted_bodies(pose, broken, transl), labels, pve.Options())
    with pytest.raises(ValueError, match="the target bodies have no smpl_pose"):
        pve.compute(predicted_bodies(pose, betas, transl), labels2d(people(2)), pve.Options())
    with pytest.raises(ValueError, match="there is no row"):
        nothing = [array[:0] for array in (pose, betas, transl)]
        pve.compute(predicted_bodies(*nothing), labels_smpl(*nothing), pve.Options())


POSES_2D = (
    {"joints2d": people(30, seed=3)},
    labels2d(people(30, seed=4), np.random.default_rng(0).random((30, 13)) < 0.7),
)
POSES_3D = (
    {"joints3d": 300 * np.random.default_rng(1).normal(size=(30, 24, 3))},
    labels3d(people(30, "smpl") @ np.eye(2, 3)),
)
BODIES = predicted_bodies(*bodies(30, 5)), labels_smpl(*bodies(30, 6))


@pytest.mark.parametrize(
    ("metric", "options", "data"),
    [
        (mpjpe2d, {"protocol": "dhp19"}, POSES_2D),
        (pck2d, {"normaliser": "head", "threshold": 1}, POSES_2D),
        (oks, {}, POSES_2D),
        (pck3d, {"head_threshold": 1}, POSES_3D),
        (pve, {}, BODIES),
    ],
)
def test_scores_of_any_rows_are_quotients_of_their_sums(metric, options, data):
    """What lets intervals be resampled without comparing poses again."""
    (predicted, target), options = data, metric.Options(**options)
    sums = metric.compute_sums(predicted, target, options)
    rows = np.array([3, 3, 8, 21, 29, 0, 3])
    chosen = {name: array[rows] for name, array in predicted.items()}
    assert metric.compute(chosen, target.take(rows), options) == pytest.approx(
        {name: total[rows].sum() / count[rows].sum() for name, (total, count) in sums.items()}, rel=1e-9
    )
