"""A simulation that diverges ends its episode without a reward, in tasks of all kinds."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.tasks import isaacgym_task_map
from isaacgymenvs_lite.tasks.anymal_terrain import AnymalTerrain
from isaacgymenvs_lite.tasks.base.vec_task import Done
from isaacgymenvs_lite.tasks.cartpole import Cartpole
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask

# One for each time at which tasks start the next episode.
TASKS = ("Cartpole", "AnymalTerrain", "Quadcopter", "HumanoidAMP")
ENV = 2


@pytest.fixture
def broken(make_task: Callable[..., Any], request: pytest.FixtureRequest) -> Any:
    """Return a task of 4 environments, two steps into its episodes."""
    words = ["task.env.stateInit=Default"] if request.param == "HumanoidAMP" else []
    task = make_task(f"task={request.param}", *words)
    task.reset()
    torch.manual_seed(0)
    for _ in range(2):
        task.step(torch.rand(4, task.num_actions) - 0.5)
        task.reset_done()
    return task


def speed_up(task: Any) -> None:
    """Give all joints of an environment a speed that nothing physical has."""
    sim, ids = task.simulation, torch.tensor([ENV])
    vel = torch.full((1, sim.dof_vel.shape[1]), 1e8)
    sim.write_state(ids, sim.root_states[ids].clone(), sim.dof_pos[ids].clone(), vel)


def others(rows: Tensor) -> Tensor:
    return rows[torch.arange(4) != ENV]


@pytest.mark.parametrize("broken", TASKS, indirect=True)
def test_it_earns_nothing_and_is_cut_off_and_starts_anew(broken: Any) -> None:
    task = broken
    before = task.obs_dict["obs"].clone()
    speed_up(task)
    obs, rewards, dones, infos = task.step(task.zero_actions())
    assert infos["diverged"].tolist() == [False, False, True, False]
    assert task.simulation.num_failures == 1
    assert rewards[ENV] == 0.0
    assert sum(terms[ENV] for terms in task.reward_terms.values()) == 0.0
    assert dones[ENV] == 1
    assert task.done_buf[ENV] == Done.DIVERGED
    # As at a time limit: its last observation, the last good one, is worth something.
    assert infos["time_outs"][ENV]
    assert obs["obs"].isfinite().all()
    if not isinstance(task, AnymalTerrain):
        assert torch.equal(obs["obs"][ENV], before[ENV])
        assert torch.equal(task.final_observations()["obs"][ENV], before[ENV])
        assert not torch.equal(others(obs["obs"]), others(before))
    task.reset_done()
    for _ in range(3):
        obs, rewards, dones, infos = task.step(task.zero_actions())
        assert not infos["diverged"].any()
        assert obs["obs"].isfinite().all()
        assert rewards.isfinite().all()
        assert dones[ENV] == 0
        task.reset_done()
    assert task.progress_buf[ENV] < task.progress_buf[0]


@pytest.mark.parametrize(
    ("broken", "value"),
    [("Ant", math.nan), ("Ant", -math.inf), *((name, math.nan) for name in TASKS)],
    indirect=["broken"],
)
def test_an_action_that_is_not_finite_is_a_failure(
    broken: Any, value: float, controls_of: Any, caplog: Any
) -> None:
    task = broken
    controls = controls_of(task)
    for _ in range(2):
        actions = task.zero_actions() + 0.1
        actions[ENV, -1] = value
        with caplog.at_level(logging.WARNING):
            obs, rewards, dones, infos = task.step(actions)
        assert all(given.isfinite().all() for given in controls)
        assert dones[ENV] == 1
        assert task.done_buf[ENV] == Done.FAILED
        assert not infos["time_outs"].any()
        assert not infos["diverged"].any()
        assert rewards[ENV] == 0.0
        assert rewards.isfinite().all()
        assert obs["obs"].isfinite().all()
        task.reset_done()
    said = [text for text in caplog.messages if "the action of environment 2 is not finite" in text]
    assert len(said) == 1


def test_other_libraries_get_a_truncation_with_the_last_good_observation(
    make_task: Callable[..., Any],
) -> None:
    for name in ["Cartpole", "Quadcopter", "HumanoidAMP"]:
        env = AutoresetTask(make_task(f"task={name}"), "a test")
        env.reset()
        actions = env.task.zero_actions()
        before = env.step(actions).observations["obs"].clone()
        assert env.last_step is not None
        assert "diverged" not in env.last_step.per_env
        speed_up(env.task)
        step = env.step(actions)
        assert step.final_observations is not None
        assert step.truncated.tolist() == [False, False, True, False]
        assert not step.terminated.any()
        assert step.per_env["diverged"].tolist() == [False, False, True, False]
        assert torch.equal(step.final_observations["obs"][ENV], before[ENV])
        assert not torch.equal(step.observations["obs"][ENV], before[ENV])
        assert step.observations["obs"].isfinite().all()


class OldWay(Cartpole):
    """A task that has its own steps, as those of IsaacGymEnvs, and does not look for divergence."""

    def pre_physics_step(self, actions: Tensor) -> None:
        self.simulation.set_controls(self.compute_controls(actions))

    def post_physics_step(self) -> None:
        self.progress_buf += 1
        env_ids = self.reset_buf.nonzero().flatten()
        if len(env_ids) > 0:
            self.reset_idx(env_ids)
        self.obs_buf[:] = self.compute_obs()
        self.rew_buf.fill_(1.0)
        self.reset_buf[:] = self.progress_buf >= self.max_episode_length - 1


def test_a_task_with_steps_of_its_own_is_protected_too(
    make_task: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(isaacgym_task_map, "Cartpole", OldWay)
    task = make_task("task=Cartpole")
    before = [task.step(task.zero_actions()) for _ in range(2)][-1][0]["obs"]
    speed_up(task)
    actions = task.zero_actions()
    actions[0] = math.nan
    obs, rewards, dones, infos = task.step(actions)
    assert rewards.tolist() == [0.0, 1.0, 0.0, 1.0]
    assert dones.tolist() == [1, 0, 1, 0]
    assert task.done_buf.tolist() == [Done.FAILED, Done.RUNNING, Done.DIVERGED, Done.RUNNING]
    assert infos["time_outs"].tolist() == infos["diverged"].tolist() == [False, False, True, False]
    assert torch.equal(obs["obs"][ENV], before[ENV])
    *_, dones, _ = task.step(task.zero_actions())
    assert not dones.any()
    assert task.progress_buf.tolist() == [0, 3, 0, 3]
