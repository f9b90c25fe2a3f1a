"""A transition whose simulation diverged changes nothing: no weight, no statistic, no mean."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import NotFiniteError
from tests.learning.test_gen_amp import GEN_AMP
from tests.learning.test_hrl import overrides as over_llc
from tests.learning.test_hrl import train_low_level
from tests.learning.test_recurrent_ppo import asymmetric
from tests.tiny import CONFIG, TINY_LSTM, TINY_PPO, TINY_SAC

ENV = 3
CARTPOLE = ("task=Cartpole", *TINY_PPO, "num_envs=8", f"{CONFIG}.minibatch_size=8")
CLASSIC = {
    "ppo": CARTPOLE,
    "asymmetric": (*CARTPOLE, *asymmetric(), f"{CONFIG}.central_value_config.minibatch_size=16"),
    "lstm": TINY_LSTM,
    "sac": TINY_SAC,
}
CRITIC = ("+task.env.asymmetric_observations=True", asymmetric()[1])
AMP = {"amp": (), "asymmetric": CRITIC, "ase": GEN_AMP}
EPOCHS = 2


def diverge(
    agent: Any, steps: set[int], garbage: float = 0.0, envs: tuple[int, ...] = (ENV,)
) -> Any:
    """Make simulations diverge in some steps, and replace what these steps return by garbage."""
    vec_env, task = agent.vec_env, agent.vec_env.env
    step, env_ids, count = vec_env.step, torch.tensor(envs), iter(range(10**6))

    def broken_step(actions: Tensor) -> Any:
        if next(count) in steps:
            sim = task.simulation
            vel = torch.full((len(envs), sim.dof_vel.shape[1]), 1e8)
            states = (sim.root_states[env_ids], sim.dof_pos[env_ids], vel)
            sim.write_state(env_ids, *(each.clone() for each in states))
        obs, rewards, dones, infos = step(actions)
        bad = infos["diverged"]
        rewards = rewards.masked_fill(bad, garbage)
        if "amp_obs" in infos:
            infos["amp_obs"] = infos["amp_obs"].masked_fill(bad.unsqueeze(-1), garbage)
        return obs, rewards, dones, infos

    vec_env.step = broken_step
    return agent


def train(agent: Any, epochs: int = EPOCHS) -> dict[str, Tensor]:
    """Train some epochs; return everything learned and the means of episodes."""
    torch.manual_seed(5)
    agent.init_tensors()
    agent.obs = agent.env_reset()
    for _ in range(epochs):
        agent.epoch_num += 1
        agent.train_epoch()
    state = {name: value.clone() for name, value in agent.model.state_dict().items()}
    state["episodes"] = agent.game_rewards.mean.clone()
    if (central := getattr(agent, "central_value_net", None)) is not None:
        state |= {f"central.{name}": value for name, value in central.state_dict().items()}
    if (discriminator := getattr(agent, "discriminator", None)) is not None:
        state |= discriminator.normalizer.state_dict()
        state["replay"] = agent._amp_replay_buffer.rows["amp_obs"].clone()
    return state


def assert_same(one: dict[str, Tensor], other: dict[str, Tensor]) -> None:
    for name, value in one.items():
        assert value.isfinite().all(), name
        assert torch.equal(value, other[name]), name


@pytest.mark.parametrize("words", CLASSIC.values(), ids=CLASSIC)
def test_what_a_diverged_step_returned_is_not_learned(words, make_classic_agent) -> None:
    one, other = (
        train(diverge(make_classic_agent(*words), {1, 6}, garbage)) for garbage in (0.0, 1e4)
    )
    assert_same(one, other)


@pytest.mark.parametrize("name", ["ppo", "asymmetric", "lstm"])
def test_its_row_has_no_weight_in_the_update(name: str, make_classic_agent) -> None:
    """What the policy did there may be anything."""
    results = []
    for garbage in (0.0, 1e3):
        agent = diverge(make_classic_agent(*CLASSIC[name]), {2})
        agent.init_tensors()
        agent.obs = agent.env_reset()
        torch.manual_seed(5)
        with torch.no_grad():
            batch = agent.play_steps_rnn() if agent.is_rnn else agent.play_steps()
        for rows in ("actions", "neglogpacs", "mus"):
            batch[rows][ENV * agent.horizon_length + 2] += garbage
        agent.set_train()
        agent.prepare_dataset(batch)
        losses = [agent.train_actor_critic(minibatch)[0] for minibatch in agent.dataset]
        if agent.has_central_value:
            agent.train_central_value()
        results.append({**agent.model.state_dict(), "losses": torch.stack(losses)})
    assert_same(*results)


@pytest.mark.parametrize("words", AMP.values(), ids=AMP)
def test_nor_does_a_discriminator_see_it(words, make_agent) -> None:
    results = []
    for garbage in (0.0, 1e4):
        torch.manual_seed(1)
        results.append(train(diverge(make_agent(*words), {1, 6}, garbage)))
    assert_same(*results)
    rows = results[0]["replay"]
    assert rows.abs().max() < 1e4
    assert len(rows) == 2 * 8 * 4 - 2  # epochs, environments, steps


@pytest.mark.slow
def test_nor_does_a_high_level(make_agent: Callable[..., Any], tmp_path: Path) -> None:
    llc = train_low_level(make_agent, tmp_path)
    results = []
    for garbage in (0.0, 1e4):
        torch.manual_seed(1)
        # In the second of three control steps under a latent.
        results.append(train(diverge(make_agent(*over_llc(llc)), {1, 7}, garbage)))
    assert_same(*results)


def returns_of(batch: dict[str, Any], horizon: int, before: int) -> Tensor:
    """Return the returns of ENV's row, `before` rows of it being left."""
    first = ENV * horizon
    return batch["returns"][first : first + before, 0]


