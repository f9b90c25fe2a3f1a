"""Agent files: cfg/<library>/<Task>.yaml, or default.yaml beside it.

A file holds keyword arguments of the library's classes, by section, and a few keys of the
workflow's own. It cannot name code: what becomes of it is decided here, not by the file.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import nn

from isaacgymenvs_lite.config.yaml_files import one_line, read_yaml
from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.paths import cfg_dir
from isaacgymenvs_lite.schema import plain, setting

PREFIX = "agent."
"""What overrides of an agent file begin with on the command line."""

_DEFAULT = "default"
_ACTIVATIONS: dict[str, type[nn.Module]] = {
    "elu": nn.ELU,
    "relu": nn.ReLU,
    "selu": nn.SELU,
    "silu": nn.SiLU,
    "tanh": nn.Tanh,
}


def load_agent_file(
    library: str, task: str, given: str | None, overrides: Sequence[str]
) -> dict[str, Any]:
    """Return the content of an agent file.

    Args:
        library: folder in cfg/.
        task: whose file it is; without one of its own, default.yaml.
        given: a path, or the name of a file of the folder, to take instead.
        overrides: `agent.key.below=value` each.

    Raises:
        ConfigError: there is no such file, or no such key.
    """
    content = read_yaml(_find(cfg_dir() / library, task, given))
    for word in overrides:
        key, _, value = word.removeprefix(PREFIX).partition("=")
        try:
            if OmegaConf.select(content, key, throw_on_missing=False) is None:
                section = OmegaConf.select(content, key.rpartition(".")[0] or "")
                known = list(section if key.count(".") and section is not None else content)
                raise ConfigError(unknown("agent key", key, map(str, known)))
            OmegaConf.update(content, key, OmegaConf.from_dotlist([f"v={value}"]).v)
        except OmegaConfBaseException as error:
            raise ConfigError(f"{word}: {one_line(error)}") from error
    return plain(content)


def _find(folder: Path, task: str, given: str | None) -> Path:
    if given is None:
        own = folder / f"{task}.yaml"
        return own if own.is_file() else folder / f"{_DEFAULT}.yaml"
    for path in (Path(given).expanduser(), folder / f"{given}.yaml"):
        if path.is_file():
            return path
    names = [path.stem for path in folder.glob("*.yaml")]
    raise ConfigError(unknown("--agent", given, names, "or give the path of a file"))


@dataclass(frozen=True, kw_only=True)
class AgentSettings:
    """The keys that every agent file has."""

    max_iterations: int = setting(minimum=1)
    """Rollouts, each with the updates that follow it."""
    checkpoint_interval: int = setting(minimum=1)
    """Iterations."""


def check_arguments(
    function: Callable[..., Any],
    arguments: Mapping[str, Any],
    where: str,
    reserved: Iterable[str] = (),
) -> None:
    """Check that a section names arguments of a function or class.

    Args:
        function: what will be called with them.
        arguments: the section.
        where: its path, `agent.ppo`.
        reserved: arguments that the workflow gives, or that could name code.

    Raises:
        ConfigError: one of them is none.
    """
    names = set(inspect.signature(function).parameters) - {"self", *reserved}
    for name in arguments:
        if name not in names:
            raise ConfigError(unknown(f"key of {where}", name, names))


def activation(name: str) -> type[nn.Module]:
    """Return the class of an activation.

    Raises:
        ConfigError: another name.
    """
    if name not in _ACTIVATIONS:
        raise ConfigError(unknown("activation", name, _ACTIVATIONS))
    return _ACTIVATIONS[name]
