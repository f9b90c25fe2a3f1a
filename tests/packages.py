"""Files of installed packages that tests read."""

from __future__ import annotations

import importlib.util
from pathlib import Path


def file_of_package(name: str) -> Path:
    """Return a file `package/path` without importing the package, which may take seconds."""
    package, _, path = name.partition("/")
    spec = importlib.util.find_spec(package)
    assert spec is not None and spec.submodule_search_locations is not None
    return Path(spec.submodule_search_locations[0]) / path
