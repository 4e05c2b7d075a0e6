"""Pose scores as the plainest loop over frames computes them, to be timed beside ours and to agree with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ctlev_core.body.layer import load_body
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.geometry.joint_sets import JOINT_SETS, SMPL_PARENTS
from ctlev_core.metrics import mpjpe2d, mpjpe3d, oks, pck2d, pck3d, pve
from data_contracts.labels import Labels

Scores = dict[str, float]
SMPL_ARRAYS = ("smpl_pose", "smpl_betas", "smpl_transl")
Job = tuple[str, Callable[[], Scores], Callable[[], Scores]]


def jobs(num_frames: int) -> Iterator[Job]:
    """Name, our score and the loop's, of the same frames."""
    random = np.random.default_rng(0)
    flat = 40 * random.normal(size=(num_frames, 13, 2)) + 150
    visible = random.random((num_frames, 13)) < 0.8
    target2d = _labels(num_frames, joints2d=flat.astype(np.float32), visible=visible, joint_set="dhp19")
    found2d = {"joints2d": flat + 5 * random.normal(size=flat.shape)}
    solid = 300 * random.normal(size=(num_frames, 24, 3)) + np.array([0, 0, 3000])
    target3d = _labels(num_frames, joints3d=solid.astype(np.float32), joint_set="smpl")
    found3d = {"joints3d": solid + 20 * random.normal(size=solid.shape)}
    yield _job("mpjpe2d", mpjpe2d, found2d, target2d, loop_mpjpe2d)
    yield _job("pck2d, torso", pck2d, found2d, target2d, loop_pck2d)
    yield _job("oks", oks, found2d, target2d, loop_oks)
    yield _job("mpjpe3d: camera, pelvis and PA", mpjpe3d, found3d, target3d, loop_mpjpe3d)
    yield _job("pck3d and AUC, pelvis", pck3d, found3d, target3d, loop_pck3d)
    bodies, labels = _bodies(num_frames, random)
    yield _job("pve: camera, pelvis and PA", pve, bodies, labels, loop_pve)


def check(name: str, ours: Scores, loop: Scores) -> None:
    """Raise unless both give the same numbers."""
    for key, value in loop.items():
        if abs(ours[key] - value) > 1e-5 * abs(value):
            raise RuntimeError(f"{name}: {key} is {ours[key]}, a loop gives {value}")


def _job(name: str, metric: Any, predicted: dict[str, np.ndarray], target: Labels, loop: Callable[..., Scores]) -> Job:
    options = metric.Options()
    return name, lambda: metric.compute(predicted, target, options), lambda: loop(predicted, target)


def _labels(num_frames: int, **arrays: Any) -> Labels:
    return Labels(("",) * num_frames, np.zeros(num_frames, np.int64), **arrays)


def _bodies(num_frames: int, random: np.random.Generator) -> tuple[dict[str, np.ndarray], Labels]:
    pose, betas = 0.3 * random.normal(size=(num_frames, 72)), random.normal(size=(num_frames, 10))
    transl = random.normal(size=(num_frames, 3)) + np.array([0, 0, 3])
    true = {name: array.astype(np.float32) for name, array in zip(SMPL_ARRAYS, (pose, betas, transl), strict=True)}
    predicted = {name: array + 0.05 * random.normal(size=array.shape) for name, array in true.items()}
    return predicted, _labels(num_frames, **true)


def loop_mpjpe2d(predicted: dict[str, np.ndarray], target: Labels) -> Scores:
    """Frame by frame, the errors of visible joints."""
    errors: list[float] = []
    for points, joints, visible in _rows2d(predicted, target):
        errors.extend(np.linalg.norm(points[visible] - joints[visible], axis=1))
    return {"mpjpe2d_px": float(np.mean(errors))}


def loop_pck2d(predicted: dict[str, np.ndarray], target: Labels) -> Scores:
    """Frame by frame, within a fifth of the torso."""
    names = JOINT_SETS["dhp19"].joints
    shoulder, hip = names.index("left_shoulder"), names.index("right_hip")
    correct: list[bool] = []
    for points, joints, visible in _rows2d(predicted, target):
        if visible[shoulder] and visible[hip]:
            limit = 0.2 * np.linalg.norm(joints[shoulder] - joints[hip])
            correct.extend(np.linalg.norm(points[visible] - joints[visible], axis=1) <= limit)
    return {"pck_torso0.2": float(np.mean(correct))}


def loop_oks(predicted: dict[str, np.ndarray], target: Labels) -> Scores:
    """Frame by frame, COCO's sum."""
    names = [name.split("_")[-1] for name in JOINT_SETS["dhp19"].joints]
    variances = (2 * np.array([oks.SIGMAS[name] for name in names])) ** 2
    similarities: list[float] = []
    for points, joints, visible in _rows2d(predicted, target):
        seen = joints[visible]
        area = 0.53 * np.prod(seen.max(axis=0) - seen.min(axis=0))
        squared = np.sum((points[visible] - seen) ** 2, axis=1)
        similarities.append(float(np.mean(np.exp(-squared / variances[visible] / area / 2))))
    reached = {f"oks_ap{t}": float(np.mean(np.array(similarities) >= t / 100)) for t in (25, 50)}
    return {**reached, "oks_mean": float(np.mean(similarities))}


