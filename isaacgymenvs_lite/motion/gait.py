"""Makes a gait of any quadruped: isaacgymenvs-lite gait ROBOT OUT [key=value ...].

    isaacgymenvs-lite gait assets/mjcf/quadruped.xml trot.npz speed=1
    isaacgymenvs-lite gait a1.urdf walk.npz gait=walk speed=0.4 frequency=1.2

ROBOT is an MJCF or URDF of a quadruped that looks along x. OUT is a clip of the robot's joint
coordinates (.npz) for task=RobotAMP. The trunk moves at constant speed, and feet in stance do not
move. Keys:

    gait=trot           trot (diagonal pairs), walk (one foot after the other), pace (left, right)
    speed=1             m/s; a negative speed goes backwards
    frequency=2         strides per second; adjusted to a whole number of strides
    duty_factor=0.5     share of a stride that a foot is on the ground (default of a walk: 0.75)
    step_height=0.06    height of the feet in mid swing, m
    body_height=0.3     height of the trunk's origin, m (default: hips at 0.7 of the legs' length)
    bounce=0            amplitude of the trunk's vertical motion, m
    knees=behind        side of the knees for legs that bend to both sides: behind, ahead, or
                        inward (front knees behind, rear knees ahead)
    seconds=4 fps=60    length and frame rate of the clip
    feet=[]             names or patterns of the feet, for example [*_foot] (default: found)
    start_rotation=[0,0,0,1]  the trunk's quaternion xyzw that makes the robot look along x
    overwrite=True      replaces an existing OUT
"""

from __future__ import annotations

import itertools
import logging
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.clip import JointClip
from isaacgymenvs_lite.motion.formats.files import check_output
from isaacgymenvs_lite.motion.formats.robot_clip import save_robot_npz
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import dofs_from_qpos
from isaacgymenvs_lite.motion.retargeting.source import find_sole
from isaacgymenvs_lite.motion.robot_file import run_file_command
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.robots.followers import Followers
from isaacgymenvs_lite.robots.limbs import ancestors, free_joints
from isaacgymenvs_lite.robots.load import PreparedRobot, load_robot
from isaacgymenvs_lite.robots.settings import RobotSettings
from isaacgymenvs_lite.robots.stance import LATERAL
from isaacgymenvs_lite.robots.start_pose import posed
from isaacgymenvs_lite.schema import setting
from isaacgymenvs_lite.utils import rotations

NUM_LEGS = 4
_LEAST_HINGES = 3  # A foot needs three hinges to reach all nearby points.
_MOST_HINGES = 6  # The search for the first pose tries three angles per hinge.
KNEES = ("behind", "ahead", "inward")
TOLERANCE_M = 1e-6
"""Largest allowed distance (m) of a foot from its target."""
_ITERATIONS = 100
_DAMPING = 1e-6  # m^2/rad^2; keeps the solver's steps for straight legs finite
_LONGEST_STEP_RAD = 0.3
_PULL = 0.1  # redundant hinges return by this share towards the first pose in a solver step
# The search for the first pose tries these angles of each joint relative to the start pose.
_FIRST_BENDS_RAD = (-1.0, 0.0, 1.0)
# Distances of solutions from the start pose are rounded to this step. If the rounded distances of
# several solutions are equal, the direction of the knees decides.
_ALIKE_RAD = 0.2
_LOWEST_M = 1e-4  # points of a foot within this height of the lowest point also count as lowest


@dataclass(frozen=True, eq=False)
class Leg:
    """A chain of hinges from the trunk to a foot."""

    foot: str  # name of the body
    body: int  # id of the body
    joints: tuple[int, ...]  # ids of the hinges from the hip down, without followers
    # (3,) m, centre of the foot's lowest sphere, or the foot's lowest point, in the foot's frame
    sole: FloatArray
    radius: float  # m, radius of the sphere, or 0 for a point
    # (3,) m, position of the hinge that swings the leg fore and aft, relative to the trunk's origin
    # in the start pose, in world axes
    hip: FloatArray
    neutral_y: float  # m, y of the foot minus y of the trunk's origin in the start pose
    length: float  # m, length of the straight leg from `hip` to `sole`


