"""Checks YAML files from outside the project's own cfg/, which other people may have written.

Hydra's own section of a configuration is as powerful as a program: callbacks, launchers, sweepers
and log handlers are Python names that it imports and calls, `job.env_set` sets variables, and
`run.dir` chooses where to write. All of that belongs to cfg/config.yaml and to the command line. A
file of somebody else may describe a task or an agent and nothing more. Everything in it that leads
to Hydra's section, to an imported name or to a secret of this machine is refused when it is read.
docs/foreign_files.md has the list for users.
"""

from __future__ import annotations

import os.path
import re
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import GrammarParseError

from isaacgymenvs_lite.config.expansion import check_expansion
from isaacgymenvs_lite.config.hydra_bridge import Override, parse_interpolations
from isaacgymenvs_lite.config.resolvers import RESOLVERS
from isaacgymenvs_lite.config.run_names import TRAIN_DIR
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import cfg_dir

_HYDRA = "hydra"
_TARGET = "_target_"
_WHERE_TO = "it belongs on the command line, or into cfg/ if you wrote the file yourself"
# The section `hydra` of a root file of IsaacGymEnvs; ours has the same values, and more.
_HARMLESS = {"output_subdir": None, "run": {"dir": "."}, "job": {"chdir": False}}
_HARMLESS_LOGGING = ("hydra/job_logging", "hydra/hydra_logging")
_NO_LOGGING = ("none", "disabled")
# Names of files and of folders below a group; a name may hold the choice of another group: ${task}.
_ENTRY = re.compile(r"(?:[\w.+-]|\$\{\w+\})+(?:/(?:[\w.+-]|\$\{\w+\})+)*")
# No value may hold a lone dollar sign: joined with a brace, it would be an unchecked interpolation
# as soon as a resolved tree becomes a configuration again.
_LONE_DOLLAR = re.compile(r"\$(?!\{)|\\\$")
# OmegaConf warns of an argument that is missing: ${resolve_default:,${x}}.
_MISSING_ARGUMENT = re.compile(r"\$\{[\w.]+:\s*,|,\s*[,}]")
_MAX_INTERPOLATION_LENGTH = 2000
_MAX_INTERPOLATIONS = 32


def is_foreign(path: Path) -> bool:
    """Return whether a file lies outside of the project's own cfg/."""
    return not Path(os.path.abspath(path)).is_relative_to(cfg_dir())


def check_foreign_file(content: dict[Any, Any], path: Path) -> None:
    """Check what a file of somebody else holds, wherever it is read.

    Raises:
        ConfigError: it sets something of Hydra, names something to be called, or has an
            interpolation that could look outside of the configuration.
    """
    if _HYDRA in content:
        raise ConfigError(f"{path} sets '{_HYDRA}', which decides what is run; {_WHERE_TO}")
    _check_values(content, str(path))


def check_composed_file(
    content: dict[Any, Any], path: Path, group: str, package: str | None
) -> None:
    """Check a file of somebody else that Hydra merges into a configuration.

    A root file may have the section `hydra` of IsaacGymEnvs' root file.

    Args:
        content: of the file.
        path: the file.
        group: folder of the file as Hydra sees it, 'train' or 'task/env'; '' for a root file.
        package: of its header `# @package`; None without one.

    Raises:
        ConfigError: as `check_foreign_file`, or it would be merged elsewhere than in its group.
    """
    own = group.replace("/", ".")
    allowed = {None, "_group_", own, f"_global_.{own}"} if own else {None, "", "_global_"}
    if package not in allowed:
        expected = f"'{own}' or none" if own else "none"
        raise ConfigError(
            f"{path} has the header '# @package {package}', which puts it into another section;"
            f" expected {expected}"
        )
    if group.split("/")[0] == _HYDRA:
        raise ConfigError(f"{path} is a file of the group '{group}'; {_WHERE_TO}")
    settings = content
    if not own and _has_only(content.get(_HYDRA, {}), _HARMLESS):
        settings = {key: value for key, value in content.items() if key != _HYDRA}
    check_foreign_file(settings, path)
    defaults = content.get("defaults", [])
    for entry in defaults if isinstance(defaults, list) else [defaults]:
        _check_entry(entry, path, is_root=not own)


def check_composed_tree(
    cfg: DictConfig, overrides: Sequence[Override], changes_hydra: bool
) -> None:
    """Check a composed tree that files of somebody else are part of.

    Args:
        cfg: the tree.
        overrides: of the command line, which may set more than files.
        changes_hydra: the section `hydra` is not what cfg/config.yaml and the overrides make it.

    Raises:
        ConfigError: a file has changed Hydra's section, chosen where a training writes, or has
            interpolations without end.
    """
    if changes_hydra:
        raise ConfigError(
            "a configuration file from outside cfg/ changes the section 'hydra', which"
            " decides what is run; remove that from the file (docs/foreign_files.md)"
        )
    check_expansion(cfg)
    if not any(_sets_train_dir(word) for word in overrides):
        _check_train_dir(cfg)


