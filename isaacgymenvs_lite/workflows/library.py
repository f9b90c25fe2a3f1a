"""What a workflow must know of an RL library."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask


class Agent(Protocol):
    """An agent of a library with its environment.

    Attributes:
        stepper: what steps the task, below the library's own wrappers.
        max_iterations: as the agent file says.
        minibatch_rows: rows that the networks are evaluated for in a gradient step.
        num_parameters: of the networks.
    """

    stepper: AutoresetTask
    max_iterations: int
    minibatch_rows: int
    num_parameters: int

    def learn(self, folder: Path, log_interval: int | None = None) -> None:
        """Train for `max_iterations`; checkpoints and TensorBoard's files go into `folder`.

        Args:
            folder: of the training.
            log_interval: frames from one log entry to the next; None: the library's own.
        """
        ...

    def save(self, folder: Path) -> Path:
        """Write a checkpoint of now below `folder`, as `learn` does; return the file."""
        ...

    def load(self, checkpoint: Path) -> None:
        """Take parameters and normalisers over from a checkpoint, without running code of it.

        Raises:
            CheckpointError: it is none of this library, or of another network.
        """
        ...

    def player(self) -> Callable[[], None]:
        """Start new episodes; return what makes a step with the policy's mean actions."""
        ...


@dataclass(frozen=True)
class Library:
    """An RL library.

    Attributes:
        name: of its folders in cfg/ and logs/, and of its package here.
        title: as its users know it.
        package: module that it is imported by.
        agent_class: name of the `Agent` in `workflows.<name>.agent`.
        checkpoints: patterns of the files that a training writes into its folder, of which the
            newest is the last checkpoint.
    """

    name: str
    title: str
    package: str
    agent_class: str
    checkpoints: tuple[str, ...]

    def make_agent(self, task: VecTask, content: dict[str, Any], device: str, seed: int) -> Agent:
        """Make an agent; the library is imported now.

        Args:
            task: what to train or play on.
            content: of an agent file.
            device: torch device of the networks.
            seed: of the agent.

        Raises:
            ConfigError: a key of the agent file that cannot be used.
        """
        module = importlib.import_module(f"isaacgymenvs_lite.workflows.{self.name}.agent")
        return getattr(module, self.agent_class)(task, content, device, seed)

    def command(self, verb: str) -> str:
        """Return the command that trains or plays: `python -m ...sb3.train`."""
        return f"python -m isaacgymenvs_lite.workflows.{self.name}.{verb}"
