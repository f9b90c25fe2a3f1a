# pyright: reportMissingImports=false
"""PPO of skrl on a task."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.resources.schedulers.torch import KLAdaptiveLR
from skrl.trainers.torch import SequentialTrainer, SequentialTrainerCfg

from isaacgymenvs_lite.schema import read_section, setting
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.workflows.agent_files import (
    AgentSettings,
    activation,
    check_arguments,
    check_keys,
    making,
)
from isaacgymenvs_lite.workflows.checkpoint_files import apply, read_parameters
from isaacgymenvs_lite.workflows.progress import ProgressLines
from isaacgymenvs_lite.workflows.skrl import LIBRARY
from isaacgymenvs_lite.workflows.skrl.models import Critic, GaussianPolicy
from isaacgymenvs_lite.wrappers.skrl_env import SkrlVecEnvWrapper

# Made by the workflow of keys of its own: classes and functions are nothing that a file can name.
_RESERVED = (
    *("experiment", "rewards_shaper", "learning_rate_scheduler", "learning_rate_scheduler_kwargs"),
    *("observation_preprocessor", "observation_preprocessor_kwargs"),
    *("state_preprocessor", "state_preprocessor_kwargs"),
    *("value_preprocessor", "value_preprocessor_kwargs"),
)


@dataclass(frozen=True, kw_only=True)
class NetworkSettings:
    """The section `network`: of policy and critic, which share no layers."""

    units: tuple[int, ...] = setting(minimum=1)
    """Of the hidden layers."""
    activation: str = setting("elu")
    initial_log_std: float = setting(0.0)


@dataclass(frozen=True, kw_only=True)
class SkrlSettings(AgentSettings):
    """An agent file."""

    ppo: dict[str, Any] = setting()
    """Keys of PPO_CFG."""
    network: NetworkSettings = setting()
    normalize_observations: bool = setting(False)
    normalize_values: bool = setting(False)
    reward_scale: float = setting(1.0)
    target_kl: float | None = setting(None, above=0)
    """What the learning rate is adapted to; None: it stays."""


@dataclass(frozen=True, kw_only=True)
class _Rollout:
    rollouts: int = setting(minimum=1)


class SkrlAgent:
    """PPO with a Gaussian policy.

    Checkpoints are `checkpoints/agent_<steps>.pt`.

    Args:
        task: the task.
        content: of an agent file.
        device: of the networks.
        seed: the generators are seeded already.

    Attributes:
        stepper: steps the task.
        max_iterations: see `library.Agent`.
        minibatch_rows: see `library.Agent`.
        num_parameters: see `library.Agent`.
        agent: skrl's.

    Raises:
        ConfigError: a key of the agent file that cannot be used.
    """

    def __init__(self, task: VecTask, content: dict[str, Any], device: str, seed: int) -> None:
        del seed
        check_keys(SkrlSettings, content, "agent", {"ppo": PPO_CFG, "network": NetworkSettings})
        if isinstance(content.get("network"), Mapping):
            check_keys(NetworkSettings, content["network"], "agent.network")
        settings = read_section(SkrlSettings, content, "agent", complete=True)
        check_arguments(PPO_CFG, settings.ppo, "agent.ppo", _RESERVED)
        rollout = read_section(_Rollout, settings.ppo, "agent.ppo", ignored=settings.ppo)
        self.max_iterations = settings.max_iterations
        self._rollouts, self._interval = rollout.rollouts, settings.checkpoint_interval
        self._env = env = SkrlVecEnvWrapper(task)
        self.stepper = env.stepper
        spaces: dict[str, Any] = {
            "observation_space": env.observation_space,
            "state_space": env.state_space,
            "action_space": env.action_space,
            "device": device,
        }
        network = settings.network
        layers = (network.units, activation(network.activation))
        models = {
            "policy": GaussianPolicy(*layers, network.initial_log_std, **spaces),
            "value": Critic(*layers, **spaces),
        }
        memory = RandomMemory(memory_size=self._rollouts, num_envs=env.num_envs, device=device)
        with making("PPO"):
            cfg = PPO_CFG(**settings.ppo, **self._made_of(settings, device))
            self.agent = PPO(models=models, memory=memory, cfg=cfg, **spaces)
        self.minibatch_rows = self._rollouts * env.num_envs // max(1, cfg.mini_batches)
        networks = models.values()
        self.num_parameters = sum(p.numel() for network in networks for p in network.parameters())

    def _made_of(self, settings: SkrlSettings, device: str) -> dict[str, Any]:
        """Return what of PPO's configuration is a class or function, by the file's own keys."""
        made: dict[str, Any] = {"rewards_shaper": lambda rewards, *_: rewards * scale}
        scale = settings.reward_scale
        sizes: dict[str, Any] = {}
        if settings.normalize_observations:
            sizes["observation"] = self._env.observation_space
            if self._env.state_space is not None:
                sizes["state"] = self._env.state_space
        if settings.normalize_values:
            sizes["value"] = 1
        for name, size in sizes.items():
            made[f"{name}_preprocessor"] = RunningStandardScaler
            made[f"{name}_preprocessor_kwargs"] = {"size": size, "device": device}
        if settings.target_kl is not None:
            made["learning_rate_scheduler"] = KLAdaptiveLR
            made["learning_rate_scheduler_kwargs"] = {"kl_threshold": settings.target_kl}
        return made

    def learn(self, folder: Path, log_interval: int | None = None) -> None:
        """See `library.Agent`."""
        experiment = self.agent.cfg.experiment
        self.agent.experiment_dir = str(folder)
        write = self._rollouts if log_interval is None else log_interval // self._env.num_envs
        self.agent.write_interval = experiment.write_interval = max(1, write)
        interval = self._interval * self._rollouts
        self.agent.checkpoint_interval = experiment.checkpoint_interval = interval
        steps = self.max_iterations * self._rollouts
        # None: no progress bar where nobody looks.
        cfg = SequentialTrainerCfg(
            timesteps=steps,
            headless=True,
            disable_progressbar=None,
            close_environment_at_exit=False,
        )
        if not sys.stderr.isatty():
            self.stepper.task.listeners.append(ProgressLines(self.stepper, steps))
        SequentialTrainer(cfg=cfg, env=self._env, agents=self.agent).train()
        self.save(folder)
        self.agent.writer.close()

    def save(self, folder: Path) -> Path:
        """See `library.Agent`."""
        path = folder / "checkpoints" / f"agent_{self.stepper.num_steps}.pt"
        path.parent.mkdir(exist_ok=True)
        self.agent.save(str(path))
        return path

    def load(self, checkpoint: Path) -> None:
        """See `library.Agent`."""
        modules = read_parameters(checkpoint, LIBRARY)

        def take() -> None:
            for name, module in self.agent.checkpoint_modules.items():
                module.load_state_dict(modules[name])

        apply(take, checkpoint)

    def player(self) -> Callable[[], None]:
        """See `library.Agent`."""
        observations, _ = self._env.reset()

        def step() -> None:
            nonlocal observations
            with torch.no_grad():
                _, outputs = self.agent.act(
                    observations, self._env.state(), timestep=0, timesteps=0
                )
            observations, *_ = self._env.step(outputs["mean_actions"])

        return step
