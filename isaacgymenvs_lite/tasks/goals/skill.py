"""Skill: travel, turn and hold a hand as the first entries of the policy's latent say.

A discriminator of short windows pays a character that stands nearly as much as a character that
walks, because standing is a part of most clips. This goal pays for what the latent commands. The
agent issues the commands (`CommandedSkillEnv`); the policy observes them as parts of its latent.
"""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.simulation.backend import SimulationBackend
from isaacgymenvs_lite.tasks.base.reward_terms import Terms
from isaacgymenvs_lite.tasks.goals.goal import ClipsAhead, Goal
from isaacgymenvs_lite.tasks.goals.planar import in_heading_frame
from isaacgymenvs_lite.tasks.goals.reach import REACHING_BODIES
from isaacgymenvs_lite.tasks.goals.velocity import MeanShortfall
from isaacgymenvs_lite.utils.rotations import planar_motion, planar_speed

# A latent is a unit vector, so that commands must be small: these factors make a run of 2.8 m/s, a
# turn of 110 degrees per second and a hand above the head about 0.5 long.
_SCALES = (0.2, 0.6, 0.3)  # per m/s forward, m/s to the left, rad/s
_HAND_SCALE = 0.6  # per m
_LEAST_PACE_M_S, _HAND_MISS_M = 0.3, 0.5
_HAND_WEIGHT = 0.5


class Skill(Goal):
    """The goal `skill`.

    A command (n, C) has the velocities forward and to the left, the turn rate, and the position of
    the hand from the root in the heading frame, each times a factor; all are means over a second.
    C is 6, or 3 for a character without a hand among its key bodies.
    """

    look_ahead_s = tuple(i / 10 - 0.5 for i in range(11))

    def attach(self, simulation: SimulationBackend, dt_s: float) -> None:
        """Run the base method, and command all characters to stand."""
        super().attach(simulation, dt_s)
        names = simulation.body_names
        known = (name for name in REACHING_BODIES if name in names and name in self.key_bodies)
        self._hand_name = next(known, "")
        self._hand = names.index(self._hand_name) if self._hand_name else None
        scales = _SCALES + (_HAND_SCALE,) * 3 * (self._hand is not None)
        self._scales = torch.tensor(scales, device=simulation.device)
        self.num_commands = len(scales)
        self.commands = torch.zeros(simulation.num_envs, len(scales), device=simulation.device)
        self._shortfall = MeanShortfall(simulation.num_envs, len(scales), dt_s, simulation.device)

    def commands_of_clips(self, ahead: ClipsAhead) -> Tensor:
        """Return commands (n, C): what n clips do in the second around a moment."""
        roots = ahead.root_states
        hand = ahead.body_pos_w[self._hand_name] if self._hand_name else None
        return self._motion(roots, hand).mean(1) * self._scales

    def command(self, env_ids: Tensor, commands: Tensor) -> None:
        """Give commands (n, C) to characters `env_ids` (n,)."""
        self.commands.index_copy_(0, env_ids, commands / self._scales)

    def _motion(self, root_states: Tensor, hand_pos_w: Tensor | None) -> Tensor:
        """Return motions (..., C) of root states (..., 13) and hands (..., 3) m."""
        rows = root_states.reshape(-1, 13)
        parts = [planar_motion(rows)]
        if hand_pos_w is not None:
            offset_w = hand_pos_w.reshape(-1, 3) - rows[:, :3]
            parts.append(in_heading_frame(rows[:, 3:7], offset_w))
        return torch.cat(parts, dim=-1).view(*root_states.shape[:-1], -1)

    def reset(self, env_ids: Tensor) -> None:
        """Clear the errors of the previous episode."""
        self._shortfall.clear(env_ids)

    def after_step(self) -> None:
        """Store the difference between the command and the motion of the step."""
        hand = None if self._hand is None else self.simulation.body_pos[:, self._hand]
        self._shortfall.add(self.commands - self._motion(self.root_states(), hand))

    def reward(self) -> Terms:
        """Return the rewards (N,) of the mean pace and hand position in the last second.

        The reward of the pace is 1 - error / commanded pace, at least -1: 0 for a character that
        stands and should move. The reward of the hand falls from 0.5 to 0 at an error of 0.5 m. In
        contrast to a Gaussian kernel, each step towards a distant command earns more.
        """
        mean = self._shortfall.mean()
        missed_m_s, asked_m_s = planar_speed(mean[:, :3]), planar_speed(self.commands[:, :3])
        pace = (1.0 - missed_m_s / asked_m_s.clamp(min=_LEAST_PACE_M_S)).clamp(min=-1.0)
        if self._hand is None:
            return {"pace": pace}
        missed_m = torch.linalg.vector_norm(mean[:, 3:], dim=-1)
        hand = _HAND_WEIGHT * (1.0 - missed_m / _HAND_MISS_M).clamp(min=0.0)
        return {"pace": pace, "hand": hand}
