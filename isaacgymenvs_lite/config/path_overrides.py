"""Finds task and train files that are named by their path: `train=/path/to/AntPPO.yaml`.

Hydra finds configuration files by their names in folders of its search path. A path on a command
line is replaced by the file's name, and the file's folder comes before the project's own while the
configuration is composed, so that a defaults list may also name the files beside it.
The clips and models that a task file names may be in its own checkout, see `checkouts`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config import checkouts
from isaacgymenvs_lite.config.hydra_bridge import ComposedFile, NamedFiles, quoted
from isaacgymenvs_lite.config.yaml_files import read_composed_file
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import user_path

log = logging.getLogger(__name__)

GROUPS = ("task", "train")
_SUFFIXES = (".yaml", ".yml")


@dataclass(frozen=True)
class PathOverrides:
    """A command line with names in place of paths.

    Attributes:
        words: the overrides.
        files: group -> name in an override -> file.
    """

    words: list[str]
    files: NamedFiles

    @classmethod
    def from_words(cls, overrides: Sequence[str]) -> PathOverrides:
        """Find the files that `task=` and `train=` name by their paths.

        Args:
            overrides: as on the command line.

        Raises:
            ConfigError: there is no such file.
        """
        words, files = [], dict[str, dict[str, Path]]()
        typed = {override.partition("=")[0] for override in overrides}

        def take(group: str, file: Path) -> None:
            name = re.sub(r"[^\w-]", "_", file.stem)  # what Hydra's grammar takes for a name
            files.setdefault(group, {})[name] = file
            words.append(f"{group}={quoted(name)}")  # 2024.yaml is no number

        for override in overrides:
            group, _, value = override.partition("=")
            if group not in GROUPS or not _is_path(value):
                words.append(override)
                continue
            file = _find(group, value)
            take(group, file)
            if group == "task":
                beside = checkouts.train_file_beside(file)
                if beside is not None and "train" not in typed:
                    log.info("train file: %s (beside the task file; train= takes another)", beside)
                    take("train", beside)
                if checkouts.KEY not in typed:
                    words.append(f"++{checkouts.KEY}={quoted(str(checkouts.checkout_of(file)))}")
        return cls(words, files)


class FileReader:
    """Reads the files of one composition; ASE's task files are completed."""

    def __init__(self) -> None:
        self._completed: set[Path] = set()  # Hydra reads a file more than once

    def __call__(self, path: Path, group: str) -> ComposedFile:
        """Read a file of a group, see `read_composed_file`."""
        file = read_composed_file(path, group)
        task = checkouts.task_of_ase_file(path) if group == "task" else None
        if task is not None and "name" not in file.config:
            _complete(file.config, task)
            if path not in self._completed:
                log.info("%s names no task, as ASE's files: taken for task=%s", path, task)
                self._completed.add(path)
        return file


def _is_path(value: str) -> bool:
    value = value.strip("'\"")
    return value.endswith(_SUFFIXES) or value.startswith(("/", "./", "../", "~"))


def _find(group: str, value: str) -> Path:
    given = user_path(value.strip("'\""))
    candidates = [given, *(given.with_name(given.name + suffix) for suffix in _SUFFIXES)]
    for candidate in candidates:
        if candidate.is_file():
            return candidate.resolve()
    raise ConfigError(
        f"{group}={value}: no file {given.absolute()}; give a {group} file, or the name of one in"
        f" cfg/{group}"
    )


def _complete(content: DictConfig, task: str) -> None:
    """Add to a task file of ASE what ASE has in its code: name, time step, gravity, `num_envs`."""
    content.setdefault("defaults", [task, "_self_"])
    number = OmegaConf.select(content, "env.numEnvs")
    if isinstance(number, int):
        content.env.numEnvs = f"${{resolve_default:{number},${{...num_envs}}}}"
