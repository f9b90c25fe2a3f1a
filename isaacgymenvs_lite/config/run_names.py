"""Reads the name of a run, from which its folder below `runs/` and its checkpoints are named."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.schema import select

TRAIN_DIR = "train.params.config.train_dir"
"""Path of the setting for the folder of all runs."""
DEFAULT_TRAIN_DIR = "runs"
_NAME_IN_FILE = "train.params.config.name"
MAX_LEVELS = 5
"""Largest number of folders in a name; `amp/walk1` has two."""
# File systems allow 255 bytes; a date, an epoch and a reward are added to the name.
_MAX_BYTES = 160


def train_dir_of(words: Sequence[str]) -> Path:
    """Return the folder of all runs that a command line names, or the default."""
    typed = dict(word.lstrip("+").split("=", 1) for word in words if "=" in word)
    return Path(typed.get(TRAIN_DIR, DEFAULT_TRAIN_DIR))


def run_name_of(tree: dict[str, Any]) -> PurePosixPath:
    """Return the name of the runs of a resolved tree: `experiment`, or the train file's name."""
    for key in ("experiment", _NAME_IN_FILE):
        given = select(tree, key)
        if given not in (None, ""):
            return read_run_name(given, key)
    raise ConfigError(f"the key '{_NAME_IN_FILE}' is missing; give experiment=NAME")


def read_run_name(given: Any, key: str) -> PurePosixPath:
    """Return a run's name as a relative path; the last component of the path names checkpoints.

    Args:
        given: a name such as `walk1` or `amp/walk1`.
        key: the setting, for messages.

    Raises:
        ConfigError: the name leads out of the folder, or cannot be the name of a folder.
    """
    text = str(given)
    path = PurePosixPath(text.strip())
    levels = [part.strip() for part in path.parts]
    problem = ""
    if path.is_absolute() or ".." in levels or text.strip().startswith("~") or "\\" in text:
        problem = "leads out of the folder of the runs"
    elif not levels or "" in levels or not text.isprintable() or len(levels) > MAX_LEVELS:
        problem = f"cannot be the name of a folder, or of folders up to {MAX_LEVELS} levels deep"
    elif max(len(part.encode(errors="replace")) for part in levels) > _MAX_BYTES:
        problem = f"is longer than {_MAX_BYTES} bytes"
    if problem:
        short = text if len(text) <= 40 else f"{text[:40]}..."
        raise ConfigError(
            f"{key}={short!r} {problem}; expected a name such as walk1, or amp/walk1 for a run in a"
            " folder of its own"
        )
    return PurePosixPath(*levels)
