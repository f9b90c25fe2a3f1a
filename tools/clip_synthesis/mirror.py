"""Mirrors a humanoid's clip in the plane y = 0, which swaps left and right."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray

# The mirror image keeps rotations about its normal y and reverses rotations about x and z.
_LINEAR = np.array([1.0, -1.0, 1.0])
_ANGULAR = np.array([-1.0, 1.0, -1.0])
_QUATERNION = np.array([-1.0, 1.0, -1.0, 1.0])


def partners(body_names: Sequence[str]) -> list[int]:
    """Return for each body the index of its mirror image, left_x for right_x and vice versa."""
    swap = {"right": "left", "left": "right"}
    images = []
    for name in body_names:
        side, _, part = name.partition("_")
        images.append(f"{swap[side]}_{part}" if side in swap else name)
    return [body_names.index(image) for image in images]


def mirror_rotations(body_names: Sequence[str], rotation: FloatArray) -> FloatArray:
    """Return the mirror image of local or global rotations (..., J, 4) xyzw.

    Left and right body frames must mirror each other.
    """
    return np.asarray(rotation)[..., partners(body_names), :] * _QUATERNION.astype(rotation.dtype)


def mirror_clip(clip: MotionClip, name: str) -> MotionClip:
    """Return the mirror image of a clip under a new name; the clip must have no `dof_pos`."""
    order = partners(clip.body_names)
    linear, angular = (v.astype(clip.root_translation.dtype) for v in (_LINEAR, _ANGULAR))
    return dataclasses.replace(
        clip,
        name=name,
        local_rotation=mirror_rotations(clip.body_names, clip.local_rotation),
        root_translation=clip.root_translation * linear,
        linear_velocity_w=clip.linear_velocity_w[:, order] * linear,
        angular_velocity_w=clip.angular_velocity_w[:, order] * angular,
    )
