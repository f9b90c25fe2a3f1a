"""What a workflow uses of an RL library: its agent, and its checkpoints.

The libraries' own `load` functions unpickle whatever a file holds. `read_parameters` reads tensors
only; the networks are made from the agent file.
"""

from __future__ import annotations

import importlib
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from isaacgymenvs_lite.checkpoints.archive import ArchiveError, read_archive
from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.typed_command import package_command
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask

# Library -> keys that only its checkpoints have. Stable-Baselines3 writes archives with a member.
_KEYS: dict[str, set[str]] = {
    "rsl_rl": {"actor_state_dict", "critic_state_dict"},
    "skrl": {"policy", "value", "optimizer"},
    "rl_games": {"model"},
}
_SB3, _SB3_MEMBER = "sb3", "policy.pth"


class Agent(Protocol):
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

    def learn(self, folder: Path, log_interval: int | None = None) -> None:
        """Train for `max_iterations`; checkpoints and TensorBoard's files go into `folder`.

        Args:
            folder: folder of the training.
            log_interval: frames from one log entry to the next; None: the library's own.
        """
        ...

    def save(self, folder: Path) -> Path:
        """Write a checkpoint below `folder`, with a name as in `learn`; return the file."""
        ...

    def load(self, checkpoint: Path) -> None:
        """Load parameters and normalisers from a checkpoint, without running code from it.

        Raises:
            CheckpointError: it belongs to another library or another network.
        """
        ...

    def player(self) -> Callable[[], None]:
        """Start new episodes; return a function that makes a step with the mean actions."""
        ...


@dataclass(frozen=True)
class Library:
    """An RL library.

    Attributes:
        name: of its folders in cfg/ and logs/, and of its package in `workflows`.
        title: as its users write it.
        package: module that it is imported by.
        agent_class: name of the `Agent` in `workflows.<name>.agent`.
        checkpoints: patterns of the checkpoints in the folder of a training.
    """

    name: str
    title: str
    package: str
    agent_class: str
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
        return getattr(module, self.agent_class)(task, content, device, seed)

    def command(self, verb: str) -> str:
        """Return the command that trains or plays, for a shell."""
        return package_command("workflows", self.name, verb)


def read_parameters(checkpoint: Path, library: Library) -> dict[str, Any]:
    """Return the tensors of a checkpoint, on the CPU: nested dictionaries by name.

    A checkpoint of Stable-Baselines3 gives an empty dictionary: its archive holds other files,
    which `Sb3Agent.load` reads.

    Raises:
        CheckpointError: no such file, a file that is damaged or would run code, or a checkpoint of
            another library.
    """
    if not checkpoint.is_file():
        raise CheckpointError(f"checkpoint={checkpoint}: no such file")
    content: dict[str, Any] = {}
    if _is_sb3(checkpoint):
        kind = _SB3
    else:
        content = _read(checkpoint, library)
        kinds = (name for name, keys in _KEYS.items() if keys <= content.keys())
        kind = next(kinds, None)
    if kind != library.name:
        raise CheckpointError(_wrong_kind(checkpoint, library, kind))
    return content


def load_into(networks: Callable[[], object], checkpoint: Path) -> None:
    """Load parameters of a checkpoint into networks.

    Args:
        networks: loads them.
        checkpoint: for the message.

    Raises:
        CheckpointError: the parameters do not fit.
    """
    try:
        networks()
    except (KeyError, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise CheckpointError(
            f"checkpoint={checkpoint}: of another network or task ({reason[:160]}); give the task"
            " and overrides of its training"
        ) from error


def _is_sb3(checkpoint: Path) -> bool:
    if not zipfile.is_zipfile(checkpoint):
        return False
    with zipfile.ZipFile(checkpoint) as archive:
        return _SB3_MEMBER in archive.namelist()


def _read(checkpoint: Path, library: Library) -> dict[str, Any]:
    try:
        content = read_archive(checkpoint)
    except (ArchiveError, OSError) as error:
        raise CheckpointError(
            f"checkpoint={checkpoint}: {error}; expected one of {library.title}"
        ) from error
    return dict(content) if isinstance(content, Mapping) else {}


def _wrong_kind(checkpoint: Path, library: Library, kind: str | None) -> str:
    hint = ""
    if kind == "rl_games":
        command = package_command("train", "task=HumanoidAMP", "test=True")
        hint = f"; play it with {command} checkpoint={checkpoint}, and its own task"
    elif kind is not None:
        hint = f"; play it with {package_command('workflows', kind, 'play')}"
    what = f"a checkpoint of {kind}" if kind else "no checkpoint of a known library"
    return f"checkpoint={checkpoint}: {what}, expected one of {library.title}{hint}"
