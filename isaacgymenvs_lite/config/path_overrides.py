"""Task and train files that are named by their path: `train=/path/to/AntPPO.yaml`.

Hydra knows configuration files by their names in folders on its search path. A path on a command
line is replaced by the file's name, and the file's folder is put before the project's own for as
long as the configuration is composed, so that a defaults list may name the files beside it, too.
The clips and models that a task file names may be in its own checkout, see `checkouts`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.config_search_path import ConfigSearchPath, SearchPathQuery
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config import checkouts
from isaacgymenvs_lite.config.yaml_files import TolerantFileSource
from isaacgymenvs_lite.errors import ConfigError

log = logging.getLogger(__name__)

GROUPS = ("task", "train")
_SUFFIXES = (".yaml", ".yml")
_SCHEME = "outside"

# Group -> name on the command line -> file; empty unless something is being composed.
_files: dict[str, dict[str, Path]] = {}
_completed: set[Path] = set()  # of the same: files of which a line in the log said what they lack


@contextmanager
def outside_files(overrides: Sequence[str]) -> Iterator[list[str]]:
    """Let Hydra find the files that overrides name by their paths.

    Args:
        overrides: as on the command line.

    Yields:
        The overrides with names in place of paths.

    Raises:
        ConfigError: there is no such file.
    """
    named, files = [], dict[str, dict[str, Path]]()
    typed = {override.partition("=")[0] for override in overrides}

    def take(group: str, file: Path) -> None:
        name = re.sub(r"[^\w-]", "_", file.stem)  # what Hydra's grammar takes for a name
        files.setdefault(group, {})[name] = file
        named.append(f"{group}={name}")

    for override in overrides:
        group, _, value = override.partition("=")
        if group not in GROUPS or not _is_path(value):
            named.append(override)
            continue
        file = _find(group, value)
        take(group, file)
        if group == "task":
            train_file = checkouts.train_file_beside(file)
            if train_file is not None and "train" not in typed:
                log.info("train file: %s (beside the task file; train= takes another)", train_file)
                take("train", train_file)
            if checkouts.KEY not in typed:
                named.append(f"++{checkouts.KEY}={_quoted(checkouts.checkout_of(file))}")
    if not files:
        yield named
        return
    Plugins.instance().register(_OutsideSearchPath)
    SourcesRegistry.instance().types[_SCHEME] = _OutsideSource
    _files.update(files)
    try:
        yield named
    finally:
        _files.clear()
        _completed.clear()


def _is_path(value: str) -> bool:
    value = value.strip("'\"")
    return value.endswith(_SUFFIXES) or value.startswith(("/", "./", "../", "~"))


def _find(group: str, value: str) -> Path:
    given = Path(value.strip("'\"")).expanduser()
    candidates = [given, *(given.with_name(given.name + suffix) for suffix in _SUFFIXES)]
    for candidate in candidates:
        if candidate.is_file():
            return candidate.resolve()
    raise ConfigError(
        f"{group}={value}: no file {given.absolute()}; give a {group} file, or the name of one in"
        f" cfg/{group}"
    )


def _quoted(path: Path) -> str:
    return QuotedString(text=str(path), quote=Quote.single).with_quotes()


def _complete(content: DictConfig, task: str) -> None:
    """Add to a task file of ASE what was in its code: name, time step, gravity, `num_envs`."""
    content.setdefault("defaults", [task, "_self_"])
    number = OmegaConf.select(content, "env.numEnvs")
    if isinstance(number, int):
        content.env.numEnvs = f"${{resolve_default:{number},${{...num_envs}}}}"


class _OutsideSearchPath(SearchPathPlugin):
    """Puts the files before all other folders."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for group in _files:
            path = f"{_SCHEME}://{group}"
            anchor = SearchPathQuery(path="pkg://hydra.conf")
            search_path.prepend(provider=_SCHEME, path=path, anchor=anchor)


class _OutsideSource(TolerantFileSource):
    """The folder of one group's file, as if it were the group."""

    @staticmethod
    def scheme() -> str:
        return _SCHEME

    def __init__(self, provider: str, path: str) -> None:
        super().__init__(provider, path)
        self._group = self.path
        self._named = _files[self._group]
        self._folder = next(iter(self._named.values())).parent

    def load_config(self, config_path: str) -> ConfigResult:
        file = self._file(config_path)
        result = self.read(file, config_path.rpartition("/")[0])
        task = checkouts.task_of_ase_file(file) if self._group == "task" else None
        content = result.config
        if task is not None and isinstance(content, DictConfig) and "name" not in content:
            _complete(content, task)
            if file not in _completed:  # Hydra reads a file more than once
                log.info("%s names no task, as ASE's files: taken for task=%s", file, task)
                _completed.add(file)
        return result

    def is_group(self, config_path: str) -> bool:
        below = self._below(config_path)
        return config_path == "" or (below is not None and below.is_dir())

    def is_config(self, config_path: str) -> bool:
        return self._file(config_path).is_file()

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        del results_filter
        return sorted(self._named) if config_path == self._group else []

    def _file(self, config_path: str) -> Path:
        group, _, name = config_path.rpartition("/")
        folder = self._below(group)
        if folder is None:
            return self._folder / "no such file"
        file = folder / f"{name.removesuffix('.yaml')}.yaml"
        return self._named.get(file.stem, file) if folder == self._folder else file

    def _below(self, group: str) -> Path | None:
        """Return the folder of a group, this one's or one below it; None for any other."""
        inside = group == self._group or group.startswith(f"{self._group}/")
        return self._folder / group[len(self._group) + 1 :] if inside else None
