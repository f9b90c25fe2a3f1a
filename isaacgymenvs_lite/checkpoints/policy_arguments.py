"""Completes command lines with a shipped policy, `checkpoint=<name>`, by its settings."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from isaacgymenvs_lite.checkpoints.shipped import shipped_policies
from isaacgymenvs_lite.config.hydra_bridge import quoted

log = logging.getLogger(__name__)


def playing_overrides(name: str) -> list[str]:
    """Return the overrides that a shipped policy needs to act, for `config.compose`.

    These are the settings that must be as in its training: no `checkpoint`, devices or sizes.

    Raises:
        KeyError: no such policy.
        CheckpointError: its file is damaged.
    """
    # imports torch, which other command lines do without
    from isaacgymenvs_lite.checkpoints.packed import read_policy_info

    info = read_policy_info(shipped_policies()[name])
    log.info("%s: %s", name, info)
    settings = [f"++{path}={as_override(value)}" for path, value in info.settings.items()]
    # The whole network is packed: keys that it lacks must not come from today's train file.
    return [f"task={info.task}", "~train.params.network", *settings]


def complete_arguments(arguments: Sequence[str]) -> list[str]:
    """Return a command line with the settings of the shipped policy that it plays or trains on.

    They are inserted before the typed words, which override them. A command line without a shipped
    policy is returned as it is.

    Args:
        arguments: as `sys.argv[1:]`: `test=True checkpoint=walk num_envs=4`.

    Raises:
        CheckpointError: the policy's file is damaged.
    """
    arguments = list(arguments)
    typed = dict(word.split("=", 1) for word in arguments if "=" in word)
    name = typed.get("checkpoint", "")
    if name not in shipped_policies():
        return arguments
    settings = playing_overrides(name)
    if "task" in typed:
        settings = settings[1:]
    # Beside the others, because Hydra's parser expects all overrides in one piece.
    place = next(i for i, word in enumerate(arguments) if "=" in word)
    return [*arguments[:place], *settings, *arguments[place:]]


def as_override(value: Any) -> str:
    """Return a value as Hydra's grammar writes it; text is quoted."""
    if value is None:
        return "null"
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, (list, tuple)):
        return f"[{','.join(as_override(entry) for entry in value)}]"
    if isinstance(value, dict):
        entries = (f"{key}:{as_override(entry)}" for key, entry in value.items())
        return f"{{{','.join(entries)}}}"
    return str(value)
