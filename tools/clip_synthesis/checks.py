"""Measures feet, joints and cycles of a finished clip for tests and documentation."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import dofs_from_rotations
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations
from tools.clip_synthesis.mirror import mirror_rotations

CONTACT_HEIGHT_M = 0.003  # a corner of a sole below this height touches the ground
# The limits of the humanoid's DOFs in degrees are published values (spec/humanoid.md), because the
# MJCF limits only the total angle of a ball joint. Limits of left and right mirror each other.
DOF_LIMITS_DEG: tuple[tuple[float, float], ...] = (
    *((-60, 60), (-60, 90), (-50, 50)),  # abdomen
    *((-50, 50), (-40, 60), (-45, 45)),  # neck
    *((-180, 45), (-180, 60), (-90, 90), (-160, 0)),  # right shoulder, elbow
    *((-45, 180), (-180, 60), (-90, 90), (-160, 0)),  # left shoulder, elbow
    *((-60, 15), (-140, 60), (-60, 35), (0, 160), (-30, 30), (-55, 55), (-40, 40)),  # right leg
    *((-15, 60), (-140, 60), (-35, 60), (0, 160), (-30, 30), (-55, 55), (-40, 40)),  # left leg
)


@dataclass(frozen=True)
class FootFigures:
    """Measurements of the soles' corners.

    Attributes:
        worst_slip_m: longest horizontal path of a corner while it stays on the ground.
        deepest_m: largest depth of a corner below the ground.
        highest_m: largest height of the lowest corner of both feet; 0 without flight.
        flight_share: share of the frames without a corner on the ground.
        double_support_share: share of the frames with corners of both feet on the ground.
        swing_clearance_m: lowest height of a foot in the middle half of its swings.
    """

    worst_slip_m: float
    deepest_m: float
    highest_m: float
    flight_share: float
    double_support_share: float
    swing_clearance_m: float


def sole_corners(skeleton: Skeleton, positions: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the world positions (T, 2, 4, 3) in m of the soles' corners, right foot first.

    `positions` (T, J, 3) in m and `rotation` (T, J, 4) xyzw describe the bodies in the world.
    """
    soles = []
    for name in ("right_foot", "left_foot"):
        foot = skeleton.body_names.index(name)
        corners = skeleton.foot_corners[[body == foot for body in skeleton.foot_body_ids]]
        sole = corners[corners[:, 2] == corners[:, 2].min()]
        soles.append(kinematics.world_points([foot] * len(sole), sole, positions, rotation))
    return np.stack(soles, axis=1)


def foot_figures(clip: MotionClip, skeleton: Skeleton) -> FootFigures:
    """Measure the feet of a clip on flat ground at z = 0."""
    corners = sole_corners(skeleton, *clip.global_poses())
    height = corners[..., 2]
    touching = height < CONTACT_HEIGHT_M
    on_ground: npt.NDArray[np.bool_] = np.asarray(touching.any(axis=-1))
    slips = [
        _longest_way(corners[:, foot, corner, :2], touching[:, foot, corner])
        for foot in range(corners.shape[1])
        for corner in range(corners.shape[2])
    ]
    lowest = height.min(axis=-1)
    return FootFigures(
        worst_slip_m=max(slips),
        deepest_m=max(0.0, -float(height.min())),
        highest_m=float(lowest.min(axis=1).max()),
        flight_share=float((~on_ground).all(axis=1).mean()),
        double_support_share=float(on_ground.all(axis=1).mean()),
        swing_clearance_m=_clearance(lowest, on_ground),
    )


def limit_margin(clip: MotionClip, skeleton: Skeleton) -> float:
    """Return the smallest distance in rad of a DOF to its limits, negative beyond a limit."""
    dofs = dofs_from_rotations(skeleton, clip.local_rotation)
    lower, upper = np.radians(DOF_LIMITS_DEG).T
    return float(np.minimum(dofs - lower, upper - dofs).min())


def peak_joint_speed(clip: MotionClip, skeleton: Skeleton) -> float:
    """Return the largest speed of a DOF between consecutive frames in rad/s."""
    velocities = kinematics.joint_velocities(clip.local_rotation, clip.fps)
    return float(np.abs(velocities[:, list(skeleton.dof_body_ids)]).max())


def closure_error(clip: MotionClip, frames_per_cycle: int) -> tuple[float, float]:
    """Return the largest differences of rotations (rad) and root positions (m) after one cycle.

    The mean displacement along x does not count as a difference.
    """
    turns = torch.from_numpy(np.asarray(clip.local_rotation, dtype=np.float64))
    angle = rotations.quat_diff_rad(turns[frames_per_cycle:], turns[:-frames_per_cycle])
    moved = clip.root_translation[frames_per_cycle:] - clip.root_translation[:-frames_per_cycle]
    moved = moved.astype(np.float64)
    moved[:, 0] -= moved[:, 0].mean()
    return float(angle.abs().max()), float(np.abs(moved).max())


def velocity_seam(clip: MotionClip) -> tuple[float, float]:
    """Return the differences of the linear (m/s) and angular (rad/s) velocities of both ends."""
    linear = np.abs(clip.linear_velocity_w[-1] - clip.linear_velocity_w[0]).max()
    angular = np.abs(clip.angular_velocity_w[-1] - clip.angular_velocity_w[0]).max()
    return float(linear), float(angular)


def symmetry_error(clip: MotionClip, frames_per_cycle: int) -> tuple[float, float]:
    """Compare every pose with its mirror image half a cycle later.

    Returns:
        The largest differences of rotations in rad and of the root's y and z in m.
    """
    half = frames_per_cycle // 2
    turns = torch.from_numpy(np.asarray(clip.local_rotation, dtype=np.float64))
    mirrored = torch.from_numpy(mirror_rotations(clip.body_names, turns.numpy()))
    angle = rotations.quat_diff_rad(turns[half:], mirrored[:-half])
    place = clip.root_translation[:, 1:].astype(np.float64)
    moved = place[half:] - place[:-half] * (-1.0, 1.0)
    return float(angle.abs().max()), float(np.abs(moved).max())


def _longest_way(points: FloatArray, touching: npt.NDArray[np.bool_]) -> float:
    """Return the longest path in m of points (T, 2) over consecutive frames with a touch (T)."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    both = touching[1:] & touching[:-1]
    longest = way = 0.0
    for step, on_ground in zip(steps, both, strict=True):
        way = way + float(step) if on_ground else 0.0
        longest = max(longest, way)
    return longest


def _clearance(lowest: FloatArray, on_ground: npt.NDArray[np.bool_]) -> float:
    """Return the lowest height in m of feet (T, 2) in the middle half of their full swings."""
    heights = []
    for foot in range(lowest.shape[1]):
        changes = np.flatnonzero(np.diff(on_ground[:, foot].astype(int)))
        for start, end in itertools.pairwise(changes):
            if not on_ground[start + 1, foot]:
                quarter = (end - start) // 4
                heights.append(lowest[start + 1 + quarter : end + 1 - quarter, foot].min())
    return float(min(heights, default=np.nan))
