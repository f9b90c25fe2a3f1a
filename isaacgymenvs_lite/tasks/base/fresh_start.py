"""FreshStartTask: tasks whose episodes start before the physics, with an action that does nothing.

So IsaacGymEnvs has it in BallBalance, Quadcopter and Ingenuity: the action of the step in which an
episode starts was chosen for the last state of the one before, and what it would do is cleared.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.classic_task import ClassicConfig, ClassicTask


@dataclass(frozen=True, kw_only=True)
class FreshStartConfig(ClassicConfig):
    """Keys of `task.env` that these tasks share."""

    max_episode_length: int = setting(500, key="maxEpisodeLength", minimum=2)
    """Control steps of an episode."""


class FreshStartTask(ClassicTask):
    """Within `step` a new episode begins with the action zero.

    Where it began by `reset` or `reset_done`, so that somebody saw its first state, the first
    action counts.
    """

    resets_before_physics = True

    def _episode_length(self) -> int:
        return self.env_cfg.max_episode_length

    def pre_physics_step(self, actions: Tensor) -> None:
        """Start episodes, then set the controls of clamped actions (N, A)."""
        ended = self.reset_buf != 0
        super().pre_physics_step(actions.masked_fill(ended[:, None], 0.0))
