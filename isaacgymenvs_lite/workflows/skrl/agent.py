# pyright: reportMissingImports=false
"""PPO of skrl on a task."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.resources.schedulers.torch import KLAdaptiveLR
from skrl.trainers.torch import SequentialTrainer, SequentialTrainerCfg
from torch import Tensor, nn

from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.workflows import library
from isaacgymenvs_lite.wrappers.skrl_env import SkrlVecEnvWrapper


@dataclass(frozen=True, kw_only=True)
class NetworkSettings:
    """The section `network`, for the policy and the critic, which share no layers."""

    units: tuple[int, ...] = setting(minimum=1)
    """Number of units in each hidden layer."""
    activation: str = setting("elu")
    initial_log_std: float = setting(0.0)


@dataclass(frozen=True, kw_only=True)
class SkrlSettings(library.AgentSettings):
    """The content of an agent file for skrl."""

    ppo: dict[str, Any] = setting()
    """Keys of PPO_CFG."""
    network: NetworkSettings = setting()
    normalize_observations: bool = setting(False)
    normalize_values: bool = setting(False)
    reward_scale: float = setting(1.0)
    target_kl: float | None = setting(None, above=0)
    """KL divergence to which the learning rate is adapted, or None for a constant learning rate."""


class Agent(library.Agent):
    """PPO with a Gaussian policy; checkpoints are `checkpoints/agent_<steps>.pt`.

    The argument `seed` is ignored, because the random generators are already seeded.
    """

    def __init__(self, task: VecTask, content: dict[str, Any], device: str, seed: int) -> None:
        self._settings = settings = library.read_agent(SkrlSettings, content)
        library.check_arguments(PPO_CFG, settings.ppo, "agent.ppo", ("experiment",))
        self.env = SkrlVecEnvWrapper(task)
        self.stepper = self.env.stepper
        spaces: dict[str, Any] = {
            "observation_space": self.env.observation_space,
            "state_space": self.env.state_space,
            "action_space": self.env.action_space,
            "device": device,
        }
        network = settings.network
        layers = (network.units, library.activation_class(network.activation))
        policy = GaussianPolicy(*layers, network.initial_log_std, **spaces)
        critic = Critic(*layers, **spaces)
        self.networks = (policy, critic)
        cfg = PPO_CFG(**settings.ppo, **self._class_arguments(device))
        memory = RandomMemory(memory_size=cfg.rollouts, num_envs=task.num_envs, device=device)
        self.agent = PPO(
            models={"policy": policy, "value": critic}, memory=memory, cfg=cfg, **spaces
        )
        self._rollouts = cfg.rollouts
        self.minibatch_rows = cfg.rollouts * task.num_envs // cfg.mini_batches

    def _class_arguments(self, device: str) -> dict[str, Any]:
        """Return the arguments of PPO_CFG that are classes or functions."""
        settings = self._settings
        made: dict[str, Any] = {
            "rewards_shaper": lambda rewards, *_: rewards * settings.reward_scale
        }
        sizes: dict[str, Any] = {}
        if settings.normalize_observations:
            sizes["observation"] = self.env.observation_space
            if self.env.state_space is not None:
                sizes["state"] = self.env.state_space
        if settings.normalize_values:
            sizes["value"] = 1
        for name, size in sizes.items():
            made[f"{name}_preprocessor"] = RunningStandardScaler
            made[f"{name}_preprocessor_kwargs"] = {"size": size, "device": device}
        if settings.target_kl is not None:
            made["learning_rate_scheduler"] = KLAdaptiveLR
            made["learning_rate_scheduler_kwargs"] = {"kl_threshold": settings.target_kl}
        return made

    def learn(self, folder: Path, log_interval: int | None) -> None:
        """See `library.Agent`."""
        experiment = self.agent.cfg.experiment
        self.agent.experiment_dir = str(folder)
        write = self._rollouts if log_interval is None else log_interval // self.env.num_envs
        self.agent.write_interval = experiment.write_interval = max(1, write)
        interval = self._settings.checkpoint_interval * self._rollouts
        self.agent.checkpoint_interval = experiment.checkpoint_interval = interval
        cfg = SequentialTrainerCfg(
            timesteps=self._settings.max_iterations * self._rollouts,
            headless=True,
            close_environment_at_exit=False,
        )
        SequentialTrainer(cfg=cfg, env=self.env, agents=self.agent).train()
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
        with library.loading(checkpoint, "skrl"):
            modules = torch.load(checkpoint, map_location="cpu", weights_only=True)
            for name, module in self.agent.checkpoint_modules.items():
                module.load_state_dict(modules[name])

    def policy(self) -> Callable[[Any], Any]:
        """See `library.Agent`."""

        def act(observations: Tensor) -> Tensor:
            outputs = self.agent.act(observations, self.env.state(), timestep=0, timesteps=0)[1]
            return outputs["mean_actions"]

        return act


def mlp(inputs: int, units: Sequence[int], outputs: int, activation: type[nn.Module]) -> nn.Module:
    """Return linear layers, with an activation between each layer and the next."""
    layers: list[nn.Module] = []
    for size in units:
        layers += [nn.Linear(inputs, size), activation()]
        inputs = size
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


class GaussianPolicy(GaussianMixin, Model):
    """Maps observations (n, F) to mean actions (n, A); learns a log standard deviation (A,)."""

    def __init__(
        self,
        units: Sequence[int],
        activation: type[nn.Module],
        initial_log_std: float,
        **spaces: Any,
    ) -> None:
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self, clip_actions=False)
        self.layers = mlp(self.num_observations, units, self.num_actions, activation)
        self.log_std_parameter = nn.Parameter(torch.full((self.num_actions,), initial_log_std))

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[Tensor, dict[str, Any]]:
        """Return mean actions (n, A) and the log standard deviation (A,)."""
        return self.layers(inputs["observations"]), {"log_std": self.log_std_parameter}


class Critic(DeterministicMixin, Model):
    """Maps states (n, S), or observations (n, F) if a task has no states, to values (n, 1)."""

    def __init__(self, units: Sequence[int], activation: type[nn.Module], **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self._input = "observations" if self.state_space is None else "states"
        inputs = self.num_observations if self.state_space is None else self.num_states
        self.layers = mlp(inputs, units, 1, activation)

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[Tensor, dict[str, Any]]:
        """Return values (n, 1)."""
        return self.layers(inputs[self._input]), {}
