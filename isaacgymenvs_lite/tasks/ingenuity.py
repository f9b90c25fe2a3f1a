"""Ingenuity: a helicopter on Mars flies to targets with two rotors, as in IsaacGymEnvs.

The task keeps two quirks. Rotors can also pull down. A new target may lie beyond the distance that
ends an episode, and then the episode ends at once.

Three things differ. Gravity is -3.721 m/s^2 from the task file, whereas IsaacGymEnvs ignores this
key. The rotors are fixed to the chassis and do not turn. There is no marker at the target.
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

_THRUST_N_PER_S = 2000.0  # thrust of a full action per second of a simulator call
_MAX_LATERAL_SHARE = 0.2
_UPRIGHT_WEIGHT = 5.0

_STEPS_PER_TARGET = 500
_TARGET_ASIDE_M = (-5.0, 5.0)
_TARGET_HEIGHT_M = (1.0, 2.0)


@dataclass(frozen=True, kw_only=True)
class IngenuityConfig(HoverConfig):
    """`task.env` of Ingenuity."""

    episode_length: int = setting(2000, key="maxEpisodeLength", minimum=2)


def compute_ingenuity_forces(actions: Tensor, dt: float) -> Tensor:
    """Return the forces (N, 6) along x, y, z of each of the two rotors, in newton.

    A full action pushes up with 2000 dt newton. Lateral forces are at most 0.2 of the vertical
    force. `actions` (N, 6) have the order of the forces, and `dt` is the time of a simulator call
    (s).
    """
    rotors = actions.reshape(len(actions), 2, 3)
    up = rotors[..., 2:].clamp(-1.0, 1.0) * (_THRUST_N_PER_S * dt)
    aside = up * rotors[..., :2].clamp(-_MAX_LATERAL_SHARE, _MAX_LATERAL_SHARE)
    return torch.cat((aside, up), dim=-1).flatten(1)


def compute_ingenuity_reward(to_target: Tensor, root_rot: Tensor, spin: Tensor) -> Terms:
    """Return reward terms (N,), whose sum is at most 7 (see `compute_hover_reward`)."""
    return compute_hover_reward(to_target, root_rot, spin, _UPRIGHT_WEIGHT)


def draw_targets(env_ids: Tensor) -> Tensor:
    """Draw random targets (n, 3) in m."""
    aside = uniform(env_ids, *_TARGET_ASIDE_M, (2,))
    return torch.cat((aside, uniform(env_ids, *_TARGET_HEIGHT_M, (1,))), dim=-1)


class Ingenuity(HoverTask):
    """N helicopters with 13 observations and 6 actions.

    A target changes at every reset and after every 500 steps of an episode.
    `compute_flight_observations` and `compute_ingenuity_forces` describe observations and actions.
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
        """Draw new targets where 500 steps have passed, then run the base method."""
        due = (self.progress_buf % _STEPS_PER_TARGET == 0) & (self.progress_buf > 0)
        self._change_targets(due.nonzero().flatten())
        super().pre_physics_step(actions)

    def _change_targets(self, env_ids: Tensor) -> None:
        self.target_pos.index_copy_(0, env_ids, draw_targets(env_ids))

    def compute_controls(self, actions: Tensor) -> Tensor:
        """See `compute_ingenuity_forces`."""
        return compute_ingenuity_forces(actions, self.sim_dt_s)

    def to_target(self) -> Tensor:
        """Return the vectors (N, 3) to the targets (m)."""
        return self.target_pos - self.simulation.root_states[:, :3]

    def compute_reward_terms(self) -> Terms:
        """See `compute_ingenuity_reward`."""
        root = self.simulation.root_states
        return compute_ingenuity_reward(self.to_target(), root[:, 3:7], root[:, 12])

    def reset_state(self, env_ids: Tensor) -> None:
        """Place the helicopters upright and at rest near the origin, and draw targets."""
        self._change_targets(env_ids)
        nothing = torch.zeros(len(env_ids), 0, device=self.device)
        self.simulation.write_state(env_ids, draw_start_states(env_ids), nothing, nothing)