def check_interpolation(text: str, where: str) -> None:
    """Check that a text leads to other settings only, through functions that do nothing else.

    Raises:
        ConfigError: it uses another resolver, such as `oc.env`, or one whose name it makes up.
    """
    if "$" not in text:
        return
    if (
        len(text) > _MAX_INTERPOLATION_LENGTH
        or text.count("$") > _MAX_INTERPOLATIONS
        or _LONE_DOLLAR.search(text)
        or _TARGET in text
        or _MISSING_ARGUMENT.search(text)
    ):
        raise ConfigError(
            f"{where}: {text[:60]!r} is no plain interpolation; expected ${{path.of.a.key}} or"
            f" ${{resolver:...}} and no other $"
        )
    try:
        found = parse_interpolations(text)
    except (GrammarParseError, RecursionError) as error:
        raise ConfigError(f"{where}: {text[:60]!r} cannot be read as an interpolation") from error
    if found.has_composed_path:
        raise ConfigError(f"{where}: '{text}' makes up the path that it leads to; write it out")
    for name in sorted(set(found.resolvers) - set(RESOLVERS)):
        raise ConfigError(
            f"{where}: '{text}' uses the resolver '{name}', which a file from outside may not use;"
            f" expected a path in the configuration or one of {', '.join(sorted(RESOLVERS))};"
            f" {_WHERE_TO}"
        )


def _check_values(value: Any, where: str) -> None:
    if isinstance(value, str):
        check_interpolation(value, where)
    elif isinstance(value, dict):
        for key, entry in value.items():
            if key == _TARGET:
                raise ConfigError(
                    f"{where} has a key '{_TARGET}', which names something to be called; a"
                    " configuration file cannot name code here (docs/own_task.md)"
                )
            _check_values(entry, f"{where}: {key}" if ": " not in where else f"{where}.{key}")
    elif isinstance(value, list):
        for entry in value:
            _check_values(entry, where)


def _check_entry(entry: Any, path: Path, is_root: bool) -> None:
    """Check an entry of a defaults list: the name of a file in the same group or below it."""
    if is_root and is_logging_entry(entry):
        return
    parts = [entry]
    if isinstance(entry, dict) and len(entry) == 1:
        group, names = next(iter(entry.items()))
        names = names if isinstance(names, list) else [names]
        parts = [
            str(group).removeprefix("optional "),
            *(name for name in names if name is not None),
        ]
    fits = all(isinstance(part, str) and _ENTRY.fullmatch(part) for part in parts)
    steps = [step for part in parts for step in str(part).split("/")]
    if not fits or ".." in steps or (is_root and steps[0] == _HYDRA):
        text = str(entry).strip("{}")
        raise ConfigError(
            f"{path}: the entry '{text}' of its defaults list leads out of its own group; expected"
            " the name of a file beside it"
        )


def is_logging_entry(entry: Any) -> bool:
    """Return whether an entry switches a log of Hydra off, as IsaacGymEnvs' root file does."""
    if not isinstance(entry, dict) or len(entry) != 1:
        return False
    key, value = next(iter(entry.items()))
    return str(key).removeprefix("override ") in _HARMLESS_LOGGING and value in _NO_LOGGING


def _has_only(section: Any, allowed: dict[str, Any]) -> bool:
    """Return whether a section has no other keys and values than `allowed`."""
    if not isinstance(section, dict):
        return False
    for key, value in section.items():
        if key not in allowed:
            return False
        expected = allowed[key]
        same = _has_only(value, expected) if isinstance(expected, dict) else value == expected
        if not same:
            return False
    return True


def _sets_train_dir(word: Override) -> bool:
    """Return whether an override chooses where runs are written."""
    is_above = f"{TRAIN_DIR}.".startswith(f"{word.key_or_group}.")
    return word.key_or_group == TRAIN_DIR or (is_above and isinstance(word.value(), dict))


def _check_train_dir(cfg: DictConfig) -> None:
    """Check that a train file from outside lets its runs stay below the working folder.

    Raises:
        ConfigError: it does not.
    """
    section, _, key = TRAIN_DIR.rpartition(".")
    config = OmegaConf.select(cfg, section)
    if not isinstance(config, DictConfig) or key not in config:
        return
    written: Any = OmegaConf.to_container(config, resolve=False)
    value = written[key]
    path = PurePath(value) if isinstance(value, str) else None
    if path is None or path.is_absolute() or ".." in path.parts or "$" in path.as_posix():
        raise ConfigError(
            f"{TRAIN_DIR}: the train file chooses {value!r}, outside of the working folder;"
            f" if that is what you want, say so yourself: {TRAIN_DIR}={value}"
        )
