"""Makes a gait of any quadruped: isaacgymenvs-lite gait ROBOT OUT [key=value ...].

    isaacgymenvs-lite gait assets/mjcf/quadruped.xml trot.npz speed=1
    isaacgymenvs-lite gait a1.urdf walk.npz gait=walk speed=0.4 frequency=1.2

ROBOT is an MJCF or URDF of a quadruped that looks along x; OUT is a clip of its joint coordinates
(.npz), for task=RobotAMP. Keys:

    gait=trot           trot (diagonal pairs), walk (one foot after the other), pace (left, right)
    speed=1             m/s; negative goes backwards
    frequency=2         strides per second; changed a little for a whole number of them
    duty_factor=0.5     share of a stride that a foot is on the ground (default of a walk: 0.75)
    step_height=0.06    m, how high feet are lifted
    body_height=0.3     m, of the trunk's origin (default: hips at 0.7 of the legs' length)
    bounce=0            m, how far the trunk rises and sinks about it, twice in a stride
    knees=behind        behind, ahead, or inward (front ones behind, rear ones ahead), of legs that
                        can bend to both sides
    seconds=4 fps=60    of the clip
    feet=[]             names or patterns of the feet, such as [*_foot] (default: found)
    start_rotation=[0,0,0,1]  of the trunk, xyzw, where the file's robot does not look along x
    overwrite=True      OUT may exist

Feet in stance stay where they are while the trunk moves on at constant speed.
"""

from __future__ import annotations

import logging
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.formats.files import check_output
from isaacgymenvs_lite.motion.formats.robot_npz import save_robot_npz
from isaacgymenvs_lite.motion.joint_clip import JointClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.legs import KNEES, Leg, LegSolver, find_legs
from isaacgymenvs_lite.motion.qpos import dofs_from_qpos
from isaacgymenvs_lite.motion.robot_file import run_file_command
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.robots.load import PreparedRobot, load_robot
from isaacgymenvs_lite.robots.settings import RobotSettings
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.utils import rotations

_log = logging.getLogger(__name__)

_NEUTRAL_SHARE = 0.7  # of the legs' length, between hips and feet


@dataclass(frozen=True)
class _Pattern:
    """When feet touch down, as shares of a stride: front left, front right, rear left, right.

    As Hildebrand, "Symmetrical gaits of horses", Science 150 (1965); the walk is the lateral
    sequence.
    """

    touch_down: tuple[float, float, float, float]
    duty_factor: float


_PATTERNS = {
    "trot": _Pattern((0.0, 0.5, 0.5, 0.0), 0.5),
    "walk": _Pattern((0.25, 0.75, 0.0, 0.5), 0.75),
    "pace": _Pattern((0.0, 0.5, 0.0, 0.5), 0.5),
}


@dataclass(frozen=True, kw_only=True)
class GaitSettings:
    """Settings of the command."""

    gait: str = setting("trot", choices=_PATTERNS)
    """Order of the feet."""
    speed: float = setting(1.0, minimum=-10, maximum=10)
    """Of the trunk along x, m/s."""
    frequency: float = setting(2.0, minimum=0.1, maximum=10)
    """Strides per second."""
    duty_factor: float | None = setting(None, minimum=0.5, maximum=0.95)
    """Share of a stride that a foot is on the ground; None: as usual for the gait."""
    step_height: float = setting(0.06, minimum=0, maximum=1)
    """How high feet are lifted, m."""
    body_height: float | None = setting(None, above=0, maximum=5)
    """Of the trunk's origin, m; None: the hips at 0.7 of the legs' length."""
    bounce: float = setting(0.0, minimum=0, maximum=0.5)
    """How far the trunk rises above its height and sinks below it, m."""
    knees: str = setting(KNEES[0], choices=KNEES)
    """Where knees are, of legs that can bend to both sides."""
    seconds: float = setting(4.0, above=0, maximum=120)
    """Length of the clip; it becomes a whole number of strides."""
    fps: float = setting(60.0, minimum=1, maximum=240)
    """Frames per second."""
    feet: tuple[str, ...] = setting(())
    """Names or patterns of the feet's bodies; (): what touches the floor in the start pose."""
    start_rotation: tuple[float, ...] | None = setting(None, length=4)
    """Rotation of the trunk, xyzw, with which the robot looks along x; None: as in its file."""
    overwrite: bool = setting(False)
    """Whether an existing output is replaced."""


