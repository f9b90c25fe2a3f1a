"""Writes checkpoints atomically, loads them without running code from them, and finds them by name.

rl_games overwrites a checkpoint in place, and an interruption then destroys the old file. rl_games
also loads checkpoints with a full unpickler, which runs code from them. Agents and players of this
project use this module instead.
"""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import nn

from isaacgymenvs_lite.checkpoints.archive import ArchiveError, read_archive
from isaacgymenvs_lite.config.staging import read_yaml
from isaacgymenvs_lite.errors import CheckpointError, ConfigError
from isaacgymenvs_lite.paths import shipped_policies, user_path
from isaacgymenvs_lite.run.folder import RunFolder, folder_of_checkpoint, newest, runs_below
from isaacgymenvs_lite.schema import select
from isaacgymenvs_lite.typed_command import package_command
from isaacgymenvs_lite.utils.files import atomic_write

log = logging.getLogger(__name__)

LLC_KEY = "llc"
"""Key of a checkpoint; its value identifies the low-level controller of the training."""

_LLC_ENTRIES = ("checkpoint", "fingerprint")
_COMPILED_PREFIX = "_orig_mod."
# rl_games 1.1.4 (ASE) stored normalisers outside of the model. Keys are their names in the file,
# and values are their prefixes in the model.
_OLD_NORMALIZERS = {"running_mean_std": "running_mean_std", "reward_mean_std": "value_mean_std"}
# Checkpoints of rl_games' SAC agent have a key for each network.
_SAC_KEYS = {"actor", "critic"}
# Entries that are dictionaries of tensors.
_STATE_DICTS = (
    *("model", "actor", "critic", "critic_target", "assymetric_vf_nets"),
    *(*_OLD_NORMALIZERS, "amp_input_mean_std"),
)
_MAX_SHOWN = 80


# --- writing -----------------------------------------------------------------------------------


def save_checkpoint(filename: str, state: dict[str, Any]) -> Path | None:
    """Write `state` to `<filename>.pth`; return the written file, or None if writing failed.

    An older file stays intact until the new file is complete. A deleted run folder is created
    again. If the run folder cannot be written (read-only or full), the failure is logged, and the
    checkpoint is written to a private folder below the system's temporary folder. If neither folder
    can be written, None is returned.
    """
    path = Path(f"{filename}.pth")
    state = plain_numbers(state)
    folder = folder_of_checkpoint(path)
    saved: Path | None = path
    try:
        folder.make_again()
        write_atomically(path, state)
    except OSError as error:
        reason = error.strerror or error
        try:
            saved = folder.make_rescue() / path.name
            write_atomically(saved, state)
        except OSError as second:
            saved = None
            log.error(
                "cannot write the checkpoint %s (%s), nor below the temporary folder (%s); training"
                " goes on, free some space before the next save",
                *(path, reason, second.strerror or second),
            )
        else:
            log.error(
                "cannot write the checkpoint %s (%s); saved %s instead, training goes on",
                *(path, reason, saved),
            )
    folder.save_failed = saved is None
    log.debug("saved %s", saved)
    return saved


