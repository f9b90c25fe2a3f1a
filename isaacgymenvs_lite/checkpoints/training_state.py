"""The files `<run>/resume/<epoch>.pth`, from which a training is resumed exactly.

A training state is a checkpoint with the additional entry `training_state`, which holds the state
of the agent and its task. A second file holds the replay buffers, which can be large. Each file is
written in one step, and the former state is removed only when both files exist. A complete training
state therefore survives a crash at any time.

Each process writes its own files: the main process writes `<epoch>.pth` with the networks, and
other processes write `<epoch>_rank<rank>.pth`. All files of a training state contain the same
random token, which shows that they belong together.
"""

from __future__ import annotations

import contextlib
import logging
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from isaacgymenvs_lite.checkpoints.archive import read_archive
from isaacgymenvs_lite.checkpoints.files import (
    load_checkpoint,
    newest_run,
    plain_numbers,
    write_atomically,
)
from isaacgymenvs_lite.errors import CheckpointError, one_line
from isaacgymenvs_lite.paths import user_path
from isaacgymenvs_lite.run.folder import RunFolder, newest, run_of_checkpoint

log = logging.getLogger(__name__)

KEY = "training_state"
"""Key of a training state's additional entry."""

FOLDER = "resume"
"""Name of the folder in a run folder that contains the training states."""

_VERSION = 2
_STATE = re.compile(r"\d+\.pth")
_FILE_OF_STATE = re.compile(r"(\d+)(_rank\d+)?(_buffers)?\.pth")


@dataclass(frozen=True)
class TrainingState:
    """The content of a file from which a training is resumed.

    Attributes:
        checkpoint: networks, optimisers and counts.
        memory: state of the agent and the task, or None if the file is a checkpoint.
        buffers: rows of replay buffers by name, or None if there is no file of replay buffers.
        num_processes: number of processes that wrote the training state. If the current number of
            processes differs, `memory` comes from the main process.
    """

    checkpoint: dict[str, Any]
    memory: dict[str, Any] | None
    buffers: dict[str, Any] | None
    num_processes: int = 1


def new_token() -> str:
    """Return a random token, which all files of a training state contain."""
    return secrets.token_hex(8)


def write_training_state(
    run: Path, state: TrainingState, epoch: int, token: str, rank: int = 0
) -> list[Path]:
    """Write the files of this process for a training state into a run folder; return them.

    The former training state is not removed. `token` is the result of `new_token` in the main
    process.
    """
    folder = run / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    file, buffers = _files_of(folder / f"{epoch}.pth", rank)
    files = [file]
    if state.buffers is not None:
        write_atomically(buffers, {"token": token, "buffers": state.buffers})
        files.append(buffers)
    entry = {
        "version": _VERSION,
        "token": token,
        "num_processes": state.num_processes,
        "memory": plain_numbers(state.memory),
    }
    checkpoint = plain_numbers(state.checkpoint) if rank == 0 else {}
    write_atomically(file, {**checkpoint, KEY: entry})
    return files


def write_start(run: Path, checkpoint: dict[str, Any]) -> Path:
    """Write a checkpoint from which another process can continue a run; return its path.

    The training states of the run are removed: `resume=` prefers training states, and their
    networks are older.
    """
    folder = run / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{checkpoint['epoch']}.pth"
    write_atomically(file, plain_numbers(checkpoint))
    remove_other_states(run, checkpoint["epoch"])
    return file


def remove_other_states(run: Path, epoch: int) -> None:
    """Remove the files of all training states of a run, except the complete one of `epoch`."""
    for file in (run / FOLDER).iterdir():
        found = _FILE_OF_STATE.fullmatch(file.name)
        if found and int(found[1]) != epoch:
            with contextlib.suppress(OSError):
                file.unlink()


def _files_of(path: Path, rank: int) -> tuple[Path, Path]:
    """Return the two files of a process, given the main process' file of the training state."""
    stem = path.stem if rank == 0 else f"{path.stem}_rank{rank}"
    return path.with_name(f"{stem}.pth"), path.with_name(f"{stem}_buffers.pth")


