"""Ant: a body with four legs learns to run along +x, as in IsaacGymEnvs.

The task keeps these quirks, because policies and curves depend on them:

- Yaw and roll jump between 0 and 2 pi.
- `angle_to_target` is wrong (see the module `locomotion`).
- The cost of joints at their limits ignores the lower limits.
- The energy cost uses the scaled joint velocity.
"""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.base.locomotion import (
    LocomotionConfig,
    LocomotionTask,
    TorsoState,
    running_terms,
)
from isaacgymenvs_lite.tasks.base.reward_terms import Terms, replace_where
from isaacgymenvs_lite.utils.scaling import unscale

_ALIVE_REWARD = 0.5
_AT_LIMIT = 0.99


def compute_ant_observations(
    torso: TorsoState,
    dof_pos: Tensor,
    dof_vel: Tensor,
    lower: Tensor,
    upper: Tensor,
    foot_wrenches: Tensor,
    actions: Tensor,
    cfg: LocomotionConfig,
) -> Tensor:
    """Return the observations (N, 60).

    First come height, velocities in the torso frame, yaw, roll, angle to the target, `up_proj` and
    `heading_proj`. Then come 8 joint positions scaled to [-1, 1], 8 joint velocities, 4 x 6 contact
    forces and torques on the feet, and 8 actions.

    Joint quantities (N, 8) are in rad and rad/s, and joint limits (8,) in rad. The foot wrenches
    (24, N) are in the foot frames, in newton and Nm.
    """
    return torch.cat(
        (
            torso.height[None],
            torso.lin_vel,
            torso.ang_vel * cfg.angular_velocity_scale,
            torch.stack((torso.yaw, torso.roll, torso.angle_to_target)),
            torso.up_proj[None],
            torso.heading_proj[None],
            unscale(dof_pos, lower, upper).t(),
            dof_vel.t() * cfg.dof_velocity_scale,
            foot_wrenches * cfg.contact_force_scale,
            actions.t(),
        )
    ).t()


def compute_ant_reward(
    torso: TorsoState,
    progress_m_s: Tensor,
    actions: Tensor,
    dof_pos_share: Tensor,
    dof_vel_scaled: Tensor,
    cfg: LocomotionConfig,
) -> Terms:
    """Return the reward terms (N,).

    `progress_m_s` (N,) is the speed towards the target. The other tensors (N, 8) are scaled like
    the observation.
    """
    terms = {
        **running_terms(torso, progress_m_s, actions, _ALIVE_REWARD, cfg),
        "energy": (actions * dof_vel_scaled).abs().sum(-1) * -cfg.energy_cost,
        "joints_at_limit": (dof_pos_share > _AT_LIMIT).sum(-1) * -cfg.joints_at_limit_cost,
    }
    return replace_where(terms, torso.height < cfg.termination_height, "fall", cfg.death_cost)


class Ant(LocomotionTask):
    """N ants with 60 observations and 8 joint torques."""

    settings_class = LocomotionConfig
    default_asset = "mjcf/ant.xml"
    published_assets = ("mjcf/nv_ant.xml",)
    actor_name = "ant"
    num_observations = 60
    num_actions = 8
    foot_names = ("front_left_foot", "front_right_foot", "left_back_foot", "right_back_foot")
    torques_nm = (15.0,) * 8

    def observation_groups(self) -> dict[str, int]:
        """See `compute_ant_observations`."""
        joints = {"dof_pos": 8, "dof_vel": 8, "foot_wrenches": 24, "last_actions": 8}
        return self.torso_groups() | joints

    def compute_obs(self) -> Tensor:
        """See `compute_ant_observations`."""
        sim = self.simulation
        return compute_ant_observations(
            self.torso_state(),
            sim.dof_pos,
            sim.dof_vel,
            self.dof_limits_lower,
            self.dof_limits_upper,
            self.foot_wrenches(),
            self.actions,
            self.env_cfg,
        )

    def compute_reward_terms(self) -> Terms:
        """See `compute_ant_reward`."""
        return compute_ant_reward(
            self.torso_state(),
            self.potentials - self.prev_potentials,
            self.actions,
            self.dof_pos_share(),
            self.dof_vel_scaled(),
            self.env_cfg,
        )