def test_earlier_returns_end_with_the_value_of_the_last_good_state(make_agent, roll_out) -> None:
    agent = diverge(make_agent(), {2}, garbage=1e4)
    batch = roll_out(agent)
    horizon, rows = agent.horizon_length, agent.experience_buffer.tensor_dict
    assert len(batch["returns"]) == len(batch["amp_obs"]) == 8 * horizon - 1
    values = rows["values"][:, ENV, 0]
    rewards = agent._combine_rewards(rows["rewards"], agent._calc_amp_rewards(rows["amp_obs"]))[
        :, ENV, 0
    ]
    second = rewards[1] + agent.gamma * values[2]
    delta = rewards[0] + agent.gamma * values[1] - values[0]
    first = values[0] + delta + agent.gamma * agent.tau * (second - values[1])
    found = returns_of(batch, horizon, 2)
    torch.testing.assert_close(found, torch.stack((first, second)))
    # The row after it is the first of the next episode.
    row = ENV * horizon + 2
    assert torch.equal(batch["obses"][row], rows["obses"][3, ENV])


def test_the_same_in_rl_games_own_agent(make_classic_agent, roll_out) -> None:
    agent = diverge(make_classic_agent(*CARTPOLE), {2}, garbage=1e4)
    batch = roll_out(agent)
    rows = agent.experience_buffer.tensor_dict
    values, rewards = rows["values"][:, ENV, 0], rows["rewards"][:, ENV, 0]
    second = rewards[1] + agent.gamma * values[2]
    torch.testing.assert_close(returns_of(batch, agent.horizon_length, 2)[1], second)
    agent.prepare_dataset(batch)
    data = agent.dataset.values_dict
    assert len(data["obs"]) == len(data["advantages"]) == 8 * 4 - 1
    assert [len(minibatch["obs"]) for minibatch in agent.dataset] == [8, 8, 8, 7]


def test_a_diverged_episode_is_in_no_mean(make_classic_agent) -> None:
    agent = make_classic_agent(*CARTPOLE)
    train(diverge(agent, {1}, garbage=50.0), epochs=1)
    assert len(agent.game_lengths) == 0
    # The next one begins with empty sums.
    assert agent.current_lengths[ENV] < agent.current_lengths[0]


def test_minibatches_are_whole_again_in_the_next_epoch(make_agent) -> None:
    agent = diverge(make_agent(), {1})
    train(agent, epochs=1)
    assert agent.dataset.batch_size == 8 * 4 - 1
    agent.train_epoch()
    assert agent.dataset.batch_size == 8 * 4
    assert sorted(len(agent.dataset[i]["obs"]) for i in range(len(agent.dataset))) == [16, 16]


def test_where_everything_diverges_the_message_says_so(make_classic_agent) -> None:
    agent = diverge(make_classic_agent(*CARTPOLE), set(range(8)), envs=tuple(range(8)))
    with pytest.raises(NotFiniteError, match=r"diverged in all steps.*simulation\.replay"):
        train(agent)
