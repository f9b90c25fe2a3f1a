"""The folder of rescued runs, for checkpoints whose run folder cannot be written.

Below the system's temporary folder the user has a private folder; in it every folder of runs has a
folder of its own, with run folders as usual: `<run name>/config.yaml` and `<run name>/nn/`.
"""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
from pathlib import Path


def rescue_dir(train_dir: Path) -> Path:
    """Return the folder to which runs below `train_dir` are rescued; make the private folder.

    Raises:
        OSError: the private folder cannot be made, or other users can write to it.
    """
    root = _private_root()
    root.mkdir(mode=0o700, exist_ok=True)
    if not _is_private(root):
        raise PermissionError(f"{root} belongs to another user or is open to others")
    return root / _key(train_dir)


def rescue_dirs(train_dir: Path) -> list[Path]:
    """Return the folder to which runs below `train_dir` were rescued, if there is one."""
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
    """Return a name for a folder of runs that no other folder on this machine has."""
    path = os.path.realpath(train_dir)
    return f"{Path(path).name[:40]}-{hashlib.sha256(os.fsencode(path)).hexdigest()[:16]}"


def _is_private(folder: Path) -> bool:
    """Return whether a folder exists, is no link, belongs to this user and is closed to others."""
    try:
        status = folder.lstat()
    except OSError:
        return False
    is_open = hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & 0o077)
    return stat.S_ISDIR(status.st_mode) and not is_open
