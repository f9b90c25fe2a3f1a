"""Writes clips in DeepMimic's text format (JSON); `deepmimic` describes and reads it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats import deepmimic as layout
from isaacgymenvs_lite.motion.formats.writing import written_clip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.utils import rotations

_DECIMALS = 9  # nanometres and nanoradians


def save_deepmimic(path: str | Path, clip: MotionClip) -> Path:
    """Write a clip of the humanoid, with `Loop` "none"; returns the path.

    Hands, sword and shield have no place in the format, nor have velocities and limb lengths.

    Raises:
        MotionFileError: the clip is not valid or lacks joints of DeepMimic's, or the file cannot be
            written.
    """
    clip.validate()
    path = Path(path)
    text = json.dumps({"Loop": "none", "Frames": _rows(clip).round(_DECIMALS).tolist()})
    with written_clip(path) as partial:
        partial.write_text(text + "\n", encoding="utf-8")
    return path


def _rows(clip: MotionClip) -> FloatArray:
    """Return the frames (T, 44)."""
    missing = [body for body in layout.MOVED_BODIES if body not in clip.body_names]
    if missing:
        raise MotionFileError(f"{clip.name}: has no {', '.join(missing)}, which DeepMimic moves")
    rows = np.zeros((clip.num_frames, layout.NUM_COLUMNS))
    rows[:-1, layout.DURATION] = 1.0 / clip.fps  # nothing comes after the last frame: 0 s
    rows[:, layout.ROOT_POSITION] = _vector(np.asarray(clip.root_translation, dtype=np.float64))
    turns = np.asarray(clip.local_rotation, dtype=np.float64)
    rows[:, layout.ROOT_ROTATION] = _quaternion(turns[:, 0])
    for body, column in layout.BALL_COLUMNS.items():
        rows[:, column : column + 4] = _quaternion(turns[:, clip.body_names.index(body)])
    for body, column in layout.HINGE_COLUMNS.items():
        turn = torch.from_numpy(turns[:, clip.body_names.index(body)])
        # DeepMimic's hinge turns about our -y.
        rows[:, column] = -rotations.quat_log(turn)[:, 1].numpy()
    return rows


def _vector(xyz: FloatArray) -> FloatArray:
    """Turn vectors (T, 3) from z up to y up: (x, y, z) -> (x, z, -y)."""
    return np.stack((xyz[:, 0], xyz[:, 2], -xyz[:, 1]), axis=-1)


def _quaternion(xyzw: FloatArray) -> FloatArray:
    """Turn quaternions (T, 4) x y z w, z up, into w x y z, y up."""
    turned = np.concatenate((_vector(xyzw[:, :3]), xyzw[:, 3:]), axis=-1)
    return rotations.wxyz_from_xyzw(torch.from_numpy(turned)).numpy()
