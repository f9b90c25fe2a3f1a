"""Retargets a BVH file to a clip of the humanoid, and logs the remaining errors."""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.editing import cut, resample
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import dofs_of_clip, poses_from_qpos
from isaacgymenvs_lite.motion.retargeting.bvh import read_bvh
from isaacgymenvs_lite.motion.retargeting.contacts import Flags, onto_ground, replanted
from isaacgymenvs_lite.motion.retargeting.figure import humanoid_figure
from isaacgymenvs_lite.motion.retargeting.mapping import SkeletonMapping
from isaacgymenvs_lite.motion.retargeting.mapping_fit import check_fit
from isaacgymenvs_lite.motion.retargeting.report import (
    KEY_BODIES,
    RetargetReport,
    deepest,
    most_limited,
    sliding_speeds,
    summed_up,
)
from isaacgymenvs_lite.motion.retargeting.robot import Robot, body_poses, robot_problem
from isaacgymenvs_lite.motion.retargeting.solve import IkProblem, humanoid_problem, solve_poses
from isaacgymenvs_lite.motion.retargeting.source import FEET, SourceMotion, source_from_bvh
from isaacgymenvs_lite.motion.retargeting.targets import Targets, make_targets
from isaacgymenvs_lite.motion.skeleton import Skeleton, shipped_humanoid_with

_log = logging.getLogger(__name__)

_AT_LIMIT_RAD = np.radians(0.1)
_ENDS = ("lower", "upper")
# How often the feet's goals are corrected by what the soles miss.
_CORRECTIONS = 2
# A first step this large, and so many times the median, is no motion.
_JUMP_DEG, _JUMP_RATIO = 20.0, 5.0


def retarget_bvh(
    path: str | Path,
    mapping: SkeletonMapping,
    skeleton: Skeleton,
    start_s: float = 0.0,
    end_s: float | None = None,
    fps: float | None = None,
) -> MotionClip:
    """Retarget the motion of a BVH file to a shipped humanoid, and log the remaining errors.

    Args:
        path: the BVH file.
        mapping: from its skeleton.
        skeleton: of the humanoid.
        start_s: where to start in the file.
        end_s: where to end; None: at its end.
        fps: frames per second of the clip; None: the file's.

    Raises:
        MissingPackageError: pybvh or mink is not installed.
        ConfigError: the file lacks a joint of the mapping.
        MotionFileError: the file cannot be read, or the times are not in it.
    """
    source = load_bvh_source(path, mapping, start_s, end_s, fps)
    targets = make_targets(source, humanoid_figure(skeleton))
    model_path = paths.assets_dir() / str(shipped_humanoid_with(skeleton.body_names))
    model = mujoco.MjModel.from_xml_path(str(model_path))
    problem = humanoid_problem(model, skeleton, targets, source.fps)
    root, local = poses_from_qpos(skeleton, solve_poses(problem))
    clip = MotionClip.from_poses(
        str(path),
        source.fps,
        skeleton.body_names,
        skeleton.parent_indices,
        skeleton.local_translation.astype(np.float32),
        local.astype(np.float32),
        root.astype(np.float32),
    )
    _log_report(humanoid_report(clip, targets, skeleton))
    return clip


def load_bvh_source(
    path: str | Path,
    mapping: SkeletonMapping,
    start_s: float = 0.0,
    end_s: float | None = None,
    fps: float | None = None,
) -> SourceMotion:
    """Read the motion of a BVH file; arguments and errors as in `retarget_bvh`."""
    joints = [source.joint for source in mapping.sources.values()]
    motion = read_bvh(path, joints)
    check_fit(motion, mapping)
    source = cut(motion.clip(mapping.to_z_up, mapping.unit_m), start_s, end_s)
    _warn_of_rest_pose(source)
    if fps is not None:
        source = resample(source, fps)
    return source_from_bvh(source, mapping)


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """A retargeted motion of a robot.

    Attributes:
        fps: frames per second.
        qpos: (T, nq), in MuJoCo's order: root position in m and quaternion wxyz, then the joints.
        report: how near it is to the source.
    """

    fps: float
    qpos: npt.NDArray[np.float64]
    report: RetargetReport


def retarget_to_robot(source: SourceMotion, robot: Robot) -> RobotMotion:
    """Retarget a motion to a robot, and log what remains.

    Args:
        source: of a BVH file or of a clip of a shipped humanoid, see `source_from_clip`.
        robot: see `robot_from_model`.

    Raises:
        MissingPackageError: mink is not installed.
    """
    targets = make_targets(source, robot.figure)
    first = problem = robot_problem(robot, targets, source.fps)
    qpos = solve_poses(problem)
    contact = robot.padded([targets.contacts[foot] for foot in FEET])
    wanted = robot.padded(
        [
            robot.figure.soles[foot].places(
                targets.positions[:, robot.figure.body_names.index(foot)], targets.turns[foot]
            )
            for foot in FEET
        ]
    )
    for _ in range(_CORRECTIONS):
        problem = _with_corrected_feet(robot, problem, wanted, robot.soles(qpos), contact)
        qpos = solve_poses(problem)
    _make_continuous(robot.model, qpos)
    qpos[:, 2] += onto_ground(robot.soles(qpos), contact)
    report = _robot_report(robot, first, qpos, contact, targets.scale)
    _log_report(report)
    return RobotMotion(source.fps, qpos, report)


