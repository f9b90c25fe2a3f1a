"""As much of an agent as observers read, and a clock that a test sets."""

from __future__ import annotations

import types
from typing import Any

import numpy as np
import pytest
from rl_games.algos_torch.torch_ext import AverageMeter

from isaacgymenvs_lite.evaluation.evaluate import EvaluationResult
from isaacgymenvs_lite.evaluation.pose_error import ImitationResult
from isaacgymenvs_lite.run import diagnostics, measurement, progress


class Writer:
    """Keeps scalars {tag: [(x, value), ...]} and texts."""

    def __init__(self) -> None:
        self.scalars: dict[str, list[tuple[float, float]]] = {}
        self.texts: list[tuple[str, str, float]] = []

    def add_scalar(self, tag: str, value: float, x: float) -> None:
        self.scalars.setdefault(tag, []).append((x, value))

    def add_text(self, tag: str, text: str, x: float) -> None:
        self.texts.append((tag, text, x))


class Agent:
    """What observers read of an AMP agent."""

    def __init__(self) -> None:
        self.writer = Writer()
        self.config: dict[str, Any] = {
            "task_reward_w": 0.0,
            "disc_reward_w": 1.0,
            "disc_reward_scale": 2,
            "disc_grad_penalty": 5,
            "learning_rate": 5e-5,
            "amp_minibatch_size": 512,
        }
        self.ppo_device = "cpu"
        self.games_to_track = 3
        self.max_epochs = 20
        self.curr_frames = self.frame = 1000
        self.game_lengths = AverageMeter(1, 100)
        self.game_rewards = AverageMeter(1, 100)
        self.train_info = {
            "disc_reward_mean": 0.4567,
            "disc_agent_acc": 0.7,
            "disc_demo_acc": 0.9,
        }

    def train_info_means(self) -> dict[str, float]:
        return self.train_info


@pytest.fixture
def agent() -> Agent:
    return Agent()


@pytest.fixture
def result() -> EvaluationResult:
    """Return an evaluation of a fair policy."""
    measured = ImitationResult(
        pose_error_m=0.123,
        per_episode=np.full(16, 0.123),
        nearest_clip=np.zeros(16, dtype=np.int64),
        tempo=1.02,
        no_fall_share=0.9,
        mean_episode_steps=90.5,
        num_episodes=16,
        motion_shown=0.87,
    )
    return EvaluationResult(16, 100.0, 90.5, 0.3, measured)


@pytest.fixture
def clock(monkeypatch) -> Any:
    """Seconds that pass only when a test adds them."""
    fake = types.SimpleNamespace(now_s=100.0)
    fake.monotonic = lambda: fake.now_s
    for module in (diagnostics, measurement, progress):
        monkeypatch.setattr(module, "time", fake)
    return fake
