"""Imports of packages that only an extra of this project brings."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from isaacgymenvs_lite.errors import ConfigError


def import_extra(package: str, purpose: str, extra: str) -> Any:
    """Return the module `package`.

    Raises:
        ConfigError: it is not installed; says what it is for and which extra brings it.
    """
    if importlib.util.find_spec(package) is None:
        raise ConfigError(
            f"{purpose} needs the package {package}, which is not installed; "
            f'pip install "isaacgymenvs-lite[{extra}]"'
        )
    return importlib.import_module(package)
