"""Reading YAML files as they were published, alone and through Hydra.

ASE's train files state `ppo` twice. OmegaConf refuses that; the loader they were written for took
the last one, and so does this one, with one warning for each file. Those of its hierarchies lack
`llc_checkpoint`, which was an argument of the command line: it can be given without a `+`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import DictConfig, OmegaConf
from omegaconf._utils import get_yaml_loader
from omegaconf.errors import OmegaConfBaseException

from isaacgymenvs_lite.errors import ConfigError

_log = logging.getLogger(__name__)
_warned_files: set[Path] = set()


def read_yaml(path: Path) -> DictConfig:
    """Read one YAML file as OmegaConf does, except that the last of equal keys wins.

    Raises:
        ConfigError: the file is missing, is no YAML, or holds no mapping.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read the configuration file {path}: {error}") from error
    duplicates: list[str] = []
    try:
        content = yaml.load(text, Loader=_last_key_wins(duplicates))
    except yaml.YAMLError as error:
        raise ConfigError(f"{path} is not valid YAML: {one_line(error)}") from error
    if content is None:
        content = {}
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise ConfigError(f"{path} holds a {kind}, expected a mapping of keys to values")
    if duplicates and path not in _warned_files:
        _warned_files.add(path)
        _log.warning(
            "%s states %s more than once: the last one counts", path, ", ".join(duplicates)
        )
    try:
        return OmegaConf.create(content)
    except OmegaConfBaseException as error:
        raise ConfigError(f"{path}: {one_line(error)}") from error


@contextmanager
def tolerant_hydra() -> Iterator[None]:
    """Let Hydra read its YAML files with `read_yaml` as long as the context lasts.

    Hydra looks up the reader of a search path when a loader is made, so the loader must be made
    inside. The former reader returns afterwards, so other Hydra programs in the process are safe.
    """
    Plugins.instance()  # registers Hydra's own readers, which must happen before one is replaced
    registry = SourcesRegistry.instance().types
    scheme = FileConfigSource.scheme()
    former = registry[scheme]
    registry[scheme] = TolerantFileSource
    try:
        yield
    finally:
        registry[scheme] = former


def one_line(error: BaseException) -> str:
    """Return the message of an error on one line."""
    return " ".join(str(error).split())


class TolerantFileSource(FileConfigSource):
    """Hydra's reader of folders, with `read_yaml` for the files."""

    def load_config(self, config_path: str) -> ConfigResult:
        """Read a file below the folder."""
        return self.read(Path(self.path, self._normalize_file_name(config_path)).resolve())

    def read(self, path: Path) -> ConfigResult:
        """Read one file."""
        config = read_yaml(path)
        _add_launch_key(config)
        with path.open(encoding="utf-8") as file:
            header = ConfigSource._get_header_dict(file.read(512))
        return ConfigResult(
            config=config,
            path=f"{self.scheme()}://{self.path}",
            provider=self.provider,
            header=header,
        )


def _add_launch_key(config: DictConfig) -> None:
    agent = OmegaConf.select(config, "params.config")
    is_whole = "defaults" not in config
    if is_whole and isinstance(agent, DictConfig) and "llc_config" in agent:
        agent.setdefault("llc_checkpoint", "")


def _last_key_wins(duplicates: list[str]) -> Any:
    """Return OmegaConf's YAML loader class, changed to list repeated keys and to keep the last."""

    class Loader(get_yaml_loader()):
        def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> Any:
            last: dict[Any, Any] = {}
            for index, (key_node, _) in enumerate(node.value):
                if isinstance(key_node, yaml.ScalarNode) and key_node.tag.endswith(":str"):
                    if key_node.value in last:
                        duplicates.append(f"'{key_node.value}'")
                    last[key_node.value] = index
                else:
                    last[index] = index
            node.value = [node.value[index] for index in sorted(last.values())]
            return super().construct_mapping(node, deep=deep)

    return Loader
