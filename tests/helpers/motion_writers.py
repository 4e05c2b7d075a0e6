"""Small motion files in the published layouts, and slow references of what is in them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ctlev_core.body.layer import joint_transforms, load_body
from ctlev_core.body.motion.clip import MotionClip
from ctlev_core.body.rotations import matrix_from_axis_angle
from ctlev_core.geometry.joint_sets import SMPL_JOINTS

LIMBS = [
    (f"{side}_{upper}", f"{side}_{lower}")
    for side in ("left", "right")
    for upper, lower in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
]

# Name, parent, place on it; a T that faces +z, in centimetres.
T_POSE = [
    ("Hips", "", (0, 95, 0)),
    ("Spine", "Hips", (0, 12, -1)),
    ("Spine1", "Spine", (0, 14, -1)),
    ("Neck", "Spine1", (0, 25, 2)),
    ("Head", "Neck", (0, 10, 3)),
    *(
        (f"{side}{name}", parent.replace("*", side), (sign * x, y, z))
        for side, sign in (("Left", 1), ("Right", -1))
        for name, parent, (x, y, z) in (
            ("UpLeg", "Hips", (9, -6, 0)),
            ("Leg", "*UpLeg", (2, -42, 1)),
            ("Foot", "*Leg", (0, -41, -3)),
            ("ToeBase", "*Foot", (3, -6, 13)),
            ("Shoulder", "Spine1", (4, 18, 0)),
            ("Arm", "*Shoulder", (12, 1, 0)),
            ("ForeArm", "*Arm", (28, 0, -1)),
            ("Hand", "*ForeArm", (25, 0, 0)),
        )
    ),
]
CMU_NAMES = {
    f"{side.lower()}_{part}": side + name
    for side in ("Left", "Right")
    for part, name in (
        ("hip", "UpLeg"), ("knee", "Leg"), ("ankle", "Foot"),
        ("shoulder", "Arm"), ("elbow", "ForeArm"), ("wrist", "Hand"),
    )
}  # fmt: skip


def write_bvh(
    path: Path,
    angles_deg: np.ndarray,
    root: np.ndarray,
    *,
    joints=T_POSE,
    order: str = "ZYX",
    step_s: float = 1 / 60,
    world: np.ndarray | None = None,
    names: Mapping[str, str] | None = None,
) -> Path:
    """A BVH of `joints`.

    Args:
        path: the file.
        angles_deg: [T, J, 3] in the order of the rotation channels.
        root: [T, 3], position channels of the root.
        joints: name, parent, offset.
        order: of the rotation channels.
        step_s: frame time.
        world: [3, 3], turns all offsets.
        names: other names of joints.
    """
    world = np.eye(3) if world is None else world
    lines = ["HIERARCHY"]

    def add(index: int, depth: int) -> None:
        name, parent, offset = joints[index]
        tab = "\t" * depth
        position = "" if parent else "Xposition Yposition Zposition "
        rotation = " ".join(f"{axis}rotation" for axis in order)
        lines.append(f"{tab}{'JOINT' if parent else 'ROOT'} {(names or {}).get(name, name)}")
        lines.append(f"{tab}{{\n{tab}\tOFFSET {' '.join(map(repr, (world @ np.array(offset, float)).tolist()))}")
        lines.append(f"{tab}\tCHANNELS {3 if parent else 6} {position}{rotation}")
        written.append(index)
        children = [i for i, (_, above, _) in enumerate(joints) if above == name]
        for child in children:
            add(child, depth + 1)
        if not children:
            lines.append(f"{tab}\tEnd Site\n{tab}\t{{\n{tab}\t\tOFFSET 0 0 0\n{tab}\t}}")
        lines.append(f"{tab}}}")

    written: list[int] = []
    add(0, 0)
    lines += ["MOTION", f"Frames: {len(root)}", f"Frame Time: {step_s!r}"]
    for frame in range(len(root)):
        values = [*root[frame], *angles_deg[frame, written].ravel()]
        lines.append(" ".join(repr(float(value)) for value in values))
    path.write_text("\n".join(lines) + "\n")
    return path


def solve_bvh(path: Path) -> dict[str, np.ndarray]:
    """Positions [T, 3] of all joints by name: word by word, with one matrix an angle."""
    head, _, tail = path.read_text().partition("MOTION")
    words = head.split()[1:]
    rows = np.array([[float(word) for word in line.split()] for line in tail.strip().split("\n")[2:]])
    positions: dict[str, np.ndarray] = {}
    stack: list[tuple[np.ndarray, np.ndarray]] = [(np.tile(np.eye(3), (len(rows), 1, 1)), np.zeros((len(rows), 3)))]
    column, at, name = 0, 0, ""
    while at < len(words):
        if words[at] in ("ROOT", "JOINT"):
            name, at = words[at + 1], at + 2
        elif words[at] == "End":
            name, at = "", at + 2
        elif words[at] == "OFFSET":
            offset, at = np.array([float(word) for word in words[at + 1 : at + 4]]), at + 4
            turn, place = stack[-1]
            if not name:
                stack.append((turn, place))
                continue
            count = int(words[at + 1]) if words[at] == "CHANNELS" else 0
            shift, local = np.tile(offset, (len(rows), 1)), np.tile(np.eye(3), (len(rows), 1, 1))
            for channel in words[at + 2 : at + 2 + count]:
                axis = "XYZ".index(channel[0])
                if channel[1:] == "position":
                    shift[:, axis] = rows[:, column]
                else:
                    local = local @ about_axis(axis, np.deg2rad(rows[:, column]))
                column += 1
            at += 2 + count
            place = place + np.einsum("tab,tb->ta", turn, shift)
            positions[name] = place
            stack.append((turn @ local, place))
        else:
            if words[at] == "}":
                stack.pop()
            at += 1
    return positions


def about_axis(axis: int, angle_rad: np.ndarray) -> np.ndarray:
    """Matrices [T, 3, 3] of a turn about a coordinate axis."""
    turn = np.zeros((len(angle_rad), 3, 3))
    turn[:, axis, axis] = 1
    one, other = (axis + 1) % 3, (axis + 2) % 3
    turn[:, one, one] = turn[:, other, other] = np.cos(angle_rad)
    turn[:, other, one] = np.sin(angle_rad)
    turn[:, one, other] = -np.sin(angle_rad)
    return turn


def write_deepmimic(path: Path, frames: np.ndarray, loop: str = "wrap") -> Path:
    """As published, frames [T, 44]."""
    rows = ",\n".join(json.dumps(row) for row in frames.tolist())
    path.write_text(f'{{\n"Loop": "{loop}",\n"Frames":\n[\n{rows}\n]\n}}')
    return path


def solve_deepmimic(frames: np.ndarray) -> dict[str, np.ndarray]:
    """Positions [T, 3] of the humanoid's joints by name, x forward, y up, z right, from its published measures."""
    positions = {}
    turn = {"root": _quaternion(frames[:, 4:8])}
    positions["root"] = frames[:, 1:4]
    turn["chest"] = turn["root"] * _quaternion(frames[:, 8:12])
    positions["chest"] = positions["root"] + turn["root"].apply([0, 0.236151, 0])
    for side, sign, leg, arm in (("right", 1, 16, 25), ("left", -1, 30, 39)):
        chains = (
            ("root", leg, ("hip", "knee", "ankle"), ((0, 0, sign * 0.084887), (0, -0.421546, 0), (0, -0.40987, 0))),
            (
                "chest",
                arm,
                ("shoulder", "elbow", "wrist"),
                ((-0.02405, 0.2435, sign * 0.18311), (0, -0.274788, 0), (0, -0.258947, 0)),
            ),
        )
        for base, column, names, places in chains:
            ball = _quaternion(frames[:, column : column + 4])
            hinge = Rotation.from_rotvec(np.outer(frames[:, column + 4], [0, 0, 1]))
            at, frame = positions[base], turn[base]
            for name, place, local in zip(names, places, (ball, hinge, None), strict=True):
                at = at + frame.apply(place)
                positions[f"{side}_{name}"] = at
                frame = frame * local if local is not None else frame
    return positions


