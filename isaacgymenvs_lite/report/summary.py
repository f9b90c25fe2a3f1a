"""Summarises a run for the head of a page: what was trained, for how long, with which result."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from isaacgymenvs_lite.report.charts import (
    GOAL_TAG,
    LENGTH_TAGS,
    REWARD_TAGS,
    without_reward_of_one,
)
from isaacgymenvs_lite.report.drawing import short
from isaacgymenvs_lite.report.scalars import FPS_TAGS, Series, first_of

# Name -> tags, and how the newest value is written.
_NEWEST = {
    "task reward of an episode": (REWARD_TAGS, "{:.4g}"),
    "measured reward": (("measured/reward",), "{:.4g}"),
    "measured falls": (("measured/fall_rate",), "{:.0%}"),
    "steps of an episode": (LENGTH_TAGS, "{:.4g}"),
    "style reward per step": (("info/disc_reward_mean",), "{:.3f}"),
    "pose error": (("imitation/pose_error_m",), "{:.3f} m"),
    "motion shown": (("imitation/motion_shown",), "{:.0%}"),
    "falls in training": (("info/fall_rate",), "{:.0%}"),
    "off the clip": (("info/off_clip_rate",), "{:.0%}"),
    "discriminator accuracy": (("info/disc_acc",), "{:.2f}"),
    "learning rate": (("info/last_lr",), "{:.3g}"),
}


def summarize(run: Path, config: str, scalars: Mapping[str, Series]) -> dict[str, str]:
    """Return name -> value, as text, in the order of a page.

    Args:
        run: its folder.
        config: text of its config.yaml; '' if there is none.
        scalars: of the run, see `read_scalars`.
    """
    scalars = without_reward_of_one(scalars)
    clock = first_of(scalars, FPS_TAGS)
    tree = _tree(config)
    facts = {
        "task": _text(tree, "task", "name"),
        "algorithm": _text(tree, "train", "params", "algo", "name"),
        "networks": _text(tree, "train", "params", "network", "name"),
        "frames": f"{_frames(clock):,.0f}",
        "epochs": _epochs(scalars),
        "minutes trained": f"{clock.minutes[-1]:.1f}" if len(clock) else "",
        "frames per second": short(round(float(np.median(clock.values)))) if len(clock) else "",
    }
    for name, (tags, pattern) in _NEWEST.items():
        series = first_of(scalars, tags)
        facts[name] = pattern.format(series.last) if len(series) else ""
    for tag in sorted(tag for tag in scalars if tag.startswith(GOAL_TAG)):
        facts[tag.removeprefix(GOAL_TAG)] = f"{scalars[tag].last:.3f}" if len(scalars[tag]) else ""
    files = (file for file in run.glob("nn/*.pth") if file.is_file())
    checkpoints = sorted(files, key=lambda file: file.stat().st_mtime)
    facts["newest checkpoint"] = f"nn/{checkpoints[-1].name}" if checkpoints else ""
    return {name: value for name, value in facts.items() if value}


def _tree(config: str) -> Any:
    try:
        return yaml.safe_load(config)
    except yaml.YAMLError:
        return None  # the page shows the text as it is


def _text(tree: Any, *path: str) -> str:
    for key in path:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return "" if tree is None else str(tree)


def _frames(clock: Series) -> float:
    """Return the frames trained: the last epoch's own count is not written."""
    if len(clock) < 2:
        return clock.last if len(clock) == 0 else float(clock.frames[-1])
    return float(2 * clock.frames[-1] - clock.frames[-2])


def _epochs(scalars: Mapping[str, Series]) -> str:
    epochs = scalars.get("info/epochs")
    return "" if epochs is None else f"{epochs.last:.0f}"
