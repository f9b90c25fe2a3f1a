"""Completes command lines that name a shipped policy by the policy's settings."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from typing import Any

from omegaconf import OmegaConf

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.staging import quoted
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import shipped_policies
from isaacgymenvs_lite.schema import leaves, select

log = logging.getLogger(__name__)

_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_.]*")
_NO_TEXT = ("true", "false", "null", "nan", "inf")
_NETWORK = "train.params.network"
# Arguments that change the values of files; with a comma they are a sweep's.
_FILE_KEYS = ("task", "train", "rl_device")


def playing_overrides(name: str) -> list[str]:
    """Return the overrides that a shipped policy needs to act, for `config.compose`.

    They restore settings of its training, but no `checkpoint`, devices or sizes.
    """
    # This imports torch, which other command lines do without.
    from isaacgymenvs_lite.checkpoints.packed import read_policy_info

    info = read_policy_info(shipped_policies()[name])
    log.info("%s: %s", name, info)
    settings = [f"++{path}={as_override(value)}" for path, value in info.settings.items()]
    # The policy has a complete network section; further keys of today's train file must not join
    # it.
    return [f"task={info.task}", f"~{_NETWORK}", *settings]


def complete_arguments(arguments: Sequence[str]) -> list[str]:
    """Return a command line with the settings of the shipped policy that it plays or trains on.

    They are inserted before the user's own overrides, which have precedence.
    """
    arguments = list(arguments)
    typed = _settings(arguments)
    name = typed.get("checkpoint", "")
    if name not in shipped_policies():
        return arguments
    settings = playing_overrides(name)
    if "task" in typed:
        settings = settings[1:]
    # Hydra's parser expects all overrides in one piece.
    place = next(i for i, word in enumerate(arguments) if "=" in word)
    return [*arguments[:place], *settings, *arguments[place:]]


def inherited_settings(arguments: Sequence[str]) -> list[str]:
    """Return settings of the shipped policy with which a run begins, for later command lines.

    A run is played by its task's and train files and the user's overrides. This function returns
    the policy's settings that differ from these files, as overrides. If the files come from a
    user's own folder, it returns all of the policy's settings.
    """
    typed = _settings(arguments)
    name = typed.get("checkpoint", "")
    if name not in shipped_policies():
        return []
    # This imports torch, which other command lines do without.
    from isaacgymenvs_lite.checkpoints.packed import read_policy_info

    info = read_policy_info(shipped_policies()[name])
    typed = {key: typed[key] for key in _FILE_KEYS if key in typed and "," not in typed[key]}
    chosen = {"task": info.task, **typed}
    try:
        tree = compose([f"{key}={value}" for key, value in chosen.items()])
    except ConfigError:  # The files are in a user's folder, or missing, which the training reports.
        return playing_overrides(name)[1:]
    files = OmegaConf.to_container(tree, resolve=True)
    settings, in_network = info.settings, f"{_NETWORK}."
    network = leaves(select(files, _NETWORK), _NETWORK)
    is_another = any(value is not None and path not in settings for path, value in network)
    words = [f"~{_NETWORK}"] if is_another else []
    for path, value in settings.items():
        if select(files, path) != value or (is_another and path.startswith(in_network)):
            words.append(f"++{path}={as_override(value)}")
    return words


def _settings(arguments: Sequence[str]) -> dict[str, str]:
    """Return the arguments key=value of a command line."""
    return dict(word.split("=", 1) for word in arguments if "=" in word)


def as_override(value: Any) -> str:
    """Return a value in Hydra's grammar; text other than a plain name is quoted."""
    if value is None:
        return "null"
    if isinstance(value, str):
        is_word = _WORD.fullmatch(value) and value.lower() not in _NO_TEXT
        return value if is_word else quoted(value)
    if isinstance(value, (list, tuple)):
        return f"[{','.join(as_override(entry) for entry in value)}]"
    if isinstance(value, dict):
        entries = (f"{key}:{as_override(entry)}" for key, entry in value.items())
        return f"{{{','.join(entries)}}}"
    return str(value)
