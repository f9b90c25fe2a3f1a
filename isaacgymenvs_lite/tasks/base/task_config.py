"""The keys that all tasks share: `task.sim`, and of `task.env` the plane, the asset and others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from isaacgymenvs_lite.config.launch import MAX_THREADS
from isaacgymenvs_lite.schema import keys_of, read_keys, read_section, setting

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
_MAX_SIZE = 2**20
_MAX_STEPS = 1000


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """The keys of `task.env` that the base class of all tasks reads."""

    num_envs: int = setting(key="numEnvs", minimum=1, maximum=2**24)
    num_agents: int = setting(1, key="numAgents", minimum=1, maximum=_MAX_SIZE)
    num_observations: int = setting(0, key="numObservations", minimum=0, maximum=_MAX_SIZE)
    num_states: int = setting(0, key="numStates", minimum=0, maximum=_MAX_SIZE)
    num_actions: int = setting(key="numActions", minimum=0, maximum=_MAX_SIZE)
    control_freq_inv: int = setting(1, key="controlFrequencyInv", minimum=1, maximum=_MAX_STEPS)
    clip_observations: float = setting(float("inf"), key="clipObservations", above=0)
    clip_actions: float = setting(float("inf"), key="clipActions", above=0)


UNREAD_ENV_KEYS = (*_IGNORED, *keys_of(EnvConfig))
"""Keys of `task.env` that need no settings class of a task."""


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
    control_freq_inv: int = setting(1, key="controlFrequencyInv", minimum=1, maximum=_MAX_STEPS)
    """Simulator calls of `sim.dt` in a control step."""
    asymmetric_observations: bool = setting(False)
    """This project's: the critic receives the observation without noise, as `states`; for train
    files with a `central_value_config`."""
    asset: AssetConfig = field(default_factory=AssetConfig)
    plane: PlaneConfig = field(default_factory=PlaneConfig)


@dataclass(frozen=True)
class SimConfig:
    """`task.sim`, without the engine's own sections."""

    dt: float = setting(0.0166, minimum=1e-6, maximum=1)
    """Time of one simulator call in s."""
    substeps: int = setting(2, minimum=1, maximum=_MAX_STEPS)
    """Physics steps of one simulator call."""
    gravity: tuple[float, ...] = setting((0.0, 0.0, -9.81), length=3)
    """m/s^2."""
    up_axis: str = setting("z", choices=("z",))
    use_gpu_pipeline: bool = setting(False)


@dataclass(frozen=True, kw_only=True)
class StepConfig:
    """The keys of `task.sim` that the base class of all tasks reads."""

    dt: float = setting(minimum=1e-6, maximum=1)
    """Time of one simulator call in s."""
    up_axis: str = setting("z", choices=("y", "z"))
    use_gpu_pipeline: bool = setting(False)


@dataclass(frozen=True, kw_only=True)
class _PhysxConfig:
    num_threads: int = setting(0, minimum=0, maximum=MAX_THREADS)


def read_num_threads(sim: Mapping[str, Any]) -> int:
    """Return the threads of the physics that `task.sim.physx` chooses, 0 for its own choice.

    Raises:
        ConfigError: it is no such number.
    """
    return read_keys(_PhysxConfig, sim.get("physx"), "task.sim.physx").num_threads


def read_sim_config(sim: dict[str, Any]) -> SimConfig:
    """Check `task.sim`; the engine's own sections (`physx`, `flex`) are not read here.

    Raises:
        ConfigError: an unknown, ill-typed or impossible value.
    """
    return read_section(SimConfig, sim, "task.sim", ignored=("physx", "flex", "num_client_threads"))
