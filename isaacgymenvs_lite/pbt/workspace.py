"""The folder through which policies of a population compare: `<train_dir>/<pbt.workspace>/`.

    000/policy.yaml      what the policy trains, so that only policies of one experiment compare
    000/000012.pth       its checkpoint at the 12th comparison
    000/000012.yaml      its record: objective, settings, frame
    best0/*.pth, *.yaml  the best of the population, as policy 0 found it

Every file has one writer and appears whole or not at all; a record appears after its checkpoint.
Records and checkpoints of others are read by the limited readers, and found by their own names:
no path in them is followed.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from isaacgymenvs_lite.checkpoints.files import plain_numbers, short, write_atomically
from isaacgymenvs_lite.config.pbt_settings import PBTSettings
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.run.lock import FolderInUseError, FolderLock
from isaacgymenvs_lite.schema import leaves, read_keys, select, setting
from isaacgymenvs_lite.utils.files import PARTIAL_FILE, atomic_write, check_no_links
from isaacgymenvs_lite.utils.yaml_file import load_yaml

log = logging.getLogger(__name__)

_POLICY_FILE = "policy.yaml"
_RECORD = re.compile(r"(\d{6,})\.yaml")
# Records of a policy that stay at most, and those of them that are its newest.
MAX_RECORDS, _NEWEST = 10, 4
_MAX_BEST = 3


@dataclass(frozen=True, kw_only=True)
class Record:
    """What a policy writes about itself at a comparison."""

    iteration: int = setting(minimum=0)
    """frame // pbt.interval_steps"""
    true_objective: float = setting()
    frame: int = setting(minimum=0)
    epoch: int = setting(0, minimum=0)
    experiment_name: str = setting()
    """Name of its run folder."""
    params: dict[str, Any] = setting()
    """Settings that mutate, numbers by path."""


@dataclass(frozen=True, kw_only=True)
class _Best:
    true_objective: float = setting()


