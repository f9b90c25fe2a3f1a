"""Defines the interface of an RL library's agent, and reads agent files and checkpoints.

An agent file, cfg/<library>/<Task>.yaml, has a section of arguments for each class of the library,
and a few keys of the workflow. An agent file cannot name code, because the workflow chooses the
classes. Only tensors are read from checkpoints, although the libraries' `load` functions unpickle
all objects.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import nn
from yaml import YAMLError

from isaacgymenvs_lite.config.staging import read_yaml
from isaacgymenvs_lite.errors import CheckpointError, ConfigError, UserError, one_line, unknown
from isaacgymenvs_lite.paths import cfg_dir, user_path
from isaacgymenvs_lite.schema import keys_of, plain, read_section, setting
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask

PREFIX = "agent."
"""Prefix of the agent file's keys on the command line."""

# Isaac Lab's scripts use names such as sb3_cfg_entry_point for a task's agent file.
_ENTRY_POINT = "_cfg_entry_point"
_ACTIVATIONS: dict[str, type[nn.Module]] = {
    "elu": nn.ELU,
    "gelu": nn.GELU,
    "leaky_relu": nn.LeakyReLU,
    "leakyrelu": nn.LeakyReLU,
    "relu": nn.ReLU,
    "selu": nn.SELU,
    "silu": nn.SiLU,
    "tanh": nn.Tanh,
}


LIBRARIES = {"sb3": "stable_baselines3", "skrl": "skrl", "rsl_rl": "rsl_rl"}
"""Maps each library's folder name (in cfg/, logs/ and workflows/) to the library's package."""


class Agent(ABC):
    """A library's agent with its environment; made from task, agent file, device and seed."""

    env: Any
    """The library's environment with all wrappers."""
    stepper: AutoresetTask
    networks: Sequence[nn.Module]
    minibatch_rows: int
    """Number of rows in a gradient step."""

    @abstractmethod
    def learn(self, folder: Path, log_interval: int | None) -> None:
        """Train, and write checkpoints and TensorBoard's files into `folder`.

        A log entry is written every `log_interval` frames; None selects the library's default.
        """

    @abstractmethod
    def save(self, folder: Path) -> Path:
        """Write a checkpoint below `folder` with the name that `learn` uses; return the path."""

    @abstractmethod
    def load(self, checkpoint: Path) -> None:
        """Load parameters and normalisers from a checkpoint; run no code from the checkpoint."""

    @abstractmethod
    def policy(self) -> Callable[[Any], Any]:
        """Stop learning; return a function from observations of `env` to mean actions."""


@dataclass(frozen=True, kw_only=True)
class SeedSettings:
    """The agent file's key `seed`, which is read before the agent is made."""

    seed: int = setting(42)
    """Seed, unless the command line contains a seed."""


@dataclass(frozen=True, kw_only=True)
class AgentSettings(SeedSettings):
    """The keys that all agent files have."""

    max_iterations: int = setting(minimum=1)
    """Number of rollouts; updates follow each rollout."""
    checkpoint_interval: int = setting(minimum=1)
    """Number of iterations."""


Settings = TypeVar("Settings", bound=AgentSettings)


def load_agent_file(
    library: str, task: str, given: str, overrides: Sequence[str]
) -> dict[str, Any]:
    """Return the content of an agent file.

    Args:
        library: name of the library's folder in cfg/.
        task: name of the task. The task's agent file is read, or default.yaml if it has none.
        given: the path of another agent file, or its name in the folder; '' and Isaac Lab's
            `sb3_cfg_entry_point` select the task's agent file.
        overrides: arguments such as `agent.key.below=value`; the agent checks the keys.
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


def read_agent(cls: type[Settings], content: Mapping[str, Any]) -> Settings:
    """Return the content of an agent file as settings.

    Raises:
        ConfigError: a key is unknown, or a value is wrong.
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
    """Check that a section contains a function's arguments with the types of the defaults.

    An integer must be at least 1, or at least the default if the default is less than 1.

    Args:
        function: the function or class.
        arguments: the section; a callable is accepted as a schedule in place of a float.
        where: path of the section, for example `agent.ppo`.
        reserved: forbidden arguments, which could name code or files.
    """
    parameters = inspect.signature(function).parameters
    names = set(parameters) - set(reserved)
    for name, value in arguments.items():
        if name not in names:
            raise ConfigError(unknown(f"key of {where}", str(name), names))
        default, annotation = parameters[name].default, str(parameters[name].annotation)
        if (value is None and "None" in annotation) or callable(value):
            continue
        if isinstance(default, bool):
            fits, expected = isinstance(value, bool), "True or False"
        elif isinstance(default, int) and "float" not in annotation:
            least = min(1, default)
            fits, expected = type(value) is int and value >= least, f"a whole number >= {least}"
        elif isinstance(default, int | float):
            fits, expected = type(value) in (int, float), "a number"
        else:
            continue
        if not fits:
            raise ConfigError(f"{where}.{name}: got {value!r}, expected {expected}")


def activation_class(name: str) -> type[nn.Module]:
    """Return the class of the activation with a name.

    Raises:
        ConfigError: the name is unknown.
    """
    if name not in _ACTIVATIONS:
        raise ConfigError(unknown("activation", name, _ACTIVATIONS))
    return _ACTIVATIONS[name]


@contextmanager
def loading(file: str | Path, library: str) -> Iterator[None]:
    """Report any error while a checkpoint is loaded as a `CheckpointError`."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # Damaged files raise errors of many types.
        fits = isinstance(error, (KeyError, OSError, RuntimeError, TypeError, ValueError))
        reason = one_line(error)[:160] if fits else "damaged, or with more than tensors in it"
        raise CheckpointError(
            f"checkpoint={file}: no checkpoint of {library} for this task and agent file"
            f" ({reason}); nothing of it was run; give the library, task and overrides of its"
            " training"
        ) from error
