"""Soft actor-critic on Ant: it trains, and a training goes on from its checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from tests.tiny import TINY_SAC


@pytest.fixture
def trained(make_classic_agent: Callable[..., Any]) -> Any:
    agent = make_classic_agent(*TINY_SAC, "max_iterations=6")
    agent.train()
    return agent


def test_it_learns_only_after_the_warm_up(make_classic_agent) -> None:
    agent = make_classic_agent(
        *TINY_SAC, "max_iterations=1", "train.params.config.num_warmup_steps=1000"
    )
    before = [parameter.clone() for parameter in agent.model.parameters()]
    agent.train()
    assert all(map(torch.equal, before, agent.model.parameters()))
    agent = make_classic_agent(*TINY_SAC, "max_iterations=6")
    before = [parameter.clone() for parameter in agent.model.sac_network.actor.parameters()]
    agent.train()
    after = list(agent.model.sac_network.actor.parameters())
    assert not any(map(torch.equal, before, after))
    assert agent.curr_frames == 8 * 8


@pytest.mark.usefixtures("bfloat16")
def test_hidden_layers_in_bfloat16_give_nearly_the_same_in_float32(make_classic_agent) -> None:
    agent = make_classic_agent(*TINY_SAC, "train.params.config.mixed_precision=True")
    plain = make_classic_agent(*TINY_SAC)
    plain.model.load_state_dict(agent.model.state_dict())
    torch.manual_seed(1)
    obs, actions = 3.0 * torch.randn(200, 60), torch.rand(200, 8)
    rounded, exact = agent.model.critic(obs, actions)[0], plain.model.critic(obs, actions)[0]
    assert rounded.dtype == torch.float32
    assert (rounded != exact).any()
    # bfloat16 has 8 bits: each of 32 summands of an output is off by 2^-9 of itself, per layer.
    torch.testing.assert_close(rounded, exact, rtol=0.02, atol=0.02 * exact.abs().max().item())
    rounded.sum().backward()
    weights = agent.model.sac_network.critic.Q1[0].weight
    assert weights.dtype == weights.grad.dtype == torch.float32
    assert weights.grad.abs().max() > 0
    # Values of hundreds keep their digits: the last layer is not rounded.
    last = agent.model.sac_network.critic.Q1[-1]
    with torch.no_grad():
        last.bias.fill_(500.0)
    shifted = agent.model.critic(obs, actions)[0]
    assert len(shifted.unique()) > 150  # in bfloat16 they would be 2 apart


@pytest.mark.usefixtures("bfloat16")
def test_it_trains_in_bfloat16(make_classic_agent) -> None:
    agent = make_classic_agent(
        *TINY_SAC, "max_iterations=6", "train.params.config.mixed_precision=True"
    )
    before = [parameter.clone() for parameter in agent.model.parameters()]
    agent.train()
    after = list(agent.model.parameters())
    assert not any(map(torch.equal, before, after))
    assert all(parameter.isfinite().all() for parameter in after)


def test_the_first_batch_may_come_in_the_middle_of_an_epoch(make_classic_agent) -> None:
    # After ten steps of 7 environments, in the second epoch: seven updates are left in it.
    agent = make_classic_agent(
        *(*TINY_SAC, "num_envs=7", "max_iterations=6", "train.params.config.batch_size=70"),
        "train.params.config.num_warmup_steps=1",
    )
    noted: list[tuple[Any, ...]] = []
    note = agent.extract_actor_stats
    agent.extract_actor_stats = lambda *args: (noted.append(args[-1]), note(*args))
    agent.train()
    losses = [loss.item() for loss, *_ in noted]
    first = next(i for i, loss in enumerate(losses) if loss != 0.0)
    # Every second step has the actor's loss of the one before.
    assert all(loss != 0.0 for loss in losses[first:])
    assert losses[first] == losses[first + 1] != losses[first + 2]
    assert all(alpha_loss is not None for *_, alpha_loss in noted)


@pytest.mark.parametrize(
    ("limit", "epochs"), [("max_iterations=2", 2), ("++train.params.config.max_frames=100", 2)]
)
def test_it_ends_at_its_limit_before_an_episode_has_ended(
    limit, epochs, make_classic_agent, tmp_path: Path
) -> None:
    """Two epochs of 8 steps of 8 environments; no episode of Ant is that short."""
    agent = make_classic_agent(*TINY_SAC, limit, "train.params.config.save_frequency=1")
    _, last_epoch = agent.train()
    assert agent.game_rewards.current_size == 0
    assert last_epoch == agent.epoch_num == epochs
    for epoch in range(1, epochs + 1):
        (file,) = tmp_path.rglob(f"last_AntSAC_ep_{epoch}_rew_-inf.pth")
        assert load_checkpoint(file)["epoch"] == epoch


def test_a_run_goes_on_with_its_temperature(trained, make_classic_agent, tmp_path: Path) -> None:
    trained.save(str(tmp_path / "saved"))
    assert trained.alpha.item() != 1.0
    resumed = make_classic_agent(*TINY_SAC, "max_iterations=8")
    resumed.restore(str(tmp_path / "saved.pth"))
    assert resumed.alpha.item() == pytest.approx(trained.alpha.item())
    assert resumed.epoch_num == trained.epoch_num
    before = [parameter.clone() for parameter in resumed.model.sac_network.actor.parameters()]
    # One step of 8 environments: the replay buffer, empty again, holds no batch of 64 yet.
    resumed.init_tensors()
    resumed.obs = resumed.env_reset()
    resumed.num_steps_per_episode = 1
    resumed.play_steps()
    assert all(map(torch.equal, before, resumed.model.sac_network.actor.parameters()))
    resumed.num_steps_per_episode = 16
    resumed.play_steps()
    assert not any(map(torch.equal, before, resumed.model.sac_network.actor.parameters()))


@pytest.mark.slow
def test_what_is_saved_is_what_plays(trained, make_classic_runner, tmp_path: Path) -> None:
    trained.save(str(tmp_path / "saved"))
    load_checkpoint(tmp_path / "saved.pth")  # without running code
    player = make_classic_runner(
        *TINY_SAC, "+train.params.config.player.games_num=8"
    ).create_player()
    player.restore(str(tmp_path / "saved.pth"))
    obs = {"obs": torch.randn(8, 60)}
    trained.set_eval()
    with torch.no_grad():
        expected = trained.act(obs["obs"], None)
    assert torch.equal(player.act(obs), expected)
    player.run()
    assert player.result.num_episodes == 8
    assert player.result.steps > 1


def test_the_best_policy_of_a_training_plays(make_classic_agent, make_classic_runner) -> None:
    """rl_games' mean reward of SAC is an array without axes, its other agents' a number."""
    agent = make_classic_agent(
        *TINY_SAC,
        *("max_iterations=4", "task.env.episodeLength=8"),
        "train.params.config.save_best_after=1",
    )
    best, _ = agent.train()
    file = Path(agent.nn_dir) / f"{agent.config['name']}.pth"
    state = load_checkpoint(file)
    assert type(state["last_mean_rewards"]) is float
    assert state["last_mean_rewards"] == pytest.approx(float(best))
    player = make_classic_runner(
        *TINY_SAC, "+train.params.config.player.games_num=8", "task.env.episodeLength=8"
    ).create_player()
    player.restore(str(file))
    player.run()
    assert player.result.num_episodes == 8
