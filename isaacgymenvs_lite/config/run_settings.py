"""The keys of `train.params.config` that all agents of rl_games read, with their limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.schema import setting

ENV_NAME = "rlgpu"
"""What train files call the environment: the task that is made for them."""


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """How long a training is, what it stores and prints."""

    name: str = setting()
    """Experiment and checkpoint name."""
    env_name: str = setting(ENV_NAME)
    train_dir: str = setting("runs")
    """Folder of the run folders."""
    max_epochs: int = setting(-1, minimum=-1)
    """-1 for no limit."""
    max_frames: int = setting(-1, minimum=-1)
    score_to_win: float = setting(float("inf"))
    """Mean episode reward at which training ends."""
    save_best_after: int = setting(100, minimum=0)
    save_frequency: int = setting(0, minimum=0)
    print_stats: bool = setting(True)
    games_to_track: int = setting(100, minimum=1)
    reward_shaper: Mapping[str, Any] = setting({})
