"""Writes checkpoints atomically, loads them without running code, and finds them by name.

rl_games writes a checkpoint in place (a kill in the middle loses the old one too) and loads it with
a full unpickler (a stranger's file runs code). The agents and players here use this module instead.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf

from isaacgymenvs_lite.checkpoints.archive import ArchiveError, read_archive
from isaacgymenvs_lite.checkpoints.shipped import shipped_policies
from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.paths import user_path
from isaacgymenvs_lite.run.folder import RunFolder, folder_of_checkpoint, newest, runs_below
from isaacgymenvs_lite.schema import select
from isaacgymenvs_lite.typed_command import package_command
from isaacgymenvs_lite.utils.files import atomic_write

log = logging.getLogger(__name__)

LLC_KEY = "llc"
"""Key of a high level's checkpoint for the low level that it was trained over."""

_COMPILED_PREFIX = "_orig_mod."
# rl_games 1.1.4 (ASE) kept the normalisers beside the model: file key -> prefix in the model.
_OLD_NORMALIZERS = {"running_mean_std": "running_mean_std", "reward_mean_std": "value_mean_std"}
# rl_games' SAC agent writes each network under a key.
_SAC_KEYS = {"actor", "critic"}
# Entries of tensors by name.
_STATE_DICTS = (
    *("model", "actor", "critic", "critic_target", "assymetric_vf_nets"),
    *(*_OLD_NORMALIZERS, "amp_input_mean_std", "advantage_mean_std"),
)
# Entries that are whole numbers, and numbers.
_COUNTS = ("epoch", "frame")
_NUMBERS = ("last_mean_rewards",)
_MAX_SHOWN = 80


# --- writing -----------------------------------------------------------------------------------


def save_checkpoint(filename: str, state: dict[str, Any]) -> Path | None:
    """Write `state` to `<filename>.pth`; an older file stays whole until the new one is.

    A run folder that was removed is made again. If it cannot be written (read-only, full), the
    failure is logged, the checkpoint is written to a private folder below the system's temporary
    one, and the training goes on: losing the run would be worse than losing a file.

    Returns:
        The file that was written; None if none could be.
    """
    path = Path(f"{filename}.pth")
    state = plain_numbers(state)
    folder = folder_of_checkpoint(path)
    try:
        folder.make_again()
        write_atomically(path, state)
        saved = path
    except OSError as error:
        saved = _rescue(path, state, folder, error)
    folder.save_failed = saved is None
    log.debug("saved %s", saved)
    return saved


