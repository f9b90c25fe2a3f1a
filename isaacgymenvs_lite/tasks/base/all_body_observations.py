"""The all-body observation of ASE's humanoids as a pure function.

Formulas as the ASE release (Peng et al. 2022, arXiv 2205.01906); quantities are named, batched over
N environments with B bodies, of which the first is the root.
"""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.base.humanoid_observations import heading_cos_sin
from isaacgymenvs_lite.utils.rotations import quat_mul_components, tan_norm_components


def all_body_observation_groups(num_bodies: int) -> dict[str, int]:
    """Return the parts of an observation in their order: name -> how many numbers.

    They add up to 223 for 15 bodies, 253 for 17.
    """
    poses = {"root_height": 1, "body_pos": 3 * (num_bodies - 1), "body_rot": 6 * num_bodies}
    return poses | {"body_lin_vel": 3 * num_bodies, "body_ang_vel": 3 * num_bodies}


def compute_all_body_observations(
    body_pos: Tensor,
    body_rot: Tensor,
    body_lin_vel: Tensor,
    body_ang_vel: Tensor,
    local_root_obs: bool,
    root_height_obs: bool = True,
) -> Tensor:
    """Describe a character by all its bodies, in the heading frame of its root.

    Args:
        body_pos: (N, B, 3) world positions (m).
        body_rot: (N, B, 4) world rotations, xyzw.
        body_lin_vel: (N, B, 3) in world axes (m/s).
        body_ang_vel: (N, B, 3) in world axes (rad/s).
        local_root_obs: the root's own rotation keeps its heading. The name means the opposite;
            ASE's files and checkpoints rely on it.
        root_height_obs: False gives 0 for the height.

    Returns:
        (N, 15 B - 2): root height; positions of the other bodies relative to the root; rotations
        (tangent, normal) of all bodies; linear, then angular velocities of all bodies.
    """
    # (components, B, N): operations run along memory if the backend keeps planes.
    pos, rot, lin_vel, ang_vel = (
        quantity.permute(2, 1, 0) for quantity in (body_pos, body_rot, body_lin_vel, body_ang_vel)
    )
    cos, sin = heading_cos_sin(*rot[:, 0].unbind(0))
    offsets = pos[:, 1:] - pos[:, :1]
    vectors = _turned_back(torch.cat((offsets, lin_vel, ang_vel), dim=1), cos, sin)

    half = -0.5 * torch.atan2(sin, cos)
    zero = torch.zeros_like(half)
    back = (zero, zero, half.sin(), half.cos())
    local = torch.stack(quat_mul_components(back, rot.unbind(0)))
    if local_root_obs:
        local[:, 0] = rot[:, 0]
    rotations = torch.stack(tan_norm_components(local.unbind(0)), dim=1)

    others = pos.shape[1] - 1
    height = pos[2, :1] if root_height_obs else torch.zeros_like(pos[2, :1])
    planes = torch.cat(
        (
            height,
            vectors[:others].flatten(0, 1),
            rotations.flatten(0, 1),
            vectors[others:].flatten(0, 1),
        )
    )
    return planes.t().contiguous()


def _turned_back(vectors_w: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Turn world vectors (3, V, N) by minus the headings (N,); the result is (V, 3, N)."""
    x, y, z = vectors_w.unbind(0)
    return torch.stack((cos * x + sin * y, cos * y - sin * x, z), dim=1)
