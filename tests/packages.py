"""Files of installed packages that tests read."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest


def needs(package: str) -> pytest.MarkDecorator:
    """Return a mark that skips a test without a package; unlike importorskip it does not import."""
    missing = importlib.util.find_spec(package) is None
    return pytest.mark.skipif(missing, reason=f"{package} is not installed")


def file_of_package(name: str) -> Path:
    """Return a file `package/path` without importing the package, which may take seconds."""
    package, _, path = name.partition("/")
    spec = importlib.util.find_spec(package)
    if spec is None:
        pytest.skip(f"{package} is not installed")
    assert spec.submodule_search_locations is not None
    return Path(spec.submodule_search_locations[0]) / path
