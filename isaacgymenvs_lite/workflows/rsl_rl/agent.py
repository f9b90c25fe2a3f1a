# pyright: reportMissingImports=false
"""PPO of rsl_rl on a task; the critic gets the states of asymmetric tasks."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules import GaussianDistribution
from rsl_rl.runners import OnPolicyRunner

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.workflows import library
from isaacgymenvs_lite.workflows.agent_files import (
    AgentSettings,
    check_arguments,
    constructing,
    read_agent,
)
from isaacgymenvs_lite.wrappers.rsl_rl_env import ACTOR_GROUP, CRITIC_GROUP, RslRlVecEnvWrapper

log = logging.getLogger(__name__)

# Set by the workflow, or able to name code.
_RESERVED_PPO = (
    *("actor", "critic", "storage", "device", "multi_gpu_cfg"),
    *("rnd_cfg", "symmetry_cfg"),
)
_RESERVED_MODEL = ("obs", "obs_groups", "obs_set", "output_dim", "distribution_cfg")


@dataclass(frozen=True, kw_only=True)
class RslRlSettings(AgentSettings):
    """An agent file."""

    num_steps_per_env: int = setting(minimum=1)
    algorithm: dict[str, Any] = setting()
    """Arguments of PPO."""
    actor: dict[str, Any] = setting()
    """Arguments of MLPModel."""
    critic: dict[str, Any] = setting()
    """The same."""
    distribution: dict[str, Any] = setting()
    """Arguments of GaussianDistribution, of the actor."""


class Agent(library.Agent):
    """The on-policy runner with PPO and two networks; checkpoints are `model_<iteration>.pt`.

    Args:
        task: the task.
        content: of an agent file.
        device: of the networks.
        seed: not read, as the generators are seeded already.

    Attributes:
        runner: rsl_rl's.

    Raises:
        ConfigError: a key of the agent file that cannot be used.
    """

    def __init__(self, task: VecTask, content: dict[str, Any], device: str, seed: int) -> None:
        settings = read_agent(RslRlSettings, content)
        self.max_iterations = settings.max_iterations
        self._env = env = RslRlVecEnvWrapper(task)
        self.stepper = env.stepper
        self._device = device
        runner_settings = _runner_settings(settings, task)
        with constructing("OnPolicyRunner"):
            self.runner = OnPolicyRunner(env, runner_settings, None, device)
        algorithm = self.runner.alg
        rows = settings.num_steps_per_env * task.num_envs
        self.minibatch_rows = rows // max(1, algorithm.num_mini_batches)
        self.num_parameters = library.count_parameters((algorithm.actor, algorithm.critic))

    def learn(self, folder: Path, log_interval: int | None = None) -> None:
        """See `library.Agent`; rsl_rl logs every iteration."""
        if log_interval is not None:
            log.info("log_interval: rsl_rl logs every iteration; the value has no effect")
        self.runner.logger.log_dir = str(folder)
        self.runner.learn(self.max_iterations)

    def save(self, folder: Path) -> Path:
        """See `library.Agent`."""
        path = folder / f"model_{self.runner.current_learning_iteration}.pt"
        self.runner.save(str(path))
        return path

    def load(self, checkpoint: Path) -> None:
        """See `library.Agent`."""
        with library.loading(checkpoint, "rsl_rl"):
            state = torch.load(checkpoint, map_location="cpu", weights_only=True)
            self.runner.alg.load(state, None, True)

    def player(self) -> Callable[[], None]:
        """See `library.Agent`."""
        policy = self.runner.get_inference_policy(self._device)
        observations, _ = self._env.reset()

        def step() -> None:
            nonlocal observations
            with torch.no_grad():
                actions = policy(observations)
            observations, *_ = self._env.step(actions)

        return step


def _runner_settings(settings: RslRlSettings, task: VecTask) -> dict[str, Any]:
    """Return the runner's configuration; an agent file cannot name its classes."""
    check_arguments(PPO, settings.algorithm, "agent.algorithm", _RESERVED_PPO)
    check_arguments(
        GaussianDistribution, settings.distribution, "agent.distribution", ("output_dim",)
    )
    check_arguments(MLPModel, settings.actor, "agent.actor", _RESERVED_MODEL)
    check_arguments(MLPModel, settings.critic, "agent.critic", _RESERVED_MODEL)
    distribution = {"class_name": "GaussianDistribution", **settings.distribution}
    critic_group = CRITIC_GROUP if task.num_states > 0 else ACTOR_GROUP
    return {
        "num_steps_per_env": settings.num_steps_per_env,
        "save_interval": settings.checkpoint_interval,
        "obs_groups": {"actor": [ACTOR_GROUP], "critic": [critic_group]},
        "algorithm": {"class_name": "PPO", **settings.algorithm},
        "actor": {"class_name": "MLPModel", "distribution_cfg": distribution, **settings.actor},
        "critic": {"class_name": "MLPModel", **settings.critic},
        "logger": "tensorboard",
    }
