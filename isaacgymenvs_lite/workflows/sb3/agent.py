# pyright: reportMissingImports=false
"""PPO of Stable-Baselines3 on a task, with agent files of ours and of Isaac Lab.

A user can load the statistics of a normalised environment without the agent:

    env = VecNormalize(Sb3VecEnvWrapper(task))
    load_statistics(env, "logs/sb3/Ant/<date>/model.npz")
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import (
    BaseCallback,
    ConvertCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
)
from stable_baselines3.common.logger import configure
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.workflows import library
from isaacgymenvs_lite.workflows.agent_files import (
    AgentSettings,
    activation_class,
    check_arguments,
    constructing,
    is_number,
    read_agent,
    whole_number,
)
from isaacgymenvs_lite.wrappers.sb3 import Sb3VecEnvWrapper
from isaacgymenvs_lite.wrappers.sb3_settings import process_sb3_cfg, read_schedules

_TITLE = "Stable-Baselines3"
# Set by the workflow, or able to name code.
_RESERVED = (
    *("policy", "env", "seed", "device", "batch_size", "policy_kwargs"),
    *("tensorboard_log", "_init_setup_model", "rollout_buffer_class", "rollout_buffer_kwargs"),
)
_RESERVED_POLICY = (
    *("observation_space", "action_space", "lr_schedule", "activation_fn"),
    *("features_extractor_class", "features_extractor_kwargs", "optimizer_class"),
)
_OWN_KEYS = ("max_iterations", "checkpoint_interval", "seed", "batch_size")
_CLIP_OBS = 100.0  # Isaac Lab's


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


class Agent(library.Agent):
    """PPO, with `VecNormalize` around the environment if the agent file has `vec_normalize`.

    Checkpoints are `checkpoints/model_<steps>.zip` and at the end `model.zip`, for `PPO.load`, each
    with a `.npz` beside it that holds the normalisers' statistics.

    Args:
        task: the task.
        content: of an agent file, ours or Isaac Lab's.
        device: of the networks.
        seed: of the agent.

    Attributes:
        model: the algorithm.
        normalizer: around the environment, or None.

    Raises:
        ConfigError: a key of the agent file that cannot be used.
    """

    def __init__(self, task: VecTask, content: dict[str, Any], device: str, seed: int) -> None:
        if "ppo" not in content and {"n_timesteps", "n_steps", "policy_kwargs"} & content.keys():
            content = to_sections(content, task.num_envs)
        settings = read_agent(Sb3Settings, content)
        self.max_iterations = settings.max_iterations
        self._interval = settings.checkpoint_interval
        adapter = Sb3VecEnvWrapper(task)
        self.stepper = adapter.stepper
        ppo = read_schedules(settings.ppo, "agent.ppo")
        check_arguments(PPO, ppo, "agent.ppo", _RESERVED)
        steps = whole_number(ppo, "n_steps", "agent.ppo")
        if (settings.minibatches is None) == (settings.batch_size is None):
            raise ConfigError("agent: expected either minibatches, of an epoch, or batch_size")
        rows = max(2, steps * task.num_envs // (settings.minibatches or 1))
        self.minibatch_rows = settings.batch_size or rows
        policy = dict(settings.policy)
        function = activation_class(policy.pop("activation", "elu"))
        check_arguments(ActorCriticPolicy, policy, "agent.policy", _RESERVED_POLICY)
        self.normalizer: VecNormalize | None = None
        normalize = settings.vec_normalize
        if normalize is not None:
            check_arguments(VecNormalize, normalize, "agent.vec_normalize", ("venv", "gamma"))
            with constructing("VecNormalize"):
                self.normalizer = VecNormalize(adapter, gamma=ppo.get("gamma", 0.99), **normalize)
        self._env: VecEnv = self.normalizer or adapter
        with constructing("PPO"):
            self.model = PPO(
                "MlpPolicy",
                self._env,
                batch_size=self.minibatch_rows,
                policy_kwargs={**policy, "activation_fn": function},
                seed=seed,
                device=device,
                **ppo,
            )
        self.num_parameters = library.count_parameters([self.model.policy])

    def learn(self, folder: Path, log_interval: int | None = None) -> None:
        """See `library.Agent`; the last checkpoint is `model.zip`."""
        self.model.set_logger(configure(str(folder), ["stdout", "tensorboard"]))
        frames = self.model.n_steps * self.stepper.num_envs

        def save(*_: Any) -> bool:
            self.save(folder)
            return True

        callbacks: list[BaseCallback] = [
            EveryNTimesteps(self._interval * frames, ConvertCallback(save))
        ]
        interval: Any = 1
        if log_interval is not None:
            callbacks.append(LogEveryNTimesteps(log_interval))
            interval = None
        total = self.max_iterations * frames
        self.model.learn(total, callback=callbacks, log_interval=interval)
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
        with library.loading(checkpoint, _TITLE):
            # load_data=False: the data would be unpickled.
            found = load_from_zip_file(checkpoint, load_data=False, device=self.model.device)
            self.model.set_parameters(found[1], exact_match=True)
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


def to_sections(content: Mapping[str, Any], num_envs: int) -> dict[str, Any]:
    """Return Isaac Lab's agent file, whose keys are in one section, in the sections of ours.

    Args:
        content: of the file.
        num_envs: of the training; `n_timesteps` counts the frames of all environments.

    Raises:
        ConfigError: a value that cannot be used.
    """
    ppo: dict[str, Any] = {"n_steps": 2048, "batch_size": 64}  # Stable-Baselines3's own
    ppo |= process_sb3_cfg(content, num_envs)
    policy = dict(ppo.pop("policy_kwargs", {}))
    policy["activation"] = policy.pop("activation_fn", activation_class("tanh")).__name__.lower()
    frames, name = ppo.pop("n_timesteps", None), ppo.pop("policy", "MlpPolicy")
    ppo.pop("device", None)  # rl_device= says where the networks are
    is_normalized = ppo.pop("normalize_input", False)
    normalizer = {
        "norm_obs": True,
        "norm_reward": ppo.pop("normalize_value", False),
        "clip_obs": ppo.pop("clip_obs", _CLIP_OBS),
        "clip_reward": math.inf,
    }
    own = {key: ppo.pop(key) for key in _OWN_KEYS if key in ppo}
    if name != "MlpPolicy":
        raise ConfigError(f"agent.policy: got {name!r}, expected MlpPolicy")
    if "max_iterations" not in own:
        if not is_number(frames) or not 1 <= frames < math.inf:
            raise ConfigError(f"agent.n_timesteps: got {frames!r}, expected a number >= 1")
        rollout = whole_number(ppo, "n_steps", "agent") * num_envs
        own["max_iterations"] = max(1, math.ceil(frames / rollout))
    return {
        "checkpoint_interval": 50,
        **own,
        "ppo": ppo,
        "policy": policy,
        "vec_normalize": normalizer if is_normalized else None,
    }


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
    with library.loading(file, _TITLE), np.load(file, allow_pickle=False) as saved:
        for name, own in _statistics(normalizer).items():
            value = saved[name]
            if value.shape != np.shape(own):
                raise ValueError(f"{name} has shape {value.shape}, not {np.shape(own)}")
            kind, part = name.split("_")
            moments = normalizer.obs_rms if kind == "obs" else normalizer.ret_rms
            setattr(moments, part, value if part != "count" else float(value))


def _statistics(normalizer: VecNormalize) -> dict[str, Any]:
    named = {"obs": normalizer.obs_rms, "ret": normalizer.ret_rms}
    return {
        f"{name}_{part}": getattr(moments, part)
        for name, moments in named.items()
        if normalizer.norm_obs or name == "ret"
        for part in ("mean", "var", "count")
    }
