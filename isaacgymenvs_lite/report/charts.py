"""Sorts the scalars of a run into the charts of a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from isaacgymenvs_lite.report.scalars import FPS_TAGS, NOTHING, Series, first_of

REWARD_TAGS = ("rewards/frame", "rewards/step")
LENGTH_TAGS = ("episode_lengths/frame", "episode_lengths/step")
_NO_FALL_TAG = "imitation/no_fall_share"
_FALL_TAG = "imitation/fall_share"  # one minus the other
GOAL_TAG = "goal/"
"""What the tags of the errors of a task's goal begin with."""


@dataclass(frozen=True)
class Line:
    """One curve of a chart.

    Attributes:
        label: for the legend.
        series: with at least one value, all finite.
    """

    label: str
    series: Series


@dataclass(frozen=True)
class Chart:
    """Curves over the same axes.

    Attributes:
        title: with the unit.
        lines: at least one.
    """

    title: str
    lines: tuple[Line, ...]

    @property
    def resumed_at(self) -> list[float]:
        """The frames at which the training was resumed."""
        return sorted({start for line in self.lines for start in line.series.resumed_at})


@dataclass(frozen=True)
class _Plan:
    """A chart that runs may have: its title, and for each line a label and the tags to look for."""

    title: str
    lines: Mapping[str, tuple[str, ...]]


_TASK_PER_STEP = "task reward per step"  # made here of two scalars
_PLANS = (
    _Plan(
        "Task reward of an episode",
        {"task reward": REWARD_TAGS, "mean policy": ("measured/reward",)},
    ),
    _Plan(
        "Reward per step, by source",
        {
            "style": ("info/disc_reward_mean",),
            "encoder": ("info/enc_reward_mean",),
            "task": (_TASK_PER_STEP,),
        },
    ),
    _Plan("Length of an episode, control steps", {"length": LENGTH_TAGS}),
    _Plan("Pose error, m", {"pose error": ("imitation/pose_error_m",)}),
    _Plan(
        "Falls, share of the episodes",
        {
            "in training": ("info/fall_rate",),
            "off the clip": ("info/off_clip_rate",),
            "mean policy": (_FALL_TAG, "measured/fall_rate"),
        },
    ),
    _Plan("Tempo, multiple of the clip's", {"tempo": ("imitation/tempo",)}),
    _Plan("Share of the clips' motion shown", {"motion shown": ("imitation/motion_shown",)}),
    _Plan(
        "Discriminator accuracy, share of the samples",
        {
            "both": ("info/disc_acc",),
            "policy": ("info/disc_agent_acc",),
            "clips": ("info/disc_demo_acc",),
        },
    ),
    _Plan("Learning rate", {"learning rate": ("info/last_lr",)}),
    _Plan("Frames per second, learning included", {"frames/s": FPS_TAGS}),
)
# Tags of which each gets a chart of its own: beginning -> beginning of the title.
_EACH = {GOAL_TAG: "Goal", "reward_terms/": "Reward term, per step", "losses/": "Loss"}


def without_reward_of_one(scalars: Mapping[str, Series]) -> Mapping[str, Series]:
    """Leave out a reward of 1 a step: it equals the episode length, which has a chart."""
    reward, length = first_of(scalars, REWARD_TAGS), first_of(scalars, LENGTH_TAGS)
    if len(reward) != len(length) or not np.allclose(reward.values, length.values, rtol=1e-4):
        return scalars
    return {tag: series for tag, series in scalars.items() if tag not in REWARD_TAGS}


def main_charts(scalars: Mapping[str, Series]) -> list[Chart]:
    """Return the main charts of a training: those that the run has scalars for."""
    scalars = without_reward_of_one(scalars)
    scalars = _finite({**scalars, **_derived(scalars)})
    charts = []
    for plan in _PLANS:
        found = {label: first_of(scalars, tags) for label, tags in plan.lines.items()}
        lines = tuple(Line(label, series) for label, series in found.items() if len(series))
        if any(line.label != "task" for line in lines):  # alone it repeats the chart of its sum
            charts.append(Chart(plan.title, lines))
    return charts + [
        _single(tag, f"{title}: {tag.removeprefix(beginning)}", scalars)
        for beginning, title in _EACH.items()
        for tag in sorted(scalars)
        if tag.startswith(beginning)
    ]


def other_charts(scalars: Mapping[str, Series]) -> list[Chart]:
    """Return a chart for each scalar that is in none of the main ones."""
    shown = {tag for plan in _PLANS for tags in plan.lines.values() for tag in tags} | {
        _NO_FALL_TAG
    }
    scalars = _finite(scalars)
    return [
        _single(tag, tag, scalars)
        for tag in sorted(scalars)
        if tag not in shown and not tag.startswith(tuple(_EACH))
    ]


def _single(tag: str, title: str, scalars: Mapping[str, Series]) -> Chart:
    return Chart(title, (Line(tag, scalars[tag]),))


def _derived(scalars: Mapping[str, Series]) -> dict[str, Series]:
    reward, length = first_of(scalars, REWARD_TAGS), first_of(scalars, LENGTH_TAGS)
    derived = {}
    no_fall = scalars.get(_NO_FALL_TAG, NOTHING)
    if len(no_fall):
        derived[_FALL_TAG] = no_fall.with_values(1.0 - no_fall.values)
    if len(reward) and len(length):
        steps = np.interp(reward.frames, length.frames, length.values)
        derived[_TASK_PER_STEP] = reward.with_values(reward.values / np.maximum(steps, 1.0))
    return derived


def _finite(scalars: Mapping[str, Series]) -> dict[str, Series]:
    """Leave out values that cannot be drawn, and scalars without any other."""
    kept = {}
    for tag, series in scalars.items():
        rows = np.isfinite(series.values)
        if rows.any():
            kept[tag] = series.rows(rows)
    return kept
