"""Observations and rewards of AnymalTerrain, as functions of named quantities. As IsaacGymEnvs.

The last dimension is N, the environments: (3, N), (12, N).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.anymal_terrain_config import TerrainLearnConfig
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.velocity_tracking import (
    BaseMotion,
    compute_tracking_rewards,
    proprioception,
)
from isaacgymenvs_lite.tasks.terrain.height_scan import NUM_POINTS

# About the height of the base above its feet; heights are observed relative to it (m).
_STANDING_M = 0.5
_WANTED_HEIGHT_M = 0.52
_WANTED_AIR_TIME_S = 0.5
# Below this commanded speed (m/s) no air time is rewarded.
_WALKING_M_S = 0.1
_STUMBLE_SIDE_N, _STUMBLE_UP_N = 5.0, 1.0
TERM_NAMES = (
    "lin_vel_xy",
    "lin_vel_z",
    "ang_vel_z",
    "ang_vel_xy",
    "orient",
    "torques",
    "joint_acc",
    "base_height",
    "air_time",
    "collision",
    "stumble",
    "action_rate",
    "hip",
)
"""Of the reward, as IsaacGymEnvs logs them."""
# The joints that swing the legs to the side.
_HIPS = slice(0, 12, 3)


def noise_widths(cfg: TerrainLearnConfig) -> Tensor:
    """Return half the widths (188,) of the noise on observations, in their units."""
    parts = (
        (3, cfg.lin_vel_noise * cfg.lin_vel_scale),
        (3, cfg.ang_vel_noise * cfg.ang_vel_scale),
        (3, cfg.gravity_noise),
        (3, 0.0),
        (12, cfg.dof_pos_noise * cfg.dof_pos_scale),
        (12, cfg.dof_vel_noise * cfg.dof_vel_scale),
        (NUM_POINTS, cfg.height_noise * cfg.height_scale),
        (12, 0.0),
    )
    return torch.tensor([width * cfg.noise_level for count, width in parts for _ in range(count)])


def compute_anymal_terrain_observations(
    motion: BaseMotion,
    commands: Tensor,
    dof_pos: Tensor,
    dof_vel: Tensor,
    base_height: Tensor,
    ground: Tensor,
    actions: Tensor,
    cfg: TerrainLearnConfig,
) -> Tensor:
    """Return the observations (N, 188), without noise.

    Linear and angular velocity, gravity, 3 commands, 12 joint positions (not from the default
    angles, as in Anymal) and velocities, 140 heights, 12 actions.

    Args:
        motion: of the base, in its frame.
        commands: (3 or more, N) m/s and rad/s.
        dof_pos: (12, N) rad.
        dof_vel: (12, N) rad/s.
        base_height: (N,) m.
        ground: (140, N) m.
        actions: (12, N) of the last step.
        cfg: the scales.
    """
    heights = (base_height - _STANDING_M - ground).clamp_(-1.0, 1.0).mul_(cfg.height_scale)
    return torch.cat(
        (*proprioception(motion, commands, dof_pos, dof_vel, cfg), heights, actions)
    ).t()


def compute_air_time(air_time_s: Tensor, on_ground: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Return how long feet are in the air now, and by how much those that land exceeded 0.5 s.

    Args:
        air_time_s: (F, N) before this step.
        on_ground: (F, N) bool, in this step.
        dt: time that a step counts (s).

    Returns:
        (F, N) s, zero on the ground; (N,) s, summed over the feet that land in this step.
    """
    lands = on_ground & (air_time_s > 0.0)
    air_time_s = air_time_s + dt
    beyond = ((air_time_s - _WANTED_AIR_TIME_S) * lands).sum(0)
    return air_time_s.masked_fill(on_ground, 0.0), beyond


class WalkStep(NamedTuple):
    """The quantities that the reward of a step depends on.

    Attributes:
        motion: of the base, in its frame.
        commands: (3 or more, N) m/s and rad/s.
        base_height: (N,) m.
        dof_offset: (12, N) of the joints from their default angles (rad).
        dof_vel: (12, N) rad/s.
        last_dof_vel: (12, N) before the step.
        torques: (12, N) Nm.
        actions: (12, N).
        last_actions: (12, N) of the step before.
        knees_in_contact: (K, N) bool.
        foot_forces: (3, F, N) in world axes (N).
        air_time_beyond_s: (N,) see `compute_air_time`.
    """

    motion: BaseMotion
    commands: Tensor
    base_height: Tensor
    dof_offset: Tensor
    dof_vel: Tensor
    last_dof_vel: Tensor
    torques: Tensor
    actions: Tensor
    last_actions: Tensor
    knees_in_contact: Tensor
    foot_forces: Tensor
    air_time_beyond_s: Tensor


def compute_anymal_terrain_reward(step: WalkStep, cfg: TerrainLearnConfig, dt: float) -> Terms:
    """Return the terms (N,) of the reward, by the names that IsaacGymEnvs logs them under.

    Args:
        step: see `WalkStep`.
        cfg: the weights of the terms per second.
        dt: time of a control step (s).
    """
    motion = step.motion
    along, turning = compute_tracking_rewards(step.commands, motion)
    walks = step.commands[:2].square().sum(0) > _WALKING_M_S**2
    side, up = step.foot_forces[:2].square().sum(0), step.foot_forces[2].abs()
    stumbles = (side > _STUMBLE_SIDE_N**2) & (up < _STUMBLE_UP_N)
    values = {
        "lin_vel_xy": (along, cfg.lin_vel_xy_reward),
        "lin_vel_z": (motion.lin_vel[2].square(), cfg.lin_vel_z_reward),
        "ang_vel_z": (turning, cfg.ang_vel_z_reward),
        "ang_vel_xy": (_squares(motion.ang_vel[:2]), cfg.ang_vel_xy_reward),
        "orient": (_squares(motion.gravity[:2]), cfg.orientation_reward),
        "torques": (_squares(step.torques), cfg.torque_reward),
        "joint_acc": (_squares(step.last_dof_vel - step.dof_vel), cfg.joint_acc_reward),
        "base_height": ((step.base_height - _WANTED_HEIGHT_M).square(), cfg.base_height_reward),
        "air_time": (step.air_time_beyond_s * walks, cfg.air_time_reward),
        "collision": (step.knees_in_contact.sum(0), cfg.knee_collision_reward),
        "stumble": (stumbles.sum(0), cfg.stumble_reward),
        "action_rate": (_squares(step.last_actions - step.actions), cfg.action_rate_reward),
        "hip": (step.dof_offset[_HIPS].abs().sum(0), cfg.hip_reward),
    }
    return {name: value * (per_second * dt) for name, (value, per_second) in values.items()}


def _squares(values: Tensor) -> Tensor:
    return values.square().sum(0)
