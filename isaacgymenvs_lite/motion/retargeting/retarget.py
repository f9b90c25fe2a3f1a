"""Retargets motion to a shipped humanoid or a robot, and logs the remaining errors."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.editing import cut, resample
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import body_poses, dofs_of_clip, poses_from_qpos
from isaacgymenvs_lite.motion.retargeting.bvh import read_bvh
from isaacgymenvs_lite.motion.retargeting.mapping import SkeletonMapping
from isaacgymenvs_lite.motion.retargeting.mapping_choice import check_fit
from isaacgymenvs_lite.motion.retargeting.robot import Robot, robot_problem
from isaacgymenvs_lite.motion.retargeting.solve import IkProblem, humanoid_problem, solve_poses
from isaacgymenvs_lite.motion.retargeting.source import (
    FEET,
    SourceMotion,
    humanoid_figure,
    source_from_bvh,
)
from isaacgymenvs_lite.motion.retargeting.targets import (
    Flags,
    Targets,
    make_targets,
    onto_ground,
    replanted,
)
from isaacgymenvs_lite.motion.skeleton import Skeleton, shipped_humanoid_with

_log = logging.getLogger(__name__)

KEY_BODIES = ("pelvis", "head", "right_hand", "left_hand", "right_foot", "left_foot")
_ON_GROUND_M = 0.01  # a sole's points below this height should not move
_AT_LIMIT_RAD = np.radians(0.1)
# Number of times that the goals of the feet are corrected by the remaining errors of the soles.
_CORRECTIONS = 2
# The first frame counts as a rest pose if a joint rotates by more than this angle between the first
# two frames, and by more than this multiple of the median rotation between frames.
_JUMP_DEG, _JUMP_RATIO = 20.0, 5.0


@dataclass(frozen=True)
class RetargetReport:
    """The errors of a retargeted motion."""

    scale: float  # the figure's leg length divided by the source's leg length
    # Mean and largest distance in m of each key body from the body's position in the scaled source
    # motion.
    errors_m: Mapping[str, tuple[float, float]]
    deepest_m: float  # largest depth of a sole below the ground, at least 0
    # Median and largest horizontal speed of the soles' points that touch the ground, or None if no
    # point touches the ground.
    slide_m_s: tuple[float, float] | None
    # Name of the joint that is most often at a limit, and the share of frames in which it is at the
    # limit. The value is None if no joint reaches a limit.
    limited: tuple[float, str] | None
    fastest_rad_s: float  # the largest speed of a joint

    @classmethod
    def of(
        cls,
        targets: Targets,
        missed: Mapping[str, FloatArray],
        points: FloatArray,
        contact: Flags,
        margins: FloatArray,
        joints: Sequence[str],
        fps: float,
        fastest_rad_s: float,
    ) -> RetargetReport:
        """Compute the report of a motion.

        `missed` (T, 3) m are the vectors from the scaled source to each key body. `points` (T, 2,
        K, 3) m are points of the soles; `contact` (T, 2, K) marks points that rest on the ground in
        the source motion. `margins` (T, D) rad are the distances from joint angles to their nearest
        limits.
        """
        errors = {body: np.linalg.norm(way, axis=-1) for body, way in missed.items()}
        speed = np.linalg.norm(np.diff(points[..., :2], axis=0), axis=-1) * fps
        touching = contact & (points[..., 2] < _ON_GROUND_M)
        slide = speed[touching[1:] & touching[:-1]]
        shares = (margins < _AT_LIMIT_RAD).mean(axis=0)
        joint = int(shares.argmax()) if len(shares) else 0
        return cls(
            scale=targets.scale,
            errors_m={body: (float(e.mean()), float(e.max())) for body, e in errors.items()},
            deepest_m=max(0.0, -float(points[..., 2].min())),
            slide_m_s=(float(np.median(slide)), float(slide.max())) if slide.size else None,
            limited=(float(shares[joint]), joints[joint]) if shares.any() else None,
            fastest_rad_s=fastest_rad_s,
        )

    def lines(self) -> list[str]:
        """Return the report as two lines of text."""
        bodies = ", ".join(
            f"{body} {mean:.4f} ({largest:.4f})" for body, (mean, largest) in self.errors_m.items()
        )
        sliding = "they never rest on the ground"
        if self.slide_m_s is not None:
            median, largest = self.slide_m_s
            sliding = f"in contact they slide at {largest:.3f} m/s at most (median {median:.3f})"
        limited = "no joint is ever at its limit"
        if self.limited is not None:
            share, joint = self.limited
            limited = (
                f"{joint} is at its limit in {share:.0%} of the frames, more than other joints"
            )
        return [
            f"scaled by {self.scale:.3f} (ratio of leg lengths); mean (largest) distance from the "
            f"scaled source in m: {bodies}",
            f"feet are {self.deepest_m:.4f} m below the ground at most; {sliding}; {limited}; the "
            f"fastest joint moves at {self.fastest_rad_s:.1f} rad/s",
        ]


def retarget_bvh(
    path: str | Path,
    mapping: SkeletonMapping,
    skeleton: Skeleton,
    start_s: float = 0.0,
    end_s: float | None = None,
    fps: float | None = None,
) -> MotionClip:
    """Retarget the motion of a BVH file to a shipped humanoid, and log the remaining errors.

    The motion from `start_s` to `end_s` is resampled to `fps` and used. If `end_s` is None, the
    motion is used to the last frame; if `fps` is None, the file's frame rate is kept.
    """
    source = load_bvh_source(path, mapping, start_s, end_s, fps)
    targets = make_targets(source, humanoid_figure(skeleton))
    model_path = paths.assets_dir() / str(shipped_humanoid_with(skeleton.body_names))
    model = mujoco.MjModel.from_xml_path(str(model_path))
    problem = humanoid_problem(model, skeleton, targets, source.fps)
    root, local = poses_from_qpos(skeleton, solve_poses(problem))
    offsets = skeleton.local_translation.astype(np.float32)
    poses = (offsets, local.astype(np.float32), root.astype(np.float32))
    tree = (skeleton.body_names, skeleton.parent_indices)
    clip = MotionClip.from_poses(str(path), source.fps, *tree, *poses)
    for line in humanoid_report(clip, targets, skeleton).lines():
        _log.info("%s", line)
    return clip


def load_bvh_source(
    path: str | Path,
    mapping: SkeletonMapping,
    start_s: float = 0.0,
    end_s: float | None = None,
    fps: float | None = None,
) -> SourceMotion:
    """Read the motion of a BVH file; `retarget_bvh` describes the arguments.

    A warning is logged if the first frame is probably a rest pose, as in CMU's files.
    """
    motion = read_bvh(path, [source.joint for source in mapping.sources.values()])
    check_fit(motion, mapping)
    source = cut(motion.clip(mapping.to_z_up, mapping.unit_m), start_s, end_s)
    first_deg, *later_deg = np.degrees(_frame_to_frame_rad(source))
    if later_deg and first_deg > max(_JUMP_DEG, _JUMP_RATIO * float(np.median(later_deg))):
        _log.warning(
            "%s: the first frame is %.0f degrees away from the second, maybe it is the rest pose;"
            " start_s=%.4f leaves it out",
            source.name,
            first_deg,
            1.0 / source.fps,
        )
    return source_from_bvh(source if fps is None else resample(source, fps), mapping)


def _frame_to_frame_rad(clip: MotionClip) -> FloatArray:
    """Return the largest joint rotation between successive frames, (T - 1,) rad."""
    turns = clip.local_rotation.astype(np.float64)
    cosines = np.abs((turns[1:] * turns[:-1]).sum(axis=-1))
    return 2.0 * np.arccos(np.minimum(cosines, 1.0)).max(axis=-1)


def humanoid_report(clip: MotionClip, targets: Targets, skeleton: Skeleton) -> RetargetReport:
    """Return the errors of a humanoid's clip relative to the targets."""
    positions, turns = clip.global_poses()
    missed = positions - targets.positions
    feet = [clip.body_names.index(foot) for foot in FEET]
    soles = zip(humanoid_figure(skeleton).soles.values(), feet, strict=True)
    points = [sole.places(positions[:, foot], turns[:, foot]) for sole, foot in soles]
    dofs = dofs_of_clip(skeleton, clip)
    lower, upper = skeleton.dof_limits.T
    return RetargetReport.of(
        targets,
        {body: missed[:, clip.body_names.index(body)] for body in KEY_BODIES},
        np.stack(points, axis=1),
        np.stack([targets.contacts[foot] for foot in FEET], axis=1),
        np.minimum(dofs - lower, upper - dofs),
        skeleton.dof_names,
        clip.fps,
        float(_frame_to_frame_rad(clip).max()) * clip.fps,
    )


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """A retargeted motion of a robot: qpos (T, nq) and the report of its errors."""

    fps: float
    qpos: npt.NDArray[np.float64]
    report: RetargetReport


