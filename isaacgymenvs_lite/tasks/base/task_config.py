"""Settings that all tasks share: `task.sim`, and the common keys of `task.env`.

The files in cfg/task describe the keys.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from isaacgymenvs_lite.config.launch import MAX_THREADS
from isaacgymenvs_lite.schema import keys_of, read_keys, read_section, setting

# Tasks ignore these keys, which configure Isaac Gym's viewer, grid and cameras.
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
    """Keys of `task.env` that the base class `Env` reads."""

    num_envs: int = setting(key="numEnvs", minimum=1, maximum=2**24)
    num_agents: int = setting(1, key="numAgents", minimum=1, maximum=_MAX_SIZE)
    num_observations: int = setting(0, key="numObservations", minimum=0, maximum=_MAX_SIZE)
    num_states: int = setting(0, key="numStates", minimum=0, maximum=_MAX_SIZE)
    num_actions: int = setting(key="numActions", minimum=0, maximum=_MAX_SIZE)
    control_freq_inv: int = setting(1, key="controlFrequencyInv", minimum=1, maximum=_MAX_STEPS)
    clip_observations: float = setting(float("inf"), key="clipObservations", above=0)
    clip_actions: float = setting(float("inf"), key="clipActions", above=0)


UNREAD_ENV_KEYS = (*_IGNORED, *keys_of(EnvConfig))
"""Keys of `task.env` that a task's settings class may omit."""


@dataclass(frozen=True)
class AssetConfig:
    """`task.env.asset`."""

    asset_file_name: str = setting("", key="assetFileName")  # empty: the task's MJCF
    asset_root: str = setting("", key="assetRoot")  # empty: the project's assets/


@dataclass(frozen=True)
class PlaneConfig:
    """`task.env.plane`."""

    static_friction: float = setting(1.0, key="staticFriction", minimum=0)  # no effect
    dynamic_friction: float = setting(1.0, key="dynamicFriction", minimum=0)
    restitution: float = setting(0.0, minimum=0)  # no effect


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """Keys of `task.env` that every task reads."""

    clip_actions: float = setting(1.0, key="clipActions", above=0)
    control_freq_inv: int = setting(1, key="controlFrequencyInv", minimum=1, maximum=_MAX_STEPS)
    asymmetric_observations: bool = setting(False)
    asset: AssetConfig = field(default_factory=AssetConfig)
    plane: PlaneConfig = field(default_factory=PlaneConfig)


@dataclass(frozen=True)
class SimConfig:
    """`task.sim` without the sections of the physics engines."""

    dt: float = setting(0.0166, minimum=1e-6, maximum=1)  # s, one simulator call
    substeps: int = setting(2, minimum=1, maximum=_MAX_STEPS)  # physics steps per simulator call
    gravity: tuple[float, ...] = setting((0.0, 0.0, -9.81), length=3)  # m/s^2
    up_axis: str = setting("z", choices=("z",))
    use_gpu_pipeline: bool = setting(False)


@dataclass(frozen=True, kw_only=True)
class StepConfig:
    """Keys of `task.sim` that the base class `Env` reads."""

    dt: float = setting(minimum=1e-6, maximum=1)
    up_axis: str = setting("z", choices=("y", "z"))
    use_gpu_pipeline: bool = setting(False)


@dataclass(frozen=True, kw_only=True)
class _PhysxConfig:
    num_threads: int = setting(0, minimum=0, maximum=MAX_THREADS)


def read_num_threads(sim: Mapping[str, Any]) -> int:
    """Return the number of physics threads in `task.sim.physx`. 0 lets the backend choose."""
    return read_keys(_PhysxConfig, sim.get("physx"), "task.sim.physx").num_threads


def read_sim_config(sim: dict[str, Any]) -> SimConfig:
    """Return the checked keys of `task.sim`; raise ConfigError for an invalid key or value."""
    return read_section(SimConfig, sim, "task.sim", ignored=("physx", "flex", "num_client_threads"))
