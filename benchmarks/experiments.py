"""Turns the experiment names of experiments.yaml into settings of train.py."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from isaacgymenvs_lite.config.staging import read_yaml
from isaacgymenvs_lite.errors import ConfigError, unknown

TABLE = Path(__file__).with_name("experiments.yaml")
_MOTION_KEY = "task.env.motion_file"


@dataclass(frozen=True)
class Experiment:
    """One training configuration.

    Attributes:
        name: `<clip>[+<variant> ...]`.
        settings: overrides for train.py except seed, threads and the run's files.
    """

    name: str
    settings: tuple[str, ...]


def find_experiment(
    name: str, motion_file: str | None = None, extra: Sequence[str] = ()
) -> Experiment:
    """Return the experiment of this name.

    Args:
        name: `<clip>[+<variant> ...]`.
        motion_file: clip of an experiment whose entry names no clip.
        extra: additional overrides, which take precedence.

    Raises:
        ConfigError: the name is unknown, or the clip is missing or does not exist.
    """
    entries: Any = OmegaConf.to_container(read_yaml(TABLE))
    clip_name, *variants = name.split("+")
    if clip_name not in entries["experiments"]:
        raise ConfigError(unknown("experiment", clip_name, entries["experiments"]))
    for variant in variants:
        if variant not in entries["variants"]:
            raise ConfigError(unknown("variant", variant, entries["variants"]))
    entry = entries["experiments"][clip_name]
    clip = []
    if "motion_file" in entry:
        file = entry["motion_file"] or _given_clip(clip_name, motion_file)
        clip.append(override(_MOTION_KEY, file))
    settings = [
        override("task", entry.get("task", "HumanoidAMP")),
        *entries["common"],
        *clip,
        *entry.get("settings", []),
        *(setting for variant in variants for setting in entries["variants"][variant]),
        *extra,
    ]
    return Experiment(name, tuple(settings))


def needs_motion_file(name: str) -> bool:
    """Return whether the command line has to name the experiment's clip."""
    entry = read_yaml(TABLE).experiments.get(name.split("+")[0])
    return entry is not None and "motion_file" in entry and entry.motion_file is None


def _given_clip(name: str, motion_file: str | None) -> str:
    if motion_file is None:
        raise ConfigError(f"the experiment '{name}' needs its clip; add --motion-file PATH")
    path = Path(motion_file).expanduser()
    if not path.is_file():
        raise ConfigError(
            f"--motion-file {motion_file}: no such file; expected a .npz or .npy clip"
        )
    return str(path.absolute())


def override(key: str, value: str) -> str:
    """Return `key=value` and quote the value for Hydra if it holds unusual characters."""
    if re.fullmatch(r"[\w./:+-]+", value):
        return f"{key}={value}"
    return "{}='{}'".format(key, value.replace("'", "\\'"))
