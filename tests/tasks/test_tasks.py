"""What every task of the map must do; a new task is covered by its entry there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.making import make_from_config
from isaacgymenvs_lite.tasks import isaacgym_task_map
from isaacgymenvs_lite.tasks.base.vec_task import VecTask

NUM_ENVS = 5


# What these show does not depend on chance.
DETERMINISTIC = {"HumanoidViewMotion"}


@pytest.fixture(params=sorted(isaacgym_task_map))
def task_name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def make_task(task_name: str, walk_clip: Path) -> Iterator[Callable[..., VecTask]]:
    """Return `make_task(*overrides, seed=0)`, a maker of the task, with a clip of the test."""
    made: list[VecTask] = []

    def make(*overrides: str, seed: int = 0) -> VecTask:
        torch.manual_seed(seed)
        fixed = (f"num_envs={NUM_ENVS}", "num_threads=1", f"task.env.motion_file={walk_clip}")
        cfg = compose([f"task={task_name}", *fixed, *overrides])
        made.append(make_from_config(cfg, sim_device="cpu", rl_device="cpu"))
        return made[-1]

    yield make
    for task in made:
        task.close()


def _random_steps(task: VecTask, count: int) -> Iterator[tuple]:
    generator = torch.Generator().manual_seed(1)
    for _ in range(count):
        actions = 2.0 * torch.rand(NUM_ENVS, task.num_actions, generator=generator) - 1.0
        yield task.step(actions)
        task.reset_done()


def test_the_class_is_a_vec_task(make_task) -> None:
    task = make_task()
    assert isinstance(task, VecTask)
    assert task.num_envs == task.simulation.num_envs == NUM_ENVS


def test_steps_meet_the_spaces(make_task) -> None:
    task = make_task()
    assert isinstance(task.observation_space, gymnasium.spaces.Box)
    assert task.observation_space.shape == (task.num_obs,)
    assert task.action_space == gymnasium.spaces.Box(-1.0, 1.0, (task.num_actions,), np.float32)
    task.reset_done()
    for observations, rewards, dones, infos in _random_steps(task, 60):
        observed = observations["obs"]
        assert (observed.shape, observed.dtype) == ((NUM_ENVS, task.num_obs), torch.float32)
        assert observed.isfinite().all()
        assert (rewards.shape, rewards.dtype) == ((NUM_ENVS,), torch.float32)
        assert rewards.isfinite().all()
        assert (dones.shape, dones.dtype) == ((NUM_ENVS,), torch.int64)
        assert set(dones.tolist()) <= {0, 1}
        time_outs = infos["time_outs"]
        assert (time_outs.shape, time_outs.dtype) == ((NUM_ENVS,), torch.bool)
        assert not (time_outs & (dones == 0)).any()


def test_the_same_seed_gives_the_same_course(make_task, task_name: str) -> None:
    def course(seed: int) -> list[bytes]:
        task = make_task("task.env.stateInit=Random", seed=seed)
        task.reset_done()
        return [step[0]["obs"].numpy().tobytes() for step in _random_steps(task, 20)]

    first = course(0)
    assert course(0) == first
    assert (course(1) == first) == (task_name in DETERMINISTIC)


def test_a_closed_task_cannot_be_stepped(make_task) -> None:
    task = make_task()
    task.close()
    with pytest.raises(RuntimeError, match="closed"):
        task.step(task.zero_actions())
