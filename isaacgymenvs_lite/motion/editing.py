"""Cuts a clip in time and changes its frame rate."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.utils import rotations

_TIME_ROUNDING_S = 1e-6
# The arrays of a clip with one row per frame.
_TIMED = ("local_rotation", "root_translation", "linear_velocity_w", "angular_velocity_w")


def cut(clip: MotionClip, start_s: float = 0.0, end_s: float | None = None) -> MotionClip:
    """Return the frames from the one nearest to `start_s` to the one nearest to `end_s`.

    Raises:
        MotionFileError: the times are not in the clip, or fewer than two frames remain.
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
    return dataclasses.replace(clip, **{key: getattr(clip, key)[kept] for key in _TIMED})


def resample(clip: MotionClip, fps: float) -> MotionClip:
    """Return the clip at another frame rate, poses and velocities interpolated.

    The first frame is kept; the last one is the last multiple of the new frame time in the clip.
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
        key: _blend(np.asarray(getattr(clip, key)), before, share)
        for key in _TIMED
        if key != "local_rotation"
    }
    turns = interpolate_rotations(
        clip.local_rotation[before], clip.local_rotation[before + 1], share[:, None]
    )
    return dataclasses.replace(
        clip, fps=float(fps), local_rotation=turns.astype(clip.local_rotation.dtype), **changed
    )


def interpolate_rotations(start: FloatArray, end: FloatArray, share: FloatArray) -> FloatArray:
    """Return rotations (..., 4) xyzw at `share` (...) of the shorter way from start to end.

    Exact for nearly equal rotations, unlike `rotations.slerp`, which repeats the original motion
    library's arithmetic.
    """
    a, b = (torch.from_numpy(np.asarray(turn, dtype=np.float64)) for turn in (start, end))
    way = rotations.quat_log(rotations.quat_mul(rotations.quat_conjugate(a), b))
    angle = torch.from_numpy(np.asarray(share)) * way.norm(dim=-1)
    return rotations.quat_mul(a, rotations.quat_from_angle_axis(angle, way)).numpy()


def _blend(values: FloatArray, before: npt.NDArray[np.integer], share: FloatArray) -> FloatArray:
    """Return values (T, ...) interpolated between the rows `before` and the next ones."""
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    blended = values[before] * (1.0 - share) + values[before + 1] * share
    return blended.astype(values.dtype)
