# pyright: reportMissingImports=false
"""PPO of Stable-Baselines3 on a task, with our agent files or Isaac Lab's agent files.

A user can load the statistics of a normalised environment without loading the agent:

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

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.schema import keys_of, read_keys, setting
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.workflows import library
from isaacgymenvs_lite.wrappers.sb3 import Sb3VecEnvWrapper, process_sb3_cfg, read_schedules

# Arguments of PPO that an agent file must not set, because they could name code or files.
_RESERVED = ("tensorboard_log", "rollout_buffer_class", "rollout_buffer_kwargs")
_RESERVED_POLICY = ("features_extractor_class", "features_extractor_kwargs", "optimizer_class")
_OWN_KEYS = ("checkpoint_interval", "seed", "batch_size")
_N_STEPS = 2048  # PPO's default


@dataclass(frozen=True, kw_only=True)
class Sb3Settings(library.AgentSettings):
    """The content of an agent file for Stable-Baselines3."""

    minibatches: int | None = setting(None, minimum=1)
    """Number of minibatches in an epoch."""
    batch_size: int | None = setting(None, minimum=2)
    """Number of rows in a minibatch, which can replace `minibatches`."""
    ppo: dict[str, Any] = setting()
    """Arguments of PPO."""
    policy: dict[str, Any] = setting()
    """Arguments of ActorCriticPolicy; the activation is the name of a class."""
    vec_normalize: dict[str, Any] | None = setting(None)
    """Arguments of VecNormalize, or None to use no VecNormalize."""


@dataclass(frozen=True, kw_only=True)
class FlatSettings:
    """The keys of Isaac Lab's agent files that are not arguments of PPO."""

    policy: str = setting("MlpPolicy", choices=("MlpPolicy",))
    n_timesteps: float = setting(1.0, minimum=1, maximum=1e15)
    """Number of control steps, summed over all environments."""
    max_iterations: int | None = setting(None, minimum=1)
    """Number of iterations, which replaces `n_timesteps`."""
    normalize_input: bool = setting(False)
    normalize_value: bool = setting(False)
    clip_obs: float = setting(100.0)
    policy_kwargs: Any = setting(None)
    device: Any = setting(None)
    """A key without effect, because rl_device= determines the device of the networks."""


class Agent(library.Agent):
    """PPO, with `VecNormalize` around the environment if the agent file has `vec_normalize`.

    The checkpoints are `checkpoints/model_<steps>.zip`, and `model.zip` at the end of the training;
    `PPO.load` can read them. A `.npz` file of the same name contains the normalisers' statistics.
    """

    def __init__(self, task: VecTask, content: dict[str, Any], device: str, seed: int) -> None:
        if "ppo" not in content and {"n_timesteps", "n_steps", "policy_kwargs"} & content.keys():
            content = to_sections(content, task.num_envs)
        self._settings = settings = library.read_agent(Sb3Settings, content)
        ppo = read_schedules(settings.ppo, "agent.ppo")
        policy = dict(settings.policy)
        activation = library.activation_class(policy.pop("activation", "elu"))
        library.check_arguments(PPO, ppo, "agent.ppo", _RESERVED)
        library.check_arguments(ActorCriticPolicy, policy, "agent.policy", _RESERVED_POLICY)
        if (settings.minibatches is None) == (settings.batch_size is None):
            raise ConfigError("agent: expected either minibatches, of an epoch, or batch_size")
        rows = ppo.get("n_steps", _N_STEPS) * task.num_envs // (settings.minibatches or 1)
        self.minibatch_rows = settings.batch_size or max(2, rows)
        self.env: VecEnv = Sb3VecEnvWrapper(task)
        self.stepper = self.env.stepper
        self.normalizer: VecNormalize | None = None
        if settings.vec_normalize is not None:
            arguments = settings.vec_normalize
            library.check_arguments(VecNormalize, arguments, "agent.vec_normalize")
            gamma = ppo.get("gamma", 0.99)
            self.env = self.normalizer = VecNormalize(self.env, gamma=gamma, **arguments)
        self.model = PPO(
            "MlpPolicy",
            self.env,
            batch_size=self.minibatch_rows,
            policy_kwargs={**policy, "activation_fn": activation},
            seed=seed,
            device=device,
            **ppo,
        )
        self.networks = (self.model.policy,)

    def learn(self, folder: Path, log_interval: int | None) -> None:
        """See `library.Agent`; the last checkpoint is `model.zip`."""
        self.model.set_logger(configure(str(folder), ["stdout", "tensorboard"]))
        frames = self.model.n_steps * self.stepper.num_envs
        save = ConvertCallback(lambda *_: bool(self.save(folder)))
        callbacks: list[BaseCallback] = [
            EveryNTimesteps(self._settings.checkpoint_interval * frames, save)
        ]
        if log_interval is not None:
            callbacks.append(LogEveryNTimesteps(log_interval))
        self.model.learn(
            self._settings.max_iterations * frames,
            callback=callbacks,
            log_interval=1 if log_interval is None else None,  # type: ignore[arg-type]
        )
        self._save(folder / "model.zip")

    def save(self, folder: Path) -> Path:
        """Write a checkpoint, and the statistics of a normalised environment; return the path."""
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
        with library.loading(checkpoint, "sb3"):
            # load_data is False, because Stable-Baselines3 unpickles the data.
            found = load_from_zip_file(checkpoint, load_data=False, device=self.model.device)
            self.model.set_parameters(found[1], exact_match=True)
        if self.normalizer is not None:
            load_statistics(self.normalizer, checkpoint.with_suffix(".npz"))

    def policy(self) -> Callable[[Any], Any]:
        """See `library.Agent`."""
        if self.normalizer is not None:
            self.normalizer.training = False
        return lambda observations: self.model.predict(observations, deterministic=True)[0]


