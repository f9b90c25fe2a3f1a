"""AnymalTerrain on a small ground, and robots put where a test wants them."""

from __future__ import annotations

import pytest
import torch

DEFAULT_ANGLES = [0.03, 0.4, -0.8, 0.03, -0.4, 0.8, -0.03, 0.4, -0.8, -0.03, -0.4, 0.8]
# Three levels of: a pit, flat at level 0; two stairs down; stairs up.
SMALL = (
    "task=AnymalTerrain",
    "task.env.terrain.numLevels=3",
    "task.env.terrain.numTerrains=4",
    "task.env.terrain.borderSize=2",
)
EXACT = ("task.env.learn.addNoise=False", "task.env.learn.pushRobots=False")


@pytest.fixture
def make(make_task):
    """Return `make(*overrides, num_envs=4, seed=0)`, robots on a small ground."""

    def small(*overrides: str, num_envs: int = 4, seed: int = 0):
        torch.manual_seed(seed)
        return make_task(*SMALL, *overrides, num_envs=num_envs)

    return small


def all_ids(task) -> torch.Tensor:
    return torch.arange(task.num_envs)


def put(task, **where) -> None:
    """Write robots at their default angles; `where`: columns of the root state and their values."""
    columns = {"pos": slice(0, 3), "rot": slice(3, 7), "vel": slice(7, 13)}
    root = task.simulation.root_states.clone()
    for name, values in where.items():
        root[:, columns[name]] = torch.as_tensor(values, dtype=torch.float32)
    joints = torch.tensor(DEFAULT_ANGLES).repeat(task.num_envs, 1)
    task.simulation.write_state(all_ids(task), root, joints, torch.zeros_like(joints))


def lie_down(task) -> None:
    """Write robots on their bellies, a hair above the ground of their tiles."""
    pos = task.curriculum.origins(all_ids(task)) + torch.tensor([0.0, 0.0, 0.105])
    root = task.simulation.root_states.clone()
    root[:, :3], root[:, 3:7], root[:, 7:] = pos, torch.tensor([0.0, 0.0, 0.0, 1.0]), 0.0
    # Legs up in the air.
    joints = torch.tensor([0.0, 3.0, 0.0, 0.0, -3.0, 0.0] * 2).repeat(task.num_envs, 1)
    task.simulation.write_state(all_ids(task), root, joints, torch.zeros_like(joints))


def step_until_done(task, actions: torch.Tensor):
    for _ in range(20):
        result = task.step(actions)
        if result[2].any():
            return result
    raise AssertionError("nothing ended")
