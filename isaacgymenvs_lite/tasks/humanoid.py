"""Humanoid: a body with 21 hinges learns to run along +x, as in IsaacGymEnvs.

The task keeps two quirks: `angle_to_target` is wrong (see `locomotion`), and the energy cost uses
the scaled joint velocity. In MuJoCo, the body has no angular damping (0.01 1/s in IsaacGymEnvs) and
no largest angular velocity (100 rad/s in IsaacGymEnvs).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.locomotion import (
    LocomotionConfig,
    LocomotionTask,
    TorsoState,
    running_terms,
)
from isaacgymenvs_lite.tasks.base.reward_terms import Terms, replace_where
from isaacgymenvs_lite.utils.rotations import normalize_angle
from isaacgymenvs_lite.utils.scaling import unscale

_ABDOMEN_NM = (67.5, 67.5, 67.5)  # z, y, x
_LEG_NM = (45.0, 45.0, 135.0, 90.0, 22.5, 22.5)  # hip x, z, y; knee; ankle y, x
_ARM_NM = (67.5, 67.5, 45.0)  # shoulder 1, 2; elbow

_ALIVE_REWARD = 2.0
_AT_LIMIT = 0.98  # share of the range


@dataclass(frozen=True, kw_only=True)
class HumanoidConfig(LocomotionConfig):
    """`task.env` of Humanoid: the keys of `LocomotionConfig` with other defaults."""

    actions_cost: float = setting(0.01, key="actionsCost")
    dof_velocity_scale: float = setting(0.1, key="dofVelocityScale")
    angular_velocity_scale: float = setting(0.1, key="angularVelocityScale")
    contact_force_scale: float = setting(0.01, key="contactForceScale")
    joints_at_limit_cost: float = setting(0.25, key="jointsAtLimitCost")
    death_cost: float = setting(-1.0, key="deathCost")
    termination_height: float = setting(0.8, key="terminationHeight")  # m


def compute_humanoid_observations(
    torso: TorsoState,
    dof_pos: Tensor,
    dof_vel: Tensor,
    dof_forces: Tensor,
    lower: Tensor,
    upper: Tensor,
    foot_wrenches: Tensor,
    actions: Tensor,
    cfg: LocomotionConfig,
) -> Tensor:
    """Return the observations (N, 108).

    First come height, velocities in the torso frame, three angles within +-pi (yaw, roll, angle to
    the target), `up_proj` and `heading_proj`. Then come 21 joint positions scaled to [-1, 1], 21
    joint velocities, 21 joint torques, 2 x 6 contact forces and torques on the feet, and 21
    actions.

    Joint quantities (N, 21) are in rad, rad/s and Nm, and joint limits (21,) in rad. The torques
    include those of springs and dampers. The wrenches (12, N) on the right and the left foot are in
    the foot frames, in newton and Nm.
    """
    angles = normalize_angle(torch.stack((torso.yaw, torso.roll, torso.angle_to_target)))
    return torch.cat(
        (
            torso.height[None],
            torso.lin_vel,
            torso.ang_vel * cfg.angular_velocity_scale,
            angles,
            torso.up_proj[None],
            torso.heading_proj[None],
            unscale(dof_pos, lower, upper).t(),
            dof_vel.t() * cfg.dof_velocity_scale,
            dof_forces.t() * cfg.contact_force_scale,
            foot_wrenches * cfg.contact_force_scale,
            actions.t(),
        )
    ).t()


def compute_humanoid_reward(
    torso: TorsoState,
    progress_m_s: Tensor,
    actions: Tensor,
    dof_pos_share: Tensor,
    dof_vel_scaled: Tensor,
    motor_effort_ratio: Tensor,
    cfg: LocomotionConfig,
) -> Terms:
    """Return the reward terms (N,).

    `progress_m_s` (N,) is the speed towards the target. Joint quantities (N, 21) are scaled like
    the observation. `motor_effort_ratio` (21,) are the torques of full actions, divided by the
    largest of them.
    """
    # The cost rises from 0 at 98% of the range to 1 at the limit.
    at_limit = ((dof_pos_share.abs() - _AT_LIMIT) / (1.0 - _AT_LIMIT)).clamp(min=0.0)
    power = (actions * dof_vel_scaled).abs()
    terms = {
        **running_terms(torso, progress_m_s, actions, _ALIVE_REWARD, cfg),
        "energy": (power * motor_effort_ratio).sum(-1) * -cfg.energy_cost,
        "joints_at_limit": (at_limit * motor_effort_ratio).sum(-1) * -cfg.joints_at_limit_cost,
    }
    return replace_where(terms, torso.height < cfg.termination_height, "fall", cfg.death_cost)


class Humanoid(LocomotionTask):
    """N humanoids with 108 observations and 21 joint torques."""

    settings_class = HumanoidConfig
    default_asset = "mjcf/humanoid.xml"
    published_assets = ("mjcf/nv_humanoid.xml",)
    actor_name = "humanoid"
    num_observations = 108
    num_actions = 21
    foot_names = ("right_foot", "left_foot")
    torques_nm = (*_ABDOMEN_NM, *_LEG_NM, *_LEG_NM, *_ARM_NM, *_ARM_NM)

    def create_sim(self) -> None:
        """Create the simulations and start measuring joint torques."""
        super().create_sim()
        self.motor_effort_ratio = self.motor_efforts / self.motor_efforts.max()
        _ = self.simulation.dof_forces  # the first read starts the measurement

    def observation_groups(self) -> dict[str, int]:
        """See `compute_humanoid_observations`."""
        joints = dict.fromkeys(("dof_pos", "dof_vel", "dof_forces"), 21)
        return self.torso_groups() | joints | {"foot_wrenches": 12, "last_actions": 21}

    def compute_obs(self) -> Tensor:
        """See `compute_humanoid_observations`."""
        sim = self.simulation
        return compute_humanoid_observations(
            self.torso_state(),
            sim.dof_pos,
            sim.dof_vel,
            sim.dof_forces,
            self.dof_limits_lower,
            self.dof_limits_upper,
            self.foot_wrenches(),
            self.actions,
            self.env_cfg,
        )

    def compute_reward_terms(self) -> Terms:
        """See `compute_humanoid_reward`."""
        return compute_humanoid_reward(
            self.torso_state(),
            self.potentials - self.prev_potentials,
            self.actions,
            self.dof_pos_share(),
            self.dof_vel_scaled(),
            self.motor_effort_ratio,
            self.env_cfg,
        )