def loop_mpjpe3d(predicted: dict[str, np.ndarray], target: Labels) -> Scores:
    """Frame by frame: as they are, from the middle of the hips, and after Procrustes."""
    errors: dict[str, list[float]] = {"mpjpe3d_mm": [], "mpjpe3d_pelvis_mm": [], "mpjpe3d_pa_mm": []}
    for points, joints in zip(predicted["joints3d"], _present(target.joints3d).astype(np.float64), strict=True):
        errors["mpjpe3d_mm"].append(np.linalg.norm(points - joints, axis=1).mean())
        hips = points[1:3].mean(axis=0) - joints[1:3].mean(axis=0)
        errors["mpjpe3d_pelvis_mm"].append(np.linalg.norm(points - joints - hips, axis=1).mean())
        errors["mpjpe3d_pa_mm"].append(np.linalg.norm(_procrustes(points, joints) - joints, axis=1).mean())
    return {name: float(np.mean(rows)) for name, rows in errors.items()}


def loop_pck3d(predicted: dict[str, np.ndarray], target: Labels) -> Scores:
    """Frame by frame, from the middle of the hips."""
    errors: list[float] = []
    for points, joints in zip(predicted["joints3d"], _present(target.joints3d).astype(np.float64), strict=True):
        hips = points[1:3].mean(axis=0) - joints[1:3].mean(axis=0)
        errors.extend(np.linalg.norm(points - joints - hips, axis=1))
    array = np.array(errors)
    shares = {f"pck3d_pelvis_{limit}mm": float(np.mean(array <= limit)) for limit in (25, 50)}
    return {**shares, "auc3d_pelvis_150mm": float(1 - np.minimum(array, 150).mean() / 150)}


def loop_pve(predicted: dict[str, np.ndarray], target: Labels) -> Scores:
    """Frame by frame, with dense weights as SMPL's own code has them."""
    errors: dict[str, list[float]] = {"pve_mm": [], "pve_pelvis_mm": [], "pve_pa_mm": []}
    body = load_body()
    weights = np.zeros((len(body.v_template), 24))
    np.put_along_axis(weights, body.weight_indices.astype(np.int64), body.weight_values, axis=1)
    true = target.arrays
    for row in range(len(target)):
        (vertices, hips), (labelled, true_hips) = (
            _pose(
                body, weights, *(arrays[n][row].astype(np.float64) for n in ("smpl_pose", "smpl_betas", "smpl_transl"))
            )
            for arrays in (predicted, true)
        )
        moved = vertices - labelled
        errors["pve_mm"].append(1000 * np.linalg.norm(moved, axis=1).mean())
        errors["pve_pelvis_mm"].append(1000 * np.linalg.norm(moved - hips + true_hips, axis=1).mean())
        aligned = _procrustes(vertices, labelled)
        errors["pve_pa_mm"].append(1000 * np.linalg.norm(aligned - labelled, axis=1).mean())
    return {name: float(np.mean(rows)) for name, rows in errors.items()}


def _rows2d(predicted: dict[str, np.ndarray], target: Labels) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    joints, visible = _present(target.joints2d).astype(np.float64), _present(target.visible)
    return zip(predicted["joints2d"], joints, visible, strict=True)


def _present(array: np.ndarray | None) -> np.ndarray:
    if array is None:
        raise ValueError("labels lack an array")
    return array


def _procrustes(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    centre, goal = points.mean(axis=0), target.mean(axis=0)
    a, b = points - centre, target - goal
    left, stretch, right = np.linalg.svd(a.T @ b)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return (stretch * sign).sum() / np.sum(a * a) * a @ (left * sign @ right) + goal


def _pose(
    body: Any, weights: np.ndarray, pose: np.ndarray, betas: np.ndarray, transl: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Linear blend skinning of one body: vertices [V, 3] and the middle of the hips [3]."""
    rest, joints = body.v_template + body.shapedirs @ betas, body.joints + body.joint_shapedirs @ betas
    rotations = matrix_from_axis_angle(pose.reshape(24, 3))
    maps = np.zeros((24, 4, 4))
    for joint, parent in enumerate(SMPL_PARENTS):
        local = np.eye(4)
        local[:3, :3] = rotations[joint]
        local[:3, 3] = joints[joint] if parent < 0 else joints[joint] - joints[parent]
        maps[joint] = local if parent < 0 else maps[parent] @ local
    posed_joints = maps[:, :3, 3].copy()
    maps[:, :3, 3] -= np.einsum("jab,jb->ja", maps[:, :3, :3], joints)
    blended = np.einsum("vj,jab->vab", weights, maps)
    vertices = np.einsum("vab,vb->va", blended[:, :3, :3], rest) + blended[:, :3, 3]
    return vertices + transl, posed_joints[1:3].mean(axis=0) + transl
