"""Reads the section `pbt`: population based training, with IsaacGymEnvs' keys."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.config.run_names import read_run_name
from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.schema import leaves, nearest, read_section, select, setting

MUTATIONS = (
    *("mutate_float", "mutate_float_min_1", "mutate_eps_clip", "mutate_mini_epochs"),
    "mutate_discount",
)
"""Names of the functions in `pbt.mutation`."""

_MAX_POLICIES = 1000  # the workspace's folders have names of three digits
_MISSPELT_RATIO = 0.85


@dataclass(frozen=True, kw_only=True)
class PBTSettings:
    """The section `pbt`; cfg/pbt/pbt_default.yaml explains the keys."""

    enabled: bool = setting(False)
    policy_idx: int = setting(0, minimum=0)
    num_policies: int = setting(8, minimum=1, maximum=_MAX_POLICIES)
    workspace: str = setting("pbt_workspace")
    dbg_mode: bool = setting(False)

    interval_steps: int = setting(10_000_000, minimum=1)
    start_after: int = setting(10_000_000, minimum=0)
    initial_delay: int = setting(20_000_000, minimum=0)

    replace_fraction_worst: float = setting(0.125, above=0, maximum=1)
    replace_fraction_best: float = setting(0.3, above=0, maximum=1)
    replace_threshold_frac_std: float = setting(0.5, minimum=0)
    replace_threshold_frac_absolute: float = setting(0.05, minimum=0)

    mutation_rate: float = setting(0.15, minimum=0, maximum=1)
    change_min: float = setting(1.1, minimum=1)
    change_max: float = setting(1.5, minimum=1)
    mutation: dict[str, Any] = setting({})


def read_pbt_settings(tree: Mapping[str, Any]) -> PBTSettings | None:
    """Return the section `pbt` of a resolved tree, or None if PBT is off."""
    settings = read_section(PBTSettings, tree.get("pbt"), "pbt", complete=True)
    if not settings.enabled:
        return None
    settings = dataclasses.replace(settings, mutation=dict(leaves(settings.mutation)))
    workspace = str(read_run_name(settings.workspace, "pbt.workspace"))
    if settings.policy_idx >= settings.num_policies:
        raise ConfigError(
            f"pbt.policy_idx={settings.policy_idx}: expected a number from 0 to"
            f" {settings.num_policies - 1}; each of the pbt.num_policies={settings.num_policies}"
            " processes needs its own"
        )
    if settings.num_policies == 1 and not settings.dbg_mode:
        raise ConfigError(
            "pbt.num_policies=1: a single policy cannot be compared; expected at least 2, or"
            " pbt.dbg_mode=True to try out mutations"
        )
    if settings.change_min > settings.change_max:
        raise ConfigError(
            f"pbt.change_min={settings.change_min:g} is above pbt.change_max="
            f"{settings.change_max:g}; expected factors such as 1.1 and 1.5"
        )
    for path, name in settings.mutation.items():
        if name not in MUTATIONS:
            raise ConfigError(f"pbt.mutation: {path}: {unknown('function', str(name), MUTATIONS)}")
    return dataclasses.replace(settings, workspace=workspace)


def mutable_values(tree: Mapping[str, Any], settings: PBTSettings) -> dict[str, float]:
    """Return a dictionary from the paths in `pbt.mutation` to the values of these settings.

    The result lacks settings that are null or missing, because published files name settings that
    some train files lack.
    """
    values: dict[str, float] = {}
    for path in settings.mutation:
        value = select(tree, path)
        if value is None:
            section, _, key = path.rpartition(".")
            below = select(tree, section)
            siblings = below if isinstance(below, dict) else {}
            others = [k for k in map(str, siblings) if f"{section}.{k}" not in settings.mutation]
            near = nearest(key, others, _MISSPELT_RATIO) if key not in siblings else None
            if near is not None:
                raise ConfigError(
                    f"pbt.mutation: unknown key '{path}' (did you mean '{near}'?); correct or"
                    " remove it"
                )
        else:
            try:
                number = math.nan if isinstance(value, bool) else float(value)
            except (TypeError, ValueError):
                number = math.nan
            if not math.isfinite(number):
                raise ConfigError(
                    f"pbt.mutation: {path}={value!r} cannot be mutated; expected a number"
                )
            values[path] = value if isinstance(value, int) else number
    if not values:
        raise ConfigError(
            "pbt.mutation names no setting of this task and train file, so all policies would be"
            " equal; expected for example train.params.config.gamma: mutate_discount"
        )
    return values