def _make_continuous(model: mujoco.MjModel, qpos: npt.NDArray[np.float64]) -> None:
    """Give quaternions of poses (T, nq) signs that do not jump, the first with w >= 0; in place."""
    for joint in range(model.njnt):
        kind = mujoco.mjtJoint(int(model.jnt_type[joint]))
        if kind == mujoco.mjtJoint.mjJNT_HINGE:
            continue
        first = int(model.jnt_qposadr[joint]) + (3 if kind == mujoco.mjtJoint.mjJNT_FREE else 0)
        turns = qpos[:, first : first + 4]
        jumps = np.sign((turns[1:] * turns[:-1]).sum(axis=1))
        turns *= np.cumprod(np.concatenate(([1.0 if turns[0, 0] >= 0.0 else -1.0], jumps)))[:, None]


def _with_corrected_feet(
    robot: Robot, problem: IkProblem, wanted: FloatArray, points: FloatArray, contact: Flags
) -> IkProblem:
    """Return the problem with the feet moved by what their points in contact miss.

    A robot without an ankle, or with one at its limit, cannot give its foot the source's attitude;
    its sole is then elsewhere although the foot's origin is where it should be.

    Args:
        robot: it.
        problem: that was solved.
        wanted: (T, 2, K, 3) m, where the points of the soles should be, right foot first.
        points: (T, 2, K, 3) m, where they are.
        contact: (T, 2, K), which of them are in contact.
    """
    goals = dict(problem.goals)
    for side, foot in enumerate(FEET):
        body = robot.mapping.bodies[foot].body
        goal = goals[body].copy()
        goal[problem.lead_in :, 4:] += replanted(points[:, side], wanted[:, side], contact[:, side])
        goals[body] = goal
    return dataclasses.replace(problem, goals=goals)


def _robot_report(
    robot: Robot, problem: IkProblem, qpos: FloatArray, contact: Flags, scale: float
) -> RetargetReport:
    mapped = {name: robot.mapping.bodies[name].body for name in KEY_BODIES if name in robot.frames}
    places, _ = body_poses(robot.model, qpos, list(mapped.values()))
    points = robot.soles(qpos)
    hinges = problem.limits.hinges
    angles = qpos[:, [hinge.qpos for hinge in hinges]]
    lower, upper = (np.array([getattr(hinge, end)[0] for hinge in hinges]) for end in _ENDS)
    near = np.minimum(angles - lower, upper - angles) < _AT_LIMIT_RAD
    joints = [robot.model.dof_jntid[hinge.dof] for hinge in hinges]
    return RetargetReport(
        scale=scale,
        errors_m={
            name: summed_up(
                np.linalg.norm(places[:, i] - problem.goals[body][problem.lead_in :, 4:], axis=-1)
            )
            for i, (name, body) in enumerate(mapped.items())
            if body in problem.goals
        },
        deepest_m=deepest(points),
        slide_m_s=sliding_speeds(points, problem.fps, contact),
        limited=most_limited(near, [robot.model.joint(joint).name for joint in joints]),
        fastest_rad_s=float(np.abs(np.diff(angles, axis=0)).max(initial=0.0)) * problem.fps,
    )


def _warn_of_rest_pose(source: MotionClip) -> None:
    """Warn of a first frame that does not belong to the motion, as in CMU's files."""
    first_deg, *later_deg = np.degrees(_frame_to_frame_rad(source))
    if later_deg and first_deg > max(_JUMP_DEG, _JUMP_RATIO * float(np.median(later_deg))):
        _log.warning(
            "%s: the first frame is %.0f degrees away from the second, maybe it is the rest pose;"
            " start_s=%.4f leaves it out",
            source.name,
            first_deg,
            1.0 / source.fps,
        )


def _frame_to_frame_rad(clip: MotionClip) -> FloatArray:
    """Return the largest rotation of any joint from each frame to the next, (T - 1,) rad."""
    turns = clip.local_rotation.astype(np.float64)
    cosines = np.abs((turns[1:] * turns[:-1]).sum(axis=-1))
    return 2.0 * np.arccos(np.minimum(cosines, 1.0)).max(axis=-1)


def humanoid_report(clip: MotionClip, targets: Targets, skeleton: Skeleton) -> RetargetReport:
    """Return what remains between a clip of a humanoid and its targets."""
    positions, turns = clip.global_poses()
    errors = np.linalg.norm(positions - targets.positions, axis=-1)
    feet = [clip.body_names.index(foot) for foot in FEET]
    points = np.stack(
        [
            sole.places(positions[:, foot], turns[:, foot])
            for sole, foot in zip(humanoid_figure(skeleton).soles.values(), feet, strict=True)
        ],
        axis=1,
    )
    contact = np.stack([targets.contacts[foot] for foot in FEET], axis=1)
    dofs = dofs_of_clip(skeleton, clip)
    lower, upper = skeleton.dof_limits.T
    near = np.minimum(dofs - lower, upper - dofs) < _AT_LIMIT_RAD
    return RetargetReport(
        scale=targets.scale,
        errors_m={body: summed_up(errors[:, clip.body_names.index(body)]) for body in KEY_BODIES},
        deepest_m=deepest(points),
        slide_m_s=sliding_speeds(points, clip.fps, contact),
        limited=most_limited(near, skeleton.dof_names),
        fastest_rad_s=float(_frame_to_frame_rad(clip).max()) * clip.fps,
    )


def _log_report(report: RetargetReport) -> None:
    for line in report.lines():
        _log.info("%s", line)
