"""Adds the settings of a shipped policy to a command line that contains the policy's name."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.staging import quoted
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import cfg_dir, shipped_policies
from isaacgymenvs_lite.schema import leaves, select

if TYPE_CHECKING:
    from isaacgymenvs_lite.checkpoints.packed import PolicyInfo

log = logging.getLogger(__name__)

_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_.]*")
_NO_TEXT = ("true", "false", "null", "nan", "inf")
_NETWORK = "train.params.network"
# The values of other settings depend on these arguments. An argument with a comma belongs to a
# sweep.
_FILE_KEYS = ("task", "train", "rl_device")


def playing_overrides(name: str) -> list[str]:
    """Return the overrides for `config.compose` that are needed to play a shipped policy.

    The overrides restore the settings of the policy's training, except `checkpoint`, devices and
    sizes.
    """
    # The import is local, because it loads torch, which takes long and which most command lines do
    # not need.
    from isaacgymenvs_lite.checkpoints.packed import read_policy_info

    info = read_policy_info(shipped_policies()[name])
    log.info("%s: %s", name, info)
    settings = [f"++{path}={as_override(value)}" for path, value in info.settings.items()]
    # The packed policy's network section is complete. The section of the current train file is
    # removed, because its keys must not be added.
    return [*_files_of(info), f"~{_NETWORK}", *settings]


def _files_of(info: PolicyInfo) -> list[str]:
    """Return `task=`, and `train=` if the task's own train file may have another algorithm."""
    others = {"hrl": "HumanoidASEHRLPPO", "amp_continuous": f"{info.task}AMP"}
    train = others.get(info.settings["train.params.algo.name"], "")
    has_file = (cfg_dir() / "train" / f"{train}.yaml").is_file()
    return [f"task={info.task}", *([f"train={train}"] if has_file else [])]


def complete_arguments(arguments: Sequence[str]) -> list[str]:
    """Return a command line, completed by the settings of the shipped policy that it names.

    The settings are inserted before the user's overrides, which therefore have precedence.
    """
    arguments = list(arguments)
    typed = _settings(arguments)
    name = typed.get("checkpoint", "")
    if name not in shipped_policies():
        return arguments
    settings = playing_overrides(name)
    settings = [word for word in settings if word.partition("=")[0] not in typed]
    # Overrides must be adjacent for Hydra's parser.
    place = next(i for i, word in enumerate(arguments) if "=" in word)
    return [*arguments[:place], *settings, *arguments[place:]]


def inherited_settings(arguments: Sequence[str]) -> list[str]:
    """Return the settings that a run takes from the shipped policy with which it begins.

    A later play of the run needs them, because it reads only the task file, the train file and the
    user's overrides. The returned overrides are those settings of the policy that differ from the
    task file and the train file. If the files are in a user's folder, the result holds all settings
    of the policy.
    """
    typed = _settings(arguments)
    name = typed.get("checkpoint", "")
    if name not in shipped_policies():
        return []
    # The import is local, because it loads torch, which takes long and which most command lines do
    # not need.
    from isaacgymenvs_lite.checkpoints.packed import read_policy_info

    info = read_policy_info(shipped_policies()[name])
    typed = {key: typed[key] for key in _FILE_KEYS if key in typed and "," not in typed[key]}
    own = [word for word in _files_of(info) if word.partition("=")[0] not in typed]
    train = [word for word in own if word.startswith("train=")]  # The caller adds task=.
    try:
        tree = compose([*own, *(f"{key}={value}" for key, value in typed.items())])
    except ConfigError:  # The files are in a user's folder, or are missing.
        return [*train, *playing_overrides(name)[len(_files_of(info)) :]]
    files = OmegaConf.to_container(tree, resolve=True)
    settings, in_network = info.settings, f"{_NETWORK}."
    network = leaves(select(files, _NETWORK), _NETWORK)
    is_another = any(value is not None and path not in settings for path, value in network)
    words = [*train, f"~{_NETWORK}"] if is_another else train
    for path, value in settings.items():
        if select(files, path) != value or (is_another and path.startswith(in_network)):
            words.append(f"++{path}={as_override(value)}")
    return words


def _settings(arguments: Sequence[str]) -> dict[str, str]:
    """Return the arguments `key=value` of a command line as a dictionary."""
    return dict(word.split("=", 1) for word in arguments if "=" in word)


def as_override(value: Any) -> str:
    """Return a value as text in Hydra's grammar; strings that are no plain names are quoted."""
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
