"""Wraps a task as rl_games' vectorised environment, IsaacGymEnvs' type `RLGPU`."""

from __future__ import annotations

from typing import Any

from rl_games.common import env_configurations
from rl_games.common.ivecenv import IVecEnv
from torch import Tensor

import isaacgymenvs_lite
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.utils.threads import release_torch_threads, trainer_sets_threads


class RLGPUEnv(IVecEnv):
    """The vectorised environment of a task; the attribute `env` is the task.

    The first action of an episode must belong to the first observation of the episode. Agents of
    the AMP family therefore call `reset_done` before each action, if the task has
    `agents_call_reset_done`. rl_games' agents never call `reset_done`; therefore `step` calls
    `reset_done` and returns its observations until an agent calls `reset_done`.

    Args:
        config_name: name of the environment in rl_games' configurations, `rlgpu`.
        num_actors: rl_games' number of environments, which `isaacgymenvs_lite.make` uses if
            `num_envs` is missing. A creator that a user has registered does not receive it.
        kwargs: arguments of the registered creator, which makes the task.
    """

    def __init__(self, config_name: str, num_actors: int, **kwargs: Any) -> None:
        creator = env_configurations.configurations[config_name]["env_creator"]
        if creator is isaacgymenvs_lite.make and "cfg" not in kwargs:
            kwargs.setdefault("num_envs", num_actors)
        with trainer_sets_threads():  # The trainer sets torch's threads by its key torch_threads.
            self._wrap(creator(**kwargs))

    @classmethod
    def from_task(cls, task: VecTask) -> RLGPUEnv:
        """Return the vectorised environment of an existing task."""
        vec_env = cls.__new__(cls)
        vec_env._wrap(task)
        return vec_env

    def _wrap(self, task: VecTask) -> None:
        self.env = task
        release_torch_threads(task)  # An existing task has set torch's number of threads.
        # An environment that a user wrote may lack this attribute.
        self._calls_reset_done = getattr(task, "agents_call_reset_done", False)

    def step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        """Advance by one control step; see `VecTask.step` and the class docstring."""
        obs, rewards, dones, infos = self.env.step(actions)
        if self._calls_reset_done:
            obs, _ = self.env.reset_done()
        return obs, rewards, dones, infos

    def reset(self) -> dict[str, Tensor]:
        """See `VecTask.reset`."""
        return self.env.reset()

    def reset_done(self) -> tuple[dict[str, Tensor], Tensor]:
        """See `VecTask.reset_done` and the class docstring."""
        self._calls_reset_done = False
        return self.env.reset_done()

    def get_number_of_agents(self) -> int:
        """Return the number of agents in each environment."""
        return self.env.num_agents

    def get_env_info(self) -> dict[str, Any]:
        """Return the task's spaces; amp_observation_space and state_space may be missing."""
        info: dict[str, Any] = {
            "action_space": self.env.action_space,
            "observation_space": self.env.observation_space,
            "agents": self.env.num_agents,
        }
        amp_observation_space = getattr(self.env, "amp_observation_space", None)
        if amp_observation_space is not None:
            info["amp_observation_space"] = amp_observation_space
        if self.env.num_states > 0:
            info["state_space"] = self.env.state_space
        return info

    def set_train_info(self, env_frames: int, *args: Any, **kwargs: Any) -> None:
        """Tell the task how many environment steps the training has made."""
        self.env.set_train_info(env_frames, *args, **kwargs)

    def get_env_state(self) -> Any:
        """Return the task's state, which the checkpoint contains."""
        return self.env.get_env_state()

    def set_env_state(self, env_state: Any) -> None:
        """Restore the task's state from a checkpoint."""
        self.env.set_env_state(env_state)

    def close(self) -> None:
        """Release the task's simulation."""
        self.env.close()