def make_gait(robot: PreparedRobot, settings: GaitSettings, name: str = "gait") -> JointClip:
    """Return a gait straight ahead along x, whole strides; the last frame is the first one's pose.

    Args:
        robot: a quadruped.
        settings: of the gait; `feet`, `start_rotation` and `overwrite` are of the command only.
        name: of the clip.

    Raises:
        ConfigError: the robot has not four legs, a foot cannot reach its places, or a stride has
            fewer than four frames.
    """
    legs = find_legs(robot)
    solver = LegSolver(robot, legs, settings.knees)
    strides = max(1, round(settings.seconds * settings.frequency))
    per_stride = round(settings.fps / settings.frequency * strides) / strides
    if per_stride < 4:
        raise ConfigError(
            f"a stride has {per_stride:.3g} frames at fps={settings.fps:g}, expected at least 4;"
            " lower frequency, or raise fps"
        )
    # Of the frames that a stride has, a touch-down may be between two.
    phases = np.arange(round(strides * per_stride) + 1) / per_stride
    period_s = per_stride / settings.fps
    root = _trunk(robot, legs, settings, phases, period_s)
    places = _foot_places(legs, settings, phases, period_s)
    standing = [(leg.hip[0], leg.neutral_y, leg.radius) for leg in legs]
    poses = [solver.first_pose(root[0], np.array(standing))]
    # The stride before the clip's first one leads from standing into the gait.
    lead_in = math.ceil(per_stride)
    for frame in (*range(lead_in), *range(len(phases))):
        poses.append(solver.next_pose(poses[-1], root[frame], places[frame]))
    qpos = np.stack(poses[-len(phases) :])
    skeleton = Skeleton.from_model(robot.model, name)
    root_rot = rotations.xyzw_from_wxyz(torch.from_numpy(qpos[:, 3:7])).numpy()
    dofs = dofs_from_qpos(skeleton, qpos)
    clip = JointClip(name, settings.fps, qpos[:, :3], root_rot, dofs, skeleton.dof_names)
    clip.validate()
    return clip


def _trunk(
    robot: PreparedRobot,
    legs: tuple[Leg, ...],
    settings: GaitSettings,
    phases: FloatArray,
    period_s: float,
) -> npt.NDArray[np.float64]:
    """Return the trunk's positions and quaternions wxyz (T, 7); it is highest at touch-downs."""
    height = settings.body_height
    if height is None:
        heights = [_NEUTRAL_SHARE * leg.length + leg.radius - leg.hip[2] for leg in legs]
        height = float(np.mean(heights))
    # How often feet touch down in a stride, together or alone.
    beats = len(set(_PATTERNS[settings.gait].touch_down))
    root = np.zeros((len(phases), 7))
    root[:, 0] = settings.speed * period_s * phases
    root[:, 2] = height + settings.bounce * np.cos(2.0 * np.pi * beats * phases)
    root[:, 3:] = robot.start_qpos[3:7]
    return root


def _foot_places(
    legs: tuple[Leg, ...], settings: GaitSettings, phases: FloatArray, period_s: float
) -> npt.NDArray[np.float64]:
    """Return where the legs' soles are (T, 4, 3) m in the world, at strides (T,) since the start.

    In mid stance a foot is below its hip. It swings with no velocity and acceleration at both ends.
    """
    pattern = _PATTERNS[settings.gait]
    duty = pattern.duty_factor if settings.duty_factor is None else settings.duty_factor
    stride_m = settings.speed * period_s
    places = np.zeros((len(phases), len(legs), 3))
    for i, (leg, touch_down) in enumerate(zip(legs, pattern.touch_down, strict=True)):
        # Shares of frames are sums of floats: what is a touch-down but for rounding is one.
        since = np.round(phases - touch_down, 9)
        number = np.floor(since)
        swing = np.clip((since - number - duty) / (1.0 - duty), 0.0, 1.0)
        forward = swing**3 * (10.0 - 15.0 * swing + 6.0 * swing**2)
        mid_stance = number + touch_down + 0.5 * duty
        places[:, i, 0] = leg.hip[0] + stride_m * (mid_stance + forward)
        places[:, i, 1] = leg.neutral_y
        places[:, i, 2] = leg.radius + settings.step_height * 64.0 * (swing * (1.0 - swing)) ** 3
    return places


def write_gait(source: str, out: str, settings: GaitSettings) -> Path:
    """Make the gait of a robot's file and write it; return the path of the clip.

    Raises:
        UserError: the robot cannot be used, see `load_robot` and `make_gait`, or the output cannot
            be written, or exists.
    """
    path = Path(out)
    check_output(path, (".npz",), settings.overwrite)
    of_robot = RobotSettings(
        contact_bodies=settings.feet,
        key_bodies=settings.feet,
        start_rotation=settings.start_rotation,
        start_pose={},  # legs as the file draws them: `knees` names the side to which they bend
    )
    robot = load_robot(source, of_robot)
    try:
        clip = make_gait(robot, settings, path.stem)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error
    save_robot_npz(path, clip)
    speeds = np.abs(np.diff(clip.dof_pos, axis=0)) * clip.fps
    _log.info(
        "%s: %s at %g m/s, %d frames at %g Hz, trunk at %.3f m, joints at most at %.1f rad/s",
        path,
        settings.gait,
        settings.speed,
        clip.num_frames,
        clip.fps,
        clip.root_pos[:, 2].mean(),
        speeds.max(),
    )
    return path


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    files = {"ROBOT": "the robot's MJCF or URDF", "OUT": "the file to write"}
    return run_file_command("gait", __doc__, GaitSettings, write_gait, arguments, **files)


if __name__ == "__main__":
    sys.exit(main())
