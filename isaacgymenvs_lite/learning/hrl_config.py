"""The HRL keys of `train.params.config`, with their checks (the PPO keys are rl_games')."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.schema import keys_of, read_section, setting


@dataclass(frozen=True, kw_only=True)
class HRLParams:
    """What an HRL agent reads beside PPO's keys; names and meanings as ASE."""

    llc_config: str = setting()
    """Train file of the low-level controller."""
    llc_checkpoint: str | None = setting("")
    """Its checkpoint, or the name of a shipped policy; see `llc_reference.llc_checkpoint_for`."""
    llc_steps: int = setting(minimum=1)
    """Control steps that the low-level controller makes under one latent."""
    task_reward_w: float = setting(1.0)
    """Weight of the task's reward."""
    disc_reward_w: float = setting(0.0)
    """Weight of the low-level controller's style reward."""
    exploration_correlation: float = setting(0.0, minimum=0, maximum=0.99)
    """This project's: correlation of the exploration noise of two steps that follow each other; see
    `correlated_noise`."""


def read_hrl_params(config: Mapping[str, Any]) -> HRLParams:
    """Check the HRL keys of `train.params.config`.

    Raises:
        ConfigError: a key is missing, ill-typed or out of range.
    """
    known = keys_of(HRLParams)
    section = {key: value for key, value in config.items() if key in known}
    return read_section(HRLParams, section, "train.params.config")
