"""Makes and finds run folders: `<train_dir>/<run name>/` with config.yaml, nn/, summaries/."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import itertools
import logging
import os
import re
import shutil
import socket
import stat
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config.run_names import MAX_LEVELS
from isaacgymenvs_lite.errors import ConfigError, one_line
from isaacgymenvs_lite.utils.files import PARTIAL_FILE, atomic_write, check_no_links

try:
    import fcntl
except ImportError:  # Windows, where folders are not locked
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

LOCK_FILE = ".lock"
_CONFIG_FILE = "config.yaml"
# File systems without locks (some network mounts) answer with these errors.
_NO_LOCKS = frozenset((errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL))
_MAX_HOLDER_BYTES = 200


class RunFolder:
    """The folder of one training run; no other run writes into it.

    A `with` statement reserves the folder before any long computation. If a user's mistake then
    ends the run, it removes the folder.

    Args:
        train_dir: folder of all runs.
        run_name: name of this run, which rl_games also receives.
        is_exact: whether to keep the name if such a folder exists; otherwise a number is added.

    Attributes:
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
        """Return the folder of a resumed run, or of the run that was rescued to `path`."""
        root = train_dir.absolute()
        for rescued in _rescue_dirs(root):
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
        """Path of the folder of checkpoints."""
        return self.path / "nn"

    # --- reserving -------------------------------------------------------------------------

    def __enter__(self) -> RunFolder:
        """Reserve the folder, and remove incomplete files of a killed run."""
        for folder in self.path.relative_to(self.train_dir).parents:
            if folder.parts and (self.train_dir / folder / _CONFIG_FILE).exists():
                raise ConfigError(
                    f"{self.path} lies in the folder of another run, {self.train_dir / folder};"
                    " choose another experiment=NAME"
                )
        with self._errors_explained():
            above = list(itertools.takewhile(lambda each: not each.exists(), self.path.parents))
            self.path.parent.mkdir(parents=True, exist_ok=True)
            for name in _numbered(self.name):  # another run may have made this folder meanwhile
                with contextlib.suppress(FileExistsError):
                    (self.train_dir / name).mkdir()
                    self.name = name
                    self._made = [self.path, *above]
                if self._made or self._is_exact:
                    break
            check_no_links(self.path)
            self._lock = FolderLock(self.path)
            for folder in [self.path, *(path for path in self.path.iterdir() if path.is_dir())]:
                for file in folder.iterdir():
                    if re.fullmatch(PARTIAL_FILE, file.name):
                        with contextlib.suppress(OSError):
                            file.unlink()
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self in _OPEN:
            _OPEN.remove(self)
        if self._lock is not None:
            self._lock.release()
            self._lock = None
        if not self._config:  # a mistake ended the run before `create`
            self._remove_made()

    def _remove_made(self) -> None:
        for folder in self._made:
            with contextlib.suppress(OSError):  # it contains another run
                folder.rmdir()

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
        """Make the folders and config.yaml; a resumed run keeps its config.yaml until `begin`."""
        self._config = OmegaConf.to_yaml(cfg)
        with self._errors_explained():
            self.checkpoints.mkdir(exist_ok=True)
            (self.path / "summaries").mkdir(exist_ok=True)
            if not (self.path / _CONFIG_FILE).exists():
                self._write_config()
        _OPEN.append(self)

    def begin(self) -> None:
        """Replace config.yaml, as the training now runs with these settings."""
        try:
            self._write_config()
        except OSError as error:
            reason = error.strerror or error
            log.warning("%s could not be updated (%s)", self.path / _CONFIG_FILE, reason)

    def make_again(self) -> None:
        """Restore the folder and config.yaml if somebody has removed them after `create`."""
        if self._lock is None:
            return  # a run of another program
        if not self.checkpoints.is_dir():
            self.checkpoints.mkdir(parents=True)
            log.warning("%s was removed during the training; it was restored", self.path)
        if not (self.path / _CONFIG_FILE).exists():
            with contextlib.suppress(OSError):  # the checkpoint is more important
                self._write_config()

    def make_rescue(self) -> Path:
        """Make the folder of the rescued run, with config.yaml; return its nn/."""
        folder = _rescue_dir(self._real_train_dir) / self.name
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
        """Remove the folders that this run made, if it has no checkpoint."""
        if self.path in self._made and self.newest_checkpoint() is None:
            shutil.rmtree(self.path, ignore_errors=True)
            self._remove_made()

    def _write_config(self) -> None:
        with atomic_write(self.path / _CONFIG_FILE) as partial:
            partial.write_text(self._config, encoding="utf-8")

    # --- finding ---------------------------------------------------------------------------

    def files(self, pattern: str) -> list[Path]:
        """Return the files that match a pattern such as `nn/*.pth`, including rescued files."""
        rescued = (folder / self.name for folder in _rescue_dirs(self._real_train_dir))
        return [file for place in (self.path, *rescued) for file in place.glob(pattern)]

    def newest_checkpoint(self) -> Path | None:
        """Return the newest checkpoint, which may be a rescued file, or None if there is none."""
        return newest(self.files("nn/*.pth"))

    def report_rescued(self, file: Path, key: str) -> None:
        """Log a warning if the checkpoint that the setting `key` has found is a rescued file."""
        if not file.is_relative_to(self.path):
            log.warning(
                "%s uses the rescued checkpoint %s, because its run folder could not be written",
                *(key, file),
            )


# The run folders of this process.
_OPEN: list[RunFolder] = []


def folder_of_checkpoint(checkpoint: Path) -> RunFolder:
    """Return the run folder of a checkpoint, or its open object if this process trains there."""
    for folder in _OPEN:
        if checkpoint.parent in (folder.checkpoints, folder.checkpoints.absolute()):
            return folder
    run = run_of_checkpoint(str(checkpoint)) or checkpoint.parent
    return RunFolder(run.parent, run.name)


