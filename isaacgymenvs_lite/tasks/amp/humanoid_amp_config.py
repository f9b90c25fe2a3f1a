"""The keys of `task.env` in cfg/task/HumanoidAMP.yaml, with their checks."""

from __future__ import annotations

from dataclasses import dataclass, field

from isaacgymenvs_lite.motion.interpolation import INTERPOLATIONS
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.tasks.base.task_config import AssetConfig, TaskConfig

OWN_ASSET = "mjcf/amp_humanoid.xml"
FEET = ("right_foot", "left_foot")


@dataclass(frozen=True, kw_only=True)
class HumanoidAMPConfig(TaskConfig):
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
    num_amp_obs_steps: int = setting(2, key="numAMPObsSteps", minimum=2, maximum=1000)
    """Control steps in one AMP observation."""
    local_root_obs: bool = setting(False, key="localRootObs")
    """Take the heading out of the root rotation in the observation."""
    contact_bodies: tuple[str, ...] | None = setting(FEET, key="contactBodies")
    """Bodies that may touch the floor; None: the feet, and what touches it in the clips."""
    termination_height: float = setting(0.5, key="terminationHeight")
    """An episode ends when a touched character has a body below this height (m)."""
    enable_early_termination: bool = setting(True, key="enableEarlyTermination")
    """End episodes at falls."""
    motion_file: str = setting("walk.npz")
    """Clip or dataset: a path, a name in assets/amp/motions, or `deepmimic:<name>`."""
    repair_repeated_frames: bool = setting(True, key="repairRepeatedFrames")
    """This project's: drop the repeats of a clip that stores every frame twice, whose joint
    velocities would alternate between zero and twice the truth."""
    clip_interpolation: str = setting("spline", key="clipInterpolation", choices=INTERPOLATIONS)
    """This project's: what is between the frames of clips: a spline, whose derivative gives the
    velocities, or what the originals compute, see `motion.interpolation`."""
    demo_motion_share: float = setting(0.0, key="demoMotionShare", minimum=0, maximum=1)
    """This project's: share of the demonstrations that are drawn in proportion to the motion in the
    clip at each time, not evenly. A policy that only rests is then rewarded less."""
    adaptive_starts: float = setting(0.0, key="adaptiveStarts", minimum=0, maximum=1)
    """This project's: share of the starts in clips that are drawn where the policy fails."""
    clip_deviation: float = setting(0.0, key="clipDeviation", minimum=0)
    """This project's: with one clip, an episode that starts in it ends as a fall when the character
    is farther from it than this, as a share of the root's height in standing; 0: it does not. A
    policy that leaves a leap out and stands is then no better than one that falls."""
    clip_deviation_final: float = setting(0.0, key="clipDeviationFinal", minimum=0)
    """This project's: `clip_deviation` comes down to this while the mean training episode gets from
    one second to three; 0: it does not."""
    clip_travel: float = setting(0.0, key="clipTravel", minimum=0, maximum=1)
    """This project's: with `clip_deviation`, such an episode also ends where it got less far in its
    last second than the clip, in the clip's direction, by more than this share of its way; 0: it
    may get anywhere. A policy that stands is near all poses of a slow walk."""
    clip_tempo: float = setting(0.0, key="clipTempo", minimum=0)
    """This project's: with `clip_deviation`, such an episode also ends where its last second shows
    the clip faster by more than this share, or as much slower; 0: at any tempo. Without a limit
    walks become quick, short steps. Half of the clip's is enough at first, until the mean episode
    has lasted three seconds."""
    end_with_clip: bool = setting(False, key="endWithClip")
    """This project's: with `clip_deviation`, an episode that starts in a clip whose end is far from
    its start reaches its time limit there. No clip shows what comes next."""
    ground_clips: bool = setting(False, key="groundClips")
    """This project's: raise or lower each clip so that its lowest points are on the ground."""
    enforce_effort_limits: bool = setting(False, key="enforceEffortLimits")
    """This project's: limit PD torques to the published motor efforts, as the MJCF lists them.
    The originals do not limit them."""
    asset: AssetConfig = field(default_factory=lambda: AssetConfig(OWN_ASSET))
