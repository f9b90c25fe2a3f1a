"""Agents of AMP with a critic that observes more than the policy."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.learning.conftest import make_training_set
from tests.tiny import CONFIG

ASYMMETRIC = (
    *("task=RobotAMP", "train=RobotAMPPPO", "task.env.motion_file=g1_walk.npz"),
    *("task.env.observations=deployable", "task.env.historySteps=2"),
)
SHORT_EPISODES = ("task.env.episodeLength=4", "task.env.enableEarlyTermination=False")


def weights(module: torch.nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in module.named_parameters()}


def changed(before: dict[str, Tensor], module: torch.nn.Module) -> set[str]:
    return {name for name, p in module.named_parameters() if not torch.equal(p, before[name])}


def values_of(agent: Any, states: Tensor) -> Tensor:
    """The critic's values by their formula: normalise, evaluate, denormalise; in float64."""
    model = agent.central_value_net.model
    stats, value_stats = model.running_mean_std, model.value_mean_std
    normalized = (states.double() - stats.running_mean) / (stats.running_var + 1e-5).sqrt()
    rows = {"obs": normalized.clamp(-5, 5).float()}
    with torch.no_grad():
        raw = model.a2c_network(rows)[0].double()
    scale = (value_stats.running_var + 1e-5).sqrt()
    return value_stats.running_mean + scale * raw.clamp(-5, 5)


def scramble(agent: Any) -> None:
    generator = torch.Generator().manual_seed(5)
    model = agent.central_value_net.model
    for normalizer in (model.running_mean_std, model.value_mean_std):
        shape = normalizer.running_mean.shape
        normalizer.running_mean.copy_(torch.rand(shape, generator=generator) + 0.5)
        normalizer.running_var.copy_(torch.rand(shape, generator=generator) + 2.0)


def test_values_and_bootstraps_are_those_of_the_states(make_agent, roll_out):
    agent = make_agent(*ASYMMETRIC, *SHORT_EPISODES, f"{CONFIG}.horizon_length=6")
    scramble(agent)
    before, after = [], []
    vec_env = agent.vec_env
    reset_done, step = vec_env.reset_done, vec_env.step

    def noting_reset_done() -> Any:
        obs, ids = reset_done()
        before.append(obs["states"].clone())
        return obs, ids

    def noting_step(actions: Tensor) -> Any:
        obs, rewards, dones, infos = step(actions)
        if len(after) == 1:  # the first episode fails in the second step
            dones[0] = infos["terminate"][0] = vec_env.env.reset_buf[0] = 1
        after.append(obs["states"].clone())
        return obs, rewards, dones, infos

    vec_env.reset_done, vec_env.step = noting_reset_done, noting_step
    roll_out(agent)
    buffer = agent.experience_buffer.tensor_dict
    assert torch.equal(buffer["states"], torch.stack(before))
    assert buffer["obses"].shape[-1] == 2 * 93 and buffer["states"].shape[-1] == 83 + 29 + 1
    # float32 networks and statistics
    expected = torch.stack([values_of(agent, states) for states in before])
    torch.testing.assert_close(buffer["values"].double(), expected, rtol=1e-5, atol=1e-5)
    expected = torch.stack([values_of(agent, states) for states in after])
    expected[1, 0] = 0.0
    torch.testing.assert_close(buffer["next_values"].double(), expected, rtol=1e-5, atol=1e-5)
    assert agent.value_mean_std is agent.central_value_net.model.value_mean_std


@pytest.mark.parametrize("own_learns", [False, True])
def test_the_critic_learns_and_the_networks_own_where_it_is_asked_to(
    own_learns, make_agent, roll_out
):
    agent = make_agent(*ASYMMETRIC, f"{CONFIG}.use_experimental_cv={own_learns}")
    central = agent.central_value_net
    make_training_set(agent, roll_out(agent))
    rows = central.dataset.values_dict
    assert torch.equal(
        rows["obs"], agent.experience_buffer.tensor_dict["states"].transpose(0, 1).flatten(0, 1)
    )
    assert torch.equal(rows["returns"], agent.dataset.values_dict["returns"])
    before, policy = weights(central.model), weights(agent.model)
    agent.train_central_value()
    assert changed(before, central.model) == set(before)
    assert changed(policy, agent.model) == set()
    agent.train_actor_critic(agent.dataset[0])
    critic = {name for name in policy if "critic_mlp" in name or ".value." in name}
    assert critic
    moved = changed(policy, agent.model)
    assert (critic <= moved) is own_learns
    assert bool(critic & moved) is own_learns
    assert {name for name in policy if "actor_mlp" in name} <= moved
    (loss,) = agent.train_log["critic_loss"]
    assert (float(loss) > 0.0) is own_learns


def test_a_symmetric_policy_has_none(make_agent):
    agent = make_agent(*ASYMMETRIC, "task.env.asymmetric_observations=False")
    assert not agent.has_central_value and agent.has_value_loss
    with pytest.raises(AttributeError, match="central_value_config"):
        _ = agent.central_value_net
