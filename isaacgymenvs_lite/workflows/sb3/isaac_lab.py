"""Isaac Lab's agent files for Stable-Baselines3: all keys in one section, classes by their names.

n_timesteps: 1.0e6
policy: MlpPolicy
n_steps: 16
batch_size: 4096
policy_kwargs: {activation_fn: nn.ELU, net_arch: [32, 32]}
normalize_input: True
"""

from __future__ import annotations

import inspect
import logging
import math
from collections.abc import Mapping
from typing import Any

from stable_baselines3 import PPO

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.wrappers.sb3_settings import read_policy_kwargs

log = logging.getLogger(__name__)

_POLICY = "MlpPolicy"
# SB3's own defaults for what a file leaves out.
_N_STEPS, _BATCH_SIZE = 2048, 64
_CLIP_OBS = 100.0  # Isaac Lab's
_OWN_KEYS = ("max_iterations", "checkpoint_interval", "seed")
_FLAT_KEYS = (
    *("n_timesteps", "policy", "policy_kwargs", "n_minibatches", "device"),
    *("normalize_input", "normalize_value", "clip_obs"),
)
# Arguments of PPO that a file cannot set.
_NOT_KEYS = (
    *("env", "tensorboard_log", "_init_setup_model"),
    *("rollout_buffer_class", "rollout_buffer_kwargs"),
)


def is_flat(content: Mapping[str, Any]) -> bool:
    """Whether an agent file is one of Isaac Lab's."""
    signs = ("n_timesteps", "n_steps", "policy_kwargs")
    return "ppo" not in content and any(key in content for key in signs)


def to_sections(content: Mapping[str, Any], num_envs: int) -> dict[str, Any]:
    """Return the content of Isaac Lab's agent file in the sections of ours.

    Args:
        content: of the file.
        num_envs: of the training; `n_timesteps` and `n_minibatches` count for all environments.

    Raises:
        ConfigError: an unknown key, or a value that cannot be used.
    """
    arguments = [
        name for name in inspect.signature(PPO).parameters if name not in (*_NOT_KEYS, *_FLAT_KEYS)
    ]
    for key in content:
        if key not in (*arguments, *_FLAT_KEYS, *_OWN_KEYS):
            names = {*arguments, *_FLAT_KEYS, *_OWN_KEYS}
            raise ConfigError(unknown("key of agent", str(key), names))
    if content.get("policy", _POLICY) != _POLICY:
        raise ConfigError(f"agent.policy: got {content['policy']!r}, expected {_POLICY}")
    if "device" in content:
        log.info("agent.device is not read: rl_device=cuda:0 puts the networks on a GPU")
    own = (*_OWN_KEYS, "batch_size")
    ppo = {name: content[name] for name in arguments if name in content and name not in own}
    ppo.setdefault("n_steps", _N_STEPS)
    sections: dict[str, Any] = {
        "checkpoint_interval": content.get("checkpoint_interval", 50),
        "max_iterations": _iterations(content, num_envs),
        "ppo": ppo,
        "policy": _policy(content.get("policy_kwargs") or {}),
        "vec_normalize": _normalizer(content),
    }
    if "n_minibatches" in content:
        sections["minibatches"] = content["n_minibatches"]
    else:
        sections["batch_size"] = content.get("batch_size", _BATCH_SIZE)
    return sections


def _iterations(content: Mapping[str, Any], num_envs: int) -> Any:
    if "max_iterations" in content:
        return content["max_iterations"]
    frames = _number(content, "n_timesteps", None)
    return max(1, math.ceil(frames / (_number(content, "n_steps", _N_STEPS) * num_envs)))


def _number(content: Mapping[str, Any], key: str, default: float | None) -> float:
    value = content.get(key, default)
    fits = isinstance(value, int | float) and not isinstance(value, bool) and 1 <= value < math.inf
    if not fits:
        raise ConfigError(f"agent.{key}: got {value!r}, expected a number >= 1")
    return value


def _normalizer(content: Mapping[str, Any]) -> dict[str, Any] | None:
    if not content.get("normalize_input", False):
        if content.get("normalize_value", False):
            log.warning("agent.normalize_value does nothing without normalize_input, as published")
        return None
    return {
        "norm_obs": True,
        "norm_reward": content.get("normalize_value", False),
        "clip_obs": content.get("clip_obs", _CLIP_OBS),
        "clip_reward": math.inf,
    }


def _policy(arguments: Any) -> dict[str, Any]:
    """Return `policy_kwargs` with our name of the activation."""
    policy = read_policy_kwargs(arguments)
    name = policy.pop("activation_fn", "Tanh").lower()  # SB3's own
    policy["activation"] = "leaky_relu" if name == "leakyrelu" else name
    return policy
