# pyright: reportMissingImports=false
"""PPO of rsl_rl on a task; the critic receives the states if the task has states."""

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
from isaacgymenvs_lite.wrappers.rsl_rl_env import ACTOR_GROUP, CRITIC_GROUP, RslRlVecEnvWrapper

log = logging.getLogger(__name__)

# Arguments of rsl_rl's classes that an agent file must not set, because they could name code.
_RESERVED = ("rnd_cfg", "symmetry_cfg", "multi_gpu_cfg", "distribution_cfg")


@dataclass(frozen=True, kw_only=True)
class RslRlSettings(library.AgentSettings):
    """The content of an agent file for rsl_rl."""

    num_steps_per_env: int = setting(minimum=1)
    algorithm: dict[str, Any] = setting()
    """Arguments of PPO."""
    actor: dict[str, Any] = setting()
    """Arguments of MLPModel."""
    critic: dict[str, Any] = setting()
    """Arguments of MLPModel."""
    distribution: dict[str, Any] = setting()
    """Arguments of the actor's GaussianDistribution."""


class Agent(library.Agent):
    """rsl_rl's on-policy runner with PPO and two networks, and checkpoints `model_<iteration>.pt`.

    The argument `seed` is ignored, because the random generators are already seeded.
    """

    def __init__(self, task: VecTask, content: dict[str, Any], device: str, seed: int) -> None:
        settings = library.read_agent(RslRlSettings, content)
        for cls, name in (
            (PPO, "algorithm"),
            (GaussianDistribution, "distribution"),
            (MLPModel, "actor"),
            (MLPModel, "critic"),
        ):
            library.check_arguments(cls, getattr(settings, name), f"agent.{name}", _RESERVED)
        self._device = device
        self._max_iterations = settings.max_iterations
        self.env = RslRlVecEnvWrapper(task)
        self.stepper = self.env.stepper
        distribution = {"class_name": "GaussianDistribution", **settings.distribution}
        actor = {"class_name": "MLPModel", "distribution_cfg": distribution, **settings.actor}
        critic_group = CRITIC_GROUP if task.num_states > 0 else ACTOR_GROUP
        runner_settings = {
            "num_steps_per_env": settings.num_steps_per_env,
            "save_interval": settings.checkpoint_interval,
            "obs_groups": {"actor": [ACTOR_GROUP], "critic": [critic_group]},
            "algorithm": {"class_name": "PPO", **settings.algorithm},
            "actor": actor,
            "critic": {"class_name": "MLPModel", **settings.critic},
            "logger": "tensorboard",
        }
        self.runner = OnPolicyRunner(self.env, runner_settings, None, device)
        algorithm = self.runner.alg
        self.networks = (algorithm.actor, algorithm.critic)
        rows = settings.num_steps_per_env * task.num_envs
        self.minibatch_rows = rows // algorithm.num_mini_batches

    def learn(self, folder: Path, log_interval: int | None) -> None:
        """See `library.Agent`; rsl_rl logs every iteration."""
        if log_interval is not None:
            log.info("log_interval: rsl_rl logs every iteration; the value has no effect")
        self.runner.logger.log_dir = str(folder)
        self.runner.learn(self._max_iterations)

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

    def policy(self) -> Callable[[Any], Any]:
        """See `library.Agent`."""
        return self.runner.get_inference_policy(self._device)