def _quaternion(wxyz: np.ndarray) -> Rotation:
    return Rotation.from_quat(wxyz[:, [1, 2, 3, 0]])


def standing_frames(count: int, seed: int | None = None) -> np.ndarray:
    """Frames [count, 44] of DeepMimic's humanoid: at rest, or with random joints."""
    frames = np.zeros((count, 44))
    frames[:, 0], frames[:, 2] = 1 / 30, 0.83
    for column in (4, 8, 12, 16, 21, 25, 30, 35, 39):
        frames[:, column] = 1
    if seed is not None:
        random = np.random.default_rng(seed)
        frames[:, 4:] += random.normal(0, 0.4, (count, 40))
        frames[:, 1:4] += random.normal(0, 0.2, (count, 3))
    return frames


def smpl_positions(clip: MotionClip) -> dict[str, np.ndarray]:
    """Joints [T, 3] of the bundled body by name."""
    rotations = matrix_from_axis_angle(clip.pose.reshape(-1, 24, 3))
    _, joints = joint_transforms(load_body(), rotations, clip.betas, clip.transl)
    return {name: joints[:, index] for index, name in enumerate(SMPL_JOINTS)}


def limb_error_deg(clip: MotionClip, source: Mapping[str, np.ndarray], world: np.ndarray) -> float:
    """Largest angle between a limb bone of the clip's body and the source's, whose positions `world` turns."""
    body = smpl_positions(clip)
    errors = []
    for upper, lower in LIMBS:
        one, other = body[lower] - body[upper], (source[lower] - source[upper]) @ world.T
        # By the tangent: the cosine cannot tell angles below 1e-6 degrees from 0.
        errors.append(np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), (one * other).sum(axis=1)))
    return float(np.rad2deg(np.max(errors)))


def by_landmark(positions: Mapping[str, np.ndarray], names: Mapping[str, str] = CMU_NAMES) -> dict[str, np.ndarray]:
    """Positions under the names of landmarks."""
    return {landmark: positions[name] for landmark, name in names.items()}
