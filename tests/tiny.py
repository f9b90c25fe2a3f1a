"""Settings that make tasks and trainings small enough for a test.

All are words of a command line; of a key that is given twice the last value counts:
`compose(["task=HumanoidAMP", *TINY_AMP, "max_iterations=1"])`.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.runner import run

CONFIG = "train.params.config"


def fast_and_slow(cases: Mapping[str, Any], *fast: str) -> list[Any]:
    """Return the cases of a parametrised test by their ids; all but the fast ones are slow."""
    return [
        pytest.param(case, id=name, marks=() if name in fast else pytest.mark.slow)
        for name, case in cases.items()
    ]


ONE_THREAD = ("num_threads=1", "rl_device=cpu")

NOT_MEASURED = f"++{CONFIG}.imitation_frequency=0"
"""No episodes of the mean policy, which take longer than a tiny training."""

TINY_PPO = (
    NOT_MEASURED,
    "num_envs=4",
    *ONE_THREAD,
    "max_iterations=2",
    "train.params.network.mlp.units=[16,8]",
    f"{CONFIG}.mixed_precision=False",
    f"{CONFIG}.horizon_length=4",
    f"{CONFIG}.mini_epochs=1",
)
"""Of PPO and the high level of HRL: two epochs of 16 samples."""

TINY_DISCRIMINATOR = (
    "train.params.network.disc.units=[12,6]",
    f"{CONFIG}.amp_batch_size=16",
    f"{CONFIG}.amp_obs_demo_buffer_size=16",
    f"{CONFIG}.amp_replay_buffer_size=64",
)

TINY_AMP = (*TINY_PPO, *TINY_DISCRIMINATOR)
"""What AMP needs: TINY_PPO and a small discriminator."""

TINY_STYLE = ("train.params.network.style.units=[10,6]", f"{CONFIG}.warm_start_steps=0")
"""What ASE needs beside TINY_AMP."""

TINY_LSTM = (
    NOT_MEASURED,
    *("task=Cartpole", "train=AnymalTerrainPPO_LSTM", "num_envs=16", "max_iterations=2"),
    "train.params.network.rnn.units=8",
    "train.params.network.mlp.units=[16]",
    f"{CONFIG}.mini_epochs=2",
    f"{CONFIG}.mixed_precision=False",
)
"""A task with a recurrent policy."""

ASYMMETRIC_CRITIC = (
    "{minibatch_size: 32768, mini_epochs: 1, learning_rate: '1e-3', clip_value: True,"
    " normalize_input: True, network: {name: actor_critic, central_value: True,"
    " mlp: {units: [8], activation: elu, initializer: {name: default}}}}"
)
"""The section of an asymmetric critic, complete."""

TINY_SAC = (
    NOT_MEASURED,
    *("task=AntSAC", "train=AntSAC", "num_envs=8"),
    f"{CONFIG}.batch_size=64",
    f"{CONFIG}.num_warmup_steps=2",
    f"{CONFIG}.replay_buffer_size=2000",
    f"{CONFIG}.mixed_precision=False",
    "train.params.network.mlp.units=[32,32]",
)
"""The task of SAC; updates begin in the second epoch."""

TINY_PBT = (
    *("task=Ant", *TINY_PPO, "num_envs=8", "task.env.episodeLength=8", "max_iterations=12"),
    *("pbt=pbt_default", "pbt.num_policies=2", "pbt.workspace=ws", "pbt.mutation_rate=1.0"),
    *("pbt.interval_steps=128", "pbt.start_after=0", "pbt.initial_delay=0"),
)
"""A policy of two; every epoch has 32 environment steps, every fourth one compares."""

DOWNHILL, UPHILL = "task.sim.gravity=[40,0,-9.81]", "task.sim.gravity=[-40,0,-9.81]"
"""What makes the objective of Ant, its speed along x, clearly good or clearly bad."""


def composed(words: Sequence[str]) -> DictConfig:
    """Return what `compose` does; the same words are composed once in a process."""
    return copy.deepcopy(_compose_once(tuple(words)))


@functools.lru_cache(maxsize=128)
def _compose_once(words: tuple[str, ...]) -> DictConfig:
    return compose(words)


def train_in(folder: Path, words: Sequence[str]) -> Path:
    """Train in a folder as train.py does with these words; return the run's folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run(compose(words))
    (run_folder,) = (folder / "runs").iterdir()
    return run_folder
