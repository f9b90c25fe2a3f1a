"""Estimates the memory of a training from its settings and the sizes of its task."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from isaacgymenvs_lite.config.rl_games_settings import num_weights
from isaacgymenvs_lite.simulation.backend import bytes_of_env
from isaacgymenvs_lite.utils.memory import check_memory

_FLOAT_BYTES = 4
# Weights, gradients, and Adam's two moments.
_COPIES_IN_TRAINING = 4
# The rollout, and the training set that is made of it.
_COPIES_OF_SAMPLES = 2


def check_training_memory(params: Mapping[str, Any], task: Any, num_envs: int) -> None:
    """Refuse a training that cannot fit into memory.

    Args:
        params: the checked section `params` of the train file.
        task: of any number of environments; its sizes count.
        num_envs: of the training.

    Raises:
        ConfigError: simulations, samples, replay buffers and networks exceed the machine's memory.
    """
    config = params["config"]
    if str(config.get("device")).startswith("cuda"):
        return  # that memory is the GPU's; the simulations' is checked where they are made
    amp_size = getattr(task, "num_amp_obs", 0) if "amp_replay_buffer_size" in config else 0
    rows = _row_size(task) + amp_size
    samples = num_envs * task.num_agents * _count(config, "horizon_length")
    replayed = _count(config, "replay_buffer_size") * (2 * task.num_obs + task.num_actions + 2)
    amp_rows = sum(_count(config, f"amp_{kind}_buffer_size") for kind in ("replay", "obs_demo"))
    networks = num_weights(params["network"], task.num_obs)
    check_memory(
        {
            "simulations": num_envs * bytes_of_env(task.simulation.model),
            "samples of an epoch": _FLOAT_BYTES * _COPIES_OF_SAMPLES * samples * rows,
            "replay buffers": _FLOAT_BYTES * (replayed + amp_rows * amp_size),
            "networks": _FLOAT_BYTES * _COPIES_IN_TRAINING * networks,
        },
        f"num_envs ({num_envs} now), horizon_length, the replay buffers or units in train.params",
    )


def _count(config: Mapping[str, Any], key: str) -> int:
    """Return a key of an agent, which checks it later."""
    value = config.get(key)
    return value if isinstance(value, int) else 0


def _row_size(task: Any) -> int:
    """Return the numbers of a sample: observation, states, action with its distribution, others."""
    return task.num_obs + task.num_states + 3 * task.num_actions + 4
