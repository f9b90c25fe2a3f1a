"""Reorders a clip's bodies to match a humanoid, and refuses clips of other skeletons."""

from __future__ import annotations

import dataclasses
import logging
import math

import numpy as np

from isaacgymenvs_lite.errors import MotionFileError, listed
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import rotations_from_dofs, turned_by_joints
from isaacgymenvs_lite.motion.skeleton import Skeleton, shipped_humanoid_with

_log = logging.getLogger(__name__)

# What to do with a clip of a robot, and with one of a humanoid, where the other is expected.
ROBOT_HINT = "a clip of a robot needs task=RobotAMP in training, robot=FILE in the clip commands"
RETARGET_HINT = "retarget it with isaacgymenvs-lite convert IN OUT.npz robot=FILE"
# Offsets in files are rounded to 1e-4 m; beyond this the clip was made for another body.
_OFFSET_TOLERANCE_M = 0.01
# A knee or elbow that turns this far out of its axis (0.6 deg) loses visible motion.
_HINGE_TOLERANCE_RAD = 0.01
# Between frames, coordinates and poses that were interpolated each for itself differ by less.
_DOF_TOLERANCE_RAD = 0.05
# Beyond any recorded person; a clip in centimetres, or one with frames that are missing, is.
_USUAL_PLACE_M, _USUAL_SPEED_M_S, _USUAL_SPEED_RAD_S = 1_000.0, 60.0, 300.0


def fit_to_skeleton(clip: MotionClip, skeleton: Skeleton) -> MotionClip:
    """Return the clip with its bodies in the order of `skeleton`.

    Logs a warning when hinge joints (knees, elbows) rotate about other axes than their own, as that
    part of the motion is dropped, when the clip was made for a body of other dimensions, when joint
    coordinates and poses disagree, and when it is faster, or farther away, than people are.

    Raises:
        MotionFileError: the clip lacks bodies, has others, or connects them in another way; it has
            joint coordinates of another skeleton, or none where rotations do not determine them.
    """
    _refuse_other_bodies(clip, skeleton)
    clip = _reorder(clip, skeleton)
    _warn_of_other_offsets(clip, skeleton)
    if clip.dof_pos is None:
        _warn_of_hinge_violation(clip, skeleton)
    else:
        _check_dofs(clip, clip.dof_pos, skeleton)
    _warn_of_odd_values(clip)
    return clip


def _refuse_other_bodies(clip: MotionClip, skeleton: Skeleton) -> None:
    missing = [name for name in skeleton.body_names if name not in clip.body_names]
    extra = [name for name in clip.body_names if name not in skeleton.body_names]
    if not missing and not extra:
        return
    is_humanoid = shipped_humanoid_with(skeleton.body_names) is not None
    found = [f"lacks {listed(missing)}"] if missing else []
    found += [f"also has {listed(extra)}"] if extra else []
    whose = "humanoid" if is_humanoid else "robot"
    bodies = ", ".join(skeleton.body_names) if is_humanoid else listed(skeleton.body_names)
    other = shipped_humanoid_with(clip.body_names)
    if other:
        use = f"use task.env.asset.assetFileName={other} or another clip"
        advice = f"it is a clip of {other}: {use if is_humanoid else RETARGET_HINT}"
    else:
        is_robots = is_humanoid and clip.dof_pos is not None
        advice = ROBOT_HINT if is_robots else f"use a clip of this {whose}"
    raise MotionFileError(
        f"{clip.name}: its skeleton {' and '.join(found)}; expected the {skeleton.num_bodies} "
        f"bodies of the {whose}: {bodies}; {advice}"
    )


def _reorder(clip: MotionClip, skeleton: Skeleton) -> MotionClip:
    """Sort the bodies by name and check that they are connected as in the skeleton."""
    order = [clip.body_names.index(name) for name in skeleton.body_names]
    for body, name in enumerate(skeleton.body_names):
        parent = _parent_name(clip.body_names, clip.parent_indices[order[body]])
        expected = _parent_name(skeleton.body_names, skeleton.parent_indices[body])
        if parent != expected:
            raise MotionFileError(
                f"{clip.name}: the parent of '{name}' is {parent}, expected {expected}"
            )
    if order == list(range(skeleton.num_bodies)):
        return clip
    if clip.dof_pos is not None:
        raise MotionFileError(
            f"{clip.name}: its bodies have another order than the model's, so that its joint"
            " coordinates (dof_pos) belong to other joints; expected "
            + ", ".join(skeleton.body_names)
        )
    _log.info("%s: bodies reordered as in the humanoid", clip.name)
    return dataclasses.replace(
        clip,
        body_names=skeleton.body_names,
        parent_indices=skeleton.parent_indices,
        local_translation=clip.local_translation[..., order, :],
        local_rotation=clip.local_rotation[:, order],
        linear_velocity_w=clip.linear_velocity_w[:, order],
        angular_velocity_w=clip.angular_velocity_w[:, order],
    )


