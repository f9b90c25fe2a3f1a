"""The folder of one training: `logs/<library>/<task>/<date>/` with params/ and checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.workflows.library import Library

_ENV_FILE, _AGENT_FILE = "params/env.yaml", "params/agent.yaml"


def create_folder(
    logs: Path, library: Library, task: str, env: Mapping[str, Any], agent: Mapping[str, Any]
) -> Path:
    """Make the folder of a training and write what it is made of.

    Args:
        logs: folder of all of them.
        library: the library.
        task: name of the task file.
        env: the task's settings.
        agent: those of the agent.

    Raises:
        ConfigError: the folder cannot be written.
    """
    folder = logs / library.name / task / date()
    try:
        (folder / "params").mkdir(parents=True)
        for name, content in ((_ENV_FILE, env), (_AGENT_FILE, agent)):
            text = yaml.safe_dump(dict(content), sort_keys=False)
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"cannot write the log folder {folder.absolute()} ({error.strerror or error}); choose"
            " another with --logs FOLDER"
        ) from error
    return folder


def date() -> str:
    """Return the present time as names of folders and files have it."""
    return datetime.now().strftime("%Y-%m-%d_%H-%M-%S-%f")


def last_checkpoint(logs: Path, library: Library, task: str) -> Path:
    """Return the newest checkpoint of a task's trainings.

    Raises:
        CheckpointError: there is none.
    """
    folder = logs / library.name / task
    files = [file for pattern in library.checkpoints for file in folder.glob(f"*/{pattern}")]
    if not files:
        raise CheckpointError(
            f"no checkpoint below {folder.absolute()}; train one first, or give --checkpoint FILE:"
            f" {library.command('train')} --task {task}"
        )
    return max(files, key=lambda file: file.stat().st_mtime)


def agent_file_of(checkpoint: Path) -> Path | None:
    """Return the agent file that a checkpoint's training was made of, if it is in its folder."""
    for folder in checkpoint.parents[:2]:
        if (folder / _AGENT_FILE).is_file():
            return folder / _AGENT_FILE
    return None


def folder_of(checkpoint: Path) -> Path:
    """Return the folder of a checkpoint's training; its own if there is none."""
    file = agent_file_of(checkpoint)
    return checkpoint.parent if file is None else file.parent.parent
