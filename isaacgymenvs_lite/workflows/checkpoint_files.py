"""Checkpoints of all libraries: told apart, and read without running code of theirs.

The libraries' own `load` functions unpickle whatever a file holds. Here parameters are read alone;
what they are of is made from the agent file.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from isaacgymenvs_lite.checkpoints.archive import read_archive
from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.workflows.library import Library

# Library -> keys that only its checkpoints have; Stable-Baselines3's are archives of files.
_KEYS: dict[str, set[str]] = {
    "rsl_rl": {"actor_state_dict", "critic_state_dict"},
    "skrl": {"policy", "value", "optimizer"},
    "rl_games": {"model"},
}
_SB3, _SB3_MEMBER = "sb3", "policy.pth"


def read_parameters(checkpoint: Path, library: Library) -> dict[str, Any]:
    """Return the tensors of a checkpoint, on the CPU: nested dictionaries of them by name.

    Of Stable-Baselines3 an empty dictionary, as its archive holds other files; its workflow reads
    them.

    Raises:
        CheckpointError: no such file, one that is damaged or would run code, or one of another
            library.
    """
    if not checkpoint.is_file():
        raise CheckpointError(f"--checkpoint {checkpoint}: no such file")
    content: dict[str, Any] = {}
    if _is_sb3(checkpoint):
        kind = _SB3
    else:
        content = _read(checkpoint, library)
        kinds = (name for name, keys in _KEYS.items() if keys <= content.keys())
        kind = next(kinds, None)
    if kind != library.name:
        raise CheckpointError(_other(checkpoint, library, kind))
    return content


def apply(change: Callable[[], object], checkpoint: Path) -> None:
    """Put parameters of a checkpoint into networks.

    Raises:
        CheckpointError: they are of other networks.
    """
    try:
        change()
    except (KeyError, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise CheckpointError(
            f"--checkpoint {checkpoint}: of another network or task ({reason[:160]}); give the task"
            " and overrides of its training"
        ) from error


def _is_sb3(checkpoint: Path) -> bool:
    if not zipfile.is_zipfile(checkpoint):
        return False
    with zipfile.ZipFile(checkpoint) as archive:
        return _SB3_MEMBER in archive.namelist()


def _read(checkpoint: Path, library: Library) -> dict[str, Any]:
    try:
        content = read_archive(checkpoint)
    except Exception as error:  # bytes that are no checkpoint may make the reader raise anything
        raise CheckpointError(
            f"--checkpoint {checkpoint}: damaged, or no checkpoint, or with more than tensors in it"
            f" (nothing was run); expected one of {library.title}"
        ) from error
    return dict(content) if isinstance(content, Mapping) else {}


def _other(checkpoint: Path, library: Library, kind: str | None) -> str:
    hint = ""
    if kind == "rl_games":
        hint = f"; play it with python train.py task=... test=True checkpoint={checkpoint}"
    elif kind is not None:
        hint = f"; play it with python -m isaacgymenvs_lite.workflows.{kind}.play"
    what = f"a checkpoint of {kind}" if kind else "no checkpoint of a known library"
    return f"--checkpoint {checkpoint}: {what}, expected one of {library.title}{hint}"