def retarget_to_robot(source: SourceMotion, robot: Robot) -> RobotMotion:
    """Retarget a motion to a robot, and log the remaining errors."""
    targets = make_targets(source, robot.figure)
    first = problem = robot_problem(robot, targets, source.fps)
    qpos = solve_poses(problem)
    contact = robot.padded([targets.contacts[foot] for foot in FEET])
    wanted = []
    for foot in FEET:
        feet = targets.positions[:, robot.figure.body_names.index(foot)]
        wanted.append(robot.figure.soles[foot].places(feet, targets.turns[foot]))
    for _ in range(_CORRECTIONS):
        # If a foot has no ankle, or an ankle at a limit, the foot cannot rotate like the source.
        # Then the sole is at a wrong position, although the foot's origin is at the goal.
        goals, points, places = dict(problem.goals), robot.soles(qpos), robot.padded(wanted)
        for side, foot in enumerate(FEET):
            body = robot.mapping.bodies[foot].body
            goals[body] = goals[body].copy()
            missed = replanted(points[:, side], places[:, side], contact[:, side])
            goals[body][problem.lead_in :, 4:] += missed
        problem = dataclasses.replace(problem, goals=goals)
        qpos = solve_poses(problem)
    _make_continuous(robot.model, qpos)
    qpos[:, 2] += onto_ground(robot.soles(qpos), contact)
    report = _robot_report(robot, first, targets, qpos, contact)
    for line in report.lines():
        _log.info("%s", line)
    return RobotMotion(source.fps, qpos, report)


