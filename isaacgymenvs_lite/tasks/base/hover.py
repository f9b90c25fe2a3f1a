"""Common parts of Quadcopter and Ingenuity: a free body learns to hover at a target.

The formulas come from IsaacGymEnvs. The reward depends on the spin about the world's vertical
axis, not about the body axis. The angular velocity is limited after every control step, whereas
PhysX limits it in every physics step.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.mjcf_task import MjcfTask
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.base.task_config import TaskConfig

HOME_M = (0.0, 0.0, 1.0)
"""Position of the body in the model, and centre of the random start positions."""
_START_ASIDE_M = (-1.5, 1.5)
_START_ABOVE_M = (-0.2, 1.5)
_MAX_ANGULAR_VELOCITY_RAD_S = 4.0 * math.pi

_DISTANCE_SCALE = 1.0 / 3.0
_VELOCITY_SCALE = 1.0 / 2.0
_ANGULAR_VELOCITY_SCALE = 1.0 / math.pi


def compute_flight_observations(to_target: Tensor, root_states: Tensor) -> Tensor:
    """Return (N, 13): vector to the target, rotation xyzw, linear and angular velocity, scaled.

    `to_target` (N, 3) is in m, in world axes.
    """
    return torch.cat(
        (
            to_target * _DISTANCE_SCALE,
            root_states[:, 3:7],
            root_states[:, 7:10] * _VELOCITY_SCALE,
            root_states[:, 10:] * _ANGULAR_VELOCITY_SCALE,
        ),
        dim=-1,
    )


def compute_hover_reward(
    to_target: Tensor, root_rot: Tensor, spin: Tensor, upright_weight: float
) -> Terms:
    """Return the reward terms (N,), where rewards of attitude and spin shrink with the distance.

    `to_target` (N, 3) is in m, `root_rot` (N, 4) is xyzw. `spin` (N,) is the angular velocity about
    the vertical (rad/s). `upright_weight` is the largest reward for being upright.
    """
    near = 1.0 / (1.0 + to_target.square().sum(-1))
    x, y = root_rot[:, 0], root_rot[:, 1]
    tilt = 2.0 * (x * x + y * y)  # 1 minus the z component of the body's z axis
    return {
        "target": near,
        "upright": near * upright_weight / (1.0 + tilt.square()),
        "spin": near / (1.0 + spin.square()),
    }


def compute_flight_failures(
    to_target: Tensor, height: Tensor, max_distance_m: float, min_height_m: float
) -> Tensor:
    """Return where (N,) the body is too far from the target or its height (N,) m is too low."""
    return (to_target.norm(dim=-1) > max_distance_m) | (height < min_height_m)


def draw_start_states(env_ids: Tensor) -> Tensor:
    """Draw states (n, 13) of upright bodies at rest near `HOME_M`."""
    states = torch.zeros(len(env_ids), 13, device=env_ids.device)
    states[:, :2] = uniform(env_ids, *_START_ASIDE_M, (2,))
    states[:, 2] = HOME_M[2] + uniform(env_ids, *_START_ABOVE_M)
    states[:, 6] = 1.0
    return states


@dataclass(frozen=True, kw_only=True)
class HoverConfig(TaskConfig):
    """Keys of `task.env` that Quadcopter and Ingenuity share."""

    episode_length: int = setting(500, key="maxEpisodeLength", minimum=2)


class HoverTask(MjcfTask):
    """N bodies that learn to hover at a target."""

    starts_before_physics = True
    zero_action_at_reset = True
    max_distance_m: ClassVar[float]
    min_height_m: ClassVar[float]

    def update_state(self) -> None:
        """Limit the angular velocity, because large time steps add energy to fast rotations."""
        sim = self.simulation
        turning = sim.root_states[:, 10:].square().sum(-1)
        env_ids = (turning > _MAX_ANGULAR_VELOCITY_RAD_S**2).nonzero().flatten()
        if len(env_ids) == 0:
            return
        root = sim.root_states.index_select(0, env_ids)
        root[:, 10:] *= (
            _MAX_ANGULAR_VELOCITY_RAD_S / turning.index_select(0, env_ids).sqrt()[:, None]
        )
        dof_pos, dof_vel = (dofs.index_select(0, env_ids) for dofs in (sim.dof_pos, sim.dof_vel))
        sim.write_state(env_ids, root, dof_pos, dof_vel)

    @abstractmethod
    def to_target(self) -> Tensor:
        """Return the vectors (N, 3) from the bodies to their targets (m)."""

    def observation_groups(self) -> dict[str, int]:
        """See `compute_flight_observations`."""
        return {"to_target": 3, "root_rot_xyzw": 4, "root_lin_vel": 3, "root_ang_vel": 3}

    def compute_obs(self) -> Tensor:
        """See `compute_flight_observations`."""
        return compute_flight_observations(self.to_target(), self.simulation.root_states)

    def compute_failures(self) -> Tensor:
        """See `compute_flight_failures`."""
        height = self.simulation.root_states[:, 2]
        return compute_flight_failures(
            self.to_target(), height, self.max_distance_m, self.min_height_m
        )
