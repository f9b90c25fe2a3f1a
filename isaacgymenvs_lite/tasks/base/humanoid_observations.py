"""Pure functions of the AMP humanoid: observations, early termination and PD targets.

The formulas come from IsaacGymEnvs' HumanoidAMP and from ASE (Peng et al. 2022, arXiv 2205.01906).
There are N environments, B bodies (the first is the root), D degrees of freedom, and K key bodies.
"""

from __future__ import annotations

import itertools
import math
from functools import lru_cache

import torch
from torch import Tensor

from isaacgymenvs_lite.motion.skeleton import skeleton_for_num_dofs
from isaacgymenvs_lite.utils.rotations import (
    exp_map_to_quat_components,
    quat_mul_components,
    tan_norm_components,
)

_NUM_ROOT_OBS = 1 + 6 + 3 + 3  # height, rotation, linear and angular velocity
_CONTACT_THRESHOLD_N = 0.1
# PD targets beyond the joint limits keep the torques large near the limits.
_HINGE_TARGET_SHARE, _BALL_TARGET_SHARE = 0.7, 1.2


@lru_cache(maxsize=8)
@torch.inference_mode(False)  # cached tensors must also work outside of inference mode
def _dof_obs_layout(
    dof_offsets: tuple[int, ...], as_ase: bool, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the index tensors of `_dof_features`.

    The first tensor holds the DOFs of the ball joints: all x, then all y, then all z. The second
    tensor holds the DOFs of the hinges. The third tensor sorts features by joint. Unsorted features
    begin with the first component of all ball joints, and the hinges follow after the last
    component.
    """
    groups = list(itertools.pairwise(dof_offsets))
    balls = [a + axis for axis in range(3) for a, b in groups if b - a == 3]
    hinges = [a for a, b in groups if b - a == 1]
    num_balls, per_hinge = len(balls) // 3, 6 if as_ase else 1
    order: list[int] = []
    next_ball, next_hinge = 0, 6 * num_balls
    for a, b in groups:
        if b - a == 3:
            order += range(next_ball, 6 * num_balls, num_balls)
            next_ball += 1
        else:
            order += range(next_hinge, 6 * num_balls + per_hinge * len(hinges), len(hinges))
            next_hinge += 1
    return (
        torch.tensor(balls, device=device, dtype=torch.long),
        torch.tensor(hinges, device=device, dtype=torch.long),
        torch.tensor(order, device=device, dtype=torch.long),
    )


def num_humanoid_obs(
    dof_offsets: tuple[int, ...], num_key_bodies: int, as_ase: bool = False
) -> int:
    """Return the dimension of an observation of `compute_humanoid_observations`.

    `dof_to_obs` describes `dof_offsets` and `as_ase`.
    """
    sizes = [end - first for first, end in itertools.pairwise(dof_offsets)]
    joints = sum(6 if as_ase or size == 3 else 1 for size in sizes)
    return _NUM_ROOT_OBS + joints + dof_offsets[-1] + 3 * num_key_bodies


def dof_to_obs(
    dof_pos: Tensor, as_ase: bool = False, dof_offsets: tuple[int, ...] | None = None
) -> Tensor:
    """Encode joint positions for the observation, in joint order.

    IsaacGymEnvs encodes a 3-DoF joint by the tangent and normal of its rotation (6 values), and a
    hinge by its angle. IsaacGymEnvs treats a rotation vector longer than pi as the identity. ASE
    accepts rotation vectors of any length. ASE encodes hinges by tangent and normal, too, and
    treats every hinge axis as y.

    Args:
        dof_pos: (N, D) rad.
        as_ase: whether to use ASE's encoding.
        dof_offsets: first degree of freedom of each joint, followed by D. None selects the shipped
            humanoid with D = 28 or 31.

    Returns:
        (N, F) with 6 values per 3-DoF joint and 1 value per hinge, or 6 per joint with `as_ase`. 28
        DOFs give F = 52, or 72 with `as_ase`.

    Raises:
        ConfigError: `dof_offsets` is None, and no shipped humanoid has D degrees of freedom.
    """
    offsets = dof_offsets or _offsets_of_shipped(dof_pos.shape[1])
    return _dof_features(dof_pos.t(), offsets, as_ase).t().contiguous()


def _offsets_of_shipped(num_dofs: int) -> tuple[int, ...]:
    return skeleton_for_num_dofs(num_dofs).dof_offsets


def _dof_features(dof_pos: Tensor, dof_offsets: tuple[int, ...], as_ase: bool) -> Tensor:
    """Compute `dof_to_obs` with N as the last dimension: (D, N) to (features, N)."""
    balls, hinges, order = _dof_obs_layout(dof_offsets, as_ase, dof_pos.device)
    # index_select is several times as fast as indexing with a tensor.
    vectors = dof_pos.index_select(0, balls).unflatten(0, (3, len(balls) // 3))
    rotations = tan_norm_components(exp_map_to_quat_components(vectors.unbind(0), as_ase))
    angles = dof_pos.index_select(0, hinges)
    if not as_ase:
        return torch.cat((*rotations, angles)).index_select(0, order)
    cos, sin, zero = angles.cos(), angles.sin(), torch.zeros_like(angles)
    turns = (cos, zero, -sin, sin, zero, cos)  # x and z axes rotated about y
    return torch.cat((*rotations, *turns)).index_select(0, order)


def compute_humanoid_observations(
    root_states: Tensor,
    dof_pos: Tensor,
    dof_vel: Tensor,
    key_body_pos: Tensor,
    local_root_obs: bool,
    as_ase: bool = False,
    dof_offsets: tuple[int, ...] | None = None,
) -> Tensor:
    """Return the policy observation, which is also one step of the AMP observation.

    Vectors are in the heading frame: the world axes rotated about z by the root's heading.

    Args:
        root_states: (N, 13) world position (m), rotation xyzw, linear and angular velocity.
        dof_pos: (N, D) rad.
        dof_vel: (N, D) rad/s.
        key_body_pos: (N, K, 3) world positions (m).
        local_root_obs: whether to remove the heading from the root rotation.
        as_ase: see `dof_to_obs`.
        dof_offsets: see `dof_to_obs`.

    Returns:
        (N, F), where F = 13 + 52 (or 72) + D + 3 K for 28 DOFs (see `num_humanoid_obs`). The order
        is root height, root rotation (tangent, normal), root linear and angular velocity, joint
        positions, joint velocities, key bodies relative to the root.
    """
    offsets = dof_offsets or _offsets_of_shipped(dof_pos.shape[1])
    # Operations are fast because the values of each component are contiguous.
    root = root_states.t().contiguous()
    cos, sin = heading_cos_sin(*root[3:7].unbind(0))
    root_rot = root[3:7].unbind(0)
    if local_root_obs:
        half = -0.5 * torch.atan2(sin, cos)
        zero = torch.zeros_like(half)
        root_rot = quat_mul_components((zero, zero, half.sin(), half.cos()), root_rot)

    # (3, 2 + K, N): root velocities and key bodies
    velocities_w = root[7:13].unflatten(0, (2, 3)).transpose(0, 1)
    key_offsets_w = key_body_pos.permute(2, 1, 0) - root[:3].unsqueeze(1)
    x, y, z = torch.cat((velocities_w, key_offsets_w), dim=1).unbind(0)
    vectors = torch.stack((cos * x + sin * y, cos * y - sin * x, z), dim=1)
    planes = torch.cat(
        (
            root[2:3],
            torch.stack(tan_norm_components(root_rot)),
            vectors[:2].flatten(0, 1),
            _dof_features(dof_pos.t(), offsets, as_ase),
            dof_vel.t(),
            vectors[2:].flatten(0, 1),
        )
    )
    return planes.t().contiguous()


def heading_cos_sin(x: Tensor, y: Tensor, z: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Return cosine and sine (N,) of the headings of quaternions with these components (N,)."""
    forward_x = 2.0 * (w * w + x * x) - 1.0
    forward_y = 2.0 * (x * y + w * z)
    length = torch.sqrt(forward_x * forward_x + forward_y * forward_y)
    upright = length == 0.0
    length = length.masked_fill(upright, 1.0)
    return (forward_x / length).masked_fill(upright, 1.0), forward_y / length


def compute_humanoid_reward(obs_buf: Tensor) -> Tensor:
    """Return the constant task reward of AMP, which is 1 (N,)."""
    return torch.ones_like(obs_buf[:, 0])


def compute_humanoid_falls(
    progress_buf: Tensor,
    contact_buf: Tensor,
    contact_body_ids: Tensor,
    rigid_body_pos: Tensor,
    termination_height: float | Tensor,
) -> Tensor:
    """Return which humanoids (N,) fell.

    A fall requires that one body is in contact and that the same or another body is below
    `termination_height`. The bodies `contact_body_ids` are ignored. The first step of an episode is
    excluded, because its contact forces may be stale. A force in any direction counts, as in ASE,
    whereas IsaacGymEnvs compares signed components.

    Args:
        progress_buf: (N,) int64 control steps since the reset, including this step.
        contact_buf: (N, B, 3) net contact forces (newton).
        contact_body_ids: (C,) bodies that may touch the floor (feet).
        rigid_body_pos: (N, B, 3) world positions of the body origins (m).
        termination_height: height in m, one for all bodies or (B,).
    """
    # (B, N) is the memory order of the backend.
    force = contact_buf.permute(2, 1, 0).abs().amax(dim=0).index_fill_(0, contact_body_ids, 0.0)
    height = rigid_body_pos[..., 2].t().index_fill(0, contact_body_ids, torch.inf)
    touched = force.amax(dim=0) > _CONTACT_THRESHOLD_N
    if isinstance(termination_height, Tensor):
        height, termination_height = height - termination_height.unsqueeze(1), 0.0
    low = height.amin(dim=0) < termination_height
    return touched & low & (progress_buf > 1)


def compute_humanoid_reset(
    reset_buf: Tensor,
    progress_buf: Tensor,
    contact_buf: Tensor,
    contact_body_ids: Tensor,
    rigid_body_pos: Tensor,
    max_episode_length: float,
    enable_early_termination: bool,
    termination_height: float | Tensor,
) -> tuple[Tensor, Tensor]:
    """Return which episodes end (reset, (N,)) and which of them by a fall (terminated, (N,)).

    IsaacGymEnvs has the same arguments; `compute_humanoid_falls` describes them. `reset_buf`
    (N,) determines only the dtype of the results.
    """
    timed_out = progress_buf >= max_episode_length - 1
    if not enable_early_termination:
        return timed_out.to(reset_buf.dtype), torch.zeros_like(reset_buf)
    fallen = compute_humanoid_falls(
        progress_buf, contact_buf, contact_body_ids, rigid_body_pos, termination_height
    )
    return (fallen | timed_out).to(reset_buf.dtype), fallen.to(reset_buf.dtype)


def pd_action_offset_scale(
    dof_lower: Tensor, dof_upper: Tensor, dof_offsets: tuple[int, ...], as_ase: bool = False
) -> tuple[Tensor, Tensor]:
    """Return offset and scale (D,) of the PD targets `offset + scale * action`, in rad.

    The targets of a hinge extend from the middle of its range by 0.7 times the range to either
    side. A 3-DoF joint has the offset 0. The scale of a 3-DoF joint is pi in IsaacGymEnvs. In ASE
    the scale is 1.2 times the joint's largest limit, but at most pi.

    The limits (D,) in rad are swapped where lower > upper. `dof_to_obs` describes `dof_offsets`.
    """
    low, high = torch.minimum(dof_lower, dof_upper), torch.maximum(dof_lower, dof_upper)
    offset = 0.5 * (low + high)
    scale = _HINGE_TARGET_SHARE * (high - low)
    furthest = torch.maximum(low.abs(), high.abs())
    for first, end in itertools.pairwise(dof_offsets):
        if end - first == 3:
            offset[first:end] = 0.0
            scale[first:end] = math.pi
            if as_ase:
                reach = _BALL_TARGET_SHARE * furthest[first:end].amax()
                scale[first:end] = reach.clamp(max=math.pi)
    return offset, scale


def all_body_observation_groups(num_bodies: int) -> dict[str, int]:
    """Return names and sizes of the observation parts. 15 bodies give 223 values, 17 give 253."""
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
    """Return the observation of all bodies, in the heading frame of the root.

    Args:
        body_pos: (N, B, 3) world positions (m).
        body_rot: (N, B, 4) world rotations, xyzw.
        body_lin_vel: (N, B, 3) in world axes (m/s).
        body_ang_vel: (N, B, 3) in world axes (rad/s).
        local_root_obs: whether to keep the heading in the root's rotation. The name says the
            opposite, but ASE's files and checkpoints rely on this meaning.
        root_height_obs: whether to observe the root height instead of 0.

    Returns:
        (N, 15 B - 2), in this order: root height, positions of the other bodies relative to the
        root, rotations (tangent, normal) of all bodies, linear velocities of all bodies, angular
        velocities of all bodies.
    """
    # (components, B, N) is the memory order of the backend.
    pos, rot, lin_vel, ang_vel = (
        quantity.permute(2, 1, 0) for quantity in (body_pos, body_rot, body_lin_vel, body_ang_vel)
    )
    cos, sin = heading_cos_sin(*rot[:, 0].unbind(0))
    offsets = pos[:, 1:] - pos[:, :1]
    x, y, z = torch.cat((offsets, lin_vel, ang_vel), dim=1).unbind(0)
    vectors = torch.stack((cos * x + sin * y, cos * y - sin * x, z), dim=1)

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