class Workspace:
    """The shared folder, as one policy uses it.

    Use it in a `with` statement: the policy's own folder is locked. What was made is removed at the
    end if the policy has written no record.

    Args:
        folder: the workspace.
        settings: of the population.
        tree: of the training, resolved.
        params: settings that mutate, numbers by path.
    """

    def __init__(
        self,
        folder: Path,
        settings: PBTSettings,
        tree: Mapping[str, Any],
        params: Mapping[str, float],
    ) -> None:
        self._folder = folder
        self._settings = settings
        self._experiment = _experiment(tree, settings)
        self._params = dict(params)
        self._own = self._folder_of(settings.policy_idx)
        self._lock: FolderLock | None = None
        self._made: list[Path] = []
        self._warned: set[Path] = set()

    def _folder_of(self, policy_idx: int) -> Path:
        return self._folder / f"{policy_idx:03d}"

    @property
    def _others(self) -> list[int]:
        indices = range(self._settings.num_policies)
        return [index for index in indices if index != self._settings.policy_idx]

    # --- joining ---------------------------------------------------------------------------

    def __enter__(self) -> Workspace:
        """Lock the folder of this policy.

        Raises:
            ConfigError: it cannot be written, another process trains this policy, or the workspace
                has a link below it.
        """
        check_no_links(self._folder)
        missing = [path for path in (self._own, *self._own.parents) if not path.exists()]
        try:
            self._own.mkdir(parents=True, exist_ok=True)
            self._made = missing
            self._lock = FolderLock(self._own)
            for file in self._own.iterdir():
                if re.fullmatch(PARTIAL_FILE, file.name):
                    file.unlink(missing_ok=True)
        except FolderInUseError as error:
            raise ConfigError(
                f"pbt.policy_idx={self._settings.policy_idx}: {str(error).partition(';')[0]}; give"
                " every process an index of its own, or wait for the end of that one"
            ) from error
        except OSError as error:
            self.__exit__()
            raise self._not_writable(error) from error
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._lock is not None and not self._iterations(self._settings.policy_idx):
            with contextlib.suppress(OSError):
                (self._own / _POLICY_FILE).unlink()
        if self._lock is not None:
            self._lock.release()
            self._lock = None
        for folder in self._made:
            with contextlib.suppress(OSError):  # another policy, or a record, is in it
                folder.rmdir()

    def join(self, is_new: bool) -> None:
        """Check that this policy belongs here, and write what it trains.

        Args:
            is_new: the policy begins; False: it goes on, and its records are there.

        Raises:
            ConfigError: the workspace is of another experiment, has a broken file, or cannot be
                written; or this policy has been trained in it.
        """
        index = self._settings.policy_idx
        if is_new and (iterations := self._iterations(index)):
            run = self._read_record(index, iterations[-1]).experiment_name
            raise ConfigError(
                f"pbt.workspace={self._settings.workspace}: policy {index} has been trained there;"
                f" go on with it: resume={self._folder.parent / run}, choose another"
                f" pbt.workspace, or remove {self._own}"
            )
        self._check_experiments(but_own=is_new)
        if is_new:
            self._check_records()
        try:
            with atomic_write(self._own / _POLICY_FILE) as partial:
                partial.write_text(_as_yaml(self._experiment), encoding="utf-8")
        except OSError as error:
            raise self._not_writable(error) from error
        # Once more: of two that begin at the same time, one at least finds the other.
        self._check_experiments()

    def _check_records(self) -> None:
        for index in self._others:
            for iteration in self._iterations(index):
                with contextlib.suppress(FileNotFoundError):  # its policy removes old ones
                    self._read_record(index, iteration)

    def _check_experiments(self, but_own: bool = False) -> None:
        """Check that all policies train the same.

        Args:
            but_own: skip the file of this new policy.

        Raises:
            ConfigError: one does not, or its file is broken.
        """
        own = yaml.safe_load(_as_yaml(self._experiment))
        for file in sorted(self._folder.glob(f"[0-9]*/{_POLICY_FILE}")):
            if but_own and file.parent == self._own:
                continue
            try:
                other = self._read_yaml(file)
            except FileNotFoundError:
                continue
            keys = [key for key in {**own, **other} if own.get(key) != other.get(key)]
            if keys:
                key = keys[0]
                there, here = (short(str(values.get(key))) for values in (other, own))
                raise ConfigError(
                    f"pbt.workspace={self._settings.workspace}: {file} is of another experiment:"
                    f" {key} is {there} there and {here} here;"
                    " choose another pbt.workspace, or correct the setting"
                )

    def _not_writable(self, error: OSError) -> ConfigError:
        return ConfigError(
            f"pbt.workspace={self._settings.workspace}: {self._own.absolute()} cannot be written"
            f" ({error.strerror or error}); choose another folder of the runs with"
            " +train.params.config.train_dir=FOLDER, the same for all policies"
        )

    # --- writing ---------------------------------------------------------------------------

    def write(self, record: Record, state: dict[str, Any]) -> None:
        """Write this policy's record and checkpoint.

        Raises:
            OSError: they cannot be written.
        """
        self._own.mkdir(parents=True, exist_ok=True)
        file = self._file(self._settings.policy_idx, record.iteration)
        checkpoint = file.with_suffix(".pth")
        write_atomically(checkpoint, plain_numbers(state))
        content = {
            **{name: getattr(record, name) for name in Record.__dataclass_fields__},
            "checkpoint": str(checkpoint.absolute()),
            "pbt_checkpoint": str(file.absolute()),
        }
        with atomic_write(file) as partial:
            partial.write_text(_as_yaml(content), encoding="utf-8")

    def remove_old(self, others: Mapping[int, Record]) -> None:
        """Remove records of this policy that no other one needs any more.

        A policy that is behind compares with the newest record that is not ahead of it.

        Args:
            others: the newest record of each policy that has one.
        """
        index = self._settings.policy_idx
        oldest = min(others[i].iteration if i in others else 0 for i in [index, *self._others])
        iterations = self._iterations(index)
        kept = [i for i in iterations if i >= oldest or i in iterations[-_NEWEST:]]
        while len(kept) > MAX_RECORDS:
            # The one between the nearest neighbours: what is left is spread over the training.
            middle = range(1, len(kept) - _NEWEST)
            kept.pop(min(middle, key=lambda at: kept[at + 1] - kept[at - 1]))
        for iteration in set(iterations) - set(kept):
            file = self._file(index, iteration)
            for path in (file, file.with_suffix(".pth")):  # no record without a checkpoint
                with contextlib.suppress(OSError):
                    path.unlink()

    def keep_best(self, policy_idx: int, record: Record, task: str) -> None:
        """Copy a policy's checkpoint into this policy's `best` folder if none there is as good.

        Args:
            policy_idx: the policy.
            record: its record.
            task: name of the task, for the name of the file.

        Raises:
            OSError: it cannot be copied.
        """
        folder = self._folder / f"best{self._settings.policy_idx}"
        folder.mkdir(exist_ok=True)
        objectives = dict[Path, float]()
        for kept in folder.glob("*.yaml"):
            with contextlib.suppress(ConfigError, OSError):  # broken: it counts as none
                objectives[kept] = read_keys(_Best, self._read_yaml(kept), "").true_objective
        if max(objectives.values(), default=-math.inf) >= record.true_objective:
            return
        file = self._file(policy_idx, record.iteration)
        name = (
            f"{task}_best_obj_{record.true_objective:015.5f}_iter_{record.iteration:04d}"
            f"_policy{policy_idx:03d}_frame{record.frame}"
        )
        for source in (file.with_suffix(".pth"), file):
            with atomic_write(folder / f"{name}{source.suffix}") as partial:
                shutil.copyfile(source, partial)
        for old in sorted(objectives, key=lambda f: objectives[f])[: -(_MAX_BEST - 1)]:
            old.unlink()
            old.with_suffix(".pth").unlink(missing_ok=True)

    # --- reading ---------------------------------------------------------------------------

    def newest_records(self, iteration: int) -> dict[int, Record]:
        """Return the newest record of each policy that is not ahead of an iteration.

        A file that cannot be used is logged once and left out: it must not end a long training.
        """
        found: dict[int, Record] = {}
        for index in range(self._settings.num_policies):
            for number in reversed([i for i in self._iterations(index) if i <= iteration]):
                try:
                    found[index] = self._read_record(index, number)
                except FileNotFoundError:  # its policy has just removed it
                    continue
                except ConfigError as error:
                    self._warn_once(self._file(index, number), error)
                    continue
                break
        return found

    def checkpoint_of(self, policy_idx: int, record: Record) -> Path:
        """Return the path of the checkpoint that was written with a record."""
        return self._file(policy_idx, record.iteration).with_suffix(".pth")

    def _iterations(self, policy_idx: int) -> list[int]:
        """Return the iterations of which a policy has records, in order."""
        with contextlib.suppress(OSError):
            names = [path.name for path in self._folder_of(policy_idx).iterdir()]
            return sorted(int(m[1]) for name in names if (m := _RECORD.fullmatch(name)))
        return []

    def _file(self, policy_idx: int, iteration: int) -> Path:
        return self._folder_of(policy_idx) / f"{iteration:06d}.yaml"

    def _read_record(self, policy_idx: int, iteration: int) -> Record:
        """Return a record.

        Raises:
            FileNotFoundError: there is none any more.
            ConfigError: the file is broken.
        """
        file = self._file(policy_idx, iteration)
        content = self._read_yaml(file)
        try:
            record = read_keys(Record, content, "")
            problem = next(self._problems(record, iteration), "")
        except ConfigError as error:
            problem = str(error)
        if problem:
            raise self._broken(file, problem)
        return record

    def _problems(self, record: Record, iteration: int) -> Iterator[str]:
        if record.iteration != iteration:
            yield f"iteration is {record.iteration}, expected {iteration} as in its name"
        for path in self._params:
            value = record.params.get(path)
            if type(value) not in (int, float) or not math.isfinite(value or 0):
                yield f"params.{path} is {short(value)}, expected a number"

    def _read_yaml(self, file: Path) -> dict[str, Any]:
        """Return the mapping in a file.

        Raises:
            FileNotFoundError: there is no such file.
            ConfigError: it is broken.
        """
        if not file.exists():
            raise FileNotFoundError(file)
        try:
            content = load_yaml(file)
        except ConfigError as error:
            if isinstance(error.__cause__, FileNotFoundError):
                raise error.__cause__ from None
            raise self._broken(file, str(error)) from error
        if not isinstance(content, dict):
            raise self._broken(file, f"holds {short(content)}, expected keys and values")
        return content

    def _broken(self, file: Path, problem: str) -> ConfigError:
        return ConfigError(
            f"pbt.workspace={self._settings.workspace}: {file} is broken: {problem}; remove it with"
            " its .pth, or choose another pbt.workspace"
        )

    def _warn_once(self, file: Path, error: ConfigError) -> None:
        if file not in self._warned:
            self._warned.add(file)
            log.warning("%s; left out of the comparison", error)


def _experiment(tree: Mapping[str, Any], settings: PBTSettings) -> dict[str, Any]:
    """Return what must be the same for all policies of a population."""
    network = dict(leaves(select(tree, "train.params.network"), "train.params.network"))
    return {
        "task": select(tree, "task.name"),
        "train.params.algo.name": select(tree, "train.params.algo.name"),
        "pbt.num_policies": settings.num_policies,
        "pbt.interval_steps": settings.interval_steps,
        "pbt.mutation": dict(settings.mutation),
        **{path: value for path, value in network.items() if path not in settings.mutation},
    }


def _as_yaml(content: Mapping[str, Any]) -> str:
    return yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True)
