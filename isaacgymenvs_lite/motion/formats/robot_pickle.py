"""Robots' clips as pickled dictionaries (`.pkl`), read without running anything from the file.

- GMR (YanjieZe/GMR, scripts/bvh_to_robot.py): fps, root_pos, root_rot xyzw, dof_pos; the keys
  local_body_pos and link_body_list are not used. Joints are in the order of GMR's MJCF file.
- MimicKit (xbpeng/MimicKit, mimickit/anim/motion.py and motion_lib.py): fps, loop_mode, frames
  (T, 6 + D) of root position, root rotation as a rotation vector, and joints in the order of the
  MJCF file. Its first versions pickled an object of a class, which is refused.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MAX_POSES
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.motion.formats.npz import check_kind
from isaacgymenvs_lite.motion.formats.restricted_pickle import load_pickle
from isaacgymenvs_lite.motion.joint_clip import JointClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.utils import rotations

_EXPECTED = "pickled dictionary of a robot's clip (GMR's or MimicKit's)"
_GMR_KEYS = ("fps", "root_pos", "root_rot", "dof_pos")
_MIMICKIT_KEYS = ("fps", "frames")
# Of an array: joints and the root's numbers.
_MAX_NUMBERS = 2 * MAX_POSES


def load_robot_pickle(path: str | Path) -> JointClip:
    """Read a clip of GMR or MimicKit; its joints have no names.

    Raises:
        MotionFileError: the file would run code, is damaged, too large, or holds something else.
    """
    with reading(path, _EXPECTED):
        data = load_pickle(path, _EXPECTED)
        keys = sorted(map(str, data)) if isinstance(data, dict) else []
        if all(key in keys for key in _GMR_KEYS):
            position, rotation, dof_pos = (_floats(data, key, path) for key in _GMR_KEYS[1:])
            return JointClip(str(path), _fps(data, path), position, rotation, dof_pos)
        if all(key in keys for key in _MIMICKIT_KEYS):
            return _mimickit(data, path)
        found = f"a dictionary of {', '.join(keys) or 'nothing'}" if keys else type(data).__name__
        raise MotionFileError(
            f"{path}: holds {found}, expected the keys {', '.join(_GMR_KEYS)} (GMR) or "
            f"{', '.join(_MIMICKIT_KEYS)} (MimicKit)"
        )


def _mimickit(data: dict[str, Any], path: str | Path) -> JointClip:
    frames = _floats(data, "frames", path)
    if frames.ndim != 2 or frames.shape[1] < 7:
        raise MotionFileError(
            f"{path}: frames has shape {frames.shape}, expected (frames, 6 + joints)"
        )
    position, exp_map, dof_pos = np.split(frames, (3, 6), axis=1)
    turns = torch.from_numpy(np.ascontiguousarray(exp_map))
    rotation = rotations.exp_map_to_quat(turns, keep_long=True).numpy()
    fps = _fps(data, path)
    return JointClip(str(path), fps, position, rotation, dof_pos, file_quat_order=None)


def _floats(data: dict[str, Any], key: str, path: str | Path) -> FloatArray:
    value = data[key]
    if not isinstance(value, np.ndarray):
        # Of a list with texts or dictionaries numpy makes an array that is far larger.
        rows = value if isinstance(value, list) else [value]
        for row in rows:
            items = row if isinstance(row, list) else [row]
            if not all(isinstance(item, (int, float)) for item in items):
                raise MotionFileError(f"{path}: {key} is no array and no list of numbers")
        value = np.asarray(value)
    check_kind(value, key, "fiu", path, _MAX_NUMBERS)
    return value.astype(np.float64)


def _fps(data: dict[str, Any], path: str | Path) -> float:
    fps = _floats(data, "fps", path)
    if fps.size != 1:
        raise MotionFileError(f"{path}: fps has shape {fps.shape}, expected one number")
    return float(fps.item())
