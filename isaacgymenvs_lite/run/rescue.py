"""Finds and makes the folders of rescued runs, whose own folder cannot be written.

Below the system's temporary folder lies one that is private to the user; in it every folder of runs
has one of its own, with run folders as usual: `<run name>/config.yaml` and `<run name>/nn/`.
"""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
from pathlib import Path

_PRIVATE = 0o700
_OF_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def rescue_dir(train_dir: Path) -> Path:
    """Return where runs below `train_dir` are rescued to; make the user's private folder.

    Other users can write to the system's temporary folder. A folder there is trusted only if it is
    no link, belongs to this user and is closed to all others; else another one is made.

    Raises:
        OSError: no folder can be made.
    """
    known = _private_roots()
    return (known[0] if known else _make_root()) / _key(train_dir)


def rescue_dirs(train_dir: Path) -> list[Path]:
    """Return the existing folders to which runs below `train_dir` were rescued."""
    folders = (root / _key(train_dir) for root in _private_roots())
    return [folder for folder in folders if folder.is_dir()]


def _key(train_dir: Path) -> str:
    """Return a name for a folder of runs that no other folder on this machine has."""
    path = os.path.realpath(train_dir)
    return f"{Path(path).name[:40]}-{hashlib.sha256(os.fsencode(path)).hexdigest()[:16]}"


def _root_name() -> str:
    # Windows has no user numbers; its temporary folder belongs to one user.
    user = os.getuid() if hasattr(os, "getuid") else "user"
    return f"isaacgymenvs_lite_rescue-{user}"


def _private_roots() -> list[Path]:
    """Return this user's private folders, the usual one first."""
    name = _root_name()
    try:
        tmp = Path(tempfile.gettempdir())
    except OSError:  # no folder can be written
        return []
    return [root for root in (tmp / name, *sorted(tmp.glob(f"{name}-*"))) if _is_private(root)]


def _is_private(folder: Path) -> bool:
    try:
        status = folder.lstat()
    except OSError:
        return False
    if not stat.S_ISDIR(status.st_mode):
        return False
    if not hasattr(os, "getuid"):
        return True
    return status.st_uid == os.getuid() and not status.st_mode & _OF_OTHERS


def _make_root() -> Path:
    root = Path(tempfile.gettempdir()) / _root_name()
    try:
        root.mkdir(mode=_PRIVATE)
    except FileExistsError:  # another user's, or open to others
        return Path(tempfile.mkdtemp(prefix=f"{root.name}-"))
    return root
