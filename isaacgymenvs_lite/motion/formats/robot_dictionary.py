"""Robots' clips as dictionaries (`.pkl`, `.npy`), read without running anything from the file.

`.pkl` is plain pickle's or joblib's, `.npy` is numpy.save's of one dictionary. Forms:

- GMR (YanjieZe/GMR, scripts/bvh_to_robot.py): fps, root_pos, root_rot xyzw, dof_pos; the keys
  local_body_pos and link_body_list are not used.
- PHC and what follows it (retargeted H1 and G1 motions): fps, root_trans_offset, root_rot xyzw,
  dof, mostly several motions by name; pose_aa is not used.
- MimicKit (xbpeng/MimicKit, mimickit/anim/motion.py and motion_lib.py): fps, loop_mode, frames
  (T, 6 + D) of root position, root rotation as a rotation vector, and joints. Its first versions
  pickled an object of a class, which is refused.

Joints are in the order of the robot's MJCF file, or as joint_names or dof_names says.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError, listed
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.motion.formats.npz import check_kind, one_number
from isaacgymenvs_lite.motion.formats.restricted_pickle import load_object_npy, load_pickle
from isaacgymenvs_lite.motion.joint_clip import JointClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.utils import rotations

SUFFIXES = (".pkl", ".pickle", ".npy")
_EXPECTED = "dictionary of a robot's clip (GMR's, PHC's or MimicKit's)"
# The names of each part, the first ones are GMR's.
_POSITION = ("root_pos", "root_trans_offset", "root_trans", "root_translation", "root_position")
_ROTATION = ("root_rot", "root_rotation", "root_quat")
_JOINTS = ("dof_pos", "dof", "joint_pos", "dof_positions", "joint_positions", "joint_angles")
_JOINT_NAMES = ("joint_names", "dof_names")
_FRAMES, _FPS = "frames", "fps"


def is_robot_dictionary(path: Path) -> bool:
    """Return whether a file is read by `load_robot_dictionary`, not as a clip of poselib.

    Raises:
        MotionFileError: the file is damaged or unsafe.
    """
    if path.suffix != ".npy":
        return path.suffix in SUFFIXES
    data = load_object_npy(path)
    return isinstance(data, dict) and not {"__name__", "skeleton_tree"} & data.keys()


def load_robot_dictionary(
    path: str | Path, motion: str = "", fps: float | None = None
) -> list[JointClip]:
    """Read the clips in a file.

    Args:
        path: of the file.
        motion: the name of one, where the file has several by name; "": all.
        fps: frames per second of a clip without a rate.

    Raises:
        MotionFileError: the file would run code, is damaged, holds something else, or
            has no such motion.
    """
    with reading(path, _EXPECTED):
        is_npy = Path(path).suffix == ".npy"
        data = load_object_npy(path) if is_npy else load_pickle(path, _EXPECTED)
        motions = _motions(data, path)
        if motion and motion not in motions:
            names = listed([name for name in motions if name], 20)
            raise MotionFileError(f"{path}: has no motion '{motion}'; it has {names or 'one clip'}")
        return [
            _clip(content, f"{path}:{name}" if name else str(path), fps)
            for name, content in motions.items()
            if motion in ("", name)
        ]


def _motions(data: Any, path: str | Path) -> dict[str, Mapping[str, Any]]:
    """Return the motions by name; "" is the name of a single one."""
    if _is_clip(data):
        return {"": data}
    if isinstance(data, dict) and data and all(map(_is_clip, data.values())):
        return {str(name): content for name, content in data.items()}
    inner = next(iter(data.values()), None) if isinstance(data, dict) else None
    content = inner if isinstance(inner, dict) else data
    found = type(data).__name__
    if isinstance(content, dict) and content:
        found = f"a dictionary of {listed([str(key) for key in content], 20)}"
    raise MotionFileError(
        f"{path}: holds {found}, expected the keys fps, root_pos, root_rot, dof_pos (GMR), fps, "
        "root_trans_offset, root_rot, dof (PHC) or fps, frames (MimicKit), or such dictionaries by "
        "the names of motions"
    )


def _is_clip(data: Any) -> bool:
    if not isinstance(data, dict):
        return False
    has_parts = all(any(key in data for key in part) for part in (_POSITION, _ROTATION, _JOINTS))
    return has_parts or {_FRAMES, _FPS} <= data.keys()


def _clip(data: Mapping[str, Any], name: str, fps: float | None) -> JointClip:
    fps = one_number(np.asarray(data[_FPS]), _FPS, name) if _FPS in data else fps
    if fps is None:
        raise MotionFileError(f"{name}: has no fps; give file_fps=, the frames per second")
    names: tuple[str, ...] | None = None
    given = next((data[key] for key in _JOINT_NAMES if key in data), None)
    if given is not None:
        check_kind(np.asarray(given), "joint_names", "U", name)
        names = tuple(str(joint) for joint in np.ravel(given))
    if not any(key in data for key in _POSITION):  # MimicKit's
        frames = _floats(data, _FRAMES, name)
        if frames.ndim != 2 or frames.shape[1] < 7:
            raise MotionFileError(
                f"{name}: frames has shape {frames.shape}, expected (frames, 6 + joints)"
            )
        position, exp_map, dof_pos = np.split(frames, (3, 6), axis=1)
        turns = torch.from_numpy(np.ascontiguousarray(exp_map))
        rotation = rotations.exp_map_to_quat(turns, keep_long=True).numpy()
        return JointClip(name, fps, position, rotation, dof_pos, names, file_quat_order=None)
    position_key, rotation_key, joints_key = (
        next(key for key in part if key in data) for part in (_POSITION, _ROTATION, _JOINTS)
    )
    position, rotation = _floats(data, position_key, name), _floats(data, rotation_key, name)
    angles = data[joints_key]
    if isinstance(angles, dict) and angles:  # by the names of the joints
        names = tuple(map(str, angles))
        joints = np.stack([_floats(angles, key, name).ravel() for key in angles], axis=-1)
    else:
        joints = _floats(data, joints_key, name)
    if joints.ndim == 3 and joints.shape[2] == 1:
        joints = joints[..., 0]
    return JointClip(name, fps, position, rotation, joints, names)


def _floats(data: Mapping[str, Any], key: str, name: str) -> FloatArray:
    value = np.asarray(data[key])
    check_kind(value, key, "fiu", name)
    return value.astype(np.float64)
