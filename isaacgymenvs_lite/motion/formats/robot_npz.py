"""Robots' clips as archives of arrays (`.npz`), in three forms, which differ in their keys.

- mjlab (mujocolab/mjlab, src/mjlab/scripts/csv_to_npz.py) and whole_body_tracking
  (HybridRobotics/whole_body_tracking, scripts/csv_to_npz.py): fps (one number in a list),
  joint_pos, body_pos_w and body_quat_w of all bodies, the root first, mostly without names. mjlab
  has MuJoCo's order of joints, whole_body_tracking has Isaac Lab's, level by level; the mirrored
  hips of a G1 show which.
- Isaac Lab's humanoid AMP task (isaac-sim/IsaacLab, isaaclab_tasks/direct/humanoid_amp/motions/
  motion_loader.py): fps, dof_names, dof_positions, body_names, body_positions, body_rotations.
- This project's: format, version, fps, root_pos, root_rot xyzw, dof_pos, joint_names.

Quaternions of the first two are wxyz; Isaac Lab 3 writes xyzw. A body that does not move within the
root shows which: only with the right order it stays in its place.

"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.errors import MotionFileError, listed
from isaacgymenvs_lite.motion.formats.files import native_floats, reading
from isaacgymenvs_lite.motion.formats.npz import (
    check_kind,
    check_version,
    one_number,
    opened,
    read_arrays,
    write_arrays,
)
from isaacgymenvs_lite.motion.formats.robot_joints import G1_29, G1_29_BREADTH_FIRST
from isaacgymenvs_lite.motion.joint_clip import QUAT_ORDERS, JointClip, QuatOrder
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.utils import rotations

_log = logging.getLogger(__name__)

_FORMAT = "isaacgymenvs_lite.joint_clip"
_OWN_KEYS = ("fps", "root_pos", "root_rot", "dof_pos")
_TRACKING_KEYS = ("fps", "joint_pos", "body_pos_w", "body_quat_w")
_ISAAC_KEYS = ("fps", "dof_positions", "body_positions", "body_rotations")
JOINT_NAME_KEYS = ("joint_names", "dof_names")
_BODY_NAMES = "body_names"
_FORMS = (_OWN_KEYS, _TRACKING_KEYS, _ISAAC_KEYS)
_EXPECTED = "archive of a robot's clip"
# In single precision, of distances of 0.2 m anywhere within 100 m of the origin.
_SAME_DISTANCE_M = 1e-3
# A body nearer to the root than this does not show how the root is turned; so many frames do.
_MIN_ARM_M, _COMPARED_FRAMES = 0.01, 256


def is_robot_npz(path: str | Path) -> bool:
    """Return whether an archive has the keys of a robot's clip."""
    with reading(path, _EXPECTED), opened(path) as archive:
        return any(set(form) <= set(archive.files) for form in _FORMS)


def load_robot_npz(
    path: str | Path, joint_names: Sequence[str] | None = None, root_body: str | None = None
) -> JointClip:
    """Read an archive in any of the three forms.

    Args:
        path: of the file.
        joint_names: in place of the file's.
        root_body: name of the robot's root, found among the file's body_names. Without it, or
            without names, the first body but MuJoCo's world is the root.

    Raises:
        MotionFileError: the file is damaged or holds something else.
    """
    with reading(path, _EXPECTED):
        arrays = read_arrays(path, {*sum(_FORMS, ()), *JOINT_NAME_KEYS, _BODY_NAMES, "version"})
        form = next((form for form in _FORMS if set(form) <= set(arrays)), None)
        if form is None:
            raise MotionFileError(
                f"{path}: holds {', '.join(sorted(arrays)) or 'no array of a clip'}, expected "
                + " or ".join(", ".join(form) for form in _FORMS)
            )
        for key in form:
            check_kind(arrays[key], key, "fiu", path)
        fps = one_number(arrays["fps"], "fps", path)
        parts = [native_floats(arrays[key]) for key in form[1:]]
        names = None if joint_names is None else tuple(joint_names)
        named = [arrays[key] for key in JOINT_NAME_KEYS if key in arrays]
        if names is None and named:
            check_kind(named[0], "joint_names", "U", path)
            names = tuple(str(name) for name in named[0].ravel())
        if form is _OWN_KEYS:
            check_version(arrays, path)
            position, rotation, dof_pos = parts
            return JointClip(str(path), fps, position, rotation, dof_pos, names)
        dof_pos, body_pos_w, body_quat_w = parts
        shape = body_pos_w.shape[:2]
        if (body_pos_w.shape, body_quat_w.shape) != ((*shape, 3), (*shape, 4)) or 0 in shape:
            raise MotionFileError(
                f"{path}: the bodies' positions and quaternions have shapes {body_pos_w.shape} and "
                f"{body_quat_w.shape}, expected (frames, bodies, 3) and (frames, bodies, 4)"
            )
        order = _root_first(arrays.get(_BODY_NAMES), root_body, body_pos_w, body_quat_w, path)
        body_pos_w, body_quat_w = body_pos_w[:, order], body_quat_w[:, order]
        clip = JointClip(
            str(path),
            fps,
            body_pos_w[:, 0],
            rotations.xyzw_from_wxyz(torch.from_numpy(body_quat_w[:, 0].copy())).numpy(),
            dof_pos,
            names,
            file_quat_order="wxyz",
        )
        if names is None and dof_pos.ndim == 2 and dof_pos.shape[1] == len(G1_29):
            clip = dataclasses.replace(clip, joint_names=_order_of_g1(body_pos_w, path))
        return clip.reread(_quat_order(body_pos_w, body_quat_w))


