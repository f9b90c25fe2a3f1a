"""Settings of published PPO files that change how rl_games' own agent trains, on Cartpole."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.tiny import CONFIG, TINY_PPO

TINY = ("task=Cartpole", *TINY_PPO, "num_envs=16", "max_iterations=4", f"{CONFIG}.mini_epochs=2")
START = 3e-4


@pytest.mark.parametrize(
    ("settings", "least", "most"),
    [
        (("lr_schedule=constant",), START, START),
        (("lr_schedule=fixed",), START, START),  # IsaacGymEnvs' Factory files
        # Used up when the training ends; rl_games' least is 1e-6.
        (("lr_schedule=linear",), 1e-6, 1e-6),
        # Every policy moves too far: divided by 1.5 after each of eight mini-epochs, or
        # minibatches, of which an epoch here has one; not below 1e-6.
        (("lr_schedule=adaptive", "schedule_type=legacy", "kl_threshold=1e-12"), 1e-6, START / 10),
        (
            ("lr_schedule=adaptive", "schedule_type=standard", "kl_threshold=1e-12"),
            1e-6,
            START / 10,
        ),
        (("lr_schedule=adaptive", "kl_threshold=1e9"), 10 * START, 1e-2),
    ],
)
def test_schedules_of_the_learning_rate(
    make_classic_agent: Callable[..., Any], settings: tuple[str, ...], least: float, most: float
) -> None:
    agent = make_classic_agent(*TINY, *(f"{CONFIG}.{setting}" for setting in settings))
    assert agent.last_lr == START
    agent.train()
    rate = agent.optimizer.param_groups[0]["lr"]
    assert least * (1 - 1e-6) <= rate <= most * (1 + 1e-6)


def test_actor_and_critic_may_share_no_layers(make_classic_agent: Callable[..., Any]) -> None:
    agent = make_classic_agent(*TINY, "train.params.network.separate=True")
    network = agent.model.a2c_network
    before = [p.clone() for p in network.critic_mlp.parameters()]
    agent.train()
    assert not set(network.critic_mlp.parameters()) & set(network.actor_mlp.parameters())
    assert any(
        (old != new).any() for old, new in zip(before, network.critic_mlp.parameters(), strict=True)
    )


def test_a_larger_model_by_one_factor(make_classic_agent: Callable[..., Any]) -> None:
    agent = make_classic_agent(*TINY, "+train.params.network.mlp.model_size_multiplier=3")
    assert agent.model.a2c_network.actor_mlp[0].out_features == 48