def write_atomically(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint in one step, so that an error does not leave a partial file."""
    with atomic_write(path) as partial, partial.open("wb") as file:
        try:
            torch.save(state, file)
        except RuntimeError as error:
            # torch's zip writer raises RuntimeError for every failure. The original exception is
            # raised instead, because Ctrl-C during a save must end the run.
            if isinstance(error.__context__, (OSError, KeyboardInterrupt)):
                raise error.__context__ from None
            raise OSError("the disk is full or broken") from error


class Retention:
    """Removes all checkpoints except the checkpoints of the last `keep` epochs.

    If `keep` is 0, no checkpoint is removed. Only files that were passed to `written` are removed.
    """

    def __init__(self, keep: int) -> None:
        self._keep = keep
        self._files: dict[int, set[Path]] = {}

    def written(self, file: Path, epoch: int) -> None:
        """Add a checkpoint, and remove checkpoints that are too old."""
        if self._keep == 0:
            return
        self._files.setdefault(epoch, set()).add(file)
        for old in sorted(self._files)[: -self._keep]:
            for path in self._files.pop(old):
                with contextlib.suppress(OSError):
                    path.unlink()


def plain_numbers(value: Any) -> Any:
    """Replace numpy scalars by Python scalars and numpy arrays by tensors, for `archive`."""
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

    Files of rl_games 1.6.5, IsaacGymEnvs and ASE are accepted. The prefix that `torch.compile` adds
    to parameter names is removed. `learning.restoring` checks whether the checkpoint fits the
    networks.

    Raises:
        CheckpointError: the file is missing, damaged or no checkpoint.
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
    has_networks = isinstance(state, dict) and (
        isinstance(state.get("model"), dict) or state.keys() >= _SAC_KEYS
    )
    if not has_networks:
        raise CheckpointError(
            f"checkpoint={path}: holds no model; expected a dictionary with the key 'model', as"
            " rl_games writes it"
        )
    reward = state.get("last_mean_rewards")
    if isinstance(reward, torch.Tensor) and reward.shape == ():  # rl_games' first SAC agents
        state["last_mean_rewards"] = reward.item()
    if (wrong := next(_wrong_entries(state), None)) is not None:
        raise CheckpointError(f"checkpoint={path}: {wrong}; expected a file that train.py wrote")
    for key in ("model", "assymetric_vf_nets"):
        if key in state:
            entries = state[key].items()
            state[key] = {name.replace(_COMPILED_PREFIX, ""): value for name, value in entries}
    for old, prefix in _OLD_NORMALIZERS.items() if "model" in state else ():
        for key, value in state.get(old, {}).items():
            state["model"].setdefault(f"{prefix}.{key}", value)
    log.debug("loaded %s", path)
    return state


def _wrong_entries(state: dict[str, Any]) -> Iterator[str]:
    """Yield error messages for entries that have the same type in all agents."""
    for key in _STATE_DICTS:
        entries = state.get(key, {})
        if not isinstance(entries, dict):
            yield f"{key} is a {type(entries).__name__}, expected tensors by name"
            continue
        for name, value in entries.items():
            if not isinstance(name, str) or not isinstance(value, torch.Tensor):
                kind = type(value).__name__
                yield f"{key}.{short(name)} is a {kind}, expected a tensor"
    for key in ("epoch", "frame"):
        count = state.get(key, 0)
        if type(count) is not int or count < 0:
            yield f"{key} is {short(count)}, expected a number of at least 0"
    number = state.get("last_mean_rewards", 0.0)
    if type(number) not in (int, float) or math.isnan(number):
        yield f"last_mean_rewards is {short(number)}, expected a number"
    llc = state.get(LLC_KEY, {"checkpoint": "", "fingerprint": ""})
    values = [llc.get(key) if isinstance(llc, dict) else None for key in _LLC_ENTRIES]
    if not all(isinstance(value, str) for value in values):
        yield f"{LLC_KEY} is {short(llc)}, expected the file and the fingerprint of a low level"
    policy = state.get("policy", {"settings": {}})
    settings = policy.get("settings") if isinstance(policy, dict) else None
    if not isinstance(settings, dict) or not all(isinstance(path, str) for path in settings):
        yield f"policy is {short(policy)}, expected the settings of a packed policy"


def short(value: Any) -> str:
    """Return a value from an untrusted file as one short line of text."""
    if isinstance(value, (dict, list, tuple, torch.Tensor)):
        return f"a {type(value).__name__}"
    text = " ".join(str(value).split())
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."


def fit_optimizer_state(
    state: dict[str, Any], optimizer: torch.optim.Optimizer, model: nn.Module
) -> dict[str, Any]:
    """Return an optimiser's `state_dict`, converted to the parameter groups of `optimizer`.

    A checkpoint of IsaacGymEnvs has one group in the order of the model's parameters, and an agent
    with `disc_learning_rate` has two groups. The states get new indices, because torch counts
    parameters group by group. Raises CheckpointError for other numbers of groups.
    """
    groups = state["param_groups"]
    if len(groups) == len(optimizer.param_groups):
        return state
    if len(groups) != 1:
        raise CheckpointError(
            f"the checkpoint's optimiser has {len(groups)} groups of parameters, expected"
            f" {len(optimizer.param_groups)}; set train.params.config.disc_learning_rate as in its"
            " training"
        )
    place = {id(parameter): i for i, parameter in enumerate(model.parameters())}
    # Item i is the index that parameter i of the optimiser has in the single group.
    order = [place[id(p)] for group in optimizer.param_groups for p in group["params"]]
    own = optimizer.state_dict()["param_groups"]
    return {
        "state": {
            new: state["state"][old] for new, old in enumerate(order) if old in state["state"]
        },
        "param_groups": [
            {**groups[0], "params": group["params"], **({} if i == 0 else {"lr": group["lr"]})}
            for i, group in enumerate(own)
        ],
    }


# --- finding -----------------------------------------------------------------------------------


def checkpoint_of_tree(tree: Mapping[str, Any], checkpoint: str, train_dir: str | Path) -> str:
    """Return the path that `checkpoint` means in a configuration; see `resolve_checkpoint`."""
    network = select(tree, "train.params.network.name")
    return resolve_checkpoint(checkpoint, train_dir, tree["task"]["name"], str(network or ""))


def resolve_checkpoint(
    checkpoint: str, train_dir: str | Path, task_name: str, network_name: str = ""
) -> str:
    """Return the path that the key `checkpoint` means.

    `checkpoint` is '' (no checkpoint), a path, a shipped policy's name, or `last`. `last` selects
    the newest checkpoint in `train_dir`, including checkpoints in the temporary folder, of runs
    with the given task and network; '' accepts all. The network distinguishes high-level and
    low-level policies of the same task.

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
            f"checkpoint={checkpoint}: no file {path.absolute()}{hint}; give a .pth file, 'last'"
            f" for this task's newest checkpoint{names}"
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
        found = [
            settings_of_run(config.parent, ["task.name"]) or {}
            for other in runs_below(train_dir)
            if other.newest_checkpoint() is not None
            for config in other.files("config.yaml")
        ]
        others = sorted({str(each.get("task.name") or "") for each in found} - {"", task_name})
        hint = f"; there are checkpoints of task={', task='.join(others)}" if others else ""
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
    """Return the run folder with the newest file that matches a pattern, or None.

    Files in the temporary folder count too. `wanted` are values that config.yaml of the run must
    have, by their paths.
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


def settings_of_run(run: Path, keys: Iterable[str]) -> dict[str, Any] | None:
    """Return settings of a run by their paths, or None if the folder is no run of this project."""
    try:
        cfg = read_yaml(run / "config.yaml")
        return {key: OmegaConf.select(cfg, key) for key in keys}
    except (ConfigError, OmegaConfBaseException):
        return None  # Another project's folder, or a damaged one.
