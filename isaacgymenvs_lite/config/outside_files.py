"""Task and train files that are named by their path: `train=/path/to/AntPPO.yaml`.

Hydra knows configuration files by their names in folders on its search path. A path on a command
line is replaced by the file's name, and the file's folder is put before the project's own for as
long as the configuration is composed, so that a defaults list may name the files beside it, too.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.config_search_path import ConfigSearchPath, SearchPathQuery
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin

from isaacgymenvs_lite.config.yaml_files import TolerantFileSource
from isaacgymenvs_lite.errors import ConfigError

GROUPS = ("task", "train")
_SUFFIXES = (".yaml", ".yml")
_SCHEME = "outside"

# Group -> name on the command line -> file; empty unless something is being composed.
_files: dict[str, dict[str, Path]] = {}


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
    for override in overrides:
        group, _, value = override.partition("=")
        if group in GROUPS and _is_path(value):
            file = _find(group, value)
            name = re.sub(r"[^\w-]", "_", file.stem)  # what Hydra's grammar takes for a name
            files.setdefault(group, {})[name] = file
            named.append(f"{group}={name}")
        else:
            named.append(override)
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
        return self.read(self._file(config_path), config_path.rpartition("/")[0])

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
