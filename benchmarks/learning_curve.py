"""The learning curve of a run from its TensorBoard files, and when it reached what."""

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
"""Names of curves -> scalar of our agents' runs, and of rl_games' own where it differs."""
_NUM_ENVS = "task.env.numEnvs"
_OF_EPISODES = ("episode_length", "episode_return")
# All environments of a resumed run begin together: in the time of one whole episode only shorter
# ones have ended, then all that are left end at once, and the next are nearly as uneven.
_UNEVEN_EPISODES = 2


@dataclass(frozen=True)
class LearningCurve:
    """The scalars of `TAGS` over a training, each possibly without values; see `read_scalars`.

    Attributes:
        series: name -> scalar.
        num_envs: environments of the training; 0 where that is not known.
    """

    series: Mapping[str, Series]
    num_envs: int = 0

    def __getitem__(self, name: str) -> Series:
        return self.series[name]

    def even(self, name: str) -> Series:
        """Return a scalar without what it was while a resumed run had ended short episodes only."""
        series, lengths = self.series[name], self.series["episode_length"]
        if name not in _OF_EPISODES or len(lengths) == 0:
            return series
        return series.without(_UNEVEN_EPISODES * float(lengths.values.max()) * self.num_envs)

    @property
    def minutes(self) -> float:
        """Minutes trained so far."""
        clock = self.series["fps"].minutes
        return float(clock[-1]) if len(clock) else 0.0

    def minutes_at(self, frames: float) -> float:
        """Return the minutes trained when a checkpoint of so many frames was written."""
        clock = self.series["fps"]
        before = int(np.searchsorted(clock.frames, frames))
        return float(clock.minutes[before - 1]) if before else 0.0


def read_learning_curve(summaries: Path) -> LearningCurve:
    """Read the event files in a run's folder summaries/; an empty curve if there are none."""
    scalars = read_scalars(summaries)
    config = summaries.parent / "config.yaml"
    register_resolvers()  # of the folder's config.yaml
    num_envs = OmegaConf.select(OmegaConf.load(config), _NUM_ENVS) if config.is_file() else None
    series = {name: first_of(scalars, tags) for name, tags in TAGS.items()}
    return LearningCurve(series, num_envs or 0)
