"""Reads YAML files as they were published, alone and for Hydra.

ASE's train files state `ppo` twice. OmegaConf refuses that; the loader they were written for took
the last one, and so does this one, with one warning for each file. Those of its hierarchies lack
`llc_checkpoint`, which was an argument of the command line: it can be given without a `+`.
"""

from __future__ import annotations

import copy
import functools
import logging
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from isaacgymenvs_lite.config.foreign_files import (
    check_composed_file,
    check_foreign_file,
    is_foreign,
    is_logging_entry,
)
from isaacgymenvs_lite.config.hydra_bridge import ComposedFile, read_header
from isaacgymenvs_lite.errors import ConfigError, one_line
from isaacgymenvs_lite.paths import cfg_dir
from isaacgymenvs_lite.yaml_text import parse_yaml, read_text

_log = logging.getLogger(__name__)
_warned_files: set[Path] = set()


def read_yaml(path: Path) -> DictConfig:
    """Read one YAML file as OmegaConf does, except that the last of equal keys wins.

    A file outside of cfg/ is checked, see `foreign_files`.

    Raises:
        ConfigError: the file is missing, is no YAML, or holds no mapping or something forbidden.
    """
    text = read_text(path)
    if not is_foreign(path):
        return _read_own(path, text)
    content = _read(path, text)
    check_foreign_file(content, path)
    return _as_config(content, path)


def _read_own(path: Path, text: str) -> DictConfig:
    """Return a tree that the caller may change, of a file of cfg/; each file is parsed once.

    Every composition reads the same few files, and parsing them takes half of its time.
    """
    return copy.deepcopy(_parse_own(path, text))


@functools.lru_cache(maxsize=128)
def _parse_own(path: Path, text: str) -> DictConfig:
    return _as_config(_read(path, text), path)


def _read(path: Path, text: str) -> dict[Any, Any]:
    """Return the mapping that a file's text holds, with one warning for keys stated twice."""
    read = parse_yaml(text, str(path))
    content = {} if read.content is None else read.content
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise ConfigError(f"{path} holds a {kind}, expected a mapping of keys to values")
    if read.repeated and path not in _warned_files:
        _warned_files.add(path)
        _log.warning(
            "%s states %s more than once: the last one counts", path, ", ".join(read.repeated)
        )
    return content


def _as_config(content: dict[Any, Any], path: Path) -> DictConfig:
    try:
        return OmegaConf.create(content)
    except OmegaConfBaseException as error:
        raise ConfigError(f"{path}: {one_line(error)}") from error


def read_composed_file(path: Path, group: str) -> ComposedFile:
    """Read one file that Hydra merges into a tree.

    Args:
        path: the file.
        group: folder of the file as Hydra sees it; '' for a root file.

    Raises:
        ConfigError: as `read_yaml`, or it would be merged elsewhere than in its group.
    """
    text = read_text(path)
    header = read_header(text, path)
    if is_foreign(path):
        content = _read(path, text)
        check_composed_file(content, path, group, header["package"])
        header["package"] = None  # which means the group
        if not group:
            _take_our_hydra(content)
        config = _as_config(content, path)
    else:
        config = _read_own(path, text)
    _add_launch_key(config)
    return ComposedFile(config, header)


def _take_our_hydra(content: dict[Any, Any]) -> None:
    """Give a root file from outside the Hydra settings of cfg/config.yaml, in place."""
    ours = parse_yaml(read_text(cfg_dir() / "config.yaml"), "config.yaml").content
    logging_entries = [entry for entry in ours["defaults"] if is_logging_entry(entry)]
    own = [entry for entry in content.get("defaults", []) if not is_logging_entry(entry)]
    content |= {"hydra": ours["hydra"], "defaults": [*own, *logging_entries]}


def _add_launch_key(config: DictConfig) -> None:
    agent = OmegaConf.select(config, "params.config")
    is_whole = "defaults" not in config
    if is_whole and isinstance(agent, DictConfig) and "llc_config" in agent:
        agent.setdefault("llc_checkpoint", "")
