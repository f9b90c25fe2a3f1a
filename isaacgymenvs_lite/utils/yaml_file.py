"""Reads a YAML file as plain values: no tag of it runs code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from isaacgymenvs_lite.errors import ConfigError, one_line


def load_yaml(path: Path) -> Any:
    """Return what a YAML file holds; None for an empty file. Of equal keys the last one counts.

    Raises:
        ConfigError: the file is missing, or is no YAML.
    """
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise ConfigError(f"the file {path} does not exist") from error
    except Exception as error:  # whatever is wrong with a stranger's file is one line
        raise ConfigError(f"{path} is not valid YAML: {one_line(error)}") from error
