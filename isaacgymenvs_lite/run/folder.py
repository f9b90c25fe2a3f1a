"""Makes and finds run folders: `<train_dir>/<run name>/` with config.yaml, nn/, summaries/."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config.run_names import MAX_LEVELS
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.run.lock import FolderLock
from isaacgymenvs_lite.run.rescue import rescue_dir, rescue_dirs
from isaacgymenvs_lite.utils.files import PARTIAL_FILE, atomic_write, check_no_links

log = logging.getLogger(__name__)

_CONFIG_FILE = "config.yaml"


class RunFolder:
    """The folder of one training run, which no other run writes into.

    Use it in a `with` statement: the folder is reserved before anything long starts, and removed
    if a mistake ends the run at once. At the end other runs may write into it.

    Args:
        train_dir: folder of all runs.
        run_name: name of this one; rl_games gets the same name and writes into the same folder.
        is_exact: False adds a number to the name if such a folder exists.

    Attributes:
        train_dir: folder of all runs.
        name: of the run; final once the folder is reserved.
        save_failed: whether the last checkpoint could not be written anywhere.
    """

    def __init__(self, train_dir: Path, run_name: str, is_exact: bool = True) -> None:
        self.train_dir = train_dir
        self._real_train_dir = Path(os.path.realpath(train_dir))
        self._is_exact = is_exact
        self.name = run_name
        if not is_exact:
            self.name = next(
                name for name in _numbered(run_name) if not (train_dir / name).exists()
            )
        self.save_failed = False
        self._made: list[Path] = []
        self._config = ""
        self._lock: FolderLock | None = None

    @classmethod
    def at(cls, path: Path, train_dir: Path) -> RunFolder:
        """Return the folder of a run that goes on, at a path, below `train_dir` or elsewhere.

        The path of a rescued run means the run folder that could not be written.
        """
        root = train_dir.absolute()
        for rescued in rescue_dirs(root):
            if path.is_relative_to(rescued):
                return cls(root, str(path.relative_to(rescued)))
        if not path.is_relative_to(root):
            root = path.parent
        return cls(root, str(path.relative_to(root)))

    @property
    def path(self) -> Path:
        """Path of the folder."""
        return self.train_dir / self.name

    @property
    def checkpoints(self) -> Path:
        """Path of its folder of checkpoints."""
        return self.path / "nn"

    # --- reserving -------------------------------------------------------------------------

    def __enter__(self) -> RunFolder:
        """Reserve the folder, and remove files that a killed run left half written.

        Raises:
            ConfigError: the folder cannot be written, is part of another run, has a link below
                it, or another run writes into it.
        """
        for folder in self.path.relative_to(self.train_dir).parents:
            if folder.parts and (self.train_dir / folder / _CONFIG_FILE).exists():
                raise ConfigError(
                    f"{self.path} lies in the folder of another run, {self.train_dir / folder};"
                    " choose another experiment=NAME"
                )
        with self._errors_explained():
            self._make_path()
            check_no_links(self.path)
            self._lock = FolderLock(self.path)
            self._remove_partial_files()
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self in _OPEN:
            _OPEN.remove(self)
        if self._lock is not None:
            self._lock.release()
            self._lock = None
        if not self._config:  # reserved, and then a mistake came
            self._remove_made()

    def _make_path(self) -> None:
        """Make the folder, with a number where another run has just taken the name."""
        missing = itertools.takewhile(lambda folder: not folder.exists(), self.path.parents)
        above = list(missing)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        for name in _numbered(self.name):
            try:
                (self.train_dir / name).mkdir()
            except FileExistsError:
                if self._is_exact:
                    break
            else:
                self.name = name
                self._made = [self.path, *above]
                break

    def _remove_made(self) -> None:
        for folder in self._made:
            with contextlib.suppress(OSError):  # another run is in it
                folder.rmdir()

    def _remove_partial_files(self) -> None:
        """Remove what a kill left."""
        for folder in [self.path, *(path for path in self.path.iterdir() if path.is_dir())]:
            for file in folder.iterdir():
                if re.fullmatch(PARTIAL_FILE, file.name):
                    with contextlib.suppress(OSError):
                        file.unlink()

    @contextlib.contextmanager
    def _errors_explained(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.remove_if_unused()
            self.__exit__()
            raise ConfigError(
                f"cannot write the run folder {self.path.absolute()}"
                f" ({error.strerror or error}); choose another with"
                " +train.params.config.train_dir=FOLDER"
            ) from error

    # --- making ----------------------------------------------------------------------------

    def create(self, cfg: DictConfig) -> None:
        """Make the folders and config.yaml: the composed tree, its interpolations unresolved.

        The config.yaml of a run that goes on stays until `begin`.

        Args:
            cfg: the tree.

        Raises:
            ConfigError: the folder cannot be written.
        """
        self._config = OmegaConf.to_yaml(cfg)
        with self._errors_explained():
            self.checkpoints.mkdir(exist_ok=True)
            (self.path / "summaries").mkdir(exist_ok=True)
            if not (self.path / _CONFIG_FILE).exists():
                self._write_config()
        _OPEN.append(self)

    def begin(self) -> None:
        """Replace config.yaml, once the training runs with these settings."""
        try:
            self._write_config()
        except OSError as error:
            reason = error.strerror or error
            log.warning("%s keeps the former settings (%s)", self.path / _CONFIG_FILE, reason)

    def make_again(self) -> None:
        """Make the folder once more if somebody removed it since `create`, config.yaml included.

        Raises:
            OSError: it cannot be made.
        """
        if self._lock is None:
            return  # a run of another program
        if not self.checkpoints.is_dir():
            self.checkpoints.mkdir(parents=True)
            log.warning("%s was removed while the run trains: made again", self.path)
        if not (self.path / _CONFIG_FILE).exists():
            with contextlib.suppress(OSError):  # the checkpoint is more important
                self._write_config()

    def make_rescue(self) -> Path:
        """Make the folder that takes this one's place, with config.yaml; return its nn/.

        Raises:
            OSError: it cannot be made.
        """
        folder = rescue_dir(self._real_train_dir) / self.name
        checkpoints = folder / self.checkpoints.name
        checkpoints.mkdir(parents=True, exist_ok=True)
        config = self._config
        if not config:  # a run of another program
            with contextlib.suppress(OSError, UnicodeDecodeError):
                config = (self.path / _CONFIG_FILE).read_text(encoding="utf-8")
        if config:
            with atomic_write(folder / _CONFIG_FILE) as partial:
                partial.write_text(config, encoding="utf-8")
        return checkpoints

    def remove_if_unused(self) -> None:
        """Remove what was made if there is no checkpoint; never a folder from before."""
        if self.path in self._made and self.newest_checkpoint() is None:
            shutil.rmtree(self.path, ignore_errors=True)
            self._remove_made()

    def _write_config(self) -> None:
        with atomic_write(self.path / _CONFIG_FILE) as partial:
            partial.write_text(self._config, encoding="utf-8")

    # --- finding ---------------------------------------------------------------------------

    def files(self, pattern: str) -> list[Path]:
        """Return files of the run by a pattern such as `nn/*.pth`, rescued ones included."""
        rescued = (folder / self.name for folder in rescue_dirs(self._real_train_dir))
        return [file for place in (self.path, *rescued) for file in place.glob(pattern)]

    def newest_checkpoint(self) -> Path | None:
        """Return the checkpoint that was written last, also a rescued one; None without one."""
        return newest(self.files("nn/*.pth"))

    def report_rescued(self, file: Path, key: str) -> None:
        """Log if a file of the run, found by `key`, is a rescued one."""
        if not file.is_relative_to(self.path):
            log.warning(
                "%s takes a rescued checkpoint, %s: its run folder could not be written", key, file
            )


# The folders into which this process trains.
_OPEN: list[RunFolder] = []


def folder_of_checkpoint(checkpoint: Path) -> RunFolder:
    """Return the run folder of a checkpoint: the open one, if this process trains in it."""
    for folder in _OPEN:
        if checkpoint.parent in (folder.checkpoints, folder.checkpoints.absolute()):
            return folder
    run = run_of_checkpoint(str(checkpoint)) or checkpoint.parent
    return RunFolder(run.parent, run.name)


def newest(files: Iterable[Path]) -> Path | None:
    """Return the file that was written last, None of none; files may vanish meanwhile."""
    times = dict[Path, float]()
    for file in files:
        with contextlib.suppress(OSError):
            times[file] = file.stat().st_mtime
    return max(times, key=lambda file: times[file], default=None)


def _numbered(name: str) -> Iterator[str]:
    return itertools.chain([name], (f"{name}_{number}" for number in itertools.count(2)))


def run_folders(train_dir: Path) -> Iterator[Path]:
    """Yield the run folders at any depth below `train_dir`: those with a config.yaml."""
    for folder, below, files in os.walk(train_dir, followlinks=True):
        if _CONFIG_FILE in files and Path(folder) != train_dir:
            below.clear()
            yield Path(folder)
        elif len(Path(folder).relative_to(train_dir).parts) >= MAX_LEVELS:
            below.clear()


def runs_below(train_dir: Path) -> list[RunFolder]:
    """Return the runs at any depth below `train_dir`, also those that only a rescue has left."""
    places = (
        (root, run) for root in (train_dir, *rescue_dirs(train_dir)) for run in run_folders(root)
    )
    names = dict.fromkeys(str(run.relative_to(root)) for root, run in places)
    return [RunFolder(train_dir, name) for name in names]


def run_of_checkpoint(checkpoint: str) -> Path | None:
    """Return the run folder that a checkpoint lies in, `<run>/nn/<name>.pth`; None elsewhere."""
    path = Path(checkpoint)
    return path.parent.parent if checkpoint and path.parent.name == "nn" else None
