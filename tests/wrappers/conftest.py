"""Makers of tasks in all three manners of starting episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from tests.tiny import composed

NUM_ENVS = 6
MakeTask = Callable[..., VecTask]


@pytest.fixture
def make_task(walk_clip: Path) -> Iterator[MakeTask]:
    """Return `make_task(name, *overrides, num_envs=6, seed=0)`; closes them at the end."""
    made: list[VecTask] = []

    def make(name: str, *overrides: str, num_envs: int = NUM_ENVS, seed: int = 0) -> VecTask:
        torch.manual_seed(seed)
        words = [f"task={name}", f"num_envs={num_envs}", "num_threads=1", "rl_device=cpu"]
        if name == "HumanoidAMP":
            words.append(f"task.env.motion_file={walk_clip}")
        if name == "AnymalTerrain":
            words += ["task.env.terrain.numLevels=2", "task.env.terrain.numTerrains=2"]
        made.append(
            make_from_config(composed([*words, *overrides]), sim_device="cpu", rl_device="cpu")
        )
        return made[-1]

    yield make
    for task in made:
        task.close()


@pytest.fixture
def make_cartpole(make_task: MakeTask) -> MakeTask:
    """Return `make_cartpole(*overrides, num_envs=6, seed=0)`."""
    return lambda *overrides, **sizes: make_task("Cartpole", *overrides, **sizes)
