"""Reads a YAML file as plain values, without running code that its tags name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from isaacgymenvs_lite.errors import ConfigError, one_line


def load_yaml(path: Path) -> Any:
    """Return the content of a YAML file, or None if it is empty; the last of equal keys counts.

    Raises:
        ConfigError: the file is missing or is not valid YAML.
    """
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise ConfigError(f"the file {path} does not exist") from error
    except Exception as error:  # every fault of a stranger's file becomes one line
        raise ConfigError(f"{path} is not valid YAML: {one_line(error)}") from error
