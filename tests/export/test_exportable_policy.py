"""Exportable policies act as the players of every kind of agent."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from isaacgymenvs_lite.export.exportable_policy import (
    HierarchyGraph,
    SkillGraph,
    make_exportable_policy,
)
from tests.learning.test_gen_amp import LATENT_DIM
from tests.learning.test_hrl import STEPS


def observations(player: Any, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 4.0 * torch.randn(player.env.num_envs, player.env.num_obs, generator=generator)


def played(player: Any, obs: Tensor) -> Tensor:
    """Return what the task makes of the player's actions for what it shows of `obs`."""
    env = player.env
    action = player.act({"obs": obs.clamp(-env.clip_obs, env.clip_obs)})
    return action.clamp(-env.clip_actions, env.clip_actions)


def check_ports(graph: Any, sizes: tuple[int, int]) -> None:
    """The ports have the shapes of the tensors, for any number of rows."""
    found = graph(*(port.sample(5) for port in graph.inputs))
    found = found if isinstance(found, tuple) else (found,)
    for port, tensor in zip(graph.outputs, found, strict=True):
        assert tensor.shape == port.sample(5).shape
        assert tensor.dtype == port.dtype
    assert (graph.inputs[0].shape[0], graph.outputs[0].shape[0]) == sizes


@pytest.mark.parametrize(
    ("kind", "sizes"), [("ppo", (4, 1)), ("sac", (60, 8)), ("ppo_unclipped", (105, 28))]
)
def test_an_observation_becomes_the_players_action(kind, sizes, make_player) -> None:
    player = make_player(kind)
    graph = make_exportable_policy(player)
    obs = observations(player)
    action = graph(obs)
    torch.testing.assert_close(action, played(player, obs))
    assert action.std() > 0.1
    assert action.abs().max() <= 1.0  # clamped by the player or, in its place, by the task
    check_ports(graph, sizes)
    # The task clamps observations and actions.
    player.env.clip_obs, player.env.clip_actions = 0.5, 0.1
    graph = make_exportable_policy(player)
    torch.testing.assert_close(graph(obs), played(player, obs))
    assert graph(obs).abs().max() == pytest.approx(0.1)


@pytest.mark.parametrize("kind", ["lstm_apart", "gru"])
def test_memory_comes_in_and_goes_out(kind, make_player) -> None:
    player = make_player(kind)
    graph = make_exportable_policy(player)
    names = ["obs", "hidden"] if kind == "gru" else ["obs", "hidden", "cell"]
    assert [port.name for port in graph.inputs] == names
    n = player.env.num_envs
    states = [0.0 * port.sample(n) for port in graph.inputs[1:]]
    for step in range(4):
        obs = observations(player, step)
        action, *states = graph(obs, *states)
        torch.testing.assert_close(action, played(player, obs))
    assert len(states) == len(names) - 1
    assert all(state.abs().max() > 0.0 for state in states)
    check_ports(graph, (4, 1))


def test_skills_take_a_latent_of_any_length(make_player: Callable[[str], Any]) -> None:
    player = make_player("gen_amp")
    graph = make_exportable_policy(player)
    assert isinstance(graph, SkillGraph)
    obs, latent = observations(player), 3.0 * torch.randn(8, LATENT_DIM)
    player._latents = lambda progress: F.normalize(latent, dim=-1)
    expected = played(player, obs)
    torch.testing.assert_close(graph(obs, latent), expected)
    assert (graph(obs, -latent) - expected).abs().max() > 1e-3
    check_ports(graph, (105, 28))


def test_a_hierarchy_decides_where_its_input_says_so(make_player: Callable[[str], Any]) -> None:
    player = make_player("hrl")
    graph = make_exportable_policy(player)
    assert isinstance(graph, HierarchyGraph)
    latent = torch.zeros(8, LATENT_DIM)
    for step in range(2 * STEPS + 1):
        obs = observations(player, step)
        decide = torch.full((8,), step % STEPS == 0)
        before = latent
        action, latent = graph(obs, latent, decide)
        torch.testing.assert_close(action, played(player, obs), rtol=1e-4, atol=1e-5)
        assert torch.equal(before, latent) == (step % STEPS != 0)
    # each row for itself
    decide = torch.arange(8) % 2 == 0
    _, after = graph(obs + 1.0, latent, decide)
    assert ((after != latent).any(dim=-1) == decide).all()
    check_ports(graph, (105, 28))