def _make_continuous(model: mujoco.MjModel, qpos: npt.NDArray[np.float64]) -> None:
    """Choose signs of quaternions in place, without jumps and with w >= 0 in the first frame."""
    for joint in range(model.njnt):
        kind = mujoco.mjtJoint(int(model.jnt_type[joint]))
        if kind == mujoco.mjtJoint.mjJNT_HINGE:
            continue
        first = int(model.jnt_qposadr[joint]) + (3 if kind == mujoco.mjtJoint.mjJNT_FREE else 0)
        turns = qpos[:, first : first + 4]
        jumps = np.sign((turns[1:] * turns[:-1]).sum(axis=1))
        turns *= np.cumprod(np.concatenate(([1.0 if turns[0, 0] >= 0.0 else -1.0], jumps)))[:, None]


def _robot_report(
    robot: Robot, problem: IkProblem, targets: Targets, qpos: FloatArray, contact: Flags
) -> RetargetReport:
    bodies = robot.mapping.bodies
    mapped = {name: bodies[name].body for name in KEY_BODIES if name in bodies}
    places, _ = body_poses(robot.model, qpos, list(mapped.values()))
    hinges = list(problem.limits.hinges)
    angles = qpos[:, robot.model.jnt_qposadr[hinges]]
    lower, upper = np.array(list(problem.limits.hinges.values())).reshape(-1, 2).T
    return RetargetReport.of(
        targets,
        {
            name: places[:, i] - problem.goals[body][problem.lead_in :, 4:]
            for i, (name, body) in enumerate(mapped.items())
            if body in problem.goals
        },
        robot.soles(qpos),
        contact,
        np.minimum(angles - lower, upper - angles),
        [robot.model.joint(joint).name for joint in hinges],
        problem.fps,
        float(np.abs(np.diff(angles, axis=0)).max(initial=0.0)) * problem.fps,
    )