def find_legs(robot: PreparedRobot) -> tuple[Leg, ...]:
    """Return the legs of a quadruped in this order: front left, front right, rear left, rear right.

    A leg is a chain of at least three hinges from the trunk to a foot. Feet are the bodies that
    touch the floor in the start pose, or the key bodies if not four legs touch the floor. Raises
    ConfigError if the robot does not have two legs on each side, or does not look along x.
    """
    by_contact = _feet(robot.model, robot.contact_bodies)
    feet = by_contact
    if len(feet) != NUM_LEGS:
        feet = _feet(robot.model, robot.key_bodies)
    if len(feet) != NUM_LEGS:
        bodies = ", ".join(dict.fromkeys((*robot.contact_bodies, *robot.key_bodies)))
        raise ConfigError(
            f"has {len(by_contact)} legs of at least {_LEAST_HINGES} hinges, expected {NUM_LEGS}:"
            f" a gait needs a quadruped; give feet=[...], its feet (found bodies: {bodies})"
        )
    legs = sorted((_leg(robot, foot) for foot in feet), key=lambda leg: -leg.hip[0])
    front, rear = (sorted(pair, key=lambda leg: -leg.hip[1]) for pair in (legs[:2], legs[2:]))
    if any(left.hip[1] <= 0 or right.hip[1] >= 0 for left, right in (front, rear)):
        raise ConfigError(
            f"the feet {', '.join(leg.foot for leg in (*front, *rear))} are not two pairs, left"
            " and right of x: a gait needs a robot that looks along x, with y to its left and z"
            " up; start_rotation=[x,y,z,w] turns it"
        )
    return (*front, *rear)


def _feet(model: mujoco.MjModel, names: Sequence[str]) -> list[int]:
    """Return the last named body of each leg."""
    feet: dict[int, int] = {}
    for foot in sorted(model.body(name).id for name in names):
        chain = _chain(model, foot)
        if len(free_joints(model, chain)) >= _LEAST_HINGES:
            feet[chain[0]] = foot
    return list(feet.values())


def _chain(model: mujoco.MjModel, foot: int) -> list[int]:
    """Return the bodies from the trunk (excluded) to a foot (included)."""
    trunk = (model.body_weldid[1], 0)
    chain = reversed(ancestors(model, foot))
    return [body for body in chain if model.body_weldid[body] not in trunk]


def _leg(robot: PreparedRobot, foot: int) -> Leg:
    model, name = robot.model, robot.model.body(foot).name
    joints = free_joints(model, _chain(model, foot))
    if any(model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE for joint in joints):
        raise ConfigError(f"the leg of '{name}' has a ball joint, expected hinges")
    if len(joints) > _MOST_HINGES:
        raise ConfigError(
            f"the leg of '{name}' has {len(joints)} hinges, expected at most {_MOST_HINGES}; name a"
            " body nearer to the trunk with feet=[...]"
        )
    centres, radii = find_sole(model, robot.start_qpos, name)
    data = posed(model, robot.start_qpos)
    lowest = centres[:, 2] - radii < (centres[:, 2] - radii).min() + _LOWEST_M
    centre = data.xpos[foot] + centres[lowest].mean(axis=0)
    places = data.xanchor[joints] - data.xpos[1]
    swings = np.abs(data.xaxis[joints, 1]) > LATERAL
    first = int(swings.argmax())  # If no joint swings fore and aft, the index is 0, the hip's.
    end = centre - data.xpos[1]
    return Leg(
        foot=name,
        body=foot,
        joints=tuple(joints),
        sole=data.xmat[foot].reshape(3, 3).T @ (centre - data.xpos[foot]),
        radius=float(radii[lowest].max()),
        hip=places[first],
        neutral_y=float(end[1]),
        length=float(np.linalg.norm(np.diff([*places[first:], end], axis=0), axis=1).sum()),
    )


