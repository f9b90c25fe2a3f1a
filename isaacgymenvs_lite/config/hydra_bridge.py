"""Hydra's loader, checked at its end: what a configuration makes Hydra do is ours or the user's.

`foreign_files` refuses each way from a file of somebody else to Hydra's section. This is the second
line of defence: it compares what came out with what cfg/config.yaml and the command line give by
themselves, whichever way a difference may have come.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any

import hydra._internal.hydra as hydra_program
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from isaacgymenvs_lite.config.expansion import check_expansion
from isaacgymenvs_lite.config.foreign_files import is_foreign
from isaacgymenvs_lite.config.yaml_files import tolerant_hydra
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import cfg_dir

CONFIG_NAME = "config"

_OWN_PACKAGE = "pkg://hydra.conf"
_TRAIN_DIR = "train.params.config.train_dir"
# What Hydra writes down of a command line, below `hydra`.
_RECORDED = ("runtime", "overrides")
_RECORDED_OF_JOB = ("override_dirname", "config_name", "name")


class CheckedLoader(ConfigLoaderImpl):
    """Composes as Hydra's own does; files from outside cfg/ have no say in what Hydra does."""

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        """Compose a configuration.

        Raises:
            ConfigError: defaults lists run in a circle, or a file from outside has changed Hydra's
                section, chosen where a training writes, or has interpolations without end.
        """
        rest = (run_mode, from_shell, validate_sweep_overrides)
        try:
            cfg = super().load_configuration(config_name, overrides, *rest)
        except RecursionError:
            raise ConfigError(
                "the defaults lists of the configuration files run in a circle; a file may name"
                " neither itself nor one of its own name in cfg/ (rename it)"
            ) from None
        if any(_is_foreign_source(source) for source in cfg.hydra.runtime.config_sources):
            parsed = OverridesParser.create().parse_overrides(overrides)
            own = [str(word.input_line) for word in parsed if _is_about_hydra(word)]
            if _settings_of_hydra(cfg) != self._own_settings(own, *rest):
                raise ConfigError(
                    "a configuration file from outside cfg/ changes the section 'hydra', which"
                    " decides what is run; remove that from the file (docs/foreign_files.md)"
                )
            check_expansion(cfg)
            if not any(_sets_train_dir(word) for word in parsed):
                _check_train_dir(cfg)
        return cfg

    def _own_settings(self, overrides: list[str], *rest: Any) -> Any:
        """Return Hydra's settings as cfg/config.yaml and the command line alone give them."""
        search_path = copy.deepcopy(self.config_search_path)
        elements = search_path.get_path()
        elements[:] = [item for item in elements if not _is_file_path(item.path)]
        place = next(i for i, item in enumerate(elements) if item.path == _OWN_PACKAGE)
        search_path.append("main", str(cfg_dir()))
        elements.insert(place + 1, elements.pop())
        try:
            loader = ConfigLoaderImpl(search_path)
            return _settings_of_hydra(loader.load_configuration(CONFIG_NAME, overrides, *rest))
        except (HydraException, OmegaConfBaseException, ValueError):
            return None  # an override of Hydra's section that needs a file from outside


@contextmanager
def checked_hydra() -> Iterator[None]:
    """Let Hydra's program read with `tolerant_hydra` and compose with `CheckedLoader`."""
    program: Any = hydra_program
    former = program.ConfigLoaderImpl
    program.ConfigLoaderImpl = CheckedLoader
    try:
        with tolerant_hydra():
            yield
    finally:
        program.ConfigLoaderImpl = former


def _is_file_path(path: str) -> bool:
    return not path.startswith(("pkg://", "structured://"))


def _is_foreign_source(source: Any) -> bool:
    if source.schema == "pkg":
        return f"pkg://{source.path}" != _OWN_PACKAGE
    return source.schema != "structured" and (
        source.schema != "file" or is_foreign(Path(source.path))
    )


def _is_about_hydra(word: Override) -> bool:
    package = (word.package or "").removeprefix("_global_.")
    return word.is_hydra_override() or package.split(".")[0] == "hydra"


def _settings_of_hydra(cfg: DictConfig) -> Any:
    settings: Any = OmegaConf.to_container(cfg.hydra, resolve=False)
    for key in _RECORDED:
        settings.pop(key, None)
    for key in _RECORDED_OF_JOB:
        settings["job"].pop(key, None)
    return settings


def _sets_train_dir(word: Override) -> bool:
    """Return whether the command line itself says where runs are written."""
    is_above = f"{_TRAIN_DIR}.".startswith(f"{word.key_or_group}.")
    return word.key_or_group == _TRAIN_DIR or (is_above and isinstance(word.value(), dict))


def _check_train_dir(cfg: DictConfig) -> None:
    """Check that a train file from outside lets its runs stay below the working folder.

    Raises:
        ConfigError: it does not.
    """
    section, _, key = _TRAIN_DIR.rpartition(".")
    config = OmegaConf.select(cfg, section)
    if not isinstance(config, DictConfig) or key not in config:
        return
    node: Any = config._get_node(key)
    value = node._value()
    path = PurePath(value) if isinstance(value, str) else None
    if path is None or path.is_absolute() or ".." in path.parts or "$" in path.as_posix():
        raise ConfigError(
            f"{_TRAIN_DIR}: the train file chooses {value!r}, outside of the working folder;"
            f" if that is what you want, say so yourself: {_TRAIN_DIR}={value}"
        )
