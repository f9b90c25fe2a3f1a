"""The names of IsaacGymEnvs' `utils.reformat`."""

from __future__ import annotations

import pprint
from typing import Any

from omegaconf import DictConfig, OmegaConf


def omegaconf_to_dict(d: DictConfig) -> dict[str, Any]:
    """Return a configuration as plain dictionaries with resolved interpolations."""
    return OmegaConf.to_container(d, resolve=True)  # type: ignore[return-value]


def print_dict(val: Any, nesting: int = -4, start: bool = True) -> None:
    """Print nested dictionaries to standard output; `nesting` and `start` have no effect."""
    pprint.pprint(val, sort_dicts=False)
