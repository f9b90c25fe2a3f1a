"""AnymalTerrain's curriculum: who goes up and down, and when nobody does."""

from __future__ import annotations

import pytest
import torch

from tests.tasks.anymal_terrain.conftest import EXACT, all_ids, put

# --- levels ---------------------------------------------------------------------------------


def test_levels_follow_the_distance_walked(make) -> None:
    task = make(*EXACT)
    task.curriculum.levels[:] = 1
    task.reset()
    # 0.5 m/s for 20 s is 10 m: below 2.5 m a robot goes back.
    task.commands[:, 0], task.commands[:, 1] = 0.3, 0.4
    away = torch.tensor([[4.2, 0.0, 2.0], [0.0, 3.0, 2.0], [2.4, 0.0, 2.0], [4.2, 0.0, 2.0]])
    put(task, pos=task.curriculum.origins(all_ids(task)) + away, vel=0.0)
    task.progress_buf[:] = torch.tensor([998, 998, 998, 500])
    *_, infos = task.step(task.zero_actions())
    assert task.curriculum.levels.tolist() == [2, 1, 0, 1]
    assert infos["episode"]["terrain_level"] == pytest.approx(1.0)
    offset = task.simulation.root_states[:3, :2] - task.curriculum.origins(all_ids(task))[:3, :2]
    assert offset.abs().max() <= 0.5


def test_a_diverged_robot_is_not_promoted(make) -> None:
    task = make(*EXACT)
    task.curriculum.levels[:] = 1
    task.reset()
    task.progress_buf[:] = 100
    vel = torch.zeros(4, 6)
    vel[2] = 1e6
    put(task, vel=vel)
    *_, dones, infos = task.step(task.zero_actions())
    assert dones.tolist() == [0, 0, 1, 0]
    assert task.curriculum.levels.tolist() == [1] * 4
    assert "episode" not in infos
    assert task.simulation.root_states.isfinite().all()


def test_levels_come_back_from_a_checkpoint(make) -> None:
    task, other, more = make(), make(seed=1), make(num_envs=5)
    task.curriculum.levels[:] = torch.tensor([2, 0, 1, 2])
    for taker in (other, more):
        taker.set_env_state(task.get_env_state())
        taker.set_env_state(None)
    other.reset()
    assert other.curriculum.levels.tolist() == [2, 0, 1, 2]
    assert other.simulation.root_states[0, 0] > 16.0
    assert more.curriculum.levels.tolist() == [0] * 5
