"""Anymal: ANYmal C follows commanded velocities on flat ground, as in IsaacGymEnvs.

The task keeps these quirks, because policies and curves depend on them:

- The start angle of each joint is its default angle times a random factor.
- A command lasts for a whole episode.
- The observed gravity is rotated the wrong way, unless `projectedGravityAsPublished` is False.

Two quirks are removed. First, IsaacGymEnvs reads stale contact forces after a fall and therefore
ends the following episode in its first step. Second, IsaacGymEnvs limits joint speeds to 20 rad/s.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.velocity_tracking import (
    BaseMotion,
    ControlConfig,
    LearnConfig,
    VelocityTrackingConfig,
    VelocityTrackingTask,
    clip_negative_total,
    compute_tracking_rewards,
    proprioception,
)


@dataclass(frozen=True, kw_only=True)
class AnymalControlConfig(ControlConfig):
    """`task.env.control` of Anymal."""

    control_freq_inv: int = setting(1, key="controlFrequencyInv", choices=(1,))


@dataclass(frozen=True, kw_only=True)
class AnymalConfig(VelocityTrackingConfig):
    """`task.env` of Anymal."""

    control: AnymalControlConfig = field(default_factory=AnymalControlConfig)
    learn: LearnConfig = field(default_factory=LearnConfig)
    gravity_as_published: bool = setting(True, key="projectedGravityAsPublished")


def rotate_down(root_rot: Tensor) -> Tensor:
    """Rotate the vector (0, 0, -1) by quaternions (N, 4) xyzw, and return the results (3, N).

    IsaacGymEnvs calls the result "projected gravity". For a small heading, the result is the
    gravity in the base frame with opposite signs of x and y.
    """
    x, y, z, w = root_rot.unbind(-1)
    return 2.0 * torch.stack((-(x * z + w * y), w * x - y * z, x * x + y * y - 0.5))


def compute_anymal_observations(
    motion: BaseMotion,
    commands: Tensor,
    dof_pos: Tensor,
    dof_vel: Tensor,
    actions: Tensor,
    cfg: LearnConfig,
) -> Tensor:
    """Return the observations (N, 48).

    First come linear and angular velocity, gravity and 3 commands. Then come 12 joint positions
    relative to the default angles, 12 joint velocities, and 12 actions. Gravity and actions are not
    scaled. The arguments have the shapes (3, N) and (12, N).
    """
    return torch.cat((*proprioception(motion, commands, dof_pos, dof_vel, cfg), actions)).t()


def compute_anymal_reward(
    motion: BaseMotion, commands: Tensor, torques: Tensor, cfg: LearnConfig, dt: float
) -> Terms:
    """Return the reward terms (N,), whose sum is at least 0.

    `commands` (3, N) are in m/s and rad/s, and `torques` (12, N) are in Nm. As in IsaacGymEnvs, the
    weights of `cfg` are per second, and `dt` is `task.sim.dt` (s).
    """
    along, turning = compute_tracking_rewards(commands, motion)
    terms = {
        "lin_vel_xy": along * (cfg.lin_vel_xy_reward * dt),
        "ang_vel_z": turning * (cfg.ang_vel_z_reward * dt),
        "torques": torques.square().sum(0) * (cfg.torque_reward * dt),
    }
    return clip_negative_total(terms)


class Anymal(VelocityTrackingTask):
    """N robots with 48 observations and 12 joint position targets."""

    settings_class = AnymalConfig
    default_asset = "mjcf/anymal.xml"
    published_assets = ("urdf/anymal_c/urdf/anymal.urdf",)
    actor_name = "anymal"
    num_observations = 48
    num_actions = 12

    def episode_length(self) -> int:
        """Return the number of control steps in `episodeLength_s`."""
        return int(self.env_cfg.learn.episode_length_s / self.sim_cfg.dt + 0.5)

    def create_sim(self) -> None:
        """Create the simulations and look up the bodies that must not touch anything."""
        super().create_sim()
        base = torch.zeros(1, dtype=torch.int64, device=self.device)
        self._untouchable_ids = torch.cat((base, self._knee_ids))

    def observation_groups(self) -> dict[str, int]:
        """See `compute_anymal_observations`."""
        return self.proprioception_groups() | {"last_actions": self.num_actions}

    def compute_obs(self) -> Tensor:
        """See `compute_anymal_observations`."""
        sim = self.simulation
        motion = self.base_motion()
        if self.env_cfg.gravity_as_published:
            motion = motion._replace(gravity=rotate_down(sim.root_states[:, 3:7]))
        return compute_anymal_observations(
            motion,
            self._command_planes,
            (sim.dof_pos - self.default_dof_pos).t(),
            sim.dof_vel.t(),
            self.actions.t(),
            self.env_cfg.learn,
        )

    def compute_reward_terms(self) -> Terms:
        """See `compute_anymal_reward`."""
        return compute_anymal_reward(
            self.base_motion(),
            self._command_planes,
            self._torques,
            self.env_cfg.learn,
            self.sim_dt_s,
        )

    def compute_failures(self) -> Tensor:
        """Return where (N,) the base or a knee is in contact."""
        return self.in_contact(self._untouchable_ids).any(0)

    def reset_state(self, env_ids: Tensor) -> None:
        """Reset base and joints, and draw commands."""
        root = self._start_root.repeat(len(env_ids), 1)
        self.simulation.write_state(env_ids, root, *self.draw_start_joints(env_ids))
        self._command_planes.index_copy_(1, env_ids, self.draw_commands(env_ids))
        self._motion = None
