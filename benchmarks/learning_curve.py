"""Reads the learning curve of a run from its TensorBoard files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from isaacgymenvs_lite.config.resolvers import register_resolvers
from isaacgymenvs_lite.report.scalars import FPS_TAGS, Series, first_of, read_scalars

TAGS = {
    "fps": FPS_TAGS,
    "episode_length": ("episode_lengths/frame", "episode_lengths/step"),
    "pose_error_m": ("imitation/pose_error_m",),
    "no_fall_share": ("imitation/no_fall_share",),
    "tempo": ("imitation/tempo",),
    "motion_shown": ("imitation/motion_shown",),
    "style_reward": ("info/disc_reward_mean",),
    "fall_rate": ("info/fall_rate",),
    "disc_agent_acc": ("info/disc_agent_acc",),
    "disc_demo_acc": ("info/disc_demo_acc",),
    "disc_agent_logit": ("info/disc_agent_logit",),
    "disc_demo_logit": ("info/disc_demo_logit",),
    "episode_return": ("rewards/frame", "rewards/step"),
}
"""The table maps each curve to the tag of our agents, then to the tag of rl_games' agents."""
# In a resumed run all episodes begin together, so short episodes end first and long ones together.
# The means of finished episodes are biased for about this many full episodes.
_UNEVEN_EPISODES = 2


@dataclass(frozen=True)
class LearningCurve:
    """The scalars of `TAGS` over a training; a scalar may have no values. See `read_scalars`.

    Attributes:
        series: name -> scalar.
        num_envs: number of environments of the training; 0 if unknown.
    """

    series: Mapping[str, Series]
    num_envs: int = 0

    def __getitem__(self, name: str) -> Series:
        return self.series[name]

    def even(self, name: str) -> Series:
        """Return a scalar; drop the biased means of episodes at the start of a resumed run."""
        series, lengths = self.series[name], self.series["episode_length"]
        if name not in ("episode_length", "episode_return") or len(lengths) == 0:
            return series
        return series.without(_UNEVEN_EPISODES * float(lengths.values.max()) * self.num_envs)

    @property
    def minutes(self) -> float:
        """The trained minutes."""
        clock = self.series["fps"].minutes
        return float(clock[-1]) if len(clock) else 0.0

    def minutes_at(self, frames: float) -> float:
        """Return the minutes of training before the checkpoint with this number of frames."""
        clock = self.series["fps"]
        before = int(np.searchsorted(clock.frames, frames))
        return float(clock.minutes[before - 1]) if before else 0.0


def read_learning_curve(summaries: Path) -> LearningCurve:
    """Read the event files of a run's folder summaries/; without files the curve is empty."""
    scalars = read_scalars(summaries)
    config = summaries.parent / "config.yaml"
    num_envs = 0
    if config.is_file():
        register_resolvers()  # config.yaml may use them
        num_envs = OmegaConf.select(OmegaConf.load(config), "task.env.numEnvs") or 0
    return LearningCurve({name: first_of(scalars, tags) for name, tags in TAGS.items()}, num_envs)
