"""The mirror image of a clip in the plane y = 0: left becomes right."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.skeleton import Skeleton

# A mirror keeps rotations about y, its normal, and reverses rotations about x and z.
_LINEAR = np.array([1.0, -1.0, 1.0])
_ANGULAR = np.array([-1.0, 1.0, -1.0])
_QUATERNION = np.array([-1.0, 1.0, -1.0, 1.0])
# Cosines of angles between axes, and of halves of those between frames.
_MIRROR_TOLERANCE = 1e-6


def partners(body_names: Sequence[str]) -> list[int]:
    """Return for each body the index of its mirror image: left_x for right_x, itself for others.

    Raises:
        MotionFileError: a body has no mirror image.
    """
    images = [_other_side(name) for name in body_names]
    for name, image in zip(body_names, images, strict=True):
        if image not in body_names:
            raise MotionFileError(
                f"'{name}' has no mirror image '{image}' among {', '.join(body_names)}"
            )
    return [body_names.index(image) for image in images]


def mirror_rotations(body_names: Sequence[str], rotation: FloatArray) -> FloatArray:
    """Return the mirror image of rotations (..., J, 4) xyzw, relative to parents or to the world.

    The bodies' frames must mirror each other, as the humanoid's do.
    """
    return np.asarray(rotation)[..., partners(body_names), :] * _QUATERNION.astype(rotation.dtype)


def mirror_clip(clip: MotionClip, name: str, skeleton: Skeleton | None = None) -> MotionClip:
    """Return the mirror image of a clip, called `name`.

    Args:
        clip: of a body that is its own mirror image.
        name: of the image.
        skeleton: of the clip; needed if it has `dof_pos`.

    Raises:
        MotionFileError: see `partners`; there are joint coordinates, but no skeleton, or one whose
            joints are not each other's mirror images.
    """
    order = partners(clip.body_names)
    linear, angular = (v.astype(clip.root_translation.dtype) for v in (_LINEAR, _ANGULAR))
    changed = {}
    if clip.dof_pos is not None:
        if skeleton is None:
            raise MotionFileError(
                f"{clip.name}: has joint coordinates (dof_pos); pass the skeleton of the clip"
            )
        columns, signs = _dof_partners(skeleton, order)
        # Hinges are mirrored about their angles at rest.
        at_rest = np.repeat(skeleton.joint_refs, skeleton.dof_sizes)
        image = at_rest + signs * (clip.dof_pos - at_rest)[:, columns]
        changed["dof_pos"] = image.astype(clip.dof_pos.dtype)
    if np.ndim(clip.local_translation) == 3:
        offsets = clip.local_translation[:, order]
        changed["local_translation"] = offsets * _LINEAR.astype(offsets.dtype)
    return dataclasses.replace(
        clip,
        **changed,
        name=name,
        local_rotation=mirror_rotations(clip.body_names, clip.local_rotation),
        root_translation=clip.root_translation * linear,
        linear_velocity_w=clip.linear_velocity_w[:, order] * linear,
        angular_velocity_w=clip.angular_velocity_w[:, order] * angular,
    )


def _dof_partners(
    skeleton: Skeleton, order: Sequence[int]
) -> tuple[list[int], npt.NDArray[np.float64]]:
    """Return which DOF (D) each DOF of the mirror image has, and the sign (D,) of its value.

    The axis of a hinge has the mirror image of a rotation vector, or its opposite.
    """
    rest = np.abs((skeleton.rest_rotation[order] * _QUATERNION * skeleton.rest_rotation).sum(-1))
    ids = skeleton.dof_body_ids
    columns, signs = [0] * skeleton.num_dofs, np.ones(skeleton.num_dofs)
    for group, body in enumerate(ids):
        place = group - ids.index(body)
        partner = ids.index(order[body]) + place if order[body] in ids else group
        start, end = skeleton.dof_offsets[group : group + 2]
        first, last = skeleton.dof_offsets[partner : partner + 2]
        image = skeleton.joint_axes[partner] * _ANGULAR
        cosine = float(image @ skeleton.joint_axes[group])
        is_mirrored = last - first == end - start and ids[partner] == order[body]
        is_mirrored = is_mirrored and rest[body] > 1.0 - _MIRROR_TOLERANCE
        if not is_mirrored or (end - start == 1 and abs(cosine) < 1.0 - _MIRROR_TOLERANCE):
            raise MotionFileError(
                f"joint '{skeleton.dof_names[start]}' has no joint as its mirror image: the frames"
                f" of '{skeleton.body_names[body]}' and '{skeleton.body_names[order[body]]}' or"
                " their axes are not mirrored in the plane y = 0"
            )
        columns[start:end] = range(first, last)
        signs[start:end] = _ANGULAR if end - start == 3 else np.sign(cosine)
    return columns, signs


def _other_side(name: str) -> str:
    swap = {"right": "left", "left": "right"}
    side, _, part = name.partition("_")
    return f"{swap[side]}_{part}" if side in swap else name