class LegSolver:
    """Inverse kinematics of a robot's legs within the joint limits.

    `knees`, one of `KNEES`, chooses where the knees point if legs can bend to both sides.
    """

    def __init__(self, robot: PreparedRobot, legs: tuple[Leg, ...], knees: str = KNEES[0]) -> None:
        self._model, self._legs, self._knees = robot.model, legs, knees
        self._data = mujoco.MjData(robot.model)
        self._followers = Followers(robot.model)
        self._start = self._posture = robot.start_qpos
        limited = robot.model.jnt_limited.astype(bool)[:, None]
        self._ranges = np.where(limited, robot.model.jnt_range, (-math.pi, math.pi))

    def first_pose(self, root: FloatArray, places: FloatArray) -> npt.NDArray[np.float64]:
        """Find the pose (nq,) with the soles at `places` that is nearest to the start pose.

        `root` (7,) is the trunk's position in m and quaternion wxyz. `places` (4, 3) m are world
        positions. Raises ConfigError if a foot cannot reach its place.
        """
        pose = self._start.copy()
        pose[:7] = root
        for leg, place in zip(self._legs, places, strict=True):
            hinges = list(leg.joints)
            columns = self._model.jnt_qposadr[hinges]
            tried = []
            for bends in itertools.product(_FIRST_BENDS_RAD, repeat=len(columns)):
                pose[columns] = self._start[columns] + bends
                error = self._reach(pose, leg, place)
                change = float(np.abs(pose[columns] - self._start[columns]).max())
                x = float(self._data.xanchor[hinges, 0].mean() - self._data.xpos[1, 0])
                knee = {"behind": x, "ahead": -x, "inward": abs(x)}[self._knees]
                rank = (error > TOLERANCE_M, round(change / _ALIKE_RAD), knee)
                tried.append((*rank, error, pose[columns].copy()))
            best = min(tried, key=lambda entry: entry[:-1])
            pose[columns] = best[-1]
        self._check(pose, places)
        self._posture = pose.copy()
        return pose

    def next_pose(
        self, last: FloatArray, root: FloatArray, places: FloatArray
    ) -> npt.NDArray[np.float64]:
        """Find the pose (nq,) with the soles at `places`; the search starts from the last pose."""
        pose = np.array(last, dtype=np.float64)
        pose[:7] = root
        for leg, place in zip(self._legs, places, strict=True):
            self._reach(pose, leg, place)
        self._check(pose, places)
        return pose

    def soles(self, pose: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Set the follower joints of a pose, and return the soles' world positions (4, 3) m."""
        self._set(pose)
        return np.stack([self._sole(leg) for leg in self._legs])

    def _set(self, pose: npt.NDArray[np.float64]) -> None:
        """Set the follower joints of a pose in place, and compute its kinematics."""
        pose[:] = self._followers.placed(pose)
        self._data.qpos[:] = pose
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)  # Jacobians need the results of this function.

    def _sole(self, leg: Leg) -> npt.NDArray[np.float64]:
        return self._data.xpos[leg.body] + self._data.xmat[leg.body].reshape(3, 3).dot(leg.sole)

    def _reach(self, pose: npt.NDArray[np.float64], leg: Leg, place: FloatArray) -> float:
        """Move a leg's sole to a place by changing `pose`, and return the remaining error in m.

        Redundant hinges stay near their angles in the first pose, so that all strides are equal.
        """
        joints = list(leg.joints)
        columns, dofs = self._model.jnt_qposadr[joints], self._model.jnt_dofadr[joints]
        lower, upper = self._ranges[joints].T
        pose[columns] = np.clip(pose[columns], lower, upper)
        jacobian = np.zeros((3, self._model.nv))
        for _ in range(_ITERATIONS):
            self._set(pose)
            error = place - self._sole(leg)
            if np.linalg.norm(error) < 0.01 * TOLERANCE_M:
                break
            mujoco.mj_jac(self._model, self._data, jacobian, None, self._sole(leg), leg.body)
            of_leg = self._followers.led(jacobian, pose)[:, dofs]
            damped = of_leg @ of_leg.T + _DAMPING * np.eye(3)
            step = of_leg.T @ np.linalg.solve(damped, error)
            if len(joints) > _LEAST_HINGES:
                pull = _PULL * (self._posture[columns] - pose[columns])
                step += pull - np.linalg.pinv(of_leg) @ (of_leg @ pull)
            step *= min(1.0, _LONGEST_STEP_RAD / max(float(np.abs(step).max()), 1e-12))
            pose[columns] = np.clip(pose[columns] + step, lower, upper)
        self._set(pose)
        return float(np.linalg.norm(place - self._sole(leg)))

    def _check(self, pose: npt.NDArray[np.float64], places: FloatArray) -> None:
        """Set the follower joints of a pose, and raise a ConfigError if a foot misses its place."""
        for leg, place, sole in zip(self._legs, places, self.soles(pose), strict=True):
            error = float(np.linalg.norm(place - sole))
            if error > TOLERANCE_M:
                raise ConfigError(
                    f"the foot '{leg.foot}' stays {error:.3g} m away from its target, which is"
                    f" {np.round(place - pose[:3], 3).tolist()} m from the trunk: its leg is too"
                    " short, or a joint is at its limit; change body_height, raise frequency, or"
                    " lower speed or step_height"
                )