def _root_first(
    names: npt.NDArray | None,
    root_body: str | None,
    positions: FloatArray,
    quaternions: FloatArray,
    path: str | Path,
) -> list[int]:
    """Return the ids of the bodies with the root first, without MuJoCo's world."""
    bodies = list(range(positions.shape[1]))
    if names is not None and root_body is not None:
        check_kind(names, _BODY_NAMES, "U", path)
        found = [str(name) for name in names.ravel()]
        if len(found) != len(bodies):
            raise MotionFileError(f"{path}: has {len(found)} body_names for {len(bodies)} bodies")
        if root_body in found:
            root = found.index(root_body)
            return [root, *(i for i in bodies if i != root and found[i] != "world")]
        _log.warning(
            "%s: its body_names lack '%s', the root of the robot; its first body is used as the "
            "root (%s)",
            path,
            root_body,
            listed(found),
        )
    is_still = not positions[:, 0].any() and (quaternions[:, 0] == quaternions[0, 0]).all()
    return bodies[1:] if len(bodies) > 1 and is_still else bodies


def _quat_order(body_pos_w: FloatArray, body_quat_w: FloatArray) -> QuatOrder:
    """Return the order of the quaternions (T, B, 4) that the places (T, B, 3) m of bodies show.

    With the right one a body on a joint at its origin has the same place in the root's frame in all
    frames. Where both orders do, or none, it is the usual one.
    """
    sample = slice(None, None, 1 + len(body_pos_w) // _COMPARED_FRAMES)
    arms_w = (body_pos_w[sample, 1:] - body_pos_w[sample, :1]).astype(np.float64)
    arms_w = arms_w[:, np.linalg.norm(arms_w[0], axis=-1) > _MIN_ARM_M]
    root_quat = torch.from_numpy(body_quat_w[sample, :1].astype(np.float64))
    fitting: list[QuatOrder] = []
    for order in QUAT_ORDERS:
        root_rot = rotations.xyzw_from_wxyz(root_quat) if order == "wxyz" else root_quat
        to_root = rotations.quat_conjugate(root_rot).expand(-1, arms_w.shape[1], -1)
        arms = rotations.quat_apply(to_root, torch.from_numpy(arms_w))
        moved_m = (arms - arms[:1]).norm(dim=-1).amax(dim=0)
        if bool((moved_m < _SAME_DISTANCE_M).any()):
            fitting.append(order)
    return fitting[0] if len(fitting) == 1 else "wxyz"


def _order_of_g1(body_pos_w: FloatArray, path: str | Path) -> tuple[str, ...]:
    """Return the names of a G1's joints in the file's order, from its bodies (T, B, 3) m.

    Both hip links are equally far from the pelvis in every pose: bodies 1 and 2 level by level,
    bodies 1 and 7 leg by leg.
    """
    if body_pos_w.shape[1] > 7:
        distance = np.linalg.norm(body_pos_w[:, 1:] - body_pos_w[:, :1], axis=-1)
        level = np.abs(distance[:, 0] - distance[:, 1]).max() < _SAME_DISTANCE_M
        chain = np.abs(distance[:, 0] - distance[:, 6]).max() < _SAME_DISTANCE_M
        if level != chain:
            return G1_29_BREADTH_FIRST if level else G1_29
    raise MotionFileError(
        f"{path}: has 29 joints without names, and its bodies do not show whether they are in "
        "MuJoCo's order or in Isaac Lab's; give joint_names"
    )


def save_robot_npz(path: str | Path, clip: JointClip) -> Path:
    """Write a clip in this project's form; `.npz` is added to `path` where it is missing.

    Raises:
        MotionFileError: the clip is not valid, or the file cannot be written.
    """
    clip.validate()
    arrays = {"root_pos": clip.root_pos, "root_rot": clip.root_rot, "dof_pos": clip.dof_pos}
    if clip.joint_names is not None:
        arrays["joint_names"] = np.array(clip.joint_names)
    return write_arrays(path, _FORMAT, clip.fps, arrays)
