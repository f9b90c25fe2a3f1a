"""Skill: travel and turn as the first entries of the policy's latent say.

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
from isaacgymenvs_lite.tasks.goals.velocity import MeanShortfall
from isaacgymenvs_lite.utils.rotations import planar_motion, planar_speed

# A latent is a unit vector, so that commands must be small: these factors make a run of 2.8 m/s and
# a turn of 110 degrees per second about 0.6 long.
_SCALES = (0.2, 0.6, 0.3)  # per m/s forward, m/s to the left, rad/s
_LEAST_PACE_M_S = 0.3


class Skill(Goal):
    """The goal `skill`.

    A command (n, 3) has the velocities forward and to the left and the turn rate, each times a
    factor. All are means over a second. If the agent issues no commands, the reward is 1 as for the
    goal `none`.
    """

    look_ahead_s = tuple(i / 10 - 0.5 for i in range(11))
    num_commands = len(_SCALES)

    def attach(self, simulation: SimulationBackend, dt_s: float) -> None:
        """Run the base method, and allocate the commands."""
        super().attach(simulation, dt_s)
        num_envs, device = simulation.num_envs, simulation.device
        self._scales = torch.tensor(_SCALES, device=device)
        self.commands = torch.zeros(num_envs, self.num_commands, device=device)
        self._is_commanded = False
        self._shortfall = MeanShortfall(num_envs, self.num_commands, dt_s, device)

    def commands_of_clips(self, ahead: ClipsAhead) -> Tensor:
        """Return commands (n, 3): what n clips do in the second around a moment."""
        motion = planar_motion(ahead.root_states.flatten(0, 1))
        return motion.view(*ahead.root_states.shape[:2], -1).mean(1) * self._scales

    def command(self, env_ids: Tensor, commands: Tensor) -> None:
        """Give commands (n, 3) to characters `env_ids` (n,)."""
        self.commands.index_copy_(0, env_ids, commands / self._scales)
        self._is_commanded = True

    def reset(self, env_ids: Tensor) -> None:
        """Clear the errors of the previous episode."""
        self._shortfall.clear(env_ids)

    def after_step(self) -> None:
        """Store the difference between the command and the motion of the step."""
        self._shortfall.add(self.commands - planar_motion(self.root_states()))

    def reward(self) -> Tensor | Terms:
        """Return the rewards (N,) of the mean pace in the last second, or 1 without commands.

        The reward is 1 - error / commanded pace, at least 0, as for a character that stands and
        should move. In contrast to a Gaussian kernel, each step towards a distant command earns
        more. A negative reward would pay characters that fall at once.
        """
        if not self._is_commanded:
            return super().reward()
        missed_m_s = planar_speed(self._shortfall.mean())
        asked_m_s = planar_speed(self.commands).clamp(min=_LEAST_PACE_M_S)
        return {"pace": (1.0 - missed_m_s / asked_m_s).clamp(min=0.0)}
