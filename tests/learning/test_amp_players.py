from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest
import torch

from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.learning.amp_players import AMPPlayerContinuous, LeastSquaresAMPPlayer

CONFIG = "train.params.config"


@pytest.fixture
def checkpoint(make_agent, tmp_path) -> tuple[Any, str]:
    """A trained agent and the file it wrote."""
    agent = make_agent("max_iterations=3", f"{CONFIG}.learning_rate=1e-3")
    agent.train()
    agent.save(str(tmp_path / "model"))
    return agent, str(tmp_path / "model.pth")


def random_obs(rows: int = 20) -> torch.Tensor:
    return torch.randn(rows, 105, generator=torch.Generator().manual_seed(0))


def test_a_restored_player_acts_as_the_agent(checkpoint, make_runner):
    agent, path = checkpoint
    player = make_runner().create_player()
    untrained = player.get_action(random_obs(), is_deterministic=True)
    player.restore(path)
    action = player.get_action(random_obs(), is_deterministic=True)
    mu = agent.get_action_values({"obs": random_obs()})["mus"]
    assert torch.equal(action, mu.clamp(-1, 1))
    assert not torch.equal(action, untrained)
    # a second player from the same file
    other = make_runner().create_player()
    other.restore(path)
    assert torch.equal(other.get_action(random_obs(), is_deterministic=True), action)


def test_a_restored_player_judges_style_as_the_agent(checkpoint, make_runner):
    agent, path = checkpoint
    player = make_runner().create_player()
    amp_obs = torch.randn(20, 210, generator=torch.Generator().manual_seed(1))
    assert not torch.equal(
        player.discriminator.reward(amp_obs), agent.discriminator.reward(amp_obs)
    )
    player.restore(path)
    assert torch.equal(player.discriminator.reward(amp_obs), agent.discriminator.reward(amp_obs))


@pytest.mark.parametrize(("deterministic", "equal"), [(True, True), (False, False)])
def test_the_player_takes_means_unless_told_otherwise(deterministic, equal, make_runner):
    runner = make_runner(f"+{CONFIG}.player.deterministic={deterministic}")
    player = runner.create_player()
    obs = {"obs": random_obs(8)}
    assert torch.equal(player.act(obs), player.act(obs)) is equal


def test_means_are_the_default(make_runner):
    player = make_runner().create_player()
    obs = {"obs": random_obs(8)}
    assert torch.equal(player.act(obs), player.act(obs))


def test_a_play_measures_and_reports(checkpoint, make_runner, caplog):
    _, path = checkpoint
    runner = make_runner(f"+{CONFIG}.player.games_num=12", "task.env.episodeLength=20")
    player = runner.create_player()
    player.restore(path)
    with caplog.at_level(logging.INFO):
        player.run()
    result = player.result
    assert result is not None
    assert result.num_episodes == 16  # two in each of 8 environments
    assert 1 <= result.steps <= 20
    assert result.reward == pytest.approx(result.steps)  # the task pays 1 per step
    assert result.style_reward is not None
    assert result.imitation is not None
    assert 0 < result.imitation.pose_error_m < 2
    assert str(result) in caplog.text


def test_the_verdict_of_the_discriminator_is_shown_if_asked_for(make_runner, caplog):
    overrides = ("task.env.episodeLength=4", "task.env.enableEarlyTermination=False")
    for asked, lines in ((True, 3), (False, 0)):
        runner = make_runner(*overrides, f"+{CONFIG}.print_disc_prediction={asked}", num_envs=2)
        caplog.clear()
        with caplog.at_level(logging.INFO):
            player = runner.create_player()
            player.games_num = 1
            player.run()
        assert caplog.text.count("disc_pred") == lines


@pytest.mark.parametrize(
    ("algo", "cls", "kind"),
    [
        ("amp_agent", LeastSquaresAMPPlayer, "least_squares"),
        ("amp_continuous", AMPPlayerContinuous, "logistic"),
        ("amp", AMPPlayerContinuous, "logistic"),
    ],
)
def test_the_style_reward_of_each_player(algo, cls, kind, make_runner):
    player = make_runner(f"train.params.algo.name={algo}").create_player()
    assert type(player) is cls
    # 1.0 is worth the whole scale of 2 or 2 * 1.313262
    expected = {"least_squares": 2.0, "logistic": 2 * 1.313262}[kind]
    reward = player.discriminator.reward_from_logits(torch.tensor(1.0))
    assert reward.item() == pytest.approx(expected, abs=1e-5)


def test_a_player_that_the_file_names_is_not_taken_and_said_so(make_runner, caplog):
    with caplog.at_level(logging.INFO):
        runner = make_runner(f"+{CONFIG}.player.class_name=MyPlayer")
    note = "player.class_name=MyPlayer has no effect: the player is the class"
    assert caplog.text.count(note) == 1
    caplog.clear()
    with caplog.at_level(logging.INFO):
        runner.create_player()
    assert caplog.text.count(note) == 1


def test_a_checkpoint_without_statistics_is_refused(checkpoint, make_runner, tmp_path):
    _, path = checkpoint
    state = torch.load(path, weights_only=True)
    del state["amp_input_mean_std"]
    torch.save(state, tmp_path / "bare.pth")
    player = make_runner().create_player()
    with pytest.raises(CheckpointError, match="amp_input_mean_std") as caught:
        player.restore(str(tmp_path / "bare.pth"))
    assert "\n" not in str(caught.value)
    # without the normaliser it is not missed
    make_runner(f"{CONFIG}.normalize_amp_input=False").create_player().restore(
        str(tmp_path / "bare.pth")
    )


def test_a_task_without_reference_motions_is_refused(make_runner, monkeypatch):
    runner = make_runner()
    from isaacgymenvs_lite.tasks.amp.humanoid_amp import HumanoidAMP

    monkeypatch.delattr(HumanoidAMP, "amp_observation_space")
    with pytest.raises(ConfigError, match="amp_observation_space"):
        runner.create_player()


def test_the_player_does_not_move_statistics(checkpoint, make_runner):
    _, path = checkpoint
    player = make_runner("task.env.episodeLength=4").create_player()
    player.restore(path)
    before = {name: value.clone() for name, value in player.model.state_dict().items()}
    player.games_num = 1
    player.run()
    for name, value in player.model.state_dict().items():
        assert torch.equal(value, before[name]), name
    assert Path(path).is_file()
