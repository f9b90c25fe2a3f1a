"""The keys that all tasks share: `task.sim`, and of `task.env` the plane, the asset and others."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from isaacgymenvs_lite.schema import read_section, setting

# Without effect on a task: keys of Isaac Gym's viewer, grid or cameras. Video recorders read
# `cameraFollow`.
_IGNORED = (
    "envSpacing",
    "cameraFollow",
    "enableDebugVis",
    "isFlagrun",
    "enableCameraSensors",
    "renderFPS",
)
# Read by the base class.
_BASE_KEYS = (
    "numEnvs",
    "numAgents",
    "numObservations",
    "numStates",
    "numActions",
    "clipObservations",
)
UNREAD_ENV_KEYS = _IGNORED + _BASE_KEYS
"""Keys of `task.env` that no settings class reads."""


@dataclass(frozen=True)
class AssetConfig:
    """`task.env.asset`."""

    asset_file_name: str = setting("", key="assetFileName")
    """MJCF, absolute or relative to `assetRoot`; '' = the task's own."""
    asset_root: str = setting("", key="assetRoot")
    """Folder; '' = the project's assets/."""


@dataclass(frozen=True)
class PlaneConfig:
    """`task.env.plane`."""

    static_friction: float = setting(1.0, key="staticFriction", minimum=0)
    """No counterpart in MuJoCo, which has one coefficient of sliding friction."""
    dynamic_friction: float = setting(1.0, key="dynamicFriction", minimum=0)
    """Coefficient of sliding friction between floor and bodies."""
    restitution: float = setting(0.0, minimum=0)
    """No counterpart in MuJoCo."""


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """Keys of `task.env` that every task reads."""

    clip_actions: float = setting(1.0, key="clipActions", above=0)
    """Actions are clamped to this magnitude."""
    control_freq_inv: int = setting(1, key="controlFrequencyInv", minimum=1)
    """Simulator calls of `sim.dt` in a control step."""
    asymmetric_observations: bool = setting(False)
    """This project's: the critic receives the observation without noise, as `states`; for train
    files with a `central_value_config`."""
    asset: AssetConfig = field(default_factory=AssetConfig)
    plane: PlaneConfig = field(default_factory=PlaneConfig)


@dataclass(frozen=True)
class SimConfig:
    """`task.sim`, without the engine's own sections."""

    dt: float = setting(0.0166, above=0, maximum=1)
    """Time of one simulator call in s."""
    substeps: int = setting(2, minimum=1)
    """Physics steps of one simulator call."""
    gravity: tuple[float, ...] = setting((0.0, 0.0, -9.81), min_length=3)
    """m/s^2."""
    up_axis: str = setting("z", choices=("z",))
    use_gpu_pipeline: bool = setting(False)


def read_sim_config(sim: dict[str, Any]) -> SimConfig:
    """Check `task.sim`; the engine's own sections (`physx`, `flex`) are not read here.

    Raises:
        ConfigError: an unknown, ill-typed or impossible value.
    """
    return read_section(SimConfig, sim, "task.sim", ignored=("physx", "flex", "num_client_threads"))
