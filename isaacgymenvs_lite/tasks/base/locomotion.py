"""Common parts of Ant and Humanoid: a body with joint torques learns to run along +x.

The formulas come from IsaacGymEnvs, including one quirk. `angle_to_target` is computed from the
height of the target instead of its lateral distance, and is therefore nearly the negative yaw.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.assets import hinge_limits
from isaacgymenvs_lite.tasks.base.mjcf_task import MjcfTask
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.task_config import TaskConfig
from isaacgymenvs_lite.tasks.base.vec_task import ActionScaling
from isaacgymenvs_lite.tasks.base.wrenches import measure_wrenches
from isaacgymenvs_lite.utils.rotations import rotate_components
from isaacgymenvs_lite.utils.scaling import unscale

_TARGET_X_M = 1000.0
_START_POS_NOISE_RAD = 0.2
_START_VEL_NOISE_RAD_S = 0.1
_FULL_HEADING, _UPRIGHT = 0.8, 0.93  # cosines of 37 and 22 degrees


@dataclass(frozen=True, kw_only=True)
class LocomotionConfig(TaskConfig):
    """Keys of `task.env` that Ant and Humanoid share."""

    episode_length: int = setting(1000, key="episodeLength", minimum=2)
    power_scale: float = setting(1.0, key="powerScale", minimum=0)
    heading_weight: float = setting(0.5, key="headingWeight")
    up_weight: float = setting(0.1, key="upWeight")
    actions_cost: float = setting(0.005, key="actionsCost")
    energy_cost: float = setting(0.05, key="energyCost")
    dof_velocity_scale: float = setting(0.2, key="dofVelocityScale")
    angular_velocity_scale: float = setting(1.0, key="angularVelocityScale")
    contact_force_scale: float = setting(0.1, key="contactForceScale")
    joints_at_limit_cost: float = setting(0.1, key="jointsAtLimitCost")
    death_cost: float = setting(-2.0, key="deathCost")
    termination_height: float = setting(0.31, key="terminationHeight")  # m


class TorsoState(NamedTuple):
    """State of the torso as tensors (N,) and (3, N), with velocities in torso axes."""

    height: Tensor
    lin_vel: Tensor
    ang_vel: Tensor
    yaw: Tensor
    roll: Tensor
    angle_to_target: Tensor
    up_proj: Tensor
    heading_proj: Tensor


def compute_torso_state(root_states: Tensor) -> TorsoState:
    """Return the torso state of `root_states` (N, 13) relative to the target at (1000, 0, 0) m.

    The angles `yaw` and `roll` (rad) are in [0, 2 pi), and `angle_to_target` (rad) is not wrapped.
    `up_proj` is the z component of the torso's z axis. `heading_proj` is the cosine between the
    torso's x axis and the direction of the target.
    """
    root = root_states.t()
    px, py, height, x, y, z, w = root[:7].unbind()
    velocities_w = root[7:].unflatten(0, (2, 3)).unbind(1)  # components x, y, z: (2, N) each
    velocities = torch.stack(rotate_components((-x, -y, -z, w), velocities_w), dim=1)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    sin_yaw = 2.0 * (x * y + w * z)
    # These are the formulas of `get_euler_xyz`.
    roll = torch.atan2(2.0 * (w * x + y * z), ww - xx - yy + zz) % math.tau
    yaw = torch.atan2(sin_yaw, ww + xx - yy - zz) % math.tau
    to_x, to_y = _TARGET_X_M - px, -py
    return TorsoState(
        height,
        velocities[0],
        velocities[1],
        yaw,
        roll,
        torch.atan2(-height, to_x) - yaw,
        1.0 - 2.0 * (xx + yy),
        ((1.0 - 2.0 * (yy + zz)) * to_x + sin_yaw * to_y) / torch.hypot(to_x, to_y),
    )


def compute_potentials(root_pos: Tensor, dt: float) -> Tensor:
    """Return the negative ground distance (N,) to the target (1000, 0, 0) m, divided by dt (s).

    The increase of the potential in a step is the speed towards the target (m/s).
    """
    return torch.hypot(_TARGET_X_M - root_pos[:, 0], root_pos[:, 1]) / -dt


def running_terms(
    torso: TorsoState, progress_m_s: Tensor, actions: Tensor, alive: float, cfg: LocomotionConfig
) -> Terms:
    """Return the reward terms (N,) that Ant and Humanoid share.

    `progress_m_s` (N,) is the speed towards the target, and `alive` is a constant reward for each
    step.
    """
    heading = cfg.heading_weight / _FULL_HEADING * torso.heading_proj
    faces_target = torso.heading_proj > _FULL_HEADING
    return {
        "progress": progress_m_s,
        "alive": torch.full_like(progress_m_s, alive),
        "heading": heading.masked_fill(faces_target, cfg.heading_weight),
        "up": (torso.up_proj > _UPRIGHT).float() * cfg.up_weight,
        "actions": actions.square().sum(-1) * -cfg.actions_cost,
    }


class LocomotionTask(MjcfTask):
    """N bodies with torque motors that learn to run along +x."""

    foot_names: ClassVar[tuple[str, ...]]
    """The policy observes the contact forces and torques on these bodies."""
    torques_nm: ClassVar[tuple[float, ...]]
    """Torque of a full action for each joint."""

    def create_sim(self) -> None:
        """Create the simulations and look up the joint limits."""
        super().create_sim()
        device = self.device
        limits = torch.from_numpy(hinge_limits(self._model, self._layout)).float().to(device)
        self.dof_limits_lower, self.dof_limits_upper = limits.unbind(-1)
        # A joint starts at zero, or at the nearest limit if its range excludes zero.
        self.initial_dof_pos = limits.clamp(min=0.0)[:, 0] + limits.clamp(max=0.0)[:, 1]
        self.motor_efforts = torch.tensor(self.torques_nm, device=device)
        self.initial_root = torch.zeros(13, device=device)
        self.initial_root[:3] = torch.from_numpy(self._model.qpos0[:3])
        self.initial_root[6] = 1.0

    def allocate_buffers(self) -> None:
        """Add the potentials of this step and of the previous one."""
        super().allocate_buffers()
        self.potentials = torch.zeros(self.num_envs, device=self.device)
        self.prev_potentials = torch.zeros_like(self.potentials)

    def torso_groups(self) -> dict[str, int]:
        """Return names and sizes of the observation parts that describe the torso."""
        names = ("yaw", "roll", "angle_to_target", "up_proj", "heading_proj")
        torso = {"torso_height": 1, "torso_lin_vel": 3, "torso_ang_vel": 3}
        return torso | dict.fromkeys(names, 1)

    def action_scaling(self) -> ActionScaling:
        """Return the mapping from actions to joint torques (Nm)."""
        efforts = self.motor_efforts * self.env_cfg.power_scale
        return ActionScaling("Nm", torch.zeros_like(efforts), efforts)

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Return the joint torques (N, D) in Nm."""
        return actions * self.motor_efforts * self.env_cfg.power_scale

    def update_state(self) -> None:
        """Update the potentials, and discard the cached torso state."""
        self.prev_potentials, self.potentials = self.potentials, self.prev_potentials
        self.potentials.copy_(compute_potentials(self.simulation.root_states[:, :3], self.sim_dt_s))
        self._torso: TorsoState | None = None

    def torso_state(self) -> TorsoState:
        """See `compute_torso_state`."""
        if self._torso is None:
            self._torso = compute_torso_state(self.simulation.root_states)
        return self._torso

    def dof_pos_share(self) -> Tensor:
        """Return joint positions (N, D), where each joint's range is scaled to [-1, 1]."""
        return unscale(self.simulation.dof_pos, self.dof_limits_lower, self.dof_limits_upper)

    def dof_vel_scaled(self) -> Tensor:
        """Return the scaled joint velocities (N, D) of the observation."""
        return self.simulation.dof_vel * self.env_cfg.dof_velocity_scale

    def foot_wrenches(self) -> Tensor:
        """Return contact forces and torques (6 K, N) on the feet, in the foot frames."""
        return measure_wrenches(self.simulation, self.foot_names)

    def compute_failures(self) -> Tensor:
        """Return where (N,) the torso is below the termination height."""
        return self.simulation.root_states[:, 2] < self.env_cfg.termination_height

    def reset_state(self, env_ids: Tensor) -> None:
        """Place the body upright at the origin, with joints near their start positions and slow."""
        size = (self.num_actions,)
        pos = self.initial_dof_pos + uniform(
            env_ids, -_START_POS_NOISE_RAD, _START_POS_NOISE_RAD, size
        )
        pos = pos.clamp(self.dof_limits_lower, self.dof_limits_upper)
        vel = uniform(env_ids, -_START_VEL_NOISE_RAD_S, _START_VEL_NOISE_RAD_S, size)
        root = self.initial_root.repeat(len(env_ids), 1)
        self.simulation.write_state(env_ids, root, pos, vel)
        # The displacement by the reset must not count as progress.
        self.potentials.index_copy_(0, env_ids, compute_potentials(root[:, :3], self.sim_dt_s))
        self._torso = None

    def infos(self) -> dict[str, Any]:
        """Return the speed along x (N,) in m/s as the objective of population-based training."""
        return {"true_objective": self._for_trainer(self.simulation.root_states[:, 7])}