def to_sections(content: Mapping[str, Any], num_envs: int) -> dict[str, Any]:
    """Convert Isaac Lab's agent file, which has one section, to the sections of our agent files."""
    ppo = {"batch_size": 64, "n_steps": _N_STEPS} | process_sb3_cfg(content, num_envs)
    flat = read_keys(FlatSettings, ppo, "agent")
    policy = dict(flat.policy_kwargs or {})
    activation = policy.pop("activation_fn", None)
    policy["activation"] = "tanh" if activation is None else activation.__name__.lower()
    own = {key: ppo.pop(key) for key in _OWN_KEYS if key in ppo}
    library.check_arguments(PPO, {"n_steps": ppo["n_steps"]}, "agent")
    iterations = math.ceil(flat.n_timesteps / (ppo["n_steps"] * num_envs))
    normalizer = {
        "norm_obs": True,
        "norm_reward": flat.normalize_value,
        "clip_obs": flat.clip_obs,
        "clip_reward": math.inf,
    }
    return {
        "checkpoint_interval": 50,
        **own,
        "max_iterations": flat.max_iterations or iterations,
        "ppo": {key: value for key, value in ppo.items() if key not in keys_of(FlatSettings)},
        "policy": policy,
        "vec_normalize": normalizer if flat.normalize_input else None,
    }


def save_statistics(normalizer: VecNormalize, file: str | Path) -> None:
    """Write mean, variance and count of observations and returns to an `.npz` file.

    This function replaces `VecNormalize.save`, whose files are pickles and can run code when read.
    """
    np.savez(Path(file), **{name: getattr(*place) for name, place in _moments(normalizer).items()})


def load_statistics(normalizer: VecNormalize, file: str | Path) -> None:
    """Load statistics from a file; run no code from the file."""
    with library.loading(file, "sb3"), np.load(file, allow_pickle=False) as saved:
        for name, (moments, part) in _moments(normalizer).items():
            value, shape = saved[name], np.shape(getattr(moments, part))
            if value.shape != shape:
                raise ValueError(f"{name} has shape {value.shape}, not {shape}")
            setattr(moments, part, float(value) if part == "count" else value)


def _moments(normalizer: VecNormalize) -> dict[str, tuple[Any, str]]:
    """Map each array's name in the file to the object and attribute that contain the array."""
    moments: dict[str, Any] = {"ret": normalizer.ret_rms}
    if normalizer.norm_obs:
        moments["obs"] = normalizer.obs_rms
    return {
        f"{name}_{part}": (statistics, part)
        for name, statistics in moments.items()
        for part in ("mean", "var", "count")
    }
