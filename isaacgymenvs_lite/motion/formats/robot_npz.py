"""Robots' clips as archives of arrays (`.npz`), in three forms, which differ in their keys.

- mjlab (mujocolab/mjlab, src/mjlab/scripts/csv_to_npz.py) and whole_body_tracking
  (HybridRobotics/whole_body_tracking, scripts/csv_to_npz.py): fps, joint_pos, body_pos_w,
  body_quat_w wxyz, without names. mjlab has MuJoCo's order of joints, whole_body_tracking has
  Isaac Lab's, level by level; the mirrored hips of a G1 show which.
- Isaac Lab's humanoid AMP task (motion_loader.py): fps, dof_names, dof_positions, body_names,
  body_positions, body_rotations wxyz.
- This project's: format, version, fps, root_pos, root_rot xyzw, dof_pos, joint_names.

mjlab's script was read. The layouts of whole_body_tracking and of Isaac Lab's task were written
from memory and were not compared with a file.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.formats.files import native_floats, reading, written_clip
from isaacgymenvs_lite.motion.formats.npz import array_names, check_kind, read_arrays
from isaacgymenvs_lite.motion.formats.robot_joints import G1_29, G1_29_BREADTH_FIRST
from isaacgymenvs_lite.motion.joint_clip import JointClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.utils import rotations

_FORMAT = "isaacgymenvs_lite.joint_clip"
_VERSION = 1
_OWN_KEYS = ("fps", "root_pos", "root_rot", "dof_pos")
_TRACKING_KEYS = ("fps", "joint_pos", "body_pos_w", "body_quat_w")
_ISAAC_KEYS = ("fps", "dof_positions", "body_positions", "body_rotations")
_NAME_KEYS = ("joint_names", "dof_names")
_FORMS = (_OWN_KEYS, _TRACKING_KEYS, _ISAAC_KEYS)
_EXPECTED = "archive of a robot's clip"
# In single precision, of distances of 0.2 m anywhere within 100 m of the origin.
_SAME_DISTANCE_M = 1e-3


def is_robot_npz(path: str | Path) -> bool:
    """Return whether an archive has the keys of a robot's clip."""
    with reading(path, _EXPECTED):
        found = array_names(path)
    return any(found.issuperset(form) for form in _FORMS)


def load_robot_npz(path: str | Path, joint_names: Sequence[str] | None = None) -> JointClip:
    """Read an archive in any of the three forms; `joint_names` replaces the file's names.

    Raises:
        MotionFileError: the file is damaged, too large, or holds something else.
    """
    with reading(path, _EXPECTED):
        keys = {key for form in _FORMS for key in form}
        arrays = read_arrays(path, (*sorted(keys), *_NAME_KEYS, "version"))
        form = next((form for form in _FORMS if set(form) <= set(arrays)), None)
        if form is None:
            raise MotionFileError(
                f"{path}: holds {', '.join(sorted(arrays)) or 'no array of a clip'}, expected "
                + " or ".join(", ".join(form) for form in _FORMS)
            )
        for key in form:
            check_kind(arrays[key], key, "fiu", path)
        fps, *parts = (arrays[key] for key in form)
        if fps.size != 1:
            raise MotionFileError(f"{path}: fps has shape {fps.shape}, expected one number")
        names = _names(arrays, path) if joint_names is None else tuple(joint_names)
        if form is _OWN_KEYS:
            _check_version(arrays, path)
            position, rotation, dof_pos = map(native_floats, parts)
        else:
            dof_pos, body_pos_w, body_quat_w = parts
            body_pos_w, body_quat_w = _without_world(body_pos_w, body_quat_w, path)
            position = native_floats(body_pos_w[:, 0])
            quaternions = np.ascontiguousarray(native_floats(body_quat_w[:, 0]))
            rotation = rotations.xyzw_from_wxyz(torch.from_numpy(quaternions)).numpy()
            dof_pos = native_floats(dof_pos)
            if names is None and dof_pos.ndim == 2 and dof_pos.shape[1] == len(G1_29):
                names = _order_of_g1(native_floats(body_pos_w), path)
        return JointClip(str(path), float(fps.item()), position, rotation, dof_pos, names)


def _names(arrays: dict[str, npt.NDArray], path: str | Path) -> tuple[str, ...] | None:
    for key in _NAME_KEYS:
        if key in arrays:
            check_kind(arrays[key], key, "U", path)
            return tuple(str(name) for name in arrays[key].ravel())
    return None


def _check_version(arrays: dict[str, npt.NDArray], path: str | Path) -> None:
    version = arrays.get("version", np.array(_VERSION))
    if version.size != 1 or version.item() != _VERSION:
        raise MotionFileError(
            f"{path}: is a robot's clip of another format version, this program reads {_VERSION}"
        )


def _without_world(
    positions: npt.NDArray, quaternions: npt.NDArray, path: str | Path
) -> tuple[npt.NDArray, npt.NDArray]:
    """Return the poses without MuJoCo's world body, which some converters write first."""
    if positions.ndim != 3 or quaternions.ndim != 3 or not positions.shape[1]:
        raise MotionFileError(
            f"{path}: the bodies' positions and quaternions have shapes {positions.shape} and "
            f"{quaternions.shape}, expected (frames, bodies, 3) and (frames, bodies, 4)"
        )
    if positions.shape[1] > 1 and not positions[:, 0].any() and not quaternions[:, 0, 1:].any():
        return positions[:, 1:], quaternions[:, 1:]
    return positions, quaternions


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
    path = Path(path)
    if path.suffix != ".npz":
        path = path.with_name(path.name + ".npz")
    names: dict[str, Any] = (
        {} if clip.joint_names is None else {"joint_names": np.array(clip.joint_names)}
    )
    with written_clip(path) as partial, partial.open("wb") as stream:
        np.savez_compressed(
            stream,
            format=np.array(_FORMAT),
            version=np.array(_VERSION),
            fps=np.array(clip.fps, dtype=np.float64),
            root_pos=clip.root_pos,
            root_rot=clip.root_rot,
            dof_pos=clip.dof_pos,
            **names,
        )
    return path
