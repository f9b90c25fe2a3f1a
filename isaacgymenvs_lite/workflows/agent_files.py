"""Agent files: cfg/<library>/<Task>.yaml, or default.yaml beside it.

A file holds keyword arguments of the library's classes, by section, and a few keys of the workflow.
It cannot name code: the workflow chooses the classes.
"""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import nn
from yaml import YAMLError

from isaacgymenvs_lite.config.staging import read_yaml
from isaacgymenvs_lite.errors import ConfigError, UserError, one_line, unknown
from isaacgymenvs_lite.paths import cfg_dir, user_path
from isaacgymenvs_lite.schema import keys_of, plain, setting

PREFIX = "agent."
"""Start of a key of the agent file on the command line."""

_DEFAULT = "default"
_NUM_NEAREST = 3
_SEED = 42
# Isaac Lab's names of a task's own file: sb3_cfg_entry_point.
_ENTRY_POINT = "_cfg_entry_point"
_ACTIVATIONS: dict[str, type[nn.Module]] = {
    "elu": nn.ELU,
    "gelu": nn.GELU,
    "leaky_relu": nn.LeakyReLU,
    "relu": nn.ReLU,
    "selu": nn.SELU,
    "silu": nn.SiLU,
    "tanh": nn.Tanh,
}


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
    content = read_yaml(_find(cfg_dir() / library, task, given))
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


def _find(folder: Path, task: str, given: str) -> Path:
    if not given or given.endswith(_ENTRY_POINT):
        own = folder / f"{task}.yaml"
        return own if own.is_file() else folder / f"{_DEFAULT}.yaml"
    for path in (user_path(given), folder / f"{given}.yaml"):
        if path.is_file():
            return path
    names = [path.stem for path in folder.glob("*.yaml")]
    raise ConfigError(unknown("agent file", given, names, "or give the path of a file"))


@dataclass(frozen=True, kw_only=True)
class AgentSettings:
    """The keys that all agent files have."""

    max_iterations: int = setting(minimum=1)
    """Rollouts, each with the updates that follow it."""
    checkpoint_interval: int = setting(minimum=1)
    """Iterations."""
    seed: int = setting(_SEED)
    """Unless the command line gives one."""


def check_keys(
    cls: type[Any],
    content: Mapping[str, Any],
    where: str,
    functions: Mapping[str, Callable[..., Any]] | None = None,
) -> None:
    """Check that a section has only keys that its settings read.

    Args:
        cls: the settings.
        content: the section.
        where: its path, `agent`.
        functions: section -> function whose arguments the section holds, to find a key that was
            written one section too high.

    Raises:
        ConfigError: an unknown key; the message names the nearest ones.
    """
    own = keys_of(cls)
    below = {
        f"{section}.{name}": name
        for section, function in (functions or {}).items()
        for name in inspect.signature(function).parameters
    }
    for key in content:
        if key in own:
            continue
        near = [path for path, name in below.items() if name == key]
        near += difflib.get_close_matches(str(key), [*own, *below], n=_NUM_NEAREST, cutoff=0.5)
        near = list(dict.fromkeys(near))[:_NUM_NEAREST]
        names = " or ".join(f"'{path}'" for path in near)
        question = f" (did you mean {names}?)" if near else ""
        raise ConfigError(
            f"unknown key '{where}.{key}'{question}; {where} has {', '.join(sorted(own))}"
        )


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
            raise ConfigError(unknown(f"key of {where}", name, names))
        default = parameters[name].default
        if isinstance(default, bool) and not isinstance(value, bool):
            raise ConfigError(f"{where}.{name}: got {value!r}, expected True or False")
        may_be_none = value is None and "None" in str(parameters[name].annotation)
        if _is_number(default) and not (_is_number(value) or may_be_none):
            raise ConfigError(f"{where}.{name}: got {value!r}, expected a number")


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


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def activation_class(name: str) -> type[nn.Module]:
    """Return the class of an activation.

    Raises:
        ConfigError: another name.
    """
    if name not in _ACTIVATIONS:
        raise ConfigError(unknown("activation", name, _ACTIVATIONS))
    return _ACTIVATIONS[name]
