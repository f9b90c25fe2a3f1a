"""Reads clip files of robots in several formats, and writes this project's format.

`formats.joint_csv` reads tables. Files in the other formats contain named arrays, in an archive
(`.npz`) or in a dictionary (`.npy`, or `.pkl` written by pickle or joblib):

- This project: format, version, fps, root_pos, root_rot xyzw, dof_pos, joint_names.
- GMR (YanjieZe/GMR, scripts/bvh_to_robot.py): fps, root_pos, root_rot xyzw, dof_pos.
- PHC (retargeted H1 and G1 motions): fps, root_trans_offset, root_rot xyzw, dof; a file often has
  several named motions.
- MimicKit (xbpeng/MimicKit, mimickit/anim/motion.py): fps, loop_mode, frames (T, 6 + D). A frame
  consists of the root's position and rotation vector and the joint angles.
- mjlab (src/mjlab/scripts/csv_to_npz.py) and HybridRobotics/whole_body_tracking
  (scripts/csv_to_npz.py): fps, joint_pos, body_pos_w and body_quat_w. The first body is the root;
  most files have no names. mjlab's files have MuJoCo's joint order, and files of
  whole_body_tracking have Isaac Lab's joint order.
- Isaac Lab's humanoid AMP task (isaaclab_tasks/direct/humanoid_amp/motions/motion_loader.py): fps,
  dof_names, dof_positions, body_names, body_positions, body_rotations.

Quaternions in the last two formats are wxyz, or xyzw in files of Isaac Lab 3 and later; the order
is deduced from the motion of the bodies. Joints without names are in the order of the robot's MJCF
file.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError, listed
from isaacgymenvs_lite.motion.clip import QUAT_ORDERS, UP, JointClip, QuatOrder
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.motion.formats.joint_csv import (
    G1_29,
    G1_29_BREADTH_FIRST,
    is_robot_csv,
    load_robot_csv,
)
from isaacgymenvs_lite.motion.formats.npz import (
    check_kind,
    check_version,
    one_number,
    opened,
    read_arrays,
    write_arrays,
)
from isaacgymenvs_lite.motion.formats.restricted_pickle import load_object_npy, load_pickle
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.utils import rotations

_log = logging.getLogger(__name__)

PICKLES = (".pkl", ".pickle")
_DICTIONARIES = (*PICKLES, ".npy")
_SUFFIXES = (".csv", ".npz", *_DICTIONARIES)
_FORMAT = "isaacgymenvs_lite.joint_clip"
_EXPECTED = "clip of a robot"
# The names of each array in the different formats; the first name is this project's name.
_POSITION = ("root_pos", "root_trans_offset", "root_trans", "root_translation", "root_position")
_ROTATION = ("root_rot", "root_rotation", "root_quat")
_JOINTS = ("dof_pos", "dof", "joint_pos", "dof_positions", "joint_positions", "joint_angles")
_BODY_POSITION = ("body_pos_w", "body_positions")
_BODY_ROTATION = ("body_quat_w", "body_rotations")
_JOINT_NAMES = ("joint_names", "dof_names")
_BODY_NAMES, _FRAMES, _FPS = "body_names", "frames", "fps"
_KEYS = (
    *(*_POSITION, *_ROTATION, *_JOINTS, *_BODY_POSITION, *_BODY_ROTATION, *_JOINT_NAMES),
    *(_BODY_NAMES, _FRAMES, _FPS, "version"),
)
_FORMS = (
    "fps and: root_pos, root_rot, dof_pos (GMR); root_trans_offset, root_rot, dof (PHC); frames "
    "(MimicKit); joint_pos, body_pos_w, body_quat_w (mjlab); or dof_positions, body_positions, "
    "body_rotations (Isaac Lab); or a dictionary of these by motion"
)
# Tolerance for equal distances, which single precision needs up to 100 m from the origin.
_SAME_DISTANCE_M = 1e-3
# Least distance from the root of bodies that are used to deduce the quaternion order.
_MIN_ARM_M = 0.01
_COMPARED_FRAMES = 256


def looks_like_joint_clip(path: str | Path) -> bool:
    """Return whether a file is a clip of a robot, so that `read_joint_clip` can read it.

    The result is False for a damaged file; the reader of humanoid clips then raises the error.
    """
    path = Path(split_motion(path)[0])
    try:
        with reading(path, _EXPECTED):
            if path.suffix == ".csv":
                return is_robot_csv(path)
            if path.suffix == ".npz":
                with opened(path) as archive:
                    return _is_clip(dict.fromkeys(archive.files))
            if path.suffix == ".npy":
                data = load_object_npy(path)
                return isinstance(data, dict) and not {"__name__", "skeleton_tree"} & data.keys()
    except MotionFileError:
        return False
    return path.suffix in PICKLES


def split_motion(name: str | Path) -> tuple[str, str]:
    """Split `FILE:MOTION` into file and motion, which is "" if the argument contains no motion."""
    for suffix in _DICTIONARIES:
        file, colon, motion = str(name).partition(f"{suffix}:")
        if colon:
            return file + suffix, motion
    return str(name), ""


def read_joint_clip(
    path: str | Path, fps: float | None = None, quat_order: QuatOrder | None = None
) -> JointClip:
    """Read the only clip of a file, or the clip `FILE:MOTION`; see `read_joint_clips`."""
    clips = read_joint_clips(path, fps, quat_order)
    if len(clips) > 1:
        raise MotionFileError(several_motions(path, [clip.name for clip in clips]))
    return clips[0]


def several_motions(path: str | Path, names: Sequence[str]) -> str:
    """Return the error message for a file with several motions, `names` (`FILE:MOTION`)."""
    short = [name.removeprefix(f"{path}:") for name in names]
    return f"{path}: has {len(names)} motions ({listed(short, 20)}); give one, as {names[0]}"


def read_joint_clips(
    path: str | Path,
    fps: float | None = None,
    quat_order: QuatOrder | None = None,
    up_b: Sequence[float] = UP,
    root_body: str | None = None,
) -> list[JointClip]:
    """Read all clips in a file of a robot; implausible values are logged as warnings.

    Args:
        path: a `.csv`, `.npz`, `.pkl` or `.npy` file, see docs/motion_formats.md. `FILE:MOTION`
            selects one of several motions in a `.pkl` or `.npy` file.
        fps: frames per second if the file has no frame rate. The default is 30 for tables, and 120
            for tables of BONES-SEED.
        quat_order: order of quaternions in the file. None selects the default of the format, or the
            order that is deduced from the bodies.
        up_b: (3,) the root's up axis in the root's frame. A warning is logged if the root seems to
            lie on its side or upside down.
        root_body: name of the robot's root in a file with body names. In other files, the root is
            the first body that is not MuJoCo's world.

    Raises:
        MotionFileError: the file is missing, damaged, not valid, or has an unknown format.
    """
    file, motion = split_motion(path)
    path = Path(file)
    if path.suffix not in _SUFFIXES:
        raise MotionFileError(
            f"{path}: a robot's clip ends in {', '.join(_SUFFIXES)}, found '{path.suffix}'"
        )
    with reading(path, _EXPECTED):
        if path.suffix == ".csv":
            clips = [load_robot_csv(path, fps)]
        else:
            clips = [
                _clip(content, f"{path}:{name}" if name else str(path), fps, root_body)
                for name, content in _motions(path, motion).items()
            ]
        for i, clip in enumerate(clips):
            clip.validate()
            clips[i] = clip if quat_order is None else clip.reread(quat_order)
            for oddity in clips[i].oddities(up_b):
                _log.warning("%s: %s", clip.name, oddity)
        return clips


def _motions(path: Path, motion: str) -> dict[str, Mapping[str, Any]]:
    """Return a dictionary from names to motions, with one motion if `motion` is not "".

    If a file has only one motion, the motion's name is "".
    """
    if path.suffix == ".npz":
        data: Any = read_arrays(path, _KEYS)
        if _POSITION[0] in data:
            check_version(data, path)
    else:
        data = load_object_npy(path) if path.suffix == ".npy" else load_pickle(path, _EXPECTED)
    if _is_clip(data):
        motions = {"": data}
    elif isinstance(data, dict) and data and all(map(_is_clip, data.values())):
        motions = {str(name): content for name, content in data.items()}
    else:
        inner = next(iter(data.values()), None) if isinstance(data, dict) else None
        content = inner if isinstance(inner, dict) else data
        keys = listed([str(key) for key in content], 20) if isinstance(content, dict) else ""
        raise MotionFileError(
            f"{path}: holds {keys or type(data).__name__}, expected the keys {_FORMS}"
        )
    if motion and motion not in motions:
        names = listed([name for name in motions if name], 20)
        raise MotionFileError(f"{path}: has no motion '{motion}'; it has {names or 'one clip'}")
    return {name: content for name, content in motions.items() if motion in ("", name)}


def _is_clip(data: Any) -> bool:
    if not isinstance(data, dict):
        return False

    def has(*parts: Sequence[str]) -> bool:
        return all(any(key in data for key in part) for part in parts)

    of_root, of_bodies = has(_POSITION, _ROTATION), has(_BODY_POSITION, _BODY_ROTATION)
    return (has(_JOINTS) and (of_root or of_bodies)) or {_FRAMES, _FPS} <= data.keys()


def _clip(
    data: Mapping[str, Any], name: str, fps: float | None, root_body: str | None
) -> JointClip:
    fps = one_number(np.asarray(data[_FPS]), _FPS, name) if _FPS in data else fps
    if fps is None:
        raise MotionFileError(f"{name}: has no fps; give file_fps=, the frames per second")
    names: tuple[str, ...] | None = None
    given = next((data[key] for key in _JOINT_NAMES if key in data), None)
    if given is not None:
        check_kind(np.asarray(given), "joint_names", "U", name)
        names = tuple(str(joint) for joint in np.ravel(given))

    def part(keys: Sequence[str], content: Mapping[str, Any] = data) -> FloatArray:
        key = next(key for key in keys if key in content)
        value = np.asarray(content[key])
        check_kind(value, key, "fiu", name)
        return value.astype(np.float64)

    if not any(key in data for key in _JOINTS):  # MimicKit's format
        frames = part([_FRAMES])
        if frames.ndim != 2 or frames.shape[1] < 7:
            raise MotionFileError(
                f"{name}: frames has shape {frames.shape}, expected (frames, 6 + joints)"
            )
        position, exp_map, dof_pos = np.split(frames, (3, 6), axis=1)
        turns = torch.from_numpy(np.ascontiguousarray(exp_map))
        rotation = rotations.exp_map_to_quat(turns, keep_long=True).numpy()
        return JointClip(name, fps, position, rotation, dof_pos, names, file_quat_order=None)
    angles = next(data[key] for key in _JOINTS if key in data)
    if isinstance(angles, dict) and angles:  # The keys are joint names.
        names = tuple(map(str, angles))
        dof_pos = np.stack([part([key], angles).ravel() for key in angles], axis=-1)
    else:
        dof_pos = part(_JOINTS)
    if dof_pos.ndim == 3 and dof_pos.shape[2] == 1:
        dof_pos = dof_pos[..., 0]
    if any(key in data for key in _POSITION):
        return JointClip(name, fps, part(_POSITION), part(_ROTATION), dof_pos, names)
    body_pos_w, body_quat_w = part(_BODY_POSITION), part(_BODY_ROTATION)
    shape = body_pos_w.shape[:2]
    if (body_pos_w.shape, body_quat_w.shape) != ((*shape, 3), (*shape, 4)) or 0 in shape:
        raise MotionFileError(
            f"{name}: the bodies' positions and quaternions have shapes {body_pos_w.shape} and "
            f"{body_quat_w.shape}, expected (frames, bodies, 3) and (frames, bodies, 4)"
        )
    order = _root_first(data.get(_BODY_NAMES), root_body, body_pos_w, body_quat_w, name)
    body_pos_w, body_quat_w = body_pos_w[:, order], body_quat_w[:, order]
    turns = rotations.xyzw_from_wxyz(torch.from_numpy(body_quat_w[:, 0].copy())).numpy()
    if names is None and dof_pos.ndim == 2 and dof_pos.shape[1] == len(G1_29):
        names = _order_of_g1(body_pos_w, name)
    clip = JointClip(name, fps, body_pos_w[:, 0], turns, dof_pos, names, file_quat_order="wxyz")
    return clip.reread(_quat_order(body_pos_w, body_quat_w))


def _root_first(
    names: Any | None,
    root_body: str | None,
    positions: FloatArray,
    quaternions: FloatArray,
    clip_name: str,
) -> list[int]:
    """Return the body ids without MuJoCo's world; the first id is the root's."""
    bodies = list(range(positions.shape[1]))
    if names is not None and root_body is not None:
        check_kind(np.asarray(names), _BODY_NAMES, "U", clip_name)
        found = [str(name) for name in np.ravel(names)]
        if len(found) != len(bodies):
            raise MotionFileError(
                f"{clip_name}: has {len(found)} body_names for {len(bodies)} bodies"
            )
        if root_body in found:
            root = found.index(root_body)
            return [root, *(i for i in bodies if i != root and found[i] != "world")]
        _log.warning(
            "%s: its body_names lack '%s', the root of the robot; its first body is used as the "
            "root (%s)",
            clip_name,
            root_body,
            listed(found),
        )
    is_still = not positions[:, 0].any() and (quaternions[:, 0] == quaternions[0, 0]).all()
    return bodies[1:] if len(bodies) > 1 and is_still else bodies


def _quat_order(body_pos_w: FloatArray, body_quat_w: FloatArray) -> QuatOrder:
    """Return the order of body quaternions (T, B, 4), deduced from body positions (T, B, 3) m.

    With the right order, a body that a hinge at its origin attaches to the root keeps its position
    in the root's frame. If the positions do not determine the order, wxyz is returned.
    """
    sample = slice(None, None, 1 + len(body_pos_w) // _COMPARED_FRAMES)
    arms_w = body_pos_w[sample, 1:] - body_pos_w[sample, :1]
    arms_w = arms_w[:, np.linalg.norm(arms_w[0], axis=-1) > _MIN_ARM_M]
    root_quat = torch.from_numpy(body_quat_w[sample, :1].copy())
    fitting: list[QuatOrder] = []
    for order in QUAT_ORDERS:
        root_rot = rotations.xyzw_from_wxyz(root_quat) if order == "wxyz" else root_quat
        to_root = rotations.quat_conjugate(root_rot).expand(-1, arms_w.shape[1], -1)
        arms = rotations.quat_apply(to_root, torch.from_numpy(arms_w))
        moved_m = (arms - arms[:1]).norm(dim=-1).amax(dim=0)
        if bool((moved_m < _SAME_DISTANCE_M).any()):
            fitting.append(order)
    return fitting[0] if len(fitting) == 1 else "wxyz"


def _order_of_g1(body_pos_w: FloatArray, name: str) -> tuple[str, ...]:
    """Return the joint names of a G1 in the file's order, deduced from positions (T, B, 3) m.

    The two hip links are equally far from the pelvis. In breadth-first order they are bodies 1 and
    2, and in depth-first order bodies 1 and 7.
    """
    if body_pos_w.shape[1] > 7:
        distance = np.linalg.norm(body_pos_w[:, 1:] - body_pos_w[:, :1], axis=-1)
        level = np.abs(distance[:, 0] - distance[:, 1]).max() < _SAME_DISTANCE_M
        chain = np.abs(distance[:, 0] - distance[:, 6]).max() < _SAME_DISTANCE_M
        if level != chain:
            return G1_29_BREADTH_FIRST if level else G1_29
    raise MotionFileError(
        f"{name}: has 29 joints without names, and its bodies do not show whether they are in "
        "MuJoCo's order or in Isaac Lab's; add joint_names to the file"
    )


def save_robot_npz(path: str | Path, clip: JointClip) -> Path:
    """Write a clip in this project's format; `.npz` is added if `path` has another suffix."""
    clip.validate()
    arrays = {"root_pos": clip.root_pos, "root_rot": clip.root_rot, "dof_pos": clip.dof_pos}
    if clip.joint_names is not None:
        arrays["joint_names"] = np.array(clip.joint_names)
    return write_arrays(path, _FORMAT, clip.fps, arrays)
