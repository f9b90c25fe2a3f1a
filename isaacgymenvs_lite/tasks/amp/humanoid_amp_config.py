"""The keys of cfg/task/HumanoidAMP.yaml, `task.env` and `task.sim`, with their checks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from isaacgymenvs_lite.schema import read_section, setting

# Accepted and without effect here: they belong to Isaac Gym's viewer, grid or cameras.
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

    asset_file_name: str = setting("mjcf/amp_humanoid.xml", key="assetFileName")
    """MJCF, absolute or relative to `assetRoot`."""
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


@dataclass(frozen=True)
class HumanoidAMPConfig:
    """`task.env` of HumanoidAMP; keys and meanings as IsaacGymEnvs unless said."""

    episode_length: int = setting(300, key="episodeLength", minimum=2)
    """Control steps of an episode."""
    pd_control: bool = setting(True, key="pdControl")
    """Actions are PD targets; False: torques, action * effort * powerScale."""
    power_scale: float = setting(1.0, key="powerScale", minimum=0)
    """Factor on the torques of `pdControl: False`."""
    control_freq_inv: int = setting(2, key="controlFrequencyInv", minimum=1)
    """Simulator calls of `sim.dt` per control step."""
    state_init: str = setting(
        "Random", key="stateInit", choices=("Default", "Start", "Random", "Hybrid")
    )
    """Where episodes start: default pose, start of a clip, random time of a clip, or a mix."""
    hybrid_init_prob: float = setting(0.5, key="hybridInitProb", minimum=0, maximum=1)
    """Hybrid: share of episodes that start from a clip."""
    num_amp_obs_steps: int = setting(2, key="numAMPObsSteps", minimum=2)
    """Control steps in one AMP observation."""
    local_root_obs: bool = setting(False, key="localRootObs")
    """Take the heading out of the root rotation in the observation."""
    contact_bodies: tuple[str, ...] = setting(("right_foot", "left_foot"), key="contactBodies")
    """Bodies that may touch the floor."""
    termination_height: float = setting(0.5, key="terminationHeight")
    """An episode ends when a touched character has a body below this height (m)."""
    enable_early_termination: bool = setting(True, key="enableEarlyTermination")
    """End episodes at falls."""
    motion_file: str = setting("walk.npz")
    """Clip or dataset: a path, a name in assets/amp/motions, or `deepmimic:<name>`."""
    clip_actions: float = setting(1.0, key="clipActions", above=0)
    """Actions are clamped to this magnitude."""
    repair_repeated_frames: bool = setting(True, key="repairRepeatedFrames")
    """This project's: drop the repeats of a clip that stores every frame twice, whose joint
    velocities would alternate between zero and twice the truth."""
    enforce_effort_limits: bool = setting(False, key="enforceEffortLimits")
    """This project's: limit PD torques to the published motor efforts, as the MJCF lists them.
    The originals do not limit them; docs/results.md says what the limits cost."""
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


def read_env_config(env: dict[str, Any]) -> HumanoidAMPConfig:
    """Check `task.env`.

    Raises:
        ConfigError: an unknown, ill-typed or impossible value.
    """
    return read_section(HumanoidAMPConfig, env, "task.env", ignored=UNREAD_ENV_KEYS)


def read_sim_config(sim: dict[str, Any]) -> SimConfig:
    """Check `task.sim`; the engine's own sections (`physx`, `flex`) are not read here.

    Raises:
        ConfigError: an unknown, ill-typed or impossible value.
    """
    return read_section(SimConfig, sim, "task.sim", ignored=("physx", "flex", "num_client_threads"))
