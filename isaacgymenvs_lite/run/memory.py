"""Estimates the memory of a training from its settings and the dimensions of its task."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

from isaacgymenvs_lite.simulation.backend import bytes_of_env
from isaacgymenvs_lite.utils.memory import check_memory

_FLOAT_BYTES = 4
_COPIES_IN_TRAINING = 4  # weights, gradients, and two averages in Adam
_COPIES_OF_SAMPLES = 2  # the rollout and the training set


def check_training_memory(params: Mapping[str, Any], task: Any, num_envs: int) -> None:
    """Refuse a training that does not fit into this machine's memory.

    Args:
        params: the checked section `params` of the train file.
        task: a task with the dimensions of the training's task.
        num_envs: number of environments of the training.
    """
    config, network = params["config"], params["network"]
    if str(config.get("device")).startswith("cuda"):
        return  # the samples are in the GPU's memory, which is not checked

    def count(key: str) -> int:  # the agent refuses a wrong value later
        return value if isinstance(value := config.get(key), int) else 0

    amp_size = getattr(task, "num_amp_obs", 0) if "amp_replay_buffer_size" in config else 0
    # A row contains observation, states, action with its distribution, and four scalars.
    row = task.num_obs + task.num_states + 3 * task.num_actions + 4 + amp_size
    samples = num_envs * task.num_agents * count("horizon_length")
    replayed = count("replay_buffer_size") * (2 * task.num_obs + task.num_actions + 2)
    amp_rows = count("amp_replay_buffer_size") + count("amp_obs_demo_buffer_size")
    layers = [(network.get(name) or {}).get("units", []) for name in ("mlp", "disc", "enc")]
    weights = sum(a * b for units in layers for a, b in itertools.pairwise(units))
    check_memory(
        {
            "simulations": num_envs * bytes_of_env(task.simulation.model),
            "samples of an epoch": _FLOAT_BYTES * _COPIES_OF_SAMPLES * samples * row,
            "replay buffers": _FLOAT_BYTES * (replayed + amp_rows * amp_size),
            "networks": _FLOAT_BYTES * _COPIES_IN_TRAINING * weights,
        },
        f"num_envs ({num_envs} now), horizon_length, the replay buffers or units in train.params",
    )
