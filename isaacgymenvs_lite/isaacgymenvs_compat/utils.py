"""The names of IsaacGymEnvs' `utils.utils`."""

from __future__ import annotations

import functools
import getpass
import logging
import os
import stat
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from isaacgymenvs_lite.config.launch import resolve_seed
from isaacgymenvs_lite.env_factory import seed_everything
from isaacgymenvs_lite.errors import ConfigError

log = logging.getLogger(__name__)


def set_np_formatting() -> None:
    """Make numpy print complete rows with two digits."""
    np.set_printoptions(edgeitems=30, linewidth=4000, precision=2, threshold=10000)


def set_seed(seed: int, torch_deterministic: bool = False, rank: int = 0) -> int:
    """Seed Python, numpy and torch with seed + rank, and return the sum; -1 draws a seed."""
    resolved = resolve_seed(seed, torch_deterministic, rank)
    seed_everything(resolved, torch_deterministic)
    return resolved


def retry(times: int, exceptions: type[Exception] | tuple[type[Exception], ...]) -> Callable:
    """Return a decorator that repeats a function after exceptions, at most `times` times.

    The pause before repetition k is 2^(k - 1) s, at most 30 s.
    """

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def again(*args: Any, **kwargs: Any) -> Any:
            for attempt in range(times):
                try:
                    return function(*args, **kwargs)
                except exceptions as error:
                    log.warning("%s failed (%s), attempt %d", function, error, attempt + 1)
                    time.sleep(min(2.0**attempt, 30.0))
            return function(*args, **kwargs)

        return again

    return decorate


def flatten_dict(d: Mapping[str, Any], prefix: str = "", separator: str = ".") -> dict[str, Any]:
    """Return one dictionary with a path for each value, {"a.b": 1} for {"a": {"b": 1}}."""
    flat: dict[str, Any] = {}
    for key, value in d.items():
        path = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= flatten_dict(value, f"{path}{separator}", separator)
        else:
            flat[path] = value
    return flat


def nested_dict_set_attr(d: dict[str, Any], key: str, val: Any) -> None:
    """Set the value at a path such as "a.b" in existing nested dictionaries."""
    parent, _, name = key.rpartition(".")
    (nested_dict_get_attr(d, parent) if parent else d)[name] = val


def nested_dict_get_attr(d: Mapping[str, Any], key: str) -> Any:
    """Return the value at a path such as "a.b" in nested dictionaries."""
    return functools.reduce(lambda level, name: level[name], key.split("."), d)


def ensure_dir_exists(path: str) -> str:
    """Make a folder and its parents unless the folder exists; return the folder's path."""
    Path(path).mkdir(parents=True, exist_ok=True)
    return path


safe_ensure_dir_exists = ensure_dir_exists


def get_username() -> str:
    """Return the user's name, or the numeric user ID if the system knows no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())


def project_tmp_dir() -> str:
    """Make the folder `ige_<user>` in the system's temporary folder, and return its path."""
    folder = Path(tempfile.gettempdir()) / f"ige_{get_username()}"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
        raise ConfigError(
            f"{folder}: is a link or belongs to another user; remove it, or set TMPDIR to a folder"
            " of your own"
        )
    return str(folder)
