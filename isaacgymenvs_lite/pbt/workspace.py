"""Reads and writes the folder of a population: `<train_dir>/<pbt.workspace>/`.

    000/policy.yaml      settings that must be equal for all policies (the experiment)
    000/000012.pth       checkpoint of policy 0 at the 12th comparison
    000/000012.yaml      record of policy 0: objective, settings, frame
    best0/*.pth, *.yaml  the best policy that policy 0 has seen

Only one process writes a file, and the file is complete or absent; a record is written after its
checkpoint. The files of other policies are found by their file names; paths inside these files are
ignored. A broken record is left out of the comparison.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from isaacgymenvs_lite.checkpoints.files import plain_numbers, short, write_atomically
from isaacgymenvs_lite.config.pbt_settings import PBTSettings
from isaacgymenvs_lite.errors import ConfigError, one_line
from isaacgymenvs_lite.run.folder import FolderInUseError, FolderLock
from isaacgymenvs_lite.schema import leaves, read_keys, select, setting
from isaacgymenvs_lite.utils.files import PARTIAL_FILE, atomic_write, check_no_links

log = logging.getLogger(__name__)

_POLICY_FILE = "policy.yaml"
_RECORD = re.compile(r"(\d{6,})\.yaml")
_OBJECTIVE = re.compile(r"_best_obj_(-?[\d.]+)_iter_")
MAX_RECORDS = 20
"""Number of records kept for each policy; other policies may still be at earlier frames."""
_MAX_BEST = 3


@dataclass(frozen=True, kw_only=True)
class Record:
    """The record of a policy at a comparison."""

    iteration: int = setting(minimum=0)
    """frame // pbt.interval_steps"""
    true_objective: float = setting()
    frame: int = setting(minimum=0)
    epoch: int = setting(0, minimum=0)
    experiment_name: str = setting()
    """Name of the policy's run folder."""
    params: dict[str, Any] = setting()
    """Maps the paths of the mutable settings to their values."""


