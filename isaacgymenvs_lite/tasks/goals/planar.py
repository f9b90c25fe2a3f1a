"""Headings, directions and speeds in the ground plane."""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.base.humanoid_observations import heading_cos_sin
from isaacgymenvs_lite.utils.rotations import rotate_about_z


def facing(root_rot: Tensor) -> Tensor:
    """Return the horizontal unit vectors (n, 2) that root rotations (n, 4) face."""
    return torch.stack(heading_cos_sin(*root_rot.unbind(-1)), dim=-1)


def in_heading_frame(root_rot: Tensor, vectors_w: Tensor) -> Tensor:
    """Express world vectors (n, 3) in the heading frames of root rotations (n, 4)."""
    cos, sin = heading_cos_sin(*root_rot.unbind(-1))
    return rotate_about_z(cos, -sin, vectors_w)


def xy_in_heading_frame(root_rot: Tensor, vectors_w: Tensor) -> Tensor:
    """Express horizontal world vectors (n, 2) in the heading frames of root rotations (n, 4)."""
    cos, sin = heading_cos_sin(*root_rot.unbind(-1))
    return turned(cos, -sin, vectors_w)


def turned(cos: Tensor | float, sin: Tensor | float, vectors: Tensor) -> Tensor:
    """Rotate vectors (n, 2) to the left by angles with these cosines and sines (n,)."""
    x, y = vectors.unbind(-1)
    return torch.stack((cos * x - sin * y, cos * y + sin * x), dim=-1)


def facing_reward(root_rot: Tensor, direction: Tensor) -> Tensor:
    """Return cosines (n,) between facing and unit directions (n, 2). Negative cosines become 0."""
    return (direction * facing(root_rot)).sum(-1).clamp(min=0.0)


def planar_velocity(root_pos: Tensor, prev_root_pos: Tensor, dt_s: float) -> Tensor:
    """Return mean velocities (n, 2) in m/s between positions (n, 3) that are `dt_s` apart."""
    return (root_pos[:, :2] - prev_root_pos[:, :2]) / dt_s


def speed_reward(speed: Tensor, wanted: float, scale: float) -> Tensor:
    """Return exp(-scale * shortfall^2) (n,) of speeds (n,) m/s, and 0 for speeds <= 0."""
    shortfall = (wanted - speed).clamp(min=0.0)
    return torch.exp(-scale * shortfall.square()).masked_fill(speed <= 0.0, 0.0)
