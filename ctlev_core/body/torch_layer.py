"""The body layer in torch: linear blend skinning with gradients to pose, shape and position.

The same body, frames and conventions as `ctlev_core.body.layer`, which is the faster one where no gradient is needed.

Source: Loper et al., SMPL, ACM TOG 2015, eq. 2-10.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch

from ctlev_core.body.layer import NUM_BETAS, NUM_JOINTS, NUM_POSE_FEATURES, BodyModel
from ctlev_core.body.torch_rotations import matrix_from_axis_angle
from ctlev_core.geometry.joint_sets import SMPL_PARENTS

FRAMES_ON_CPU = 4
"""The blended matrices, 12 numbers a vertex, of so many frames stay in a CPU's cache; a GPU takes all at once."""


def _levels() -> list[slice]:
    """Joints as far from the pelvis as one another; SMPL numbers them one after the other."""
    depth = [0] * NUM_JOINTS
    for joint, parent in enumerate(SMPL_PARENTS):
        depth[joint] = 0 if parent < 0 else depth[parent] + 1
    return [slice(depth.index(level), depth.index(level) + depth.count(level)) for level in range(max(depth) + 1)]


_LEVELS = _levels()


class BodyLayer(torch.nn.Module):
    """Posed vertices and joints of a body, differentiable. It has no parameters; `to` moves it and changes its dtype.

    Args:
        body: the body; its posedirs are applied where it has any.
        dtype: of the arrays. `layer.to(torch.float64)` afterwards would keep the digits of float32 only.
    """

    v_template: torch.Tensor
    shapedirs: torch.Tensor
    posedirs: torch.Tensor | None
    weights: torch.Tensor
    joints: torch.Tensor
    joint_shapedirs: torch.Tensor
    faces: torch.Tensor

    def __init__(self, body: BodyModel, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        count = len(body.v_template)
        weights = np.zeros((count, NUM_JOINTS))
        np.put_along_axis(weights, body.weight_indices, body.weight_values, axis=1)
        weights /= weights.sum(axis=1, keepdims=True)
        # Coordinates lie apart, [3, V]: every product then runs over vertices that lie side by side.
        arrays = {
            "v_template": body.v_template.T,
            "shapedirs": body.shapedirs.transpose(2, 1, 0).reshape(NUM_BETAS, 3 * count),
            "weights": weights.T,
            "joints": body.joints,
            "joint_shapedirs": body.joint_shapedirs,
            "posedirs": None,
        }
        if body.posedirs is not None:
            correctives = body.posedirs.reshape(NUM_POSE_FEATURES, count, 3)
            arrays["posedirs"] = correctives.transpose(0, 2, 1).reshape(NUM_POSE_FEATURES, 3 * count)
        for name, array in arrays.items():
            tensor = None if array is None else torch.tensor(np.ascontiguousarray(array), dtype=dtype)
            self.register_buffer(name, tensor, persistent=False)
        self.register_buffer("faces", torch.tensor(body.faces, dtype=torch.int64), persistent=False)

    def forward(
        self, pose: torch.Tensor, betas: torch.Tensor, transl: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Pose a batch. A number that is not finite is not looked for: its frame comes out as NaN.

        Args:
            pose: [N, 24, 3, 3] rotations, each joint relative to its parent, or [N, 72] rad, axis-angle; the root turns
                about the pelvis.
            betas: [N, 10], or [10] for all.
            transl: [N, 3] m, added to everything; none when None.
        Returns:
            vertices: [N, V, 3] m.
            joints: [N, 24, 3] m.
        Raises:
            ValueError: shapes or dtypes disagree.
        """
        rotations = matrix_from_axis_angle(pose.unflatten(-1, (NUM_JOINTS, 3))) if pose.shape[1:] == (72,) else pose
        transl = pose.new_zeros(len(pose), 3) if transl is None else transl
        self._check(rotations, betas, transl)
        rest = self.v_template + (betas @ self.shapedirs).unflatten(-1, (3, -1))
        if self.posedirs is not None:
            identity = torch.eye(3, dtype=pose.dtype, device=pose.device)
            features = (rotations[:, 1:] - identity).flatten(1)
            rest = rest + (features @ self.posedirs).unflatten(-1, (3, -1))
        rest = rest.expand(len(pose), -1, -1)
        bones = self.joints + torch.einsum("jcb,...b->...jc", self.joint_shapedirs, betas)
        turned, joints = _chain(rotations, bones.expand(len(pose), -1, -1), transl)
        offsets = joints - (turned @ bones[..., None]).squeeze(-1)
        moves = torch.cat([turned, offsets[..., None]], -1)
        return self._skin(rest, moves), joints

    def pose_joints(self, rotations: torch.Tensor, betas: torch.Tensor, transl: torch.Tensor) -> torch.Tensor:
        """Joints [N, 24, 3] m alone, at a fraction of the cost; arguments as for `forward`, [N, 24, 3, 3] rotations."""
        self._check(rotations, betas, transl)
        bones = self.joints + torch.einsum("jcb,...b->...jc", self.joint_shapedirs, betas)
        return _chain(rotations, bones.expand(len(rotations), -1, -1), transl)[1]

    def _skin(self, rest: torch.Tensor, moves: torch.Tensor) -> torch.Tensor:
        """Vertices [N, V, 3] of rest vertices [N, 3, V] and the bones' maps [N, 24, 3, 4]."""
        count, num_vertices = len(rest), rest.shape[2]
        columns = moves.permute(0, 3, 2, 1)
        step = FRAMES_ON_CPU if rest.device.type == "cpu" else max(count, 1)
        segments = []
        for start in range(0, max(count, 1), step):
            x, y, z = rest[start : start + step].unbind(1)
            few = columns[start : start + step]
            # One product for all frames: [12 N, 24] by [24, V].
            blended = (few.reshape(-1, NUM_JOINTS) @ self.weights).view(len(few), 4, 3, num_vertices)
            posed = torch.addcmul(blended[:, 3], blended[:, 0], x[:, None])
            posed = torch.addcmul(torch.addcmul(posed, blended[:, 1], y[:, None]), blended[:, 2], z[:, None])
            segments.append(posed.transpose(1, 2))
        return torch.cat(segments)

    def _check(self, rotations: torch.Tensor, betas: torch.Tensor, transl: torch.Tensor) -> None:
        count = len(rotations)
        if rotations.shape[1:] != (NUM_JOINTS, 3, 3):
            raise ValueError(
                f"pose must be [N, {NUM_JOINTS}, 3, 3] or [N, {3 * NUM_JOINTS}], got {list(rotations.shape)}"
            )
        if tuple(betas.shape) not in ((count, NUM_BETAS), (NUM_BETAS,)):
            raise ValueError(f"betas must be [{count}, {NUM_BETAS}] or [{NUM_BETAS}], got {list(betas.shape)}")
        if tuple(transl.shape) != (count, 3):
            raise ValueError(f"transl must be [{count}, 3], got {list(transl.shape)}")
        for name, tensor in (("pose", rotations), ("betas", betas), ("transl", transl)):
            if tensor.dtype != self.v_template.dtype:
                raise ValueError(f"{name} must be {self.v_template.dtype} like the layer, got {tensor.dtype}")


def _chain(rotations: torch.Tensor, bones: torch.Tensor, transl: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Forward kinematics, one level of the tree a step: orientations [N, 24, 3, 3] and joints [N, 24, 3]."""
    turned, joints = [rotations[:, :1]], [bones[:, :1] + transl[:, None]]
    for above, level in pairwise(_LEVELS):
        parents = [SMPL_PARENTS[joint] for joint in range(level.start, level.stop)]
        local = [parent - above.start for parent in parents]
        orientation = turned[-1][:, local]
        turned.append(orientation @ rotations[:, level])
        lever = bones[:, level] - bones[:, parents]
        joints.append((orientation @ lever[..., None]).squeeze(-1) + joints[-1][:, local])
    return torch.cat(turned, 1), torch.cat(joints, 1)
