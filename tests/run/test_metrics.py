from __future__ import annotations

import pytest
import torch

from isaacgymenvs_lite.run.metrics import EpochMetrics, MetricsObserver


@pytest.fixture
def figures(agent) -> MetricsObserver:
    observer = MetricsObserver()
    observer.after_init(agent)
    return observer


def end(observer: MetricsObserver, rows: list[int], **infos: list[int]) -> None:
    """A step of four environments after which the episodes of `rows` have ended."""
    flags = {name: torch.tensor(values) for name, values in infos.items()}
    # rl_games gives done indices as a column
    observer.process_infos(flags, torch.tensor(rows, dtype=torch.int64).view(-1, 1))


def test_figures_of_an_epoch(figures, agent):
    agent.game_lengths.update(torch.tensor([[100.0], [110.0]]))
    agent.game_rewards.update(torch.tensor([[5.0], [6.0]]))
    end(figures, [0, 2], terminate=[1, 1, 0, 0], time_outs=[0, 0, 1, 0])
    assert figures.latest is None
    figures.after_print_stats(16000, 3, 12.5)
    latest = figures.latest
    assert latest == EpochMetrics(3, 16000, 105.0, 5.5, 0.5, None, agent.train_info)
    assert latest is not None
    assert latest.style_reward == 0.4567
    assert latest.disc_accuracy == pytest.approx(0.8)
    assert agent.writer.scalars == {
        "info/fall_rate": [(16000, 0.5)],
        "info/disc_acc": [(16000, pytest.approx(0.8))],
    }


def test_before_the_first_episode_has_ended_nothing_is_said_of_episodes(figures, agent):
    end(figures, [], terminate=[0, 0, 0, 0])
    figures.after_print_stats(16000, 1, 12.5)
    assert figures.latest == EpochMetrics(1, 16000, train_info=agent.train_info)
    assert set(agent.writer.scalars) == {"info/disc_acc"}


def test_episodes_that_left_their_clip_are_no_falls(figures, agent):
    flags = {"terminate": [1, 1, 1, 0], "off_clip": [True, False, True, False]}
    end(figures, [0, 1, 3], **flags)
    figures.after_print_stats(16000, 1, 12.5)
    assert figures.latest is not None
    assert figures.latest.fall_rate == pytest.approx(1 / 3)
    assert figures.latest.early_end_rate == pytest.approx(2 / 3)
    assert figures.latest.off_clip_rate == pytest.approx(1 / 3)
    assert agent.writer.scalars["info/off_clip_rate"] == [(16000, pytest.approx(1 / 3))]


def test_a_diverged_episode_is_neither_a_fall_nor_none(figures):
    flags = {"terminate": torch.tensor([1, 0, 0]), "diverged": torch.tensor([False, True, False])}
    figures.process_infos(flags, torch.tensor([[0], [1]]))
    figures.after_print_stats(16000, 1, 12.5)
    assert figures.latest is not None
    assert figures.latest.fall_rate == 1.0


def end_with_successes(observer: MetricsObserver, rows: list[int]) -> None:
    successes = {"at_goal": torch.tensor([True, False, True, True]), "goals": torch.arange(4)}
    flags = {"successes": successes, "diverged": torch.tensor([False, False, False, True])}
    observer.process_infos(flags, torch.tensor(rows, dtype=torch.int64).view(-1, 1))


def test_successes_are_those_of_ended_episodes(figures, agent):
    end_with_successes(figures, [])
    figures.after_print_stats(1000, 1, 0.0)
    assert figures.latest is not None
    assert figures.latest.successes == {}
    end_with_successes(figures, [1, 3])  # the last one diverged
    end_with_successes(figures, [0, 2])
    figures.after_print_stats(2000, 2, 0.0)
    assert figures.latest.successes == {"at_goal": pytest.approx(2 / 3), "goals": 1.0}
    assert agent.writer.scalars["success/at_goal"] == [(2000, pytest.approx(2 / 3))]
    assert agent.writer.scalars["success/goals"] == [(2000, 1.0)]
    figures.after_clear_stats()
    figures.after_print_stats(3000, 3, 0.0)
    assert figures.latest.successes == {}


def test_successes_are_in_checkpoints(figures, agent):
    end_with_successes(figures, [0, 1])
    resumed = MetricsObserver()
    resumed.after_init(agent)
    resumed.load_state_dict(figures.state_dict())
    end_with_successes(resumed, [2])  # a third episode, and `games_to_track` is 3
    resumed.after_print_stats(1000, 1, 0.0)
    assert resumed.latest is not None
    assert resumed.latest.successes == {"at_goal": pytest.approx(2 / 3), "goals": 1.0}


def test_a_checkpoint_from_before_there_were_successes(figures, agent):
    end_with_successes(figures, [0, 1])
    older = figures.state_dict()
    del older["successes"]
    figures.load_state_dict(older)
    figures.after_print_stats(1000, 1, 0.0)
    assert figures.latest is not None
    assert figures.latest.successes == {}
    end_with_successes(figures, [2])
    figures.after_print_stats(2000, 2, 0.0)
    assert figures.latest.successes == {"at_goal": 1.0, "goals": 2.0}


def test_the_best_reward_of_all_epochs(figures, agent):
    figures.after_print_stats(0, 1, 0.0)
    assert figures.best_reward is None
    for epoch, reward in enumerate((-9.0, -3.0, -5.0), start=2):
        agent.game_rewards.clear()
        agent.game_rewards.update(torch.tensor([[reward]]))
        agent.game_lengths.update(torch.tensor([[10.0]]))
        figures.after_print_stats(1000 * epoch, epoch, 0.0)
    assert figures.best_reward == -3.0
