# pyright: reportMissingImports=false
"""Wraps a task as a vectorised environment of rsl_rl, with TensorDicts of observations."""

from __future__ import annotations

from typing import Any

from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask, Observations

ACTOR_GROUP, CRITIC_GROUP = "policy", "critic"
"""rsl_rl's names for the group of observations and the group of states of asymmetric critics."""


class RslRlVecEnvWrapper(VecEnv):
    """N environments of a task of `isaacgymenvs_lite.make` for rsl_rl's runners.

    Observations have the groups `policy` (N, F) and, if the task has states, `critic` (N, S).
    `extras` has `time_outs` (N,) and the task's infos for each environment, for example `amp_obs`
    (N, F); `extras["log"]` has the infos about all environments. `stepper` steps the task.
    """

    def __init__(self, task: Any) -> None:
        self.stepper = AutoresetTask(task, type(self).__name__)
        self.task = self.stepper.task
        self.num_envs = self.task.num_envs
        self.num_actions = self.task.num_actions
        self.max_episode_length = self.task.max_episode_length
        self.device = self.task.rl_device
        self.cfg = self.task.cfg
        self._observations = self._grouped(self.stepper.reset())

    @property
    def episode_length_buf(self) -> Tensor:
        """(N,) int64, control steps of the running episodes; runners also set this attribute."""
        return self.task.progress_buf.to(self.device)

    @episode_length_buf.setter
    def episode_length_buf(self, lengths: Tensor) -> None:
        self.task.progress_buf.copy_(lengths)

    def get_observations(self) -> TensorDict:
        """Return a TensorDict that maps each group to the current observations."""
        return self._observations

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Start new episodes; return their observations and empty extras."""
        self._observations = self._grouped(self.stepper.reset())
        return self._observations, {}

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Advance by one control step with actions (N, A).

        Returns:
            TensorDict of observations, rewards (N,), dones (N,) int64 and extras.
        """
        step = self.stepper.step(actions)
        self._observations = self._grouped(step.observations)
        extras: dict[str, Any] = {**step.per_env, "time_outs": step.truncated}
        if step.scalars:
            extras["log"] = dict(step.scalars)
        return self._observations, step.rewards, step.ended.long(), extras

    def close(self) -> None:
        """Release the simulation."""
        self.stepper.close()

    def _grouped(self, observations: Observations) -> TensorDict:
        groups = {ACTOR_GROUP: observations["obs"]}
        if "states" in observations:
            groups[CRITIC_GROUP] = observations["states"]
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)
