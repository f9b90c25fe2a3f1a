"""Cartpole: a policy pushes a cart to keep a hinged pole upright, as in IsaacGymEnvs.

The model is a file of this project instead of the published URDF file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.mjcf_task import MjcfTask
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms, replace_where
from isaacgymenvs_lite.tasks.base.task_config import TaskConfig
from isaacgymenvs_lite.tasks.base.vec_task import ActionScaling

_EPISODE_LENGTH = 500
_MAX_ANGLE_RAD = math.pi / 2.0
_FAILURE_REWARD = -2.0
_START_POS = 0.1  # m and rad
_START_VEL = 0.25  # m/s and rad/s


@dataclass(frozen=True, kw_only=True)
class CartpoleConfig(TaskConfig):
    """`task.env` of Cartpole."""

    reset_dist: float = setting(3.0, key="resetDist", above=0)  # m
    max_effort: float = setting(400.0, key="maxEffort", minimum=0)  # newton


def compute_cartpole_observations(
    cart_pos: Tensor, cart_vel: Tensor, pole_angle: Tensor, pole_vel: Tensor
) -> Tensor:
    """Return the observations (N, 4) from quantities (N,) in m, m/s, rad, rad/s."""
    return torch.stack((cart_pos, cart_vel, pole_angle, pole_vel), dim=-1)


def compute_cartpole_reward(
    pole_angle: Tensor, pole_vel: Tensor, cart_vel: Tensor, cart_pos: Tensor, reset_dist: float
) -> Terms:
    """Return the reward terms (N,) for an upright, slow pole and cart, or for a failure.

    The quantities (N,) are in rad, rad/s, m/s and m. A pole with the angle 0 is upright.
    """
    terms = {
        "upright": 1.0 - pole_angle.square(),
        "cart_speed": -0.01 * cart_vel.abs(),
        "pole_speed": -0.005 * pole_vel.abs(),
    }
    failed = compute_cartpole_failures(pole_angle, cart_pos, reset_dist)
    return replace_where(terms, failed, "failure", _FAILURE_REWARD)


def compute_cartpole_failures(pole_angle: Tensor, cart_pos: Tensor, reset_dist: float) -> Tensor:
    """Return where (N,) the cart (m) is too far away or the pole (rad) fell."""
    return (cart_pos.abs() > reset_dist) | (pole_angle.abs() > _MAX_ANGLE_RAD)


class Cartpole(MjcfTask):
    """N cart-poles with 4 observations and 1 action."""

    settings_class = CartpoleConfig
    default_asset = "mjcf/cartpole.xml"
    published_assets = ("urdf/cartpole.urdf",)
    actor_name = "cartpole"
    num_observations = 4
    num_actions = 1

    def episode_length(self) -> int:
        """Return the number of control steps in an episode."""
        return _EPISODE_LENGTH

    def observation_groups(self) -> dict[str, int]:
        """See `compute_cartpole_observations`."""
        return {"cart_pos": 1, "cart_vel": 1, "pole_angle": 1, "pole_vel": 1}

    def action_scaling(self) -> ActionScaling:
        """Return the mapping from actions to the force on the cart (newton)."""
        effort = torch.tensor([self.env_cfg.max_effort])
        return ActionScaling("N", torch.zeros(1), effort)

    def compute_controls(self, actions: Tensor) -> Tensor:
        """Return the forces (N, 1) on the carts in newton."""
        return actions * self.env_cfg.max_effort

    def compute_obs(self) -> Tensor:
        """See `compute_cartpole_observations`."""
        pos, vel = self.simulation.dof_pos, self.simulation.dof_vel
        return compute_cartpole_observations(pos[:, 0], vel[:, 0], pos[:, 1], vel[:, 1])

    def compute_reward_terms(self) -> Terms:
        """See `compute_cartpole_reward`."""
        pos, vel = self.simulation.dof_pos, self.simulation.dof_vel
        return compute_cartpole_reward(
            pos[:, 1], vel[:, 1], vel[:, 0], pos[:, 0], self.env_cfg.reset_dist
        )

    def compute_failures(self) -> Tensor:
        """See `compute_cartpole_failures`."""
        pos = self.simulation.dof_pos
        return compute_cartpole_failures(pos[:, 1], pos[:, 0], self.env_cfg.reset_dist)

    def reset_state(self, env_ids: Tensor) -> None:
        """Place carts with nearly upright poles near the middle, and nearly at rest."""
        n = len(env_ids)
        pos = uniform(env_ids, -_START_POS, _START_POS, (2,))
        vel = uniform(env_ids, -_START_VEL, _START_VEL, (2,))
        self.simulation.write_state(env_ids, torch.zeros(n, 13, device=self.device), pos, vel)
