"""Makes a motion clip of the data of a move."""

from __future__ import annotations

import mujoco
import numpy as np

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import poses_from_qpos, qpos_from_poses
from isaacgymenvs_lite.motion.skeleton import Skeleton
from tools.clip_synthesis import dynamics
from tools.clip_synthesis.assemble import clip_from_poses, foot_frames
from tools.clip_synthesis.generate import MODEL
from tools.clip_synthesis.leg import Leg
from tools.clip_synthesis.moves.contacts import SIDES
from tools.clip_synthesis.moves.move import Move
from tools.clip_synthesis.moves.plan import MovePlan
from tools.clip_synthesis.moves.posture import target_rotations
from tools.clip_synthesis.posture import set_leg
from tools.clip_synthesis.solve import PoseSolver

FPS = 30
_PASSES = 4
_PAD = 6  # additional frames at both ends for differences and smoothing


def generate_move(move: Move) -> MotionClip:
    """Make the clip of a move; it starts with the root at x = y = 0.

    Raises:
        MissingPackageError: mink is not installed.
        ValueError: a foot is out of reach.
    """
    skeleton = Skeleton.from_mjcf(paths.assets_dir() / MODEL)
    root, local = poses_from_qpos(skeleton, solve_move(move, skeleton))
    root = root - root[_PAD] * (1.0, 1.0, 0.0)
    return clip_from_poses(move.name, FPS, skeleton, root, local, _PAD)


def solve_move(move: Move, skeleton: Skeleton) -> FloatArray:
    """Return the poses qpos (T + 2 pad, nq) of a move's clip with its additional frames."""
    model = mujoco.MjModel.from_xml_path(str(paths.assets_dir() / MODEL))
    plan = MovePlan.of(move, Leg.from_skeleton(skeleton))
    first, last = (round(time * FPS) for time in move.window_s)
    times_s = np.arange(first - _PAD, last + _PAD + 1) / FPS
    feet = [track.poses(times_s) for track in plan.tracks]
    frames = [foot_frames(foot[:, :3], foot[:, 3], foot[:, 4]) for foot in feet]
    posture = target_rotations(move.carriage, skeleton, plan.tracks, plan.path, times_s)
    solver = PoseSolver(model, tuple(f"{name}_foot" for name, _ in SIDES))
    poses = qpos_from_poses(skeleton, np.zeros((len(times_s), 3)), posture)
    shift = np.zeros((len(times_s), 2))
    # The poses depend on the planned hips, and the hips depend on the poses.
    for _ in range(_PASSES):
        com, hips = dynamics.com_and_hips(model, poses)
        offset = hips - com[:, None]
        planned = plan.com(*(_resample(x, times_s, plan.times_s) for x in (offset, shift)))
        com = _resample(planned, plan.times_s, times_s)
        for i, (name, _) in enumerate(SIDES):
            aim_leg(posture, skeleton, name, plan.leg, com + offset[:, i], feet[i])
        targets = qpos_from_poses(skeleton, com, posture)
        rows = zip(targets, com, *frames, strict=True)
        poses = np.stack([solver.solve(row, place, [*ends]) for row, place, *ends in rows])
        shift = _momentum_shift(model, poses)
    return poses


def aim_leg(
    posture: FloatArray,
    skeleton: Skeleton,
    side: str,
    leg: Leg,
    hip: FloatArray,
    foot: FloatArray,
) -> None:
    """Write the rotations of a leg between hip (n, 3) and foot (n, 5) into `posture` (n, J, 4)."""
    offset, yaw = foot[:, :3] - hip, foot[:, 3]
    ahead = offset[:, 0] * np.cos(yaw) + offset[:, 1] * np.sin(yaw)
    beside = offset[:, 1] * np.cos(yaw) - offset[:, 0] * np.sin(yaw)
    thigh, knee = leg.angles(ahead, np.hypot(beside, offset[:, 2]))
    set_leg(posture, skeleton, side, (thigh, knee, foot[:, 4]), yaw)


def _momentum_shift(model: mujoco.MjModel, poses: FloatArray) -> FloatArray:
    """Return (L_y', -L_x') / m as (n, 2) for poses (n, nq); see `plan_com`."""
    moment = dynamics.moments(model, poses, FPS)
    kernel = np.array([0.25, 0.5, 0.25])
    smooth = np.stack(
        [np.convolve(np.pad(axis, 1, mode="edge"), kernel, mode="valid") for axis in moment.T]
    )
    return np.stack((smooth[1], -smooth[0]), axis=-1) / float(model.body_subtreemass[1])


def _resample(values: FloatArray, from_s: FloatArray, to_s: FloatArray) -> FloatArray:
    """Interpolate values (m, ...) at times (m) to other times (n); constant outside."""
    columns = [np.interp(to_s, from_s, column) for column in values.reshape(len(values), -1).T]
    return np.stack(columns, axis=-1).reshape(len(to_s), *values.shape[1:])
