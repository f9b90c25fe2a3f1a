"""Settings of HumanoidAMP; cfg/task/HumanoidAMP.yaml describes the keys."""

from __future__ import annotations

from dataclasses import dataclass, field

from isaacgymenvs_lite.motion.interpolation import INTERPOLATIONS
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.task_config import AssetConfig, TaskConfig

OWN_ASSET = "mjcf/amp_humanoid.xml"
FEET = ("right_foot", "left_foot")


@dataclass(frozen=True, kw_only=True)
class HumanoidAMPConfig(TaskConfig):
    """`task.env` of HumanoidAMP: IsaacGymEnvs' keys and this project's."""

    episode_length: int = setting(300, key="episodeLength", minimum=2)
    pd_control: bool = setting(True, key="pdControl")
    power_scale: float = setting(1.0, key="powerScale", minimum=0)
    control_freq_inv: int = setting(2, key="controlFrequencyInv", minimum=1)
    state_init: str = setting(
        "Random", key="stateInit", choices=("Default", "Start", "Random", "Hybrid")
    )
    hybrid_init_prob: float = setting(0.5, key="hybridInitProb", minimum=0, maximum=1)
    num_amp_obs_steps: int = setting(2, key="numAMPObsSteps", minimum=2, maximum=1000)
    local_root_obs: bool = setting(False, key="localRootObs")
    contact_bodies: tuple[str, ...] | None = setting(FEET, key="contactBodies")
    termination_height: float = setting(0.5, key="terminationHeight")  # m
    enable_early_termination: bool = setting(True, key="enableEarlyTermination")
    motion_file: str = setting("walk.npz")
    repair_repeated_frames: bool = setting(True, key="repairRepeatedFrames")
    clip_interpolation: str = setting("spline", key="clipInterpolation", choices=INTERPOLATIONS)
    demo_motion_share: float = setting(0.0, key="demoMotionShare", minimum=0, maximum=1)
    adaptive_starts: float = setting(0.0, key="adaptiveStarts", minimum=0, maximum=1)
    clip_deviation: float = setting(0.0, key="clipDeviation", minimum=0)
    clip_deviation_final: float = setting(0.0, key="clipDeviationFinal", minimum=0)
    clip_travel: float = setting(0.0, key="clipTravel", minimum=0, maximum=1)
    clip_tempo: float = setting(0.0, key="clipTempo", minimum=0)
    end_with_clip: bool = setting(False, key="endWithClip")
    ground_clips: bool = setting(False, key="groundClips")
    enforce_effort_limits: bool = setting(False, key="enforceEffortLimits")
    asset: AssetConfig = field(default_factory=lambda: AssetConfig(OWN_ASSET))
