"""Cuts a clip in time and changes its frame rate."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import joint_rotations, local_poses, qpos_from_dofs
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations

_TIME_ROUNDING_S = 1e-6


def cut(clip: MotionClip, start_s: float = 0.0, end_s: float | None = None) -> MotionClip:
    """Return the frames between `start_s` and `end_s`, after rounding both times to frames.

    Raises MotionFileError if the times are not in the clip or if fewer than two frames remain.
    """
    end_s = clip.length_s if end_s is None else end_s
    if not 0.0 <= start_s < end_s <= clip.length_s + _TIME_ROUNDING_S:
        raise MotionFileError(
            f"{clip.name}: start_s={start_s:g} end_s={end_s:g} is no part of the clip; "
            f"expected 0 <= start_s < end_s <= {clip.length_s:g}"
        )
    first, last = round(start_s * clip.fps), round(end_s * clip.fps)
    if first == last:
        raise MotionFileError(
            f"{clip.name}: start_s={start_s:g} end_s={end_s:g} leaves one frame of "
            f"{1.0 / clip.fps:g} s, expected at least 2"
        )
    kept = slice(first, last + 1)
    timed = clip.timed_arrays()
    return dataclasses.replace(clip, **{key: values[kept] for key, values in timed.items()})


def resample(clip: MotionClip, fps: float, skeleton: Skeleton | None = None) -> MotionClip:
    """Return the clip at another frame rate by interpolating poses and velocities.

    The first frame is kept. If the clip has joint coordinates, they determine the poses, and
    `skeleton` is required. Raises MotionFileError if fewer than two frames remain.
    """
    num_frames = int(clip.length_s * fps + _TIME_ROUNDING_S) + 1
    if num_frames < 2:
        raise MotionFileError(
            f"{clip.name}: fps={fps:g} leaves one frame of {clip.length_s:g} s, expected at least 2"
        )
    places = np.arange(num_frames) * (clip.fps / fps)
    before = np.minimum(places.astype(int), clip.num_frames - 2)
    share = places - before
    changed = {
        key: _blend(values, before, share)
        for key, values in clip.timed_arrays().items()
        if key != "local_rotation"
    }
    frames = (clip.local_rotation[before], clip.local_rotation[before + 1])
    turns = interpolate_rotations(*frames, share[:, None])
    changed["local_rotation"] = turns.astype(clip.local_rotation.dtype)
    if clip.dof_pos is not None:
        if skeleton is None:
            raise MotionFileError(
                f"{clip.name}: has joint coordinates (dof_pos); pass the skeleton of the clip"
            )
        dofs = _blend_dofs(clip.dof_pos, skeleton, before, share)
        root = changed["root_translation"]
        offsets, turns = local_poses(skeleton, qpos_from_dofs(skeleton, root, turns[:, 0], dofs))
        changed["local_rotation"] = turns.astype(clip.local_rotation.dtype)
        changed["local_translation"] = offsets.astype(clip.local_translation.dtype)
        changed["dof_pos"] = dofs.astype(clip.dof_pos.dtype)
    return dataclasses.replace(clip, fps=float(fps), **changed)


def interpolate_rotations(start: FloatArray, end: FloatArray, share: FloatArray) -> FloatArray:
    """Return rotations (..., 4) xyzw at `share` (...) of the shortest rotation from start to end.

    The result is exact even for nearly equal rotations. In contrast, `rotations.slerp` repeats the
    arithmetic of the original motion library.
    """
    a, b = (torch.from_numpy(np.asarray(turn, dtype=np.float64)) for turn in (start, end))
    way = rotations.quat_log(rotations.quat_mul(rotations.quat_conjugate(a), b))
    angle = torch.from_numpy(np.asarray(share)) * way.norm(dim=-1)
    return rotations.quat_mul(a, rotations.quat_from_angle_axis(angle, way)).numpy()


def _blend_dofs(
    dofs: FloatArray, skeleton: Skeleton, before: npt.NDArray[np.integer], share: FloatArray
) -> FloatArray:
    """Interpolate DOFs (T, D) linearly for hinges, and along shortest rotations for ball joints."""
    blended = _blend(np.asarray(dofs, dtype=np.float64), before, share)
    turns = joint_rotations(skeleton, dofs).numpy()
    turns = interpolate_rotations(turns[before], turns[before + 1], share[:, None])
    vectors = rotations.quat_log(torch.from_numpy(turns)).numpy()
    for group, (start, end) in enumerate(itertools.pairwise(skeleton.dof_offsets)):
        if end - start == 3:
            blended[:, start:end] = vectors[:, group]
    return blended


def _blend(values: FloatArray, before: npt.NDArray[np.integer], share: FloatArray) -> FloatArray:
    """Interpolate values (T, ...) between the rows `before` and their next rows."""
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    blended = values[before] * (1.0 - share) + values[before + 1] * share
    return blended.astype(values.dtype)
