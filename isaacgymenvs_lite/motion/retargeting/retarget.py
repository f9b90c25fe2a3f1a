"""Retargets a BVH file to a clip of the humanoid, and logs the remaining errors."""

from __future__ import annotations

import logging
from pathlib import Path

import mujoco
import numpy as np

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.editing import cut, resample
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import dofs_of_clip, poses_from_qpos
from isaacgymenvs_lite.motion.retargeting.bvh import load_bvh
from isaacgymenvs_lite.motion.retargeting.mapping import SkeletonMapping
from isaacgymenvs_lite.motion.retargeting.solve import solve_poses
from isaacgymenvs_lite.motion.retargeting.targets import Targets, make_targets
from isaacgymenvs_lite.motion.skeleton import Skeleton, shipped_humanoid_with

_log = logging.getLogger(__name__)

KEY_BODIES = ("pelvis", "head", "right_hand", "left_hand", "right_foot", "left_foot")
_ON_GROUND_M = 0.01  # a corner of a sole below this height should not move
_AT_LIMIT_RAD = np.radians(0.1)
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
    source = cut(load_bvh(path, mapping.to_z_up, mapping.unit_m), start_s, end_s)
    _warn_of_rest_pose(source)
    if fps is not None:
        source = resample(source, fps)
    targets = make_targets(source, mapping, skeleton)
    model_path = paths.assets_dir() / str(shipped_humanoid_with(skeleton.body_names))
    model = mujoco.MjModel.from_xml_path(str(model_path))
    root, local = poses_from_qpos(skeleton, solve_poses(model, skeleton, targets))
    clip = MotionClip.from_poses(
        str(path),
        source.fps,
        skeleton.body_names,
        skeleton.parent_indices,
        skeleton.local_translation.astype(np.float32),
        local.astype(np.float32),
        root.astype(np.float32),
    )
    _log.info("scaled by %.3f, the length of the legs", targets.scale)
    for line in (*describe_errors(clip, targets), describe_feet(clip, skeleton)):
        _log.info(line)
    _log.info("a joint is at its limit in %.0f %% of the frames", _limited(clip, skeleton) * 100.0)
    return clip


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


def key_body_errors(clip: MotionClip, targets: Targets) -> dict[str, FloatArray]:
    """Return the distances (T,) in m of the key bodies from their targets."""
    distances = np.linalg.norm(clip.global_poses()[0] - targets.positions, axis=-1)
    return {body: distances[:, clip.body_names.index(body)] for body in KEY_BODIES}


def describe_errors(clip: MotionClip, targets: Targets) -> list[str]:
    """Return the errors of the key bodies in m, one line each."""
    return [
        f"{body}: {error.mean():.4f} m from the scaled source on average, {error.max():.4f} at most"
        for body, error in key_body_errors(clip, targets).items()
    ]


def describe_feet(clip: MotionClip, skeleton: Skeleton) -> str:
    """Return one line: the depth of the feet in the ground and their sliding speed on it."""
    corners = skeleton.sole_corners(*clip.global_poses())
    depth = max(0.0, -float(corners[..., 2].min()))
    speed = np.linalg.norm(np.diff(corners[..., :2], axis=0), axis=-1) * clip.fps
    low = corners[..., 2] < _ON_GROUND_M
    sliding = speed[low[1:] & low[:-1]]
    if not sliding.size:
        return f"feet: {depth:.4f} m below the ground at most; they never rest on it"
    return (
        f"feet: {depth:.4f} m below the ground at most; where they touch it they slide at "
        f"{np.median(sliding):.3f} m/s (median)"
    )


def _limited(clip: MotionClip, skeleton: Skeleton) -> float:
    """Return the share of the frames in which a joint has reached a limit."""
    dofs = dofs_of_clip(skeleton, clip)
    lower, upper = skeleton.dof_limits.T
    near = np.minimum(dofs - lower, upper - dofs) < _AT_LIMIT_RAD
    return float(near.any(axis=1).mean())
