"""PPO with recurrent networks and asymmetric critics on Cartpole."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from tests.tiny import TINY_LSTM

_MLP = "{units: [16], activation: elu, initializer: {name: default}, regularizer: {name: None}}"
_RNN = "{name: lstm, units: 8, layers: 1, before_mlp: False, concat_input: True, layer_norm: True}"
_CRITIC = (
    "{minibatch_size: 96, mini_epochs: 2, learning_rate: 1e-3, lr_schedule: adaptive,"
    " kl_threshold: 0.016, clip_value: True, normalize_input: True, truncate_grads: True,"
    " network: {name: actor_critic, central_value: True, mlp: %s %s}}"
)


def asymmetric(rnn: str = "") -> tuple[str, ...]:
    critic = _CRITIC % (_MLP, f", rnn: {rnn}" if rnn else "")
    section = f"+train.params.config.central_value_config={critic}"
    return "task.env.asymmetric_observations=True", section


def weights(module: torch.nn.Module) -> list[torch.Tensor]:
    return [parameter.detach().clone() for parameter in module.parameters()]


def test_a_recurrent_policy_learns(make_classic_agent: Callable[..., Any]) -> None:
    agent = make_classic_agent(*TINY_LSTM)
    assert agent.is_rnn
    before = weights(agent.model.a2c_network)
    agent.train()
    assert not any(map(torch.equal, before, weights(agent.model.a2c_network)))
    assert all(state.abs().max() > 0 for state in agent.rnn_states)
    assert all(state.dtype == torch.float32 for state in agent.rnn_states)


def test_it_remembers_until_an_episode_ends(make_classic_runner: Callable[..., Any]) -> None:
    player = make_classic_runner(*TINY_LSTM).create_player()
    obs = {"obs": torch.ones(16, 4)}
    first, second = player.act(obs), player.act(obs)
    assert (first != second).any()
    ended = torch.zeros(16)
    ended[3] = 1.0
    player.on_step(ended, {})
    third = player.act(obs)
    torch.testing.assert_close(third[3], first[3])
    assert (third[4] != first[4]).any()


def test_a_recurrent_critic_beside_a_policy_without_memory(
    make_classic_agent: Callable[..., Any],
) -> None:
    words = ("task=Cartpole", "num_envs=16", "max_iterations=2", *asymmetric(_RNN))
    agent = make_classic_agent(*words, "+train.params.config.seq_length=8")
    assert (agent.is_rnn, agent.seq_length, agent.central_value_net.seq_length) == (False, 8, 8)
    before = weights(agent.central_value_net.model.a2c_network.rnn)
    agent.train()
    after = weights(agent.central_value_net.model.a2c_network.rnn)
    assert not any(map(torch.equal, before, after))


@pytest.mark.parametrize("rnn", ["", _RNN])
def test_an_asymmetric_critic_learns(make_classic_agent: Callable[..., Any], rnn: str) -> None:
    agent = make_classic_agent(*TINY_LSTM, *asymmetric(rnn))
    assert agent.has_central_value
    before = weights(agent.central_value_net.model)
    agent.train()
    after = weights(agent.central_value_net.model)
    changed = [not same for same in map(torch.equal, before, after)]
    # The critic's network has an actor's outputs, too, which it does not use.
    assert sum(changed) > len(changed) / 2


def test_bfloat16_keeps_the_memory_in_float32(make_classic_agent: Callable[..., Any]) -> None:
    agent = make_classic_agent(*TINY_LSTM, "train.params.config.mixed_precision=True")
    agent.train()
    assert all(state.dtype == torch.float32 for state in agent.rnn_states)
    assert all(parameter.isfinite().all() for parameter in agent.model.parameters())
