"""What the workflows use of an RL library.

The libraries' own `load` functions unpickle whatever a file holds. Agents here are made from the
agent file, and read only tensors from a checkpoint.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from isaacgymenvs_lite.errors import CheckpointError, UserError, one_line
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask


class Agent(ABC):
    """An agent of a library with its environment.

    Attributes:
        stepper: steps the task, below the library's own wrappers.
        max_iterations: from the agent file.
        minibatch_rows: rows that the networks are evaluated for in a gradient step.
        num_parameters: number of parameters of all networks.
    """

    stepper: AutoresetTask
    max_iterations: int
    minibatch_rows: int
    num_parameters: int

    @abstractmethod
    def learn(self, folder: Path, log_interval: int | None = None) -> None:
        """Train for `max_iterations`; checkpoints and TensorBoard's files go into `folder`.

        Args:
            folder: folder of the training.
            log_interval: frames from one log entry to the next; None: the library's own.
        """

    @abstractmethod
    def save(self, folder: Path) -> Path:
        """Write a checkpoint below `folder`, with a name as in `learn`; return the file."""

    @abstractmethod
    def load(self, checkpoint: Path) -> None:
        """Load parameters and normalisers from a checkpoint, without running code from it.

        Raises:
            CheckpointError: it belongs to another library or another network.
        """

    @abstractmethod
    def player(self) -> Callable[[], None]:
        """Start new episodes; return a function that makes a step with the mean actions."""


@dataclass(frozen=True)
class Library:
    """An RL library.

    Attributes:
        name: of its folders in cfg/ and logs/, and of its package in `workflows`.
        title: as its users write it.
        package: module that it is imported by.
        checkpoints: patterns of the checkpoints in the folder of a training.
    """

    name: str
    title: str
    package: str
    checkpoints: tuple[str, ...]

    def make_agent(self, task: VecTask, content: dict[str, Any], device: str, seed: int) -> Agent:
        """Import the library and make an agent.

        Args:
            task: what to train or play on.
            content: of an agent file.
            device: torch device of the networks.
            seed: of the agent.

        Raises:
            ConfigError: a key of the agent file that cannot be used.
        """
        module = importlib.import_module(f"isaacgymenvs_lite.workflows.{self.name}.agent")
        return module.Agent(task, content, device, seed)


LIBRARIES = {
    library.name: library
    for library in (
        Library(
            "sb3",
            "Stable-Baselines3",
            "stable_baselines3",
            ("checkpoints/model_*.zip", "model.zip"),
        ),
        Library("skrl", "skrl", "skrl", ("checkpoints/agent_*.pt",)),
        Library("rsl_rl", "rsl_rl", "rsl_rl", ("model_*.pt",)),
    )
}


@contextmanager
def loading(file: str | Path, title: str) -> Iterator[None]:
    """Report whatever goes wrong while a checkpoint is loaded as a user's mistake.

    Args:
        file: the checkpoint.
        title: of the library.

    Raises:
        CheckpointError: something was raised.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # on arbitrary bytes the readers may raise anything
        fits = isinstance(error, (KeyError, RuntimeError, TypeError, ValueError))
        reason = one_line(error)[:160] if fits else "damaged, or with more than tensors in it"
        raise CheckpointError(
            f"checkpoint={file}: no checkpoint of {title} for this task and agent file ({reason});"
            " nothing of it was run; give the library, task and overrides of its training"
        ) from error


def count_parameters(networks: Iterable[nn.Module]) -> int:
    """Return the number of parameters of networks."""
    return sum(parameter.numel() for network in networks for parameter in network.parameters())
