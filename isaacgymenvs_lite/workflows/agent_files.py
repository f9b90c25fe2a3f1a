"""Agent files: cfg/<library>/<Task>.yaml, or default.yaml beside it.

A file holds keyword arguments of the library's classes, by section, and a few keys of the workflow.
It cannot name code: the workflow chooses the classes.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import nn
from yaml import YAMLError

from isaacgymenvs_lite.config.staging import read_yaml
from isaacgymenvs_lite.errors import ConfigError, UserError, one_line, unknown
from isaacgymenvs_lite.paths import cfg_dir, user_path
from isaacgymenvs_lite.schema import keys_of, plain, read_section, setting

PREFIX = "agent."
"""Start of a key of the agent file on the command line."""

_SEED = 42
# Isaac Lab's names of a task's own file: sb3_cfg_entry_point.
_ENTRY_POINT = "_cfg_entry_point"
_ACTIVATIONS = {
    function.__name__.lower(): function
    for function in (nn.ELU, nn.GELU, nn.LeakyReLU, nn.ReLU, nn.SELU, nn.SiLU, nn.Tanh)
} | {"leaky_relu": nn.LeakyReLU}


def load_agent_file(
    library: str, task: str, given: str, overrides: Sequence[str]
) -> dict[str, Any]:
    """Return the content of an agent file.

    Args:
        library: folder in cfg/.
        task: name of the task, whose file is read; default.yaml if it has none.
        given: a path, or the name of a file in the folder, to read instead; '' and Isaac Lab's
            `sb3_cfg_entry_point` mean the task's file.
        overrides: `agent.key.below=value` each; the agent checks the keys.

    Raises:
        ConfigError: there is no such file, or a value is not valid YAML.
    """
    folder = cfg_dir() / library
    if not given or given.endswith(_ENTRY_POINT):
        places = [folder / f"{task}.yaml", folder / "default.yaml"]
    else:
        places = [user_path(given), folder / f"{given}.yaml"]
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        names = [path.stem for path in folder.glob("*.yaml")]
        raise ConfigError(unknown("agent file", given, names, "or give the path of a file"))
    content = read_yaml(file)
    for word in overrides:
        key, _, value = word.removeprefix(PREFIX).partition("=")
        try:
            OmegaConf.update(content, key, OmegaConf.from_dotlist([f"v={value}"]).v)
        except (OmegaConfBaseException, YAMLError) as error:
            raise ConfigError(f"{word}: {one_line(error)}") from error
    return plain(content)


def seed_of(content: Mapping[str, Any]) -> int:
    """Return the seed of an agent file, as Isaac Lab's have one; 42 if it has none.

    Raises:
        ConfigError: not a whole number.
    """
    seed = content.get("seed", _SEED)
    if not isinstance(seed, int) or isinstance(seed, bool):
        raise ConfigError(f"agent.seed: got {seed!r}, expected a whole number")
    return seed


@dataclass(frozen=True, kw_only=True)
class AgentSettings:
    """The keys that all agent files have."""

    max_iterations: int = setting(minimum=1)
    """Rollouts, each with the updates that follow it."""
    checkpoint_interval: int = setting(minimum=1)
    """Iterations."""
    seed: int = setting(_SEED)
    """Unless the command line gives one."""


Settings = TypeVar("Settings", bound=AgentSettings)


def read_agent(cls: type[Settings], content: Mapping[str, Any]) -> Settings:
    """Return the content of an agent file as settings.

    Raises:
        ConfigError: an unknown key, or a value that cannot be used.
    """
    for key in content:
        if key not in keys_of(cls):
            raise ConfigError(unknown("key of agent", str(key), keys_of(cls)))
    return read_section(cls, content, "agent", complete=True)


def check_arguments(
    function: Callable[..., Any],
    arguments: Mapping[str, Any],
    where: str,
    reserved: Iterable[str] = (),
) -> None:
    """Check that a section holds arguments of a function or class, of the kind of its defaults.

    Args:
        function: what will be called with them.
        arguments: the section.
        where: its path, `agent.ppo`.
        reserved: arguments that the workflow sets, or that could name code.

    Raises:
        ConfigError: an unknown argument, or a value of another kind.
    """
    parameters = inspect.signature(function).parameters
    names = set(parameters) - {"self", *reserved}
    for name, value in arguments.items():
        if name not in names:
            raise ConfigError(unknown(f"key of {where}", str(name), names))
        default = parameters[name].default
        may_be_none = value is None and "None" in str(parameters[name].annotation)
        if isinstance(default, bool):
            if not isinstance(value, bool):
                raise ConfigError(f"{where}.{name}: got {value!r}, expected True or False")
        elif isinstance(default, int | float) and not may_be_none and not is_number(value):
            raise ConfigError(f"{where}.{name}: got {value!r}, expected a number")


def is_number(value: Any) -> bool:
    """Return whether a value is a number, or a library's schedule of one."""
    return callable(value) or (isinstance(value, int | float) and not isinstance(value, bool))


def whole_number(section: Mapping[str, Any], key: str, where: str) -> int:
    """Return a whole number >= 1 of a section.

    Raises:
        ConfigError: it is missing or something else.
    """
    value = section.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ConfigError(f"{where}.{key}: got {value!r}, expected a whole number >= 1")
    return value


@contextmanager
def constructing(what: str) -> Iterator[None]:
    """Report values that a library's constructor refuses as a user's mistake.

    Args:
        what: name of the class, for the message.

    Raises:
        ConfigError: the constructor raised something.
    """
    try:
        yield
    except UserError:
        raise
    except (TypeError, ValueError, AssertionError) as error:
        raise ConfigError(f"agent: {what} refuses its values: {one_line(error)}") from error


def activation_class(name: str) -> type[nn.Module]:
    """Return the class of an activation.

    Raises:
        ConfigError: another name.
    """
    if name not in _ACTIVATIONS:
        raise ConfigError(unknown("activation", name, _ACTIVATIONS))
    return _ACTIVATIONS[name]
