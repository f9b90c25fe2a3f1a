"""Completes command lines with a shipped policy, `checkpoint=<name>`, by its settings."""

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
# Words on which the values of files depend; with a comma they are a sweep's.
_FILE_KEYS = ("task", "train", "rl_device")


def playing_overrides(name: str) -> list[str]:
    """Return the overrides that a shipped policy needs to act, for `config.compose`.

    These are the settings that must be as in its training: no `checkpoint`, devices or sizes.
    """
    # imports torch, which other command lines do without
    from isaacgymenvs_lite.checkpoints.packed import read_policy_info

    info = read_policy_info(shipped_policies()[name])
    log.info("%s: %s", name, info)
    settings = [f"++{path}={as_override(value)}" for path, value in info.settings.items()]
    # The whole network is packed: keys that it lacks must not come from today's train file.
    return [f"task={info.task}", f"~{_NETWORK}", *settings]


def complete_arguments(arguments: Sequence[str]) -> list[str]:
    """Return a command line with the settings of the shipped policy that it plays or trains on.

    They are inserted before the typed words, which override them.
    """
    arguments = list(arguments)
    typed = _settings(arguments)
    name = typed.get("checkpoint", "")
    if name not in shipped_policies():
        return arguments
    settings = playing_overrides(name)
    if "task" in typed:
        settings = settings[1:]
    # Beside the others, because Hydra's parser expects all overrides in one piece.
    place = next(i for i, word in enumerate(arguments) if "=" in word)
    return [*arguments[:place], *settings, *arguments[place:]]


def inherited_settings(arguments: Sequence[str]) -> list[str]:
    """Return the settings that later command lines about a run need if a shipped policy began it.

    Such a run is played by the files of task and training and by the typed words. So these are the
    policy's settings that the files do not have, as overrides; all of its settings where the files
    come from a folder of the user's own.
    """
    typed = _settings(arguments)
    name = typed.get("checkpoint", "")
    if name not in shipped_policies():
        return []
    # imports torch, which other command lines do without
    from isaacgymenvs_lite.checkpoints.packed import read_policy_info

    info = read_policy_info(shipped_policies()[name])
    typed = {key: typed[key] for key in _FILE_KEYS if key in typed and "," not in typed[key]}
    chosen = {"task": info.task, **typed}
    try:
        tree = compose([f"{key}={value}" for key, value in chosen.items()])
    except ConfigError:  # in a folder of the user's own, or nowhere, which the training reports
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
    """Return the words of a command line that set a key."""
    return dict(word.split("=", 1) for word in arguments if "=" in word)


def as_override(value: Any) -> str:
    """Return a value as Hydra's grammar writes it; text that may be no plain word is quoted."""
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
