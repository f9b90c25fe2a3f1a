"""What every task of the map must do; a new task is covered by its entry there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.tasks import isaacgym_task_map
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import HumanoidAMPBase
from isaacgymenvs_lite.tasks.base.vec_task import Done, VecTask
from tests.tiny import composed

NUM_ENVS = 5


# What these show does not depend on chance.
DETERMINISTIC = {"HumanoidViewMotion"}
CLASSIC = sorted(
    name
    for name, task in isaacgym_task_map.items()
    if isinstance(task, type) and not issubclass(task, HumanoidAMPBase)
)


@pytest.fixture(params=sorted(isaacgym_task_map))
def task_name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def make_task(task_name: str, walk_clip: Path) -> Iterator[Callable[..., VecTask]]:
    """Return `make_task(*overrides, seed=0, num_envs=5)`, a maker of the task."""
    made: list[VecTask] = []

    def make(*overrides: str, seed: int = 0, num_envs: int = NUM_ENVS) -> VecTask:
        torch.manual_seed(seed)
        fixed = [f"task={task_name}", f"num_envs={num_envs}", "num_threads=1"]
        if task_name not in CLASSIC:
            clip = "g1_walk" if task_name.startswith("RobotAMP") else walk_clip
            fixed += [f"task.env.motion_file={clip}", "task.env.stateInit=Random"]
        cfg = composed([*fixed, *overrides])
        made.append(make_from_config(cfg, sim_device="cpu", rl_device="cpu"))
        return made[-1]

    yield make
    for task in made:
        task.close()


def _random_steps(task: VecTask, count: int) -> Iterator[tuple]:
    generator = torch.Generator().manual_seed(1)
    for _ in range(count):
        actions = 2.0 * torch.rand(task.num_envs, task.num_actions, generator=generator) - 1.0
        yield task.step(actions)
        if task.agents_call_reset_done:
            task.reset_done()


def test_what_a_task_says_of_itself(make_task, task_name: str) -> None:
    """Sizes, the time of a control step, the parts of an observation, what an action means."""
    task = make_task()
    assert isinstance(task, VecTask)
    assert task.num_envs == task.simulation.num_envs == NUM_ENVS
    assert task.sim_dt_s == pytest.approx(task.cfg["sim"]["dt"])
    # A playback of clips steps the physics once only, and overwrites the result.
    calls = 1 if task_name != "HumanoidViewMotion" else task.control_freq_inv
    assert task.control_dt_s == pytest.approx(calls * task.simulation.dt)
    # `dt` is IsaacGymEnvs': of a control step in some tasks, of a simulator call in others.
    counts_control_steps = task_name == "AnymalTerrain" or task_name not in CLASSIC
    assert task.dt == (task.control_dt_s if counts_control_steps else task.sim_dt_s)
    groups = task.observation_groups()
    assert sum(groups.values()) == task.num_obs
    assert min(groups.values()) > 0
    scaling = task.action_scaling()
    if scaling is not None:
        assert scaling.unit in ("rad", "Nm", "N")
        assert scaling.offset.shape == scaling.scale.shape == (task.num_actions,)
        controls = []
        task.simulation.set_controls = lambda rows: controls.append(rows.clone())
        task.pre_physics_step(0.5 * torch.ones(NUM_ENVS, task.num_actions))
        expected = (scaling.offset + 0.5 * scaling.scale).expand(NUM_ENVS, -1)
        torch.testing.assert_close(controls[0], expected)
    task.close()
    with pytest.raises(RuntimeError, match="closed"):
        task.step(task.zero_actions())


def test_every_default_file_composes_with_its_train_file() -> None:
    for task_name in isaacgym_task_map:
        cfg = compose([f"task={task_name}"])
        assert cfg.task.name == task_name
        assert cfg.train.params.config.num_actors == cfg.task.env.numEnvs


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


@pytest.mark.slow
def test_random_steps_give_numbers(make_task) -> None:
    """Beyond the longest episode of most tasks."""
    task = make_task(num_envs=64)
    task.reset()
    for observations, rewards, _, _ in _random_steps(task, 1000):
        assert observations["obs"].isfinite().all()
        assert rewards.isfinite().all()


def test_the_same_seed_gives_the_same_course(make_task, task_name: str) -> None:
    def course(seed: int) -> list[bytes]:
        task = make_task(seed=seed)
        task.reset_done()
        return [step[0]["obs"].numpy().tobytes() for step in _random_steps(task, 20)]

    first = course(0)
    assert course(0) == first
    assert (course(1) == first) == (task_name in DETERMINISTIC)


def test_resets_touch_only_their_rows_and_time_outs_come_at_the_limit(make_task) -> None:
    task = make_task()
    task.reset()
    for _, _, _, infos in _random_steps(task, 3):
        assert not infos["time_outs"].any()
    task.progress_buf[:] = 7
    others = torch.tensor([0, 2, 4])
    before = [state[others].clone() for state in _states(task)]
    task.reset_idx(torch.tensor([1, 3]))
    for was, state in zip(before, _states(task), strict=True):
        assert torch.equal(was, state[others])
    assert (task.progress_buf[[1, 3]] == 0).all()
    task.progress_buf[:] = task.max_episode_length - 2
    _, _, dones, infos = task.step(task.zero_actions())
    assert dones.any()
    assert torch.equal(infos["time_outs"], task.done_buf == Done.TIME_OUT)
    assert torch.equal(infos["time_outs"], (dones != 0) & (task.done_buf != Done.FAILED))


def _states(task: VecTask) -> list[torch.Tensor]:
    sim = task.simulation
    return [sim.root_states, sim.dof_pos, sim.dof_vel, sim.object_states, task.progress_buf]


@pytest.mark.parametrize("task_name", CLASSIC)
def test_the_terms_sum_to_the_reward(make_task) -> None:
    task = make_task(num_envs=32)
    task.reset()
    for _, rewards, _, _ in _random_steps(task, 50):
        assert len(task.reward_terms) > 1
        paid = sum(term.double() for term in task.reward_terms.values())
        # float32 sums of terms of either sign: an error of their magnitudes, not of the sum's.
        largest = max(term.abs().max().item() for term in task.reward_terms.values())
        assert torch.allclose(rewards.double(), paid, rtol=1e-5, atol=1e-5 * max(1.0, largest))


@pytest.mark.parametrize("task_name", ["Ant", "HumanoidAMP", "HumanoidStrike"])
def test_an_asymmetric_critic_is_given_the_observation(make_task) -> None:
    task = make_task("++task.env.asymmetric_observations=True")
    task.reset()
    assert task.state_space.shape == (task.num_obs,)
    for observations, *_ in _random_steps(task, 3):
        assert observations["states"].shape == (NUM_ENVS, task.num_obs)
