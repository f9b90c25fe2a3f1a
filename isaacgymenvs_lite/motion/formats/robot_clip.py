"""Reads the clip file of a robot, whichever of the known forms it has."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

from isaacgymenvs_lite.errors import MotionFileError, listed
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.motion.formats.joint_csv import (
    POSITION,
    ROTATION,
    TIME,
    is_number,
    read_header,
    read_lines,
)
from isaacgymenvs_lite.motion.formats.robot_csv import load_robot_csv
from isaacgymenvs_lite.motion.formats.robot_dictionary import (
    SUFFIXES,
    is_robot_dictionary,
    load_robot_dictionary,
)
from isaacgymenvs_lite.motion.formats.robot_npz import is_robot_npz, load_robot_npz
from isaacgymenvs_lite.motion.joint_clip import UP, JointClip, QuatOrder
from isaacgymenvs_lite.motion.skeleton import SHIPPED_NUM_DOFS, skeleton_for_num_dofs

_log = logging.getLogger(__name__)
PICKLES = tuple(suffix for suffix in SUFFIXES if suffix != ".npy")
_SUFFIXES = (".csv", ".npz", *SUFFIXES)


def looks_like_joint_clip(path: str | Path) -> bool:
    """Return whether a file is read by `read_joint_clip` rather than as a clip of a humanoid.

    A table with our header is one unless its joints are mostly a shipped humanoid's. A damaged
    file is none; its own reader says what is wrong with it.
    """
    path = Path(split_motion(path)[0])
    try:
        if path.suffix == ".npz":
            return is_robot_npz(path)
        if path.suffix != ".csv":
            return is_robot_dictionary(path)
        with reading(path, "table of joint angles"):
            header = read_lines(path)[0][0]
            if is_number(header[0]):
                return True
            names = set(read_header(header, path)[0])
    except MotionFileError:
        return False
    joints = names - {TIME, *POSITION, *ROTATION}
    of_humanoids = {
        name for number in SHIPPED_NUM_DOFS for name in skeleton_for_num_dofs(number).dof_names
    }
    return len(joints & of_humanoids) < len(joints) / 2


def split_motion(name: str | Path) -> tuple[str, str]:
    """Return the file and the motion of `FILE:MOTION`; "" of a name without a motion."""
    for suffix in SUFFIXES:
        file, colon, motion = str(name).partition(f"{suffix}:")
        if colon:
            return file + suffix, motion
    return str(name), ""


def read_joint_clip(
    path: str | Path, fps: float | None = None, quat_order: QuatOrder | None = None
) -> JointClip:
    """Read a file's only clip, or the one in `FILE:MOTION`; see `read_joint_clips`.

    Raises:
        MotionFileError: also for a file of several motions.
    """
    clips = read_joint_clips(path, fps, quat_order=quat_order)
    if len(clips) > 1:
        raise MotionFileError(several_motions(path, [clip.name for clip in clips]))
    return clips[0]


def several_motions(path: str | Path, names: Sequence[str]) -> str:
    """Return what to do with a file that has several motions of these names, as `FILE:MOTION`."""
    short = [name.removeprefix(f"{path}:") for name in names]
    return f"{path}: has {len(names)} motions ({listed(short, 20)}); give one, as {names[0]}"


def read_joint_clips(
    path: str | Path,
    fps: float | None = None,
    joint_names: Sequence[str] | None = None,
    quat_order: QuatOrder | None = None,
    up_b: Sequence[float] = UP,
    root_body: str | None = None,
) -> list[JointClip]:
    """Read a robot's clips by the content of their file; what looks odd is logged as a warning.

    Args:
        path: `.csv`, `.npz`, `.pkl` or `.npy`, see docs/motion_formats.md; `FILE:MOTION` is one of
            several motions in a `.pkl` or `.npy`.
        fps: frames per second of a file that has no rate (a table by default 30, BONES-SEED 120).
        joint_names: of the file's columns, in place of those that it has or implies.
        quat_order: of the file's quaternions; None: as usual for its form, or as its bodies show.
        up_b: (3,) the upward direction in the frame of the robot's root, for the warning about a
            root that lies down.
        root_body: name of the robot's root, which is looked for in a file with names of bodies.

    Raises:
        MotionFileError: the file is missing, hostile, damaged, none of these forms, or not valid.
    """
    file, motion = split_motion(path)
    path = Path(file)
    if path.suffix not in _SUFFIXES:
        raise MotionFileError(
            f"{path}: a robot's clip ends in {', '.join(_SUFFIXES)}, found '{path.suffix}'"
        )
    with reading(path, "clip of a robot"):
        if path.suffix == ".csv":
            clips = [load_robot_csv(path, fps)]
        elif path.suffix == ".npz":
            clips = [load_robot_npz(path, joint_names, root_body)]
        else:
            clips = load_robot_dictionary(path, motion, fps)
        for i, clip in enumerate(clips):
            if joint_names is not None:
                clip = dataclasses.replace(clip, joint_names=tuple(joint_names))
            clip.validate()
            clips[i] = clip if quat_order is None else clip.reread(quat_order)
            for oddity in clips[i].oddities(up_b):
                _log.warning("%s: %s", clip.name, oddity)
        return clips
