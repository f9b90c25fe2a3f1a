"""The rollout, with AMPAgent on real humanoids as the agent."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from isaacgymenvs_lite.learning.common_agent import failures

# Without falls of its own an environment times out after 4 control steps.
SHORT_EPISODES = (
    "task.env.episodeLength=5",
    "task.env.enableEarlyTermination=False",
    "train.params.config.horizon_length=8",
)


def values_of(agent: Any, obs: torch.Tensor) -> torch.Tensor:
    """The critic's verdict by its formula: normalise, evaluate, denormalise; float64 statistics."""
    stats, value_stats = agent.model.running_mean_std, agent.model.value_mean_std
    normalized = (obs.double() - stats.running_mean) / (stats.running_var + 1e-5).sqrt()
    with torch.no_grad():
        raw = agent.model.a2c_network.eval_critic(normalized.clamp(-5, 5).float()).double()
    scale = (value_stats.running_var + 1e-5).sqrt()
    return value_stats.running_mean + scale * raw.clamp(-5, 5)


def test_next_values_are_those_of_the_observation_after_each_step(
    make_agent, record, roll_out, scramble
):
    agent = make_agent(*SHORT_EPISODES)
    scramble(agent)
    falls = ((1, 2), (6, 2), (7, 5))
    tape = record(agent, falls)
    roll_out(agent)
    next_values = agent.experience_buffer.tensor_dict["next_values"]
    dones, terminate = torch.stack(tape.dones), torch.stack(tape.terminate)
    time_outs = (dones == 1) & (terminate == 0)
    assert terminate.sum() == len(falls)
    assert time_outs.sum() >= 8

    expected = torch.stack([values_of(agent, obs) for obs in tape.after])
    expected[terminate == 1] = 0.0
    # float32 networks and statistics, values of about one
    torch.testing.assert_close(next_values.double(), expected, rtol=1e-5, atol=1e-5)
    assert (next_values[time_outs] != 0.0).all()

    # The value of the state after the reset, which a broken rollout would take, is another one.
    for n in range(agent.horizon_length - 1):
        after_reset = values_of(agent, tape.before[n + 1])
        timed_out = time_outs[n]
        assert ((after_reset - expected[n])[timed_out].abs() > 1e-3).all()


def test_a_rollout_may_end_in_the_middle_of_all_episodes(make_agent, record, roll_out, scramble):
    agent = make_agent("task.env.enableEarlyTermination=False")
    scramble(agent)
    tape = record(agent)
    roll_out(agent)
    assert not torch.stack(tape.dones).any()
    expected = torch.stack([values_of(agent, obs) for obs in tape.after])
    next_values = agent.experience_buffer.tensor_dict["next_values"]
    torch.testing.assert_close(next_values.double(), expected, rtol=1e-5, atol=1e-5)


