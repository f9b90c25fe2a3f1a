"""Ingenuity: a helicopter on Mars flies to targets with two rotors. As IsaacGymEnvs.

Quirks kept, because policies and curves depend on them: rotors can pull down as well as
push up; a new target may be farther away than the distance at which an episode ends, so that some
episodes end with their first step, or with the step in which the target changes.

What differs from the original: gravity is the task file's -3.721 m/s^2 (there the
file's value is not read); the rotors are part of the chassis and do not turn, and there is no
marker at the target.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.hover import (
    HOME_M,
    HoverConfig,
    HoverTask,
    compute_hover_reward,
    draw_start_states,
)
from isaacgymenvs_lite.tasks.base.random_values import uniform
from isaacgymenvs_lite.tasks.base.reward_terms import Terms

# Times the time of a simulator call (s): the vertical force (N) of a full action.
_THRUST_N_PER_S = 2000.0
_MAX_LATERAL_SHARE = 0.2
_UPRIGHT_WEIGHT = 5.0

_STEPS_OF_A_TARGET = 500
_TARGET_ASIDE_M = (-5.0, 5.0)
_TARGET_HEIGHT_M = (1.0, 2.0)


@dataclass(frozen=True, kw_only=True)
class IngenuityConfig(HoverConfig):
    """`task.env` of Ingenuity."""

    episode_length: int = setting(2000, key="maxEpisodeLength", minimum=2)
    """Control steps of an episode."""


def compute_ingenuity_forces(actions: Tensor, dt: float) -> Tensor:
    """Return the forces (N, 6) on two rotors (N), x, y, z each, in the rotors' axes.

    A full action pushes up with 2000 dt; the lateral forces are shares of that, up to 0.2.

    Args:
        actions: (N, 6), x, y, z of each rotor.
        dt: time of a simulator call (s).
    """
    rotors = actions.reshape(len(actions), 2, 3)
    up = rotors[..., 2:].clamp(-1.0, 1.0) * (_THRUST_N_PER_S * dt)
    aside = up * rotors[..., :2].clamp(-_MAX_LATERAL_SHARE, _MAX_LATERAL_SHARE)
    return torch.cat((aside, up), dim=-1).flatten(1)


def compute_ingenuity_reward(to_target: Tensor, root_rot: Tensor, spin: Tensor) -> Terms:
    """Return the terms (N,) of the reward, 7 at most; see `compute_hover_reward`."""
    return compute_hover_reward(to_target, root_rot, spin, _UPRIGHT_WEIGHT)


def draw_targets(env_ids: Tensor) -> Tensor:
    """Return targets (n, 3) in m."""
    aside = uniform(env_ids, *_TARGET_ASIDE_M, (2,))
    return torch.cat((aside, uniform(env_ids, *_TARGET_HEIGHT_M, (1,))), dim=-1)


class Ingenuity(HoverTask):
    """N helicopters: 13 observations, 6 actions. Keys: `IngenuityConfig`.

    See `compute_flight_observations` and `compute_ingenuity_forces`.

    Attributes:
        target_pos: (N, 3) m; it changes with each episode, and every 500 steps of it.
    """

    settings_class = IngenuityConfig
    default_asset = "mjcf/ingenuity.xml"
    actor_name = "ingenuity"
    num_observations = 13
    num_actions = 6
    max_distance_m = 8.0
    min_height_m = 0.5

    def allocate_buffers(self) -> None:
        """Add the targets."""
        super().allocate_buffers()
        self.target_pos = torch.tensor(HOME_M, device=self.device).repeat(self.num_envs, 1)

    def pre_physics_step(self, actions: Tensor) -> None:
        """Move targets that are due, then as the base."""
        # At step 0 the target is as new as the episode.
        due = (self.progress_buf % _STEPS_OF_A_TARGET == 0) & (self.progress_buf > 0)
        self._change_targets(due.nonzero().flatten())
        super().pre_physics_step(actions)

    def _change_targets(self, env_ids: Tensor) -> None:
        self.target_pos.index_copy_(0, env_ids, draw_targets(env_ids))

    def compute_controls(self, actions: Tensor) -> Tensor:
        """See `compute_ingenuity_forces`."""
        return compute_ingenuity_forces(actions, self.sim_dt_s)

    def to_target(self) -> Tensor:
        """Return the ways (N, 3) to the targets (m)."""
        return self.target_pos - self.simulation.root_states[:, :3]

    def compute_reward_terms(self) -> Terms:
        """See `compute_ingenuity_reward`."""
        root = self.simulation.root_states
        return compute_ingenuity_reward(self.to_target(), root[:, 3:7], root[:, 12])

    def reset_state(self, env_ids: Tensor) -> None:
        """Near the middle, upright and at rest, with a new target."""
        self._change_targets(env_ids)
        nothing = torch.zeros(len(env_ids), 0, device=self.device)
        self.simulation.write_state(env_ids, draw_start_states(env_ids), nothing, nothing)
