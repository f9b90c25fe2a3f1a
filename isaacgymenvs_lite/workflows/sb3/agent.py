# pyright: reportMissingImports=false
"""PPO of Stable-Baselines3 on a task."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.schema import read_section, setting
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.workflows.agent_files import (
    AgentSettings,
    activation,
    check_arguments,
    making,
)
from isaacgymenvs_lite.workflows.checkpoint_files import apply, read_parameters
from isaacgymenvs_lite.workflows.sb3 import LIBRARY
from isaacgymenvs_lite.wrappers.sb3_env import Sb3VecEnvWrapper

# Given by the workflow.
_RESERVED = (
    *("policy", "env", "seed", "device", "batch_size", "policy_kwargs"),
    *("tensorboard_log", "_init_setup_model"),
)


@dataclass(frozen=True, kw_only=True)
class Sb3Settings(AgentSettings):
    """An agent file."""

    minibatches: int = setting(minimum=1)
    """Of an epoch."""
    ppo: dict[str, Any] = setting()
    """Arguments of PPO."""
    policy: dict[str, Any] = setting()
    """Arguments of ActorCriticPolicy, the activation by name."""
    vec_normalize: dict[str, Any] | None = setting(None)
    """Arguments of VecNormalize; None for none."""


@dataclass(frozen=True, kw_only=True)
class _Rollout:
    n_steps: int = setting(minimum=1)


class Sb3Agent:
    """PPO, `VecNormalize` around the environment where the agent file has `vec_normalize`.

    A checkpoint is `checkpoints/model_<steps>.zip`, which PPO.load reads, and beside it
    `model_<steps>.npz` with the normalisers' statistics.

    Args:
        task: the task.
        content: of an agent file.
        device: of the networks.
        seed: of the agent.

    Attributes:
        stepper: steps the task.
        model: the algorithm.
        max_iterations: see `library.Agent`.
        normalizer: around the environment, or None.

    Raises:
        ConfigError: a key of the agent file that cannot be used.
    """

    def __init__(self, task: VecTask, content: dict[str, Any], device: str, seed: int) -> None:
        settings = read_section(Sb3Settings, content, "agent", complete=True)
        check_arguments(PPO, settings.ppo, "agent.ppo", _RESERVED)
        rollout = read_section(_Rollout, settings.ppo, "agent.ppo", ignored=settings.ppo)
        self.max_iterations = settings.max_iterations
        self._interval = settings.checkpoint_interval
        adapter = Sb3VecEnvWrapper(task)
        self.stepper = adapter.stepper
        self._env: VecEnv = adapter
        self.normalizer: VecNormalize | None = None
        if settings.vec_normalize is not None:
            normalize = settings.vec_normalize
            check_arguments(VecNormalize, normalize, "agent.vec_normalize", ("venv", "gamma"))
            gamma = float(settings.ppo.get("gamma", 0.99))
            with making("VecNormalize"):
                self._env = self.normalizer = VecNormalize(adapter, gamma=gamma, **normalize)
        samples = rollout.n_steps * task.num_envs
        function = activation(settings.policy.get("activation", "elu"))
        policy = {k: v for k, v in settings.policy.items() if k != "activation"}
        check_arguments(ActorCriticPolicy, policy, "agent.policy", ("activation_fn",))
        with making("PPO"):
            self.model = PPO(
                "MlpPolicy",
                self._env,
                batch_size=max(2, samples // settings.minibatches),
                policy_kwargs={**policy, "activation_fn": function},
                seed=seed,
                device=device,
                **settings.ppo,
            )

    def learn(self, folder: Path) -> None:
        """See `library.Agent`."""
        self.model.set_logger(configure(str(folder), ["stdout", "tensorboard"]))
        steps = self.max_iterations * self.model.n_steps * self.stepper.num_envs
        self.model.learn(steps, callback=_Saver(self, folder, self._interval))
        self.save(folder)

    def save(self, folder: Path) -> Path:
        """See `library.Agent`; of a normalised environment also the statistics, `.npz`."""
        path = folder / "checkpoints" / f"model_{self.model.num_timesteps}.zip"
        path.parent.mkdir(exist_ok=True)
        self.model.save(path)
        if self.normalizer is not None:
            np.savez(path.with_suffix(".npz"), **_statistics(self.normalizer))
        return path

    def load(self, checkpoint: Path) -> None:
        """See `library.Agent`."""
        read_parameters(checkpoint, LIBRARY)
        # Without its data, which would be unpickled.
        _, parameters, _ = load_from_zip_file(checkpoint, load_data=False, device=self.model.device)
        apply(lambda: self.model.set_parameters(parameters, exact_match=True), checkpoint)
        if self.normalizer is not None:
            statistics = checkpoint.with_suffix(".npz")
            if not statistics.is_file():
                raise CheckpointError(
                    f"--checkpoint {checkpoint}: the agent file has vec_normalize, and there are no"
                    f" statistics beside it: {statistics.name} is missing"
                )
            _take_statistics(self.normalizer, statistics)

    def player(self) -> Callable[[], None]:
        """See `library.Agent`."""
        if self.normalizer is not None:
            self.normalizer.training = False
        observations: Any = self._env.reset()

        def step() -> None:
            nonlocal observations
            actions, _ = self.model.predict(observations, deterministic=True)
            observations, *_ = self._env.step(actions)

        return step


class _Saver(BaseCallback):
    """Writes a checkpoint every so many rollouts."""

    def __init__(self, agent: Sb3Agent, folder: Path, interval: int) -> None:
        super().__init__()
        self._agent, self._folder, self._interval = agent, folder, interval
        self._rollouts = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self._rollouts += 1
        if self._rollouts % self._interval == 0:
            self._agent.save(self._folder)


def _statistics(normalizer: VecNormalize) -> dict[str, Any]:
    """Return mean, variance and number of observations and of returns, by name."""
    named = {"obs": normalizer.obs_rms, "ret": normalizer.ret_rms}
    return {
        f"{name}_{part}": getattr(moments, part)
        for name, moments in named.items()
        if normalizer.norm_obs or name == "ret"
        for part in ("mean", "var", "count")
    }


def _take_statistics(normalizer: VecNormalize, file: Path) -> None:
    def take() -> None:
        with np.load(file, allow_pickle=False) as saved:
            for name, own in _statistics(normalizer).items():
                value = saved[name]
                if value.shape != np.shape(own):
                    raise ValueError(f"{name} has shape {value.shape}, not {np.shape(own)}")
                kind, part = name.split("_")
                moments = normalizer.obs_rms if kind == "obs" else normalizer.ret_rms
                setattr(moments, part, value if part != "count" else float(value))

    apply(take, file)
