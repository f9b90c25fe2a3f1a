"""MeasurementObserver with a real agent and simulations of its own."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from isaacgymenvs_lite.run.measurement import MeasurementObserver


@pytest.fixture
def observed(make_agent, make_runner) -> tuple[Any, MeasurementObserver]:
    """An agent in the middle of an episode, and its observer with four environments."""
    agent = make_agent("max_iterations=1", "task.env.episodeLength=12")

    def make_env(num_envs: int) -> Any:
        runner = make_runner("task.env.episodeLength=12", num_envs=num_envs)
        return runner.create_player().env

    observer = MeasurementObserver(make_env, 1, 4)
    observer.after_init(agent)
    agent.train()
    return agent, observer


def numbers(observer: MeasurementObserver) -> tuple[float, float, float]:
    result = observer.measure()
    assert result.imitation is not None
    return result.steps, result.reward, result.imitation.pose_error_m


def test_measurements_of_the_same_policy_are_the_same(observed):
    _, observer = observed
    first = numbers(observer)
    torch.rand(7)  # the training goes on drawing numbers
    assert numbers(observer) == first


def test_measurements_of_another_policy_differ(observed):
    agent, observer = observed
    first = numbers(observer)
    with torch.no_grad():
        agent.model.a2c_network.mu.bias += 1.0
    assert numbers(observer)[2] != first[2]


def test_the_training_is_not_disturbed(observed):
    agent, observer = observed
    numbers(observer)  # makes the simulations, here through a Runner, which seeds
    torch.manual_seed(3)
    before = {name: value.clone() for name, value in agent.model.state_dict().items()}
    state = agent.vec_env.env.simulation.root_states.clone()
    random_state = torch.get_rng_state()
    numbers(observer)
    assert torch.equal(torch.get_rng_state(), random_state)
    assert torch.equal(agent.vec_env.env.simulation.root_states, state)
    for name, value in agent.model.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_the_mean_action_is_played_within_its_limits(observed):
    agent, _ = observed
    with torch.no_grad():
        agent.model.a2c_network.mu.bias.fill_(3.0)
    actions = agent.mean_policy(agent.vec_env.env)({"obs": torch.zeros(4, 105)})
    assert torch.equal(actions, torch.ones(4, 28))
