"""Packages that only an extra brings along, and the error for one that is missing."""

from __future__ import annotations

import importlib.util

from isaacgymenvs_lite.errors import MissingPackageError

# Module -> extra of this package that installs it.
EXTRAS = {"av": "video", "rsl_rl": "rsl-rl", "skrl": "skrl", "stable_baselines3": "sb3"}


def require(module: str, wanted_by: str) -> None:
    """Check that a package is installed, without importing it.

    Args:
        module: name that it is imported by, of `EXTRAS`.
        wanted_by: what needs it, for the message.

    Raises:
        MissingPackageError: it is not; the message names the extra.
    """
    if importlib.util.find_spec(module) is None:
        raise MissingPackageError(
            f"{wanted_by} needs the package {module}, which is not installed;"
            f' pip install "isaacgymenvs-lite[{EXTRAS[module]}]"'
        )