def newest(files: Iterable[Path]) -> Path | None:
    """Return the file that was written last, or None if no file exists (any more)."""
    times = dict[Path, float]()
    for file in files:
        with contextlib.suppress(OSError):
            times[file] = file.stat().st_mtime
    return max(times, key=lambda file: times[file], default=None)


def _numbered(name: str) -> Iterator[str]:
    return itertools.chain([name], (f"{name}_{number}" for number in itertools.count(2)))


def run_folders(train_dir: Path) -> Iterator[Path]:
    """Yield the folders with a config.yaml at any depth below `train_dir`."""
    for folder, below, files in os.walk(train_dir, followlinks=True):
        if _CONFIG_FILE in files and Path(folder) != train_dir:
            below.clear()
            yield Path(folder)
        elif len(Path(folder).relative_to(train_dir).parts) >= MAX_LEVELS:
            below.clear()


def runs_below(train_dir: Path) -> list[RunFolder]:
    """Return the runs at any depth below `train_dir`, including runs that were only rescued."""
    places = (
        (root, run) for root in (train_dir, *_rescue_dirs(train_dir)) for run in run_folders(root)
    )
    names = dict.fromkeys(str(run.relative_to(root)) for root, run in places)
    return [RunFolder(train_dir, name) for name in names]


def run_of_checkpoint(checkpoint: str) -> Path | None:
    """Return `<run>` if the checkpoint's path is `<run>/nn/<name>.pth`, else None."""
    path = Path(checkpoint)
    return path.parent.parent if checkpoint and path.parent.name == "nn" else None


# --- locks ----------------------------------------------------------------------------------------


class FolderInUseError(ConfigError):
    """Another run writes into the folder."""


class FolderLock:
    """An exclusive lock on an existing folder; it lasts until `release` or the end of the process.

    The locked object is a file in the folder; the file names process and host for messages. A
    killed process leaves the file but not the lock. If the file system has no locks, the log has
    one warning.

    Raises:
        FolderInUseError: another run holds the lock.
        OSError: the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file = folder / LOCK_FILE
        self._fd = self._open()
        while not self.is_intact():  # the process that held the lock has removed the file
            os.close(self._fd)
            self._fd = self._open()
        with contextlib.suppress(OSError):  # if the disk is full, the file remains empty
            os.ftruncate(self._fd, 0)
            os.write(self._fd, f"process {os.getpid()} on {socket.gethostname()}\n".encode())

    def is_intact(self) -> bool:
        """Return whether the lock's file still exists, so that the lock protects the folder."""
        try:
            return os.path.samestat(os.fstat(self._fd), self._file.stat(follow_symlinks=False))
        except OSError:
            return False

    def release(self) -> None:
        """Remove the lock's file and release the lock."""
        if self.is_intact():  # otherwise the file may belong to another run
            with contextlib.suppress(OSError):
                self._file.unlink()
        with contextlib.suppress(OSError):
            os.close(self._fd)

    def _open(self) -> int:
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
        fd = os.open(self._file, flags, 0o644)
        try:
            if fcntl is None:
                raise OSError(errno.ENOSYS, "no locks")
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in _NO_LOCKS:
                log.warning(
                    "%s: this file system has no locks; do not start a second run in this folder",
                    self._folder,
                )
                return fd
            os.close(fd)
            if error.errno in (errno.EAGAIN, errno.EACCES, errno.EDEADLK):
                holder = ""
                with contextlib.suppress(OSError), self._file.open("rb") as file:
                    holder = one_line(file.read(_MAX_HOLDER_BYTES).decode(errors="replace"))
                raise FolderInUseError(
                    f"another run writes into {self._folder} ({holder or 'process unknown'}); wait"
                    " for its end, or choose another experiment=NAME or +full_experiment_name=NAME"
                ) from error
            raise
        return fd


# --- rescued runs -----------------------------------------------------------------------------
#
# If a run folder cannot be written, its checkpoints go to a private folder of the user below the
# system's temporary folder. The private folder contains a folder for every folder of runs, in which
# the runs have the usual form: `<run name>/config.yaml` and `<run name>/nn/`.


def _rescue_dir(train_dir: Path) -> Path:
    """Make the private folder; return the path in it for rescued runs of `train_dir`."""
    root = _private_root()
    root.mkdir(mode=0o700, exist_ok=True)
    if not _is_private(root):
        raise PermissionError(f"{root} belongs to another user or is open to others")
    return root / _key(train_dir)


def _rescue_dirs(train_dir: Path) -> list[Path]:
    """Return a list with the folder of rescued runs of `train_dir`, empty if it does not exist."""
    try:
        root = _private_root()
    except OSError:  # there is no temporary folder
        return []
    folder = root / _key(train_dir)
    return [folder] if _is_private(root) and folder.is_dir() else []


def _private_root() -> Path:
    # Windows has no numeric user IDs; its temporary folder belongs to one user.
    user = os.getuid() if hasattr(os, "getuid") else "user"
    return Path(tempfile.gettempdir()) / f"isaacgymenvs_lite_rescue-{user}"


def _key(train_dir: Path) -> str:
    """Return a name for a folder of runs; no other folder of this machine gets the same name."""
    path = os.path.realpath(train_dir)
    return f"{Path(path).name[:40]}-{hashlib.sha256(os.fsencode(path)).hexdigest()[:16]}"


def _is_private(folder: Path) -> bool:
    """Return whether a folder exists, is not a link, and may be entered only by this user."""
    try:
        status = folder.lstat()
    except OSError:
        return False
    is_open = hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & 0o077)
    return stat.S_ISDIR(status.st_mode) and not is_open
