"""Estimates the memory of a training from its settings and the sizes of its task."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

from isaacgymenvs_lite.env_interface import Env
from isaacgymenvs_lite.simulation.backend import bytes_of_env
from isaacgymenvs_lite.utils.memory import check_memory

_FLOAT_BYTES = 4
# Weights, gradients, and Adam's two moments.
_COPIES_IN_TRAINING = 4
# The rollout, and the training set that is made of it.
_COPIES_OF_SAMPLES = 2
_GATES = {"lstm": 4, "gru": 3}


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
    samples = num_envs * task.num_agents * config.get("horizon_length", 0)
    replayed = config.get("replay_buffer_size", 0) * (2 * task.num_obs + task.num_actions + 2)
    amp_rows = config.get("amp_replay_buffer_size", 0) + config.get("amp_obs_demo_buffer_size", 0)
    networks = _parameters(params["network"], task.num_obs)
    check_memory(
        {
            "simulations": num_envs * bytes_of_env(task.simulation.model),
            "samples of an epoch": _FLOAT_BYTES * _COPIES_OF_SAMPLES * samples * rows,
            "replay buffers": _FLOAT_BYTES * (replayed + amp_rows * amp_size),
            "networks": _FLOAT_BYTES * _COPIES_IN_TRAINING * networks,
        },
        f"num_envs ({num_envs} now), horizon_length, the replay buffers or units in train.params",
    )


def check_play_memory(params: Mapping[str, Any], task: Any) -> None:
    """Refuse networks that cannot fit into memory, before they are made to be played.

    Raises:
        ConfigError: they exceed the machine's memory.
    """
    networks = _FLOAT_BYTES * _parameters(params["network"], task.num_obs)
    check_memory({"networks": networks}, "units in train.params.network")


def _row_size(task: Env) -> int:
    """Return the numbers of a sample: observation, states, action with its distribution, others."""
    return task.num_obs + task.num_states + 3 * task.num_actions + 4


def _parameters(network: Mapping[str, Any], num_inputs: int) -> int:
    """Return how many weights the hidden layers have at least, also of networks in networks."""
    count = 0
    for section in network.values():
        if not isinstance(section, Mapping):
            continue
        units = section.get("units")
        if isinstance(units, int):  # recurrent
            gates = _GATES.get(str(section.get("name")), 0)
            count += gates * units * units * int(section.get("layers", 1))
        elif isinstance(units, (list, tuple)):
            count += sum(a * b for a, b in itertools.pairwise(units))
    units = (network.get("mlp") or {}).get("units")
    return count + (num_inputs * units[0] if units else 0)