def _parent_name(names: tuple[str, ...], parent: int) -> str:
    return "the world" if parent < 0 else f"'{names[parent]}'"


def _warn_of_other_offsets(clip: MotionClip, skeleton: Skeleton) -> None:
    # The root's offset does not count: it is only the position of the character in its file.
    difference = np.linalg.norm(clip.local_translation - skeleton.local_translation, axis=-1)
    # Bodies whose joints are beside their origins move in their parents.
    anchored = np.array(skeleton.dof_body_ids, dtype=int)[skeleton.joint_anchors.any(axis=1)]
    difference[..., anchored] = 0.0
    difference = difference.reshape(-1, skeleton.num_bodies).max(axis=0)[1:]
    if difference.max() > _OFFSET_TOLERANCE_M:
        body = int(difference.argmax()) + 1
        _log.warning(
            "%s: made for a body of other dimensions: the offset of '%s' differs by %.3f m from "
            "the humanoid's; feet may sink or slide",
            clip.name,
            skeleton.body_names[body],
            difference[body - 1],
        )


def _warn_of_odd_values(clip: MotionClip) -> None:
    for what, values, usual, unit in (
        ("the root is", clip.root_translation, _USUAL_PLACE_M, "m from the origin"),
        ("a body moves at", clip.linear_velocity_w, _USUAL_SPEED_M_S, "m/s"),
        ("a body rotates at", clip.angular_velocity_w, _USUAL_SPEED_RAD_S, "rad/s"),
    ):
        largest = float(np.linalg.norm(values, axis=-1).max())
        if largest > usual:
            _log.warning(
                "%s: %s up to %.4g %s; are units and fps right?", clip.name, what, largest, unit
            )


def _warn_of_hinge_violation(clip: MotionClip, skeleton: Skeleton) -> None:
    try:
        turns = turned_by_joints(skeleton, clip.local_rotation).numpy()
    except MotionFileError as error:
        raise MotionFileError(f"{clip.name}: {error}") from error
    groups = [group for group, size in enumerate(skeleton.dof_sizes) if size == 1]
    if not groups:
        return
    hinges = [skeleton.dof_body_ids[group] for group in groups]
    # The part of the quaternion's vector across the axis is the sine of half the angle between the
    # axis and its image.
    off_axis = np.linalg.norm(np.cross(turns[:, hinges, :3], skeleton.joint_axes[groups]), axis=-1)
    frame, hinge = (int(i) for i in np.unravel_index(off_axis.argmax(), off_axis.shape))
    angle_rad = 2.0 * math.asin(min(float(off_axis[frame, hinge]), 1.0))
    if angle_rad > _HINGE_TOLERANCE_RAD:
        _log.warning(
            "%s: '%s' is a hinge about %s but turns %.3f rad out of that axis in frame %d; "
            "that part of the motion is dropped",
            clip.name,
            skeleton.body_names[hinges[hinge]],
            "({:.3g}, {:.3g}, {:.3g})".format(*skeleton.joint_axes[groups[hinge]]),
            angle_rad,
            frame,
        )


def _check_dofs(clip: MotionClip, dofs: FloatArray, skeleton: Skeleton) -> None:
    """Refuse joint coordinates of another number; warn where they give other poses."""
    if dofs.shape[1] != skeleton.num_dofs:
        raise MotionFileError(
            f"{clip.name}: dof_pos has {dofs.shape[1]} columns, expected the {skeleton.num_dofs} "
            f"degrees of freedom of the model: {', '.join(skeleton.dof_names)}"
        )
    turns = rotations_from_dofs(skeleton, clip.local_rotation[:, 0], dofs)
    # |a - b| or |a + b| of unit quaternions is 2 sin(angle / 4), angle from one to the other.
    stored = np.asarray(clip.local_rotation, dtype=np.float64)
    sines = [np.linalg.norm(turns + sign * stored, axis=-1) / 2.0 for sign in (-1.0, 1.0)]
    difference = 4.0 * np.arcsin(np.minimum(*sines).clip(max=1.0))
    frame, body = (int(i) for i in np.unravel_index(difference.argmax(), difference.shape))
    if difference[frame, body] > _DOF_TOLERANCE_RAD:
        _log.warning(
            "%s: joint coordinates (dof_pos) and poses differ by %.3f rad at '%s' in frame %d; "
            "was the clip made for another model?",
            clip.name,
            difference[frame, body],
            skeleton.body_names[body],
            frame,
        )
