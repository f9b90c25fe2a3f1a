"""`checkpoint=<name of a shipped policy>` on a command line."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from isaacgymenvs_lite.checkpoints.shipped import shipped_policies
from isaacgymenvs_lite.config.hydra_bridge import quoted

log = logging.getLogger(__name__)


def playing_overrides(name: str) -> list[str]:
    """Return the overrides that a shipped policy needs to be played, for `config.compose`.

    Without `checkpoint`, devices and sizes: only what the policy must find as it was trained.

    Raises:
        KeyError: no such policy.
        CheckpointError: its file is damaged.
    """
    # torch: only once a shipped policy is asked for
    from isaacgymenvs_lite.checkpoints.packed import read_policy_info

    info = read_policy_info(shipped_policies()[name])
    log.info("%s: %s", name, info)
    settings = [f"++{path}={as_override(value)}" for path, value in info.settings.items()]
    # All of the network is packed: what it has no word of is not what the train file says today.
    return [f"task={info.task}", "~train.params.network", *settings]


def complete_arguments(arguments: Sequence[str]) -> list[str]:
    """Return a command line with the settings of the shipped policy that it plays.

    They go before the words that were typed, so that those win. A command line that plays no
    shipped policy is returned as it is.

    Args:
        arguments: as `sys.argv[1:]`: `test=True checkpoint=walk num_envs=4`.

    Raises:
        CheckpointError: the policy's file is damaged.
    """
    arguments = list(arguments)
    typed = dict(word.split("=", 1) for word in arguments if "=" in word)
    name = typed.get("checkpoint", "")
    plays = typed.get("test", "").lower() in ("true", "1", "yes", "on")
    if not plays or name not in shipped_policies():
        return arguments
    settings = playing_overrides(name)
    if "task" in typed:
        settings = settings[1:]
    # Beside the others: Hydra's parser takes them in one piece.
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
