"""Trainings that break: what ends them, what is saved, and what is saved before an episode ends."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from isaacgymenvs_lite.checkpoints import files as checkpoints
from isaacgymenvs_lite.errors import ConfigError, NotFiniteError
from isaacgymenvs_lite.learning.sac import SACAgent
from tests.learning.test_hrl import llc  # noqa: F401  a fixture
from tests.learning.test_restoring import CONFIG, EACH_KIND, PPO, make  # noqa: F401  a fixture

_EVERY_EPOCH = f"{CONFIG}.save_frequency=1"


def break_step(agent: Any, number: int, change: Callable[[Any, torch.Tensor], None]) -> None:
    """Let `change(obs, rewards)` happen to what the task's step `number`, from 1 on, returns."""
    step, count = agent.vec_env.env.step, 0

    def broken(actions: torch.Tensor) -> Any:
        nonlocal count
        count += 1
        obs, rewards, dones, infos = step(actions)
        if count == number:
            change(obs, rewards)
        return obs, rewards, dones, infos

    agent.vec_env.env.step = broken


def files(agent: Any) -> dict[str, dict[str, Any]]:
    return {
        path.name: checkpoints.load_checkpoint(path) for path in Path(agent.nn_dir).glob("*.pth")
    }


def all_finite(value: Any) -> bool:
    if isinstance(value, dict):
        return all(all_finite(entry) for entry in value.values())
    return not isinstance(value, torch.Tensor) or bool(value.isfinite().all())


def one_line(error: pytest.ExceptionInfo[NotFiniteError]) -> str:
    assert "\n" not in str(error.value)
    return str(error.value)


def broken_reward(_obs: Any, rewards: torch.Tensor) -> None:
    rewards[3] = math.nan


def broken_observation(obs: Any, _rewards: torch.Tensor) -> None:
    obs["obs"][2, 1] = math.inf


def test_an_observation_that_stays_broken(make):  # noqa: F811
    """Agents that ask for resets read it from the task a second time."""
    agent = make("amp")
    task = agent.vec_env.env

    def broken(*_: Any) -> None:
        task.obs_buf[5, 7] = math.nan

    break_step(agent, 2, broken)
    with pytest.raises(NotFiniteError, match=r"observations of environment 5 hold nan at step 2 "):
        agent.train()


def test_a_policy_that_can_draw_no_action_is_explained(make):  # noqa: F811
    """A standard deviation that the network computes is nan where the observation is."""
    agent = make("ppo", "train.params.network.space.continuous.fixed_sigma=False")
    break_step(agent, 3, lambda obs, _: obs["obs"][4].fill_(math.nan))
    with pytest.raises(NotFiniteError, match=r"observations of environment 4 hold nan at step 3 "):
        agent.train()


@pytest.mark.parametrize("kind", EACH_KIND)
def test_a_reward_that_is_nan_ends_the_training(kind, make):  # noqa: F811
    agent = make(kind, "max_iterations=6", _EVERY_EPOCH)
    steps = agent.num_steps_per_episode if kind == "sac" else agent.horizon_length
    broken_at = 2 * steps + 2  # the second policy step of epoch 3
    if kind == "hrl":
        broken_at = 2 * steps * agent.control_steps_per_action + 4
    break_step(agent, broken_at, broken_reward)
    with pytest.raises(NotFiniteError) as caught:
        agent.train()
    message = one_line(caught)
    assert message.startswith("rewards of environment 3 hold nan at step 1 of epoch 3: the task")
    # Of the two epochs before, and of the networks as they were after them.
    interrupted = f"{agent.config['name']}_interrupted.pth"
    assert message.endswith(f"checkpoint={agent.nn_dir}/{interrupted}")
    saved = files(agent)
    assert interrupted in saved
    assert len(saved) >= 3
    assert all_finite(saved)
    agent.restore(f"{agent.nn_dir}/{interrupted}")


@pytest.mark.parametrize("kind", ["ppo", "asymmetric", "sac"])
def test_so_does_an_observation_in_the_first_epoch(kind, make):  # noqa: F811
    agent = make(kind, _EVERY_EPOCH)
    break_step(agent, 2, broken_observation)
    with pytest.raises(NotFiniteError) as caught:
        agent.train()
    assert one_line(caught).startswith("observations of environment 2 hold inf at step ")
    assert "checkpoint=" not in str(caught.value)
    assert files(agent) == {}


def test_the_last_observation_of_a_rollout_counts(make):  # noqa: F811
    agent = make("ppo")
    break_step(agent, agent.horizon_length, broken_observation)
    with pytest.raises(NotFiniteError, match=r"observations of environment 2 hold inf at step 8 "):
        agent.train()