def write_atomically(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint in one step, see `utils.files`.

    Raises:
        OSError: the folder cannot be written or is full; no partial file is left.
        KeyboardInterrupt: the user interrupted it; no partial file is left either.
    """
    with atomic_write(path) as partial, partial.open("wb") as file:
        try:
            torch.save(state, file)
        except RuntimeError as error:
            # torch's zip writer turns whatever ends a write into a RuntimeError: a second Ctrl-C
            # in a save must end the run, and is no full disk.
            if isinstance(error.__context__, (OSError, KeyboardInterrupt)):
                raise error.__context__ from None
            raise OSError("the disk is full or broken") from error


def _rescue(path: Path, state: dict[str, Any], folder: RunFolder, error: OSError) -> Path | None:
    """Write a checkpoint to the place of rescue; return its path, None if that fails, too."""
    try:
        rescued = folder.make_rescue() / path.name
        write_atomically(rescued, state)
    except OSError as second_error:
        log.error(
            "cannot write the checkpoint %s (%s), nor below the temporary folder (%s); training"
            " goes on, free some space before the next save",
            path,
            error.strerror or error,
            second_error.strerror or second_error,
        )
        return None
    log.error(
        "cannot write the checkpoint %s (%s); saved %s instead, training goes on",
        path,
        error.strerror or error,
        rescued,
    )
    return rescued


def plain_numbers(value: Any) -> Any:
    """Replace numpy scalars, which a safe loader refuses, by Python numbers, arrays by tensors."""
    if isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.ndim == 0):
        return value.item()
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value)
    if isinstance(value, dict):
        return type(value)((key, plain_numbers(entry)) for key, entry in value.items())
    if isinstance(value, (list, tuple)):
        return type(value)(plain_numbers(entry) for entry in value)
    return value


# --- reading -----------------------------------------------------------------------------------


def load_checkpoint(filename: str | Path) -> dict[str, Any]:
    """Load a checkpoint on the CPU without running code from it; see `archive`.

    Accepts files of rl_games 1.6.5, of IsaacGymEnvs and of ASE (whose normalisers are beside the
    model), and strips the parameter prefix of compiled models. `learning.restoring` checks whether
    it fits the networks.

    Raises:
        CheckpointError: the file is missing, damaged, holds anything but tensors and plain
            containers, or is no checkpoint.
    """
    path = Path(filename)
    if not path.is_file():
        raise CheckpointError(f"checkpoint={filename}: no such file; give a .pth file or 'last'")
    try:
        state = read_archive(path)
    except OSError as error:
        raise CheckpointError(f"checkpoint={path}: cannot be read ({error.strerror})") from error
    except ArchiveError as error:
        raise CheckpointError(
            f"checkpoint={path}: {error}; expected a .pth file that train.py wrote"
        ) from error
    if not isinstance(state, dict) or not (_has_model(state) or state.keys() >= _SAC_KEYS):
        raise CheckpointError(
            f"checkpoint={path}: holds no model; expected a dictionary with the key 'model' as"
            " rl_games writes it"
        )
    _unwrap_numbers(state)
    wrong = next(_wrong_entries(state), None)
    if wrong is not None:
        raise CheckpointError(f"checkpoint={path}: {wrong}; expected a file that train.py wrote")
    log.debug("loaded %s", path)
    return _modernize(state)


def _has_model(state: dict[str, Any]) -> bool:
    return isinstance(state.get("model"), Mapping)


def _unwrap_numbers(state: dict[str, Any]) -> None:
    """Replace tensors of one number: SAC's best reward was one in the first versions' files."""
    for key in _NUMBERS:
        value = state.get(key)
        if isinstance(value, torch.Tensor) and value.shape == ():
            state[key] = value.item()


def _wrong_entries(state: dict[str, Any]) -> Iterator[str]:
    """Yield what is wrong with entries whose type does not depend on the agent."""
    for key in _STATE_DICTS:
        entries = state.get(key, {})
        if not isinstance(entries, dict):
            yield f"{key} is a {type(entries).__name__}, expected tensors by name"
            continue
        for name, value in entries.items():
            if not isinstance(name, str) or not isinstance(value, torch.Tensor):
                kind = type(value).__name__
                yield f"{key}.{short(name)} is a {kind}, expected a tensor"
    for key in _COUNTS:
        count = state.get(key, 0)
        if type(count) is not int or count < 0:
            yield f"{key} is {short(count)}, expected a number of at least 0"
    for key in _NUMBERS:
        number = state.get(key, 0.0)
        if type(number) not in (int, float) or math.isnan(number):
            yield f"{key} is {short(number)}, expected a number"
    llc = state.get(LLC_KEY, {"checkpoint": "", "fingerprint": ""})
    if not _is_reference(llc):
        yield f"{LLC_KEY} is {short(llc)}, expected the file and the fingerprint of a low level"
    policy = state.get("policy", {"settings": {}})
    settings = policy.get("settings") if isinstance(policy, dict) else None
    if not isinstance(settings, dict) or not all(isinstance(path, str) for path in settings):
        yield f"policy is {short(policy)}, expected the settings of a packed policy"


def _is_reference(llc: Any) -> bool:
    keys = ("checkpoint", "fingerprint")
    return isinstance(llc, dict) and all(isinstance(llc.get(key), str) for key in keys)


def short(value: Any) -> str:
    """Return a value of a stranger's file as one short line."""
    if isinstance(value, (dict, list, tuple, torch.Tensor)):
        return f"a {type(value).__name__}"
    text = " ".join(str(value).split())
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."


def _modernize(state: dict[str, Any]) -> dict[str, Any]:
    for key in ("model", "assymetric_vf_nets"):
        if key in state:
            entries = state[key].items()
            state[key] = {name.replace(_COMPILED_PREFIX, ""): value for name, value in entries}
    if "model" not in state:
        return state
    model = state["model"]
    for old, prefix in _OLD_NORMALIZERS.items():
        statistics = state.get(old)
        if isinstance(statistics, Mapping):
            for key, value in statistics.items():
                model.setdefault(f"{prefix}.{key}", value)
    return state


# --- finding -----------------------------------------------------------------------------------


def checkpoint_of_tree(tree: Mapping[str, Any], checkpoint: str, train_dir: str | Path) -> str:
    """Return the path that `checkpoint` means to a resolved tree, to train, play or export.

    Args:
        tree: the tree; `last` is the newest checkpoint of its task and of its kind of network.
        checkpoint: as `resolve_checkpoint`.
        train_dir: folder of the run folders.

    Raises:
        CheckpointError: there is no such file.
    """
    network = select(tree, "train.params.network.name")
    return resolve_checkpoint(checkpoint, train_dir, tree["task"]["name"], str(network or ""))


def resolve_checkpoint(
    checkpoint: str, train_dir: str | Path, task_name: str, network_name: str = ""
) -> str:
    """Return the path that the key `checkpoint` means.

    Args:
        checkpoint: '' (none), a path, `last`: the newest checkpoint of the task's runs, also a
            rescued one, or the name of a shipped policy.
        train_dir: folder of the run folders.
        task_name: task of the runs that `last` searches; '': all.
        network_name: name of their networks; '': all. Several levels of a hierarchy are trained on
            one task.

    Raises:
        CheckpointError: there is no such file.
    """
    if not checkpoint:
        return ""
    if checkpoint == "last":
        return str(_newest(Path(train_dir), task_name, network_name))
    policies = shipped_policies()
    path = policies.get(checkpoint) or user_path(checkpoint)
    if not path.is_file():
        hint = f"; did you mean {path}.pth?" if Path(f"{path}.pth").is_file() else ""
        names = f", or a shipped policy: {', '.join(policies)}" if policies else ""
        raise CheckpointError(
            f"checkpoint={checkpoint}: no file {path.absolute()}{hint}; give a .pth file, or"
            f" 'last' for the newest one of this task{names}"
        )
    return str(path.absolute())


def _newest(train_dir: Path, task_name: str, network_name: str) -> Path:
    wanted = {"task.name": task_name, "train.params.network.name": network_name}
    wanted = {key: value for key, value in wanted.items() if value}
    run = newest_run(train_dir, wanted, ["nn/*.pth"])
    file = None if run is None else run.newest_checkpoint()
    if run is None or file is None:
        task = f"task={task_name}" if task_name else "any task"
        command = package_command("train", f"task={task_name or 'HumanoidAMP'}")
        others = _tasks_of_checkpoints(train_dir) - {task_name}
        hint = f"; there are some of task={', task='.join(sorted(others))}" if others else ""
        network = f" with the network {network_name}" if network_name else ""
        raise CheckpointError(
            f"checkpoint=last: no checkpoint of {task}{network} below {train_dir.absolute()}{hint};"
            f" train one first: {command}"
        )
    run.report_rescued(file, "checkpoint=last")
    return file.absolute()


def newest_run(
    train_dir: Path, wanted: Mapping[str, str], patterns: Sequence[str]
) -> RunFolder | None:
    """Return the run with the file that was written last; None if no run has such a file.

    Args:
        train_dir: folder of the runs.
        wanted: values that config.yaml of the run has, by their paths.
        patterns: of the files, `nn/*.pth`; rescued ones count.
    """
    runs = {
        file: run
        for run in runs_below(train_dir)
        if any(settings_of_run(file.parent, wanted) == wanted for file in run.files("config.yaml"))
        for pattern in patterns
        for file in run.files(pattern)
    }
    file = newest(runs)
    return None if file is None else runs[file]


def _tasks_of_checkpoints(train_dir: Path) -> set[str]:
    runs = [run for run in runs_below(train_dir) if run.newest_checkpoint() is not None]
    names = [
        settings_of_run(f.parent, ["task.name"]) for run in runs for f in run.files("config.yaml")
    ]
    return {str(found["task.name"]) for found in names if found and found["task.name"]}


def settings_of_run(run: Path, keys: Iterable[str]) -> dict[str, Any] | None:
    """Return settings of a run by their paths; None if it is no run of this project."""
    from omegaconf.errors import OmegaConfBaseException

    from isaacgymenvs_lite.config.staging import read_yaml

    try:
        cfg = read_yaml(run / "config.yaml")
        return {key: OmegaConf.select(cfg, key) for key in keys}
    except (ConfigError, OmegaConfBaseException):
        return None  # a damaged run folder, or of another project: left out