class Workspace:
    """The shared folder, from the view of one policy.

    A `with` statement locks the policy's folder. If the policy has written no record, its folders
    are removed at the end of the `with` statement.

    Args:
        folder: the workspace.
        settings: settings of the population.
        tree: resolved tree of the training.
        params: maps the paths of the mutable settings to their values.
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
        self._own = folder / f"{settings.policy_idx:03d}"
        self._lock: FolderLock | None = None
        self._made: list[Path] = []
        self._warned: set[Path] = set()

    # --- joining ---------------------------------------------------------------------------

    def __enter__(self) -> Workspace:
        """Lock the folder of this policy.

        Raises:
            ConfigError: the folder contains links or cannot be written, or another process trains
                this policy.
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
        if self._lock is not None:
            if not self._iterations(self._settings.policy_idx):
                (self._own / _POLICY_FILE).unlink(missing_ok=True)
            self._lock.release()
            self._lock = None
        for folder in self._made:
            with contextlib.suppress(OSError):  # The folder contains another policy or a record.
                folder.rmdir()

    def join(self, is_new: bool) -> None:
        """Check that this policy belongs to the workspace, and write its experiment.

        Args:
            is_new: whether the policy begins. If it is False, the policy continues from its
            records.

        Raises:
            ConfigError: the workspace belongs to another experiment, or a new policy already has
                records.
        """
        index = self._settings.policy_idx
        if is_new and (iterations := self._iterations(index)):
            run = self._read_record(self._file(index, iterations[-1]), iterations[-1])
            raise ConfigError(
                f"pbt.workspace={self._settings.workspace}: policy {index} has been trained there;"
                f" go on with it: resume={self._folder.parent / run.experiment_name}, choose"
                f" another pbt.workspace, or remove {self._own}"
            )
        for file in sorted(self._folder.glob(f"[0-9]*/{_POLICY_FILE}")):
            if not (is_new and file.parent == self._own):
                self._check_experiment(file)
        try:
            self._write_yaml(self._own / _POLICY_FILE, self._experiment)
        except OSError as error:
            raise self._not_writable(error) from error

    def _check_experiment(self, file: Path) -> None:
        """Check that another policy trains the same experiment."""
        own = self._experiment
        try:
            other = _read_yaml(file)
        except FileNotFoundError:
            return
        except ConfigError as error:
            raise ConfigError(
                f"pbt.workspace={self._settings.workspace}: {error}; remove it, or choose another"
                " pbt.workspace"
            ) from error
        key = next((key for key in {**own, **other} if own.get(key) != other.get(key)), None)
        if key is not None:
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
        """Write this policy's record and checkpoint, and remove its oldest record."""
        self._own.mkdir(parents=True, exist_ok=True)
        index = self._settings.policy_idx
        file = self._file(index, record.iteration)
        checkpoint = file.with_suffix(".pth")
        write_atomically(checkpoint, plain_numbers(state))
        paths = {"checkpoint": str(checkpoint.absolute()), "pbt_checkpoint": str(file.absolute())}
        self._write_yaml(file, {**asdict(record), **paths})
        for iteration in self._iterations(index)[:-MAX_RECORDS]:
            old = self._file(index, iteration)
            old.unlink(missing_ok=True)  # A record is removed before its checkpoint.
            old.with_suffix(".pth").unlink(missing_ok=True)

    def keep_best(self, policy_idx: int, record: Record, task: str) -> None:
        """Copy a policy's checkpoint into this policy's `best` folder if no better policy is there.

        The name of the copied file includes the task.
        """
        folder = self._folder / f"best{self._settings.policy_idx}"
        folder.mkdir(exist_ok=True)
        names = ((_OBJECTIVE.search(path.name), path) for path in folder.glob("*.yaml"))
        kept = sorted((float(found[1]), path) for found, path in names if found)
        if kept and kept[-1][0] >= round(record.true_objective, 5):
            return
        file = self._file(policy_idx, record.iteration)
        name = (
            f"{task}_best_obj_{record.true_objective:015.5f}_iter_{record.iteration:04d}"
            f"_policy{policy_idx:03d}_frame{record.frame}"
        )
        for source in (file.with_suffix(".pth"), file):
            with atomic_write(folder / f"{name}{source.suffix}") as partial:
                shutil.copyfile(source, partial)
        for _, old in kept[: 1 - _MAX_BEST]:
            old.unlink()
            old.with_suffix(".pth").unlink(missing_ok=True)

    @staticmethod
    def _write_yaml(file: Path, content: Mapping[str, Any]) -> None:
        with atomic_write(file) as partial:
            text = yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True)
            partial.write_text(text, encoding="utf-8")

    # --- reading ---------------------------------------------------------------------------

    def newest_records(self, iteration: int) -> dict[int, Record]:
        """Return a dictionary from each policy to its newest record up to an iteration.

        A broken file is logged once and left out, because an error would end a long training.
        """
        found: dict[int, Record] = {}
        for index in range(self._settings.num_policies):
            for number in reversed([i for i in self._iterations(index) if i <= iteration]):
                file = self._file(index, number)
                try:
                    found[index] = self._read_record(file, number)
                except FileNotFoundError:  # The other policy has removed its record meanwhile.
                    continue
                except ConfigError as error:
                    if file not in self._warned:
                        self._warned.add(file)
                        log.warning("pbt: %s; left out of the comparison", error)
                    continue
                break
        return found

    def checkpoint_of(self, policy_idx: int, record: Record) -> Path:
        """Return the path of a record's checkpoint."""
        return self._file(policy_idx, record.iteration).with_suffix(".pth")

    def _iterations(self, policy_idx: int) -> list[int]:
        """Return the iterations of a policy's records in ascending order."""
        paths = (self._folder / f"{policy_idx:03d}").glob("*.yaml")
        return sorted(int(found[1]) for path in paths if (found := _RECORD.fullmatch(path.name)))

    def _file(self, policy_idx: int, iteration: int) -> Path:
        return self._folder / f"{policy_idx:03d}" / f"{iteration:06d}.yaml"

    def _read_record(self, file: Path, iteration: int) -> Record:
        """Return a record.

        Raises:
            FileNotFoundError: the file was removed.
            ConfigError: the file is broken.
        """
        content = _read_yaml(file)
        try:
            record = read_keys(Record, content, "")
        except ConfigError as error:
            raise ConfigError(f"{file} is broken: {error}") from error
        if record.iteration != iteration:
            raise ConfigError(f"{file} is broken: iteration is {record.iteration}")
        for path in self._params:
            value = record.params.get(path)
            if type(value) not in (int, float) or not math.isfinite(value or 0):
                raise ConfigError(f"{file} is broken: params.{path} is {short(value)}")
        return record


def _read_yaml(file: Path) -> dict[str, Any]:
    """Return the mapping that a file contains; see `_read_record` for errors."""
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise
    except Exception as error:  # The YAML reader raises many types of errors on arbitrary bytes.
        raise ConfigError(f"{file} is broken: {one_line(error)[:200]}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{file} is broken: {short(content)}, expected keys and values")
    return content


def _experiment(tree: Mapping[str, Any], settings: PBTSettings) -> dict[str, Any]:
    """Return the settings that must be equal for all policies of a population."""
    network = dict(leaves(select(tree, "train.params.network"), "train.params.network"))
    return {
        "task": select(tree, "task.name"),
        "train.params.algo.name": select(tree, "train.params.algo.name"),
        "pbt.num_policies": settings.num_policies,
        "pbt.interval_steps": settings.interval_steps,
        "pbt.mutation": dict(settings.mutation),
        **{path: value for path, value in network.items() if path not in settings.mutation},
    }
