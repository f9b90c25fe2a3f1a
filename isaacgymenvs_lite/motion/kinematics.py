"""Forward kinematics and velocities of pose sequences in float64, with quaternions xyzw.

The formulas are poselib's formulas. Velocities agree with a published file within 3e-6 m/s and 1e-3
rad/s. T is the number of frames and J the number of bodies.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.utils import rotations

FloatArray = npt.NDArray[np.floating]

# Sigma and radius, in frames, of the Gaussian filter with which poselib smooths velocities.
_FILTER_SIGMA = 2.0
_FILTER_RADIUS = 8


def forward_kinematics(
    parent_indices: Sequence[int],
    local_translation: FloatArray,
    local_rotation: FloatArray,
    root_translation: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the world positions (T, J, 3) m and the world rotations (T, J, 4) of all bodies.

    Args:
        parent_indices: J body ids of the parents, and -1 for the root. Parents come before
            children.
        local_translation: (J, 3) or (T, J, 3) m, offsets in the parents' frames. The root's offset
            is not used.
        local_rotation: (T, J, 4), rotations relative to the parents.
        root_translation: (T, 3) m, world positions of the root.
    """
    local = _tensor(local_rotation)
    offsets = _tensor(local_translation)
    positions = [_tensor(root_translation)]
    turns = [local[:, 0]]
    for body in range(1, len(parent_indices)):
        parent = parent_indices[body]
        offset = rotations.quat_apply(turns[parent], offsets[..., body, :].expand_as(positions[0]))
        positions.append(positions[parent] + offset)
        turns.append(_canonical(rotations.quat_mul(turns[parent], local[:, body])))
    return torch.stack(positions, dim=1).numpy(), torch.stack(turns, dim=1).numpy()


def local_rotations(parent_indices: Sequence[int], global_rotation: FloatArray) -> FloatArray:
    """Convert world rotations (T, J, 4) to rotations relative to the parents (T, J, 4)."""
    turns = _tensor(global_rotation)
    parents = turns[:, [max(parent, 0) for parent in parent_indices]]
    local = _canonical(rotations.quat_mul(rotations.quat_conjugate(parents), turns))
    is_root = torch.tensor([parent < 0 for parent in parent_indices])
    return torch.where(is_root.unsqueeze(-1), turns, local).numpy()


def linear_velocities(positions: FloatArray, fps: float) -> FloatArray:
    """Return the smoothed velocities (T, J, 3) m/s of positions (T, J, 3) m, T >= 2.

    The velocities are central differences (one-sided in the first and last frame), which the
    Gaussian filter smooths.
    """
    return _smooth(np.gradient(np.asarray(positions, dtype=np.float64), axis=0)) * fps


def angular_velocities(rotation: FloatArray, fps: float) -> FloatArray:
    """Return the smoothed world angular velocities (T, J, 3) rad/s of rotations (T, J, 4).

    The velocity of a frame comes from the rotation to the next frame. The last frame has zero
    velocity, as in poselib's files. The Gaussian filter then smooths the velocities.
    """
    turns = _tensor(rotation)
    steps = rotations.quat_mul(turns[1:], rotations.quat_conjugate(turns[:-1]))
    velocities = np.zeros((*turns.shape[:-1], 3))
    velocities[:-1] = rotations.quat_log(rotations.quat_unit(steps)).numpy()
    return _smooth(velocities) * fps


def joint_velocities(local_rotation: FloatArray, fps: float) -> FloatArray:
    """Return the unsmoothed angular velocities (T, J, 3) rad/s of joints, in the child's frame.

    The velocity of a frame comes from the rotation to the next frame. The last frame repeats the
    previous velocity (T >= 2). The arithmetic is that of IsaacGymEnvs in the precision of the data,
    and the results agree with IsaacGymEnvs within 3e-6 rad/s. In float32 at 60 fps, the errors of
    the arc cosine reach 0.03 rad/s for slow joints.
    """
    local = torch.from_numpy(np.ascontiguousarray(local_rotation))
    if local.dtype != torch.float32:
        local = local.double()
    steps = _canonical(rotations.quat_mul(rotations.quat_conjugate(local[:-1]), local[1:]))
    w = steps[..., 3:]
    angle = torch.acos((2.0 * w * w - 1.0).clamp(-1.0, 1.0))
    velocities = (angle * rotations.normalize(steps[..., :3])).double().numpy() * fps
    return np.concatenate((velocities, velocities[-1:]))


def world_points(
    body_ids: Sequence[int], points: FloatArray, positions: FloatArray, rotation: FloatArray
) -> FloatArray:
    """Return the world positions (T, K, 3) m of points (K, 3) m in the frames of K bodies.

    `positions` (T, J, 3) m and `rotation` (T, J, 4) are the world poses of all bodies.
    """
    ids = list(body_ids)
    turns = _tensor(rotation)[:, ids]
    offsets = rotations.quat_apply(turns, _tensor(points).expand(*turns.shape[:-1], 3))
    return (_tensor(positions)[:, ids] + offsets).numpy()


def _tensor(array: FloatArray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float64))


def _canonical(q: torch.Tensor) -> torch.Tensor:
    """Scale quaternions (..., 4) to unit length, and negate those with w < 0."""
    return rotations.quat_unit(torch.where(q[..., 3:] < 0.0, -q, q))


def _smooth(x: FloatArray) -> FloatArray:
    """Filter x (T, ...) over time with the Gaussian filter.

    Beyond the first and the last frame, x is constant.
    """
    reach = np.arange(-_FILTER_RADIUS, _FILTER_RADIUS + 1)
    weights = np.exp(-0.5 * (reach / _FILTER_SIGMA) ** 2)
    weights /= weights.sum()
    edges = [(_FILTER_RADIUS, _FILTER_RADIUS)] + [(0, 0)] * (x.ndim - 1)
    padded = np.pad(x, edges, mode="edge")
    smooth = np.zeros_like(x)
    for shift, weight in enumerate(weights):
        smooth += weight * padded[shift : shift + len(x)]
    return smooth