_log = logging.getLogger(__name__)

_NEUTRAL_SHARE = 0.7  # default height of the hips above the feet, divided by the legs' length


# Maps a gait to the touch-down phases of the feet (front left and right, rear left and right) and
# the duty factor. Source: Hildebrand, "Symmetrical gaits of horses", Science 150 (1965).
_PATTERNS = {
    "trot": ((0.0, 0.5, 0.5, 0.0), 0.5),
    "walk": ((0.25, 0.75, 0.0, 0.5), 0.75),
    "pace": ((0.0, 0.5, 0.0, 0.5), 0.5),
}


@dataclass(frozen=True, kw_only=True)
class GaitSettings:
    """Keys of the command; the module docstring describes them."""

    gait: str = setting("trot", choices=_PATTERNS)
    speed: float = setting(1.0, minimum=-10, maximum=10)
    frequency: float = setting(2.0, minimum=0.1, maximum=10)
    duty_factor: float | None = setting(None, minimum=0.5, maximum=0.95)
    step_height: float = setting(0.06, minimum=0, maximum=1)
    body_height: float | None = setting(None, above=0, maximum=5)
    bounce: float = setting(0.0, minimum=0, maximum=0.5)
    knees: str = setting(KNEES[0], choices=KNEES)
    seconds: float = setting(4.0, above=0, maximum=120)
    fps: float = setting(60.0, minimum=1, maximum=240)
    feet: tuple[str, ...] = setting(())
    start_rotation: tuple[float, ...] | None = setting(None, length=4)
    overwrite: bool = setting(False)


def make_gait(robot: PreparedRobot, settings: GaitSettings, name: str = "gait") -> JointClip:
    """Return a whole number of strides along x, whose last pose equals the first pose.

    Raises ConfigError if the robot does not have four legs, if a foot cannot reach its target, or
    if a stride has fewer than four frames.
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
    # A phase of 1 is a stride. A touch-down may lie between two frames.
    phases = np.arange(round(strides * per_stride) + 1) / per_stride
    period_s = per_stride / settings.fps
    root = _trunk(robot, legs, settings, phases, period_s)
    places = _foot_places(legs, settings, phases, period_s)
    standing = [(leg.hip[0], leg.neutral_y, leg.radius) for leg in legs]
    poses = [solver.first_pose(root[0], np.array(standing))]
    # A first stride, which the clip does not contain, leads from standing into the gait.
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
    """Return the trunk's poses (T, 7), m and wxyz, with the largest heights at touch-downs."""
    height = settings.body_height
    if height is None:
        heights = [_NEUTRAL_SHARE * leg.length + leg.radius - leg.hip[2] for leg in legs]
        height = float(np.mean(heights))
    # Number of touch-downs in a stride; simultaneous touch-downs count as one.
    beats = len(set(_PATTERNS[settings.gait][0]))
    root = np.zeros((len(phases), 7))
    root[:, 0] = settings.speed * period_s * phases
    root[:, 2] = height + settings.bounce * np.cos(2.0 * np.pi * beats * phases)
    root[:, 3:] = robot.start_qpos[3:7]
    return root


def _foot_places(
    legs: tuple[Leg, ...], settings: GaitSettings, phases: FloatArray, period_s: float
) -> npt.NDArray[np.float64]:
    """Return the world positions (T, 4, 3) m of the soles at phases (T,) in strides.

    A foot is below its hip in mid stance. A foot's swing starts and ends with zero velocity and
    acceleration.
    """
    touch_downs, duty = _PATTERNS[settings.gait]
    duty = duty if settings.duty_factor is None else settings.duty_factor
    stride_m = settings.speed * period_s
    places = np.zeros((len(phases), len(legs), 3))
    for i, (leg, touch_down) in enumerate(zip(legs, touch_downs, strict=True)):
        # Rounding errors could place a touch-down at the end of the previous stride.
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
    """Make a gait for a robot's file, write it, and return the path of the clip."""
    path = Path(out)
    check_output(path, (".npz",), settings.overwrite)
    of_robot = RobotSettings(
        contact_bodies=settings.feet,
        key_bodies=settings.feet,
        start_rotation=settings.start_rotation,
        start_pose={},  # keeps the pose in the file, because `knees` determines how the legs bend
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