def read_training_state(path: Path, rank: int = 0, num_processes: int = 1) -> TrainingState:
    """Return the content of a training state or a checkpoint.

    `path` is the file of the main process; a process with another `rank` reads its own file in the
    same folder. Raises CheckpointError if a file is missing or damaged.
    """
    checkpoint = load_checkpoint(path)
    entry = checkpoint.pop(KEY, None)
    if entry is None:
        return TrainingState(checkpoint, None, None)
    memory, token = _memory_of(entry, path), entry.get("token")
    former_processes = entry.get("num_processes", 1)
    if former_processes != num_processes:
        return TrainingState(checkpoint, memory, None, former_processes)
    file, buffers_file = _files_of(path, rank)
    if rank > 0:
        hint = "all processes need the run folder on a disk they share"
        own = _read_archive(file, hint).get(KEY, {})
        memory = _memory_of(own, file)
        if own.get("token") != token:
            raise CheckpointError(f"resume={file}: is not of the same training state as {path}")
    buffers = None
    if buffers_file.is_file():
        content = _read_archive(buffers_file, "remove it to go on with empty replay buffers")
        buffers = content.get("buffers") if content.get("token") == token else None
    return TrainingState(checkpoint, memory, buffers, num_processes)


def _memory_of(entry: Any, path: Path) -> dict[str, Any]:
    if not isinstance(entry, dict) or entry.get("version") != _VERSION:
        raise CheckpointError(
            f"resume={path}: its training state is of another version; start a run with its"
            f" networks: checkpoint={path}"
        )
    return entry["memory"]


def _read_archive(file: Path, hint: str) -> dict[str, Any]:
    try:
        return dict(read_archive(file))
    except OSError as error:
        raise CheckpointError(f"resume={file}: {error.strerror}; {hint}") from error
    except Exception as error:  # For a damaged file, the reader may raise any exception.
        raise CheckpointError(f"resume={file}: damaged ({one_line(error)}); {hint}") from error


def resume_file(resume: str, train_dir: Path, wanted: Mapping[str, str]) -> Path:
    """Return the file to resume from, given the key `resume`: `last`, a run folder or a file.

    `last` searches the runs in `train_dir` whose config.yaml has the values `wanted`, given by
    path.
    """
    given = user_path(resume)
    if resume == "last":
        run = newest_run(train_dir, wanted, ["nn/*.pth", f"{FOLDER}/*.pth"])
        if run is None:
            of = f" with {', '.join(f'{k}={v}' for k, v in wanted.items())}" if wanted else ""
            raise CheckpointError(
                f"resume=last: no run{of} below {train_dir.absolute()} has a checkpoint to continue"
                " from; start a run without resume="
            )
    elif given.is_dir():
        run = RunFolder.at(given.absolute(), train_dir)
    elif given.is_file():
        if not (run_of_file(given) / "config.yaml").is_file():
            raise CheckpointError(
                f"resume={resume}: no config.yaml in its run folder; start a new run from it:"
                f" checkpoint={resume}"
            )
        return given.absolute()
    else:
        raise CheckpointError(
            f"resume={resume}: no such file or folder; expected 'last', a run folder or a file in"
            " its nn/ or resume/"
        )
    if not run.files("config.yaml"):
        raise CheckpointError(f"resume={resume}: no run folder, because it has no config.yaml")
    file = _newest_state(run)
    if file is None:
        raise CheckpointError(f"resume={resume}: {run.path} has no checkpoint yet to continue from")
    run.report_rescued(file, f"resume={resume}")
    return file.absolute()


def _newest_state(run: RunFolder) -> Path | None:
    """Return the newest training state of a run, or a newer checkpoint in the temporary folder.

    If there is no training state, the newest checkpoint is returned. If the run folder has a
    checkpoint that is newer than the training state, the checkpoint is only logged, because it does
    not allow an exact resume.
    """
    states = [file for file in run.files(f"{FOLDER}/*.pth") if _STATE.fullmatch(file.name)]
    state, checkpoint = newest(states), run.newest_checkpoint()
    if state is None or checkpoint is None:
        return state or checkpoint
    epoch = -1  # A damaged checkpoint has no epoch.
    with contextlib.suppress(CheckpointError):
        epoch = int(load_checkpoint(checkpoint).get("epoch", -1))
    if epoch <= int(state.stem):
        return state
    if not checkpoint.is_relative_to(run.path):
        return checkpoint
    log.warning(
        "resuming from the training state of epoch %s; the newer %s (epoch %d) has only networks"
        " and optimisers: resume=%s resumes from it",
        *(state.stem, checkpoint.name, epoch, checkpoint),
    )
    return state


def run_of_file(file: Path) -> Path:
    """Return the run folder, given a file in its folder nn/ or resume/."""
    return run_of_checkpoint(str(file)) or file.absolute().parent.parent


def num_bytes(value: Any) -> int:
    """Return the memory of all tensors in nested dictionaries, in bytes."""
    if isinstance(value, dict):
        return sum(num_bytes(part) for part in value.values())
    return value.nbytes if hasattr(value, "nbytes") else 0
