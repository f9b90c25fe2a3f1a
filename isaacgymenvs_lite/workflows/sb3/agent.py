# pyright: reportMissingImports=false
"""PPO of Stable-Baselines3 on a task.

A user can load the statistics of a normalised environment without the agent:

    env = VecNormalize(Sb3VecEnvWrapper(task))
    load_statistics(env, "logs/sb3/Ant/<date>/model.npz")
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, LogEveryNTimesteps
from stable_baselines3.common.logger import configure
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.schema import read_section, setting
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.workflows.agent_files import (
    AgentSettings,
    activation_class,
    check_arguments,
    check_keys,
    constructing,
)
from isaacgymenvs_lite.workflows.library import load_into, read_parameters
from isaacgymenvs_lite.workflows.sb3 import LIBRARY
from isaacgymenvs_lite.workflows.sb3.isaac_lab import is_flat, to_sections
from isaacgymenvs_lite.wrappers.sb3 import Sb3VecEnvWrapper
from isaacgymenvs_lite.wrappers.sb3_settings import SCHEDULED, read_schedule

# Set by the workflow, or able to name code.
_RESERVED = (
    *("policy", "env", "seed", "device", "batch_size", "policy_kwargs"),
    *("tensorboard_log", "_init_setup_model", "rollout_buffer_class", "rollout_buffer_kwargs"),
)
_RESERVED_POLICY = (
    *("observation_space", "action_space", "lr_schedule", "activation_fn"),
    *("features_extractor_class", "features_extractor_kwargs", "optimizer_class"),
)


@dataclass(frozen=True, kw_only=True)
class Sb3Settings(AgentSettings):
    """An agent file."""

    minibatches: int | None = setting(None, minimum=1)
    """Of an epoch."""
    batch_size: int | None = setting(None, minimum=2)
    """Rows of a minibatch, in place of `minibatches`."""
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
    """PPO, with `VecNormalize` around the environment if the agent file has `vec_normalize`.

    Checkpoints are `checkpoints/model_<steps>.zip` and at the end `model.zip`, for `PPO.load`, each
    with a `.npz` beside it that holds the normalisers' statistics.

    Args:
        task: the task.
        content: of an agent file, ours or Isaac Lab's.
        device: of the networks.
        seed: of the agent.

    Attributes:
        stepper: steps the task.
        model: the algorithm.
        max_iterations: see `library.Agent`.
        minibatch_rows: see `library.Agent`.
        num_parameters: see `library.Agent`.
        normalizer: around the environment, or None.

    Raises:
        ConfigError: a key of the agent file that cannot be used.
    """

    def __init__(self, task: VecTask, content: dict[str, Any], device: str, seed: int) -> None:
        if is_flat(content):
            content = to_sections(content, task.num_envs)
        sections = {"ppo": PPO, "policy": ActorCriticPolicy, "vec_normalize": VecNormalize}
        check_keys(Sb3Settings, content, "agent", sections)
        settings = read_section(Sb3Settings, content, "agent", complete=True)
        self.max_iterations = settings.max_iterations
        self._interval = settings.checkpoint_interval
        adapter = Sb3VecEnvWrapper(task)
        self.stepper = adapter.stepper
        self.normalizer = _make_normalizer(settings, adapter)
        self._env: VecEnv = self.normalizer or adapter
        arguments = _ppo_arguments(settings)
        self.minibatch_rows = _minibatch_rows(settings, task.num_envs)
        function = activation_class(settings.policy.get("activation", "elu"))
        policy = {k: v for k, v in settings.policy.items() if k != "activation"}
        check_arguments(ActorCriticPolicy, policy, "agent.policy", _RESERVED_POLICY)
        with constructing("PPO"):
            self.model = PPO(
                "MlpPolicy",
                self._env,
                batch_size=self.minibatch_rows,
                policy_kwargs={**policy, "activation_fn": function},
                seed=seed,
                device=device,
                **arguments,
            )
        self.num_parameters = sum(p.numel() for p in self.model.policy.parameters())

    def learn(self, folder: Path, log_interval: int | None = None) -> None:
        """See `library.Agent`; the last checkpoint is `model.zip`."""
        self.model.set_logger(configure(str(folder), ["stdout", "tensorboard"]))
        steps = self.max_iterations * self.model.n_steps * self.stepper.num_envs
        callbacks: list[BaseCallback] = [_Saver(self, folder, self._interval)]
        if log_interval is None:
            self.model.learn(steps, callback=callbacks)
        else:
            callbacks.append(LogEveryNTimesteps(log_interval))
            self.model.learn(steps, callback=callbacks, log_interval=None)  # type: ignore[arg-type]
        self._save(folder / "model.zip")

    def save(self, folder: Path) -> Path:
        """See `library.Agent`; also writes the statistics of a normalised environment, `.npz`."""
        path = folder / "checkpoints" / f"model_{self.model.num_timesteps}.zip"
        path.parent.mkdir(exist_ok=True)
        self._save(path)
        return path

    def _save(self, path: Path) -> None:
        self.model.save(path)
        if self.normalizer is not None:
            save_statistics(self.normalizer, path.with_suffix(".npz"))

    def load(self, checkpoint: Path) -> None:
        """See `library.Agent`."""
        read_parameters(checkpoint, LIBRARY)
        # load_data=False: the data would be unpickled.
        _, parameters, _ = load_from_zip_file(checkpoint, load_data=False, device=self.model.device)
        load_into(lambda: self.model.set_parameters(parameters, exact_match=True), checkpoint)
        if self.normalizer is not None:
            statistics = checkpoint.with_suffix(".npz")
            if not statistics.is_file():
                raise CheckpointError(
                    f"checkpoint={checkpoint}: the agent file has vec_normalize, and there are no"
                    f" statistics beside it: {statistics.name} is missing"
                )
            load_statistics(self.normalizer, statistics)

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


def _make_normalizer(settings: Sb3Settings, env: VecEnv) -> VecNormalize | None:
    normalize = settings.vec_normalize
    if normalize is None:
        return None
    check_arguments(VecNormalize, normalize, "agent.vec_normalize", ("venv", "gamma"))
    gamma = settings.ppo.get("gamma", 0.99)
    with constructing("VecNormalize"):
        return VecNormalize(env, gamma=float(gamma), **normalize)


def _ppo_arguments(settings: Sb3Settings) -> dict[str, Any]:
    """Return the section `ppo` with schedules as functions.

    Raises:
        ConfigError: a key or a value that cannot be used.
    """
    arguments = dict(settings.ppo)
    schedules: dict[str, LinearSchedule] = {}
    for key in SCHEDULED:
        value = read_schedule(arguments.get(key), f"agent.ppo.{key}")
        if isinstance(value, LinearSchedule):
            schedules[key] = value
            arguments[key] = value.start
    check_arguments(PPO, arguments, "agent.ppo", _RESERVED)
    return arguments | schedules


def _minibatch_rows(settings: Sb3Settings, num_envs: int) -> int:
    """Return the rows of a minibatch.

    Raises:
        ConfigError: the agent file has both keys for it, or none.
    """
    if (settings.minibatches is None) == (settings.batch_size is None):
        raise ConfigError("agent: expected either minibatches, of an epoch, or batch_size, in rows")
    if settings.batch_size is not None:
        return settings.batch_size
    rollout = read_section(_Rollout, settings.ppo, "agent.ppo", ignored=settings.ppo)
    return max(2, rollout.n_steps * num_envs // (settings.minibatches or 1))


def save_statistics(normalizer: VecNormalize, file: str | Path) -> None:
    """Write mean, variance and count of observations and returns to an `.npz` file.

    `VecNormalize.save` pickles the object, and reading a pickle can run code.
    """
    np.savez(Path(file), **_statistics(normalizer))


def load_statistics(normalizer: VecNormalize, file: str | Path) -> None:
    """Load statistics from a file, without running code from it.

    Raises:
        CheckpointError: they belong to other observations, or the file is damaged.
    """

    def assign() -> None:
        with np.load(file, allow_pickle=False) as saved:
            for name, own in _statistics(normalizer).items():
                value = saved[name]
                if value.shape != np.shape(own):
                    raise ValueError(f"{name} has shape {value.shape}, not {np.shape(own)}")
                kind, part = name.split("_")
                moments = normalizer.obs_rms if kind == "obs" else normalizer.ret_rms
                setattr(moments, part, value if part != "count" else float(value))

    load_into(assign, Path(file))


def _statistics(normalizer: VecNormalize) -> dict[str, Any]:
    named = {"obs": normalizer.obs_rms, "ret": normalizer.ret_rms}
    return {
        f"{name}_{part}": getattr(moments, part)
        for name, moments in named.items()
        if normalizer.norm_obs or name == "ret"
        for part in ("mean", "var", "count")
    }