def test_the_policy_acts_on_normalised_observations_after_resets(
    make_agent, record, roll_out, scramble
):
    agent = make_agent(*SHORT_EPISODES, "train.params.config.horizon_length=6")
    scramble(agent)
    tape = record(agent, ((2, 1),))
    roll_out(agent)
    buffer = agent.experience_buffer.tensor_dict
    before = torch.stack(tape.before)
    assert torch.equal(buffer["obses"], before)
    # after a reset another observation than the terminal one is stored
    assert not torch.equal(buffer["obses"][3][1], tape.after[2][1])

    stats = agent.model.running_mean_std
    normalized = ((before.double() - stats.running_mean) / (stats.running_var + 1e-5).sqrt()).clamp(
        -5, 5
    )
    with torch.no_grad():
        mu, log_sigma = agent.model.a2c_network.eval_actor(normalized.float())
    torch.testing.assert_close(buffer["mus"], mu, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(buffer["sigmas"], log_sigma.exp())
    torch.testing.assert_close(
        buffer["values"].double(), values_of(agent, before), rtol=1e-5, atol=1e-5
    )
    # sampled around the mean: 6 * 8 * 28 numbers of standard deviation exp(-2.9)
    noise = (buffer["actions"] - mu) / log_sigma.exp()
    assert noise.std().item() == pytest.approx(1.0, abs=0.1)
    neglogp = 0.5 * (noise**2).sum(-1) + 28 * (0.5 * math.log(2 * math.pi) - 2.9)
    torch.testing.assert_close(buffer["neglogpacs"], neglogp, rtol=1e-4, atol=1e-3)
    # and the environment gets them clamped
    assert torch.equal(torch.stack(tape.actions), buffer["actions"].clamp(-1, 1))


def test_dones_and_rewards_are_those_of_the_same_step(make_agent, record, roll_out):
    agent = make_agent(*SHORT_EPISODES, "+train.params.config.reward_shaper.shift_value=2.0")
    agent.rewards_shaper.scale_value = 0.5
    tape = record(agent, ((0, 3),))
    roll_out(agent)
    buffer = agent.experience_buffer.tensor_dict
    assert torch.equal(buffer["dones"].long(), torch.stack(tape.dones))
    assert buffer["dones"][0].tolist() == [0, 0, 0, 1, 0, 0, 0, 0]
    shaped = (torch.stack(tape.rewards) + 2.0) * 0.5
    torch.testing.assert_close(buffer["rewards"][..., 0], shaped)


def test_rows_are_environment_major(make_agent, record, roll_out):
    agent = make_agent(*SHORT_EPISODES)
    record(agent)
    batch = roll_out(agent)
    buffer = agent.experience_buffer.tensor_dict
    horizon, num_envs = agent.horizon_length, agent.num_actors
    for name in ("obses", "actions", "neglogpacs", "values", "mus", "dones", "amp_obs"):
        assert len(batch[name]) == horizon * num_envs
        for env, n in ((0, 0), (0, 7), (3, 5), (7, 7)):
            assert torch.equal(batch[name][env * horizon + n], buffer[name][n, env]), name
    assert batch["played_frames"] == horizon * num_envs


def test_returns_against_a_slow_loop(make_agent, record, roll_out, scramble):
    agent = make_agent(
        *SHORT_EPISODES,
        "train.params.config.task_reward_w=1.0",
        "train.params.config.disc_reward_w=0.0",
        "train.params.config.gamma=0.9",
    )
    scramble(agent)
    tape = record(agent, ((3, 0), (5, 6)))
    batch = roll_out(agent)
    rewards, dones = torch.stack(tape.rewards), torch.stack(tape.dones)
    values = torch.stack([values_of(agent, obs) for obs in tape.before])[..., 0]
    after = torch.stack([values_of(agent, obs) for obs in tape.after])[..., 0]
    returns = torch.zeros_like(values)
    for env in range(agent.num_actors):
        advantage = 0.0
        for n in reversed(range(agent.horizon_length)):
            bootstrap = 0.0 if tape.terminate[n][env] else float(after[n, env])
            delta = float(rewards[n, env]) + 0.9 * bootstrap - float(values[n, env])
            advantage = delta + 0.9 * 0.95 * (1 - int(dones[n, env])) * advantage
            returns[n, env] = advantage + values[n, env]
    own = batch["returns"].view(agent.num_actors, agent.horizon_length).T
    # eight float32 steps
    torch.testing.assert_close(own.double(), returns, rtol=1e-4, atol=1e-4)


def test_meters_count_finished_episodes_in_unshaped_rewards(make_agent, record, roll_out):
    agent = make_agent(*SHORT_EPISODES, "train.params.config.reward_shaper.scale_value=0.1")
    tape = record(agent, ((0, 3), (2, 5), (3, 5)))
    roll_out(agent)
    lengths, rewards = [], []
    for env in range(agent.num_actors):
        length, reward = 0, 0.0
        for n in range(agent.horizon_length):
            length, reward = length + 1, reward + float(tape.rewards[n][env])
            if tape.dones[n][env]:
                lengths.append(length)
                rewards.append(reward)
                length, reward = 0, 0.0
    assert len(lengths) > 8
    assert 1 in lengths
    assert agent.game_lengths.current_size == len(lengths)
    assert agent.game_lengths.mean.item() == pytest.approx(np.mean(lengths), rel=1e-5)
    assert agent.game_rewards.mean.item() == pytest.approx(np.mean(rewards), rel=1e-5)
    assert agent.game_shaped_rewards.mean.item() == pytest.approx(0.1 * np.mean(rewards), rel=1e-5)


def test_failures_are_read_from_what_the_environment_offers():
    dones = torch.tensor([0, 1, 1, 1])
    time_outs = torch.tensor([False, False, True, False])
    terminate = torch.tensor([0, 0, 0, 1])
    both = {"terminate": terminate, "time_outs": time_outs}
    assert failures(dones, both).tolist() == [0, 0, 0, 1]
    assert failures(dones, {"time_outs": time_outs}).int().tolist() == [0, 1, 0, 1]
    assert failures(dones, {}).tolist() == [0, 1, 1, 1]