@pytest.mark.parametrize("kind", EACH_KIND)
def test_networks_that_break_are_not_saved(kind, make):  # noqa: F811
    """In the last update of epoch 2: rl_games would save them, as the periodic checkpoint."""
    agent = make(kind, "max_iterations=4", _EVERY_EPOCH)
    name = "update" if isinstance(agent, SACAgent) else "trancate_gradients_and_step"
    update = getattr(agent, name)

    def breaking(*args: Any) -> Any:
        result = update(*args)
        if agent.epoch_num == 2:
            with torch.no_grad():
                list(agent.model.parameters())[1].view(-1)[0] = math.nan
        return result

    setattr(agent, name, breaking)
    with pytest.raises(NotFiniteError, match=r"not finite in epoch 2, .*_ep_1_rew_") as caught:
        agent.train()
    message = one_line(caught)
    saved = files(agent)
    (good,) = saved
    assert f"checkpoint={agent.nn_dir}/{good}, with train.params.config." in message
    assert ("actor_lr=0.00" if kind == "sac" else "learning_rate=") in message
    assert saved[good]["epoch"] == 1
    assert all_finite(saved)
    with pytest.raises(NotFiniteError):
        agent.save(f"{agent.nn_dir}/{agent.config['name']}")
    assert set(files(agent)) == {good}


def test_moments_of_the_optimiser_count(make):  # noqa: F811
    """With an infinite second moment a parameter stays as it is for ever, and is finite."""
    agent = make("ppo")
    agent.train()
    entry = list(agent.optimizer.state.values())[2]
    entry["exp_avg_sq"].view(-1)[0] = math.inf
    with pytest.raises(NotFiniteError, match=r"optimizer\.state\.2\.exp_avg_sq is not finite"):
        agent.save(f"{agent.nn_dir}/x")


def test_large_numbers_are_finite(make):  # noqa: F811
    """Whose sum is none."""
    agent = make("ppo")
    with torch.no_grad():
        agent.model.a2c_network.actor_mlp[0].weight.fill_(3e38)
    agent.save(f"{agent.nn_dir}/large")
    assert set(files(agent)) == {"large.pth"}


@pytest.mark.parametrize(
    "kind", [each for each in EACH_KIND if each.id not in ("asymmetric", "lstm")]
)
def test_periodic_checkpoints_do_not_wait_for_the_first_episode(kind, make):  # noqa: F811
    # Too few steps for a pole to fall, and a floor that nobody falls to.
    more = {
        "ppo": (f"{CONFIG}.horizon_length=2", f"{CONFIG}.minibatch_size=16"),
        "sac": ("task.env.episodeLength=300",),
    }.get(kind, ("task.env.terminationHeight=-9", "task.env.clipDeviation=0"))
    agent = make(kind, *more, "max_iterations=2", _EVERY_EPOCH)
    agent.train()
    assert agent.game_rewards.current_size == 0
    saved = files(agent)
    name = agent.config["name"]
    assert set(saved) >= {f"last_{name}_ep_{epoch}_rew_-inf.pth" for epoch in (1, 2)}
    for epoch in (1, 2):
        state = saved[f"last_{name}_ep_{epoch}_rew_-inf.pth"]
        assert state["epoch"] == epoch
        assert state["frame"] == epoch * agent.curr_frames


def test_without_a_period_there_is_no_periodic_checkpoint(make):  # noqa: F811
    agent = make("amp", "task.env.terminationHeight=-9", "max_iterations=2")
    agent.save_freq = 0
    agent.train()
    assert {name.split("_rew_")[0] for name in files(agent)} == {"last_HumanoidAMP_ep_2"}


def test_one_sample_per_epoch_is_refused(make_classic_agent):
    with pytest.raises(ConfigError, match=r"horizon_length 1 gives one sample .* raise num_envs"):
        make_classic_agent("task=Cartpole", "num_envs=1", f"{CONFIG}.horizon_length=1")


def test_a_runner_of_ones_own_ends_in_the_same_way(make_classic_runner, monkeypatch):
    """`runner.run` hands no agent out; the task is what a user has in hand."""
    runner = make_classic_runner(*PPO, "max_iterations=3")
    from isaacgymenvs_lite.tasks.base.vec_task import VecTask

    step = VecTask.step

    def broken(self: VecTask, actions: torch.Tensor) -> Any:
        obs, rewards, dones, infos = step(self, actions)
        if self.control_steps == 12:
            rewards[0] = -math.inf
        return obs, rewards, dones, infos

    monkeypatch.setattr(VecTask, "step", broken)
    with pytest.raises(NotFiniteError, match=r"rewards of environment 0 hold -inf at step 3 of ep"):
        runner.run({"train": True})
