"""Reads and writes clips in DeepMimic's text format (JSON).

A clip is {"Loop": "wrap" or "none", "Frames": rows of 44 values}. A row holds the duration of the
frame (s), the root's position and rotation, and the rotations of 12 joints of the humanoid. The
axes of a file are x forward, y up, z right; the axes of this project are x forward, y left, z up.
Clips with "wrap" are not repeated. The format has no hands; therefore the humanoid's hands keep
their zero pose.
"""

from __future__ import annotations

import importlib.util
import json
import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError, suggest
from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.clip import MAX_PLACE_M, MIN_FPS, MotionClip
from isaacgymenvs_lite.motion.formats.files import read_json, reading, written_clip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.plausibility import is_in_air, put_on_ground
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations

PREFIX = "deepmimic:"
_PACKAGE = "pybullet_data"
# Maps each folder to a pattern of the file names of humanoid clips; other files are clips of a dog.
_PACKAGE_FOLDERS = {"": "humanoid3d_*.txt", "walker": "*.txt"}
_SHORT_FOR = "humanoid3d_"

_KINDS = {
    "walk": ("humanoid3d_walk", "walker/0walk_forward"),
    "turn": tuple(f"walker/turn_{side}{number}" for side in ("left", "right") for number in (0, 1)),
    "run": ("humanoid3d_run",),
    "jump": ("humanoid3d_jump",),
    "crawl": ("humanoid3d_crawl",),
    "get up": ("humanoid3d_getup_facedown", "humanoid3d_getup_faceup"),
    "acrobatics": (
        "humanoid3d_backflip",
        "humanoid3d_cartwheel",
        "humanoid3d_roll",
        "humanoid3d_spin",
    ),
    "strike": ("humanoid3d_kick", "humanoid3d_punch", "humanoid3d_spinkick"),
    "dance": ("humanoid3d_dance_a", "humanoid3d_dance_b"),
}
_KIND_OF = {clip: kind for kind, clips in _KINDS.items() for clip in clips}
# Kinds of movement in the data set `locomotion`, which have a steady speed.
_LOCOMOTION = ("walk", "turn", "run")
_LOCOMOTION_SET, _ALL_SET = "locomotion", "all"


class PackageClip(NamedTuple):
    """A clip of the package, its full name, and its weight in a data set (weights sum to 1)."""

    name: str
    path: Path
    weight: float


def is_package_name(motion_file: str | Path) -> bool:
    """Return whether `motion_file` is the name of a clip or a data set in the package."""
    return str(motion_file).startswith(PREFIX)


def clips_in_package() -> list[str]:
    """Return the full names of all clips in the package, such as `deepmimic:humanoid3d_walk`."""
    return [PREFIX + name for name in _paths_of_clips(PREFIX + _ALL_SET)]


def find_in_package(motion_file: str) -> list[PackageClip]:
    """Return the clip, or all clips of the data set, with the name `deepmimic:<name>`.

    `walk` is short for `humanoid3d_walk`; `walker/turn_left0` is a clip in the folder walker. The
    data set `locomotion` contains walking, turning and running; `all` contains every clip. Each
    kind of movement has the same weight, which is divided equally among the clips of this kind. A
    clip of unknown kind counts as a separate kind.

    Raises:
        MotionFileError: the package is not installed, or contains no clip or data set with this
            name.
    """
    name = motion_file.removeprefix(PREFIX)
    paths = _paths_of_clips(motion_file)
    gaits = [clip for kind in _LOCOMOTION for clip in _KINDS[kind]]
    if name in (_ALL_SET, _LOCOMOTION_SET):
        names = list(paths) if name == _ALL_SET else gaits
        kinds = [_KIND_OF.get(clip, clip) for clip in names]
        missing = [clip for clip in names if clip not in paths]
        if missing:
            raise MotionFileError(
                f"'{motion_file}': the installed {_PACKAGE} lacks {', '.join(missing)}; "
                "pybullet 3.2.7 has all clips"
            )
        return [
            PackageClip(PREFIX + clip, paths[clip], 1.0 / (len(set(kinds)) * kinds.count(kind)))
            for clip, kind in zip(names, kinds, strict=True)
        ]
    for full_name in (name, _SHORT_FOR + name):
        if full_name in paths:
            return [PackageClip(PREFIX + full_name, paths[full_name], 1.0)]
    known = [_ALL_SET, _LOCOMOTION_SET, *paths, *(clip.removeprefix(_SHORT_FOR) for clip in paths)]
    raise MotionFileError(
        f"unknown DeepMimic clip or data set '{name}'{suggest(name, known)}; "
        f"data sets: {_ALL_SET}, {_LOCOMOTION_SET}; clips: {', '.join(paths)}"
    )


def _paths_of_clips(motion_file: str) -> dict[str, Path]:
    """Return the files of all clips, sorted by their full names without the prefix."""
    spec = importlib.util.find_spec(_PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise MotionFileError(
            f"'{motion_file}' belongs to the package {_PACKAGE}, which is not installed; "
            'pip install "isaacgymenvs-lite[motions]"'
        )
    folder = Path(spec.submodule_search_locations[0]) / "data" / "motions"
    paths = {
        path.relative_to(folder).with_suffix("").as_posix(): path
        for sub, pattern in _PACKAGE_FOLDERS.items()
        for path in (folder / sub).glob(pattern)
    }
    return dict(sorted(paths.items()))


_log = logging.getLogger(__name__)

NUM_COLUMNS = 44
DURATION, ROOT_POSITION, ROOT_ROTATION = 0, slice(1, 4), slice(4, 8)
# The first column of each ball joint's quaternion (w, x, y, z), and the column of each hinge angle.
BALL_COLUMNS = {
    "torso": 8,
    "head": 12,
    "right_thigh": 16,
    "right_foot": 21,
    "right_upper_arm": 25,
    "left_thigh": 30,
    "left_foot": 35,
    "left_upper_arm": 39,
}
HINGE_COLUMNS = {"right_shin": 20, "right_lower_arm": 29, "left_shin": 34, "left_lower_arm": 43}
MOVED_BODIES = (*BALL_COLUMNS, *HINGE_COLUMNS)
# Durations whose relative difference from the median is smaller than this count as equal.
_DURATION_TOLERANCE = 1e-3
# The lengths of quaternions in published clips differ from 1 by up to 0.42 (in kick).
_LENGTH_TOLERANCE = 0.5
_LOGGED_LIFT_M = 5e-4  # smaller lifts are not logged
_DECIMALS = 9


def load_deepmimic(path: str | Path, skeleton: Skeleton, name: str | None = None) -> MotionClip:
    """Read a clip from a file in DeepMimic's format; its default name is the path."""
    return clip_from_deepmimic(read_json(path), skeleton, name or str(path))


def clip_from_deepmimic(data: dict[str, Any], skeleton: Skeleton, name: str) -> MotionClip:
    """Make a clip from the content of a DeepMimic file; `skeleton` gives the limb lengths.

    Frames of unequal duration are resampled. If a foot is below the ground in a frame, the whole
    clip is lifted by a constant height, so that the lowest corner of a foot touches the ground. If
    no body touches the ground in the lifted clip, `plausibility.put_on_ground` lowers it again.
    Velocities are smoothed differences.
    """
    with reading(name, "DeepMimic clip"):
        rows = _rows(data, name)
        missing = [body for body in MOVED_BODIES if body not in skeleton.body_names]
        if missing:
            raise MotionFileError(
                f"{name}: a DeepMimic clip moves bodies that this humanoid lacks: {missing}"
            )
        root = _vector(rows[:, ROOT_POSITION])
        local = np.zeros((len(rows), skeleton.num_bodies, 4))
        local[..., 3] = 1.0
        local[:, 0] = _quaternion(rows[:, ROOT_ROTATION], "root", name)
        for body, column in BALL_COLUMNS.items():
            quaternion = _quaternion(rows[:, column : column + 4], body, name)
            local[:, skeleton.body_names.index(body)] = quaternion
        for body, column in HINGE_COLUMNS.items():
            # DeepMimic's hinge axis z is this project's axis -y; therefore the angle is negated.
            half = -0.5 * rows[:, column]
            local[:, skeleton.body_names.index(body), 1] = np.sin(half)
            local[:, skeleton.body_names.index(body), 3] = np.cos(half)
        fps, local, root = _equal_durations(rows[:-1, DURATION], local, root, name)
        lifted = _lifted(skeleton, local, root, name)
        tree = (skeleton.body_names, skeleton.parent_indices, skeleton.local_translation)
        clip = MotionClip.from_poses(name, fps, *tree, local, lifted)
        if lifted is root or not is_in_air(clip, skeleton):
            return clip
        # If a toe is below the ground in a crawl, the lift raises the hands and knees into the air.
        _log.info("%s: lowered to the ground, because the lifted clip was in the air", name)
        return put_on_ground(clip, skeleton)


def _rows(data: dict[str, Any], name: str) -> FloatArray:
    """Return the frames of a file as an array (T, 44)."""
    rows = np.array(data.get("Frames"), dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != NUM_COLUMNS:
        keys = f"the keys {', '.join(sorted(data)) or 'nothing'}"
        found = f"rows of {rows.shape[1]} numbers" if rows.ndim == 2 else keys
        raise MotionFileError(
            f"{name}: is no DeepMimic clip of the humanoid, expected 'Frames' with rows of "
            f"{NUM_COLUMNS} numbers, found {found}; write a robot's frames as a .csv (root position"
            " in m, root quaternion xyzw, joints in rad) and convert it with robot=FILE"
        )
    if not np.abs(rows).max(initial=0.0) <= MAX_PLACE_M:  # This condition is True for NaN.
        raise MotionFileError(
            f"{name}: the frames hold {np.abs(rows).max():.3g}, expected seconds, metres and "
            f"radians of at most {MAX_PLACE_M:g}"
        )
    if len(rows) < 2:
        raise MotionFileError(f"{name}: holds {len(rows)} frame, expected at least 2")
    # The duration of the last frame is not used; it is 0 in most files.
    durations = rows[:-1, DURATION]
    odd = (durations <= 0.0) | (durations > 1.0 / MIN_FPS)
    if odd.any():
        frame = int(odd.argmax())
        raise MotionFileError(
            f"{name}: frame {frame} lasts {durations[frame]:g} s, expected more than 0 and at most "
            f"{1.0 / MIN_FPS:g}"
        )
    return rows


def _vector(xyz: FloatArray) -> FloatArray:
    """Convert vectors (..., 3) from axes with y up to z up, (x, y, z) -> (x, -z, y)."""
    return np.stack((xyz[..., 0], -xyz[..., 2], xyz[..., 1]), axis=-1)


def _quaternion(wxyz: FloatArray, body: str, name: str) -> FloatArray:
    """Convert quaternions (T, 4) from wxyz and y up to unit quaternions xyzw with z up."""
    length = np.linalg.norm(wxyz, axis=-1, keepdims=True)
    deviation = float(np.abs(length - 1.0).max())
    if deviation > _LENGTH_TOLERANCE:
        raise MotionFileError(
            f"{name}: the rotations of '{body}' are no quaternions "
            f"(length off by {deviation:.3g}, allowed {_LENGTH_TOLERANCE:g})"
        )
    xyzw = rotations.xyzw_from_wxyz(torch.from_numpy(wxyz / length)).numpy()
    return np.concatenate((_vector(xyzw[:, :3]), xyzw[:, 3:]), axis=-1)


def _equal_durations(
    durations: FloatArray, local: FloatArray, root: FloatArray, name: str
) -> tuple[float, FloatArray, FloatArray]:
    """Resample a motion to frames of equal duration; return fps, rotations and root positions.

    `durations` (T - 1,) are the times in s between successive frames. The first and the last frame
    are kept.
    """
    usual = float(np.median(durations))
    total = float(durations.sum())
    if np.abs(durations - usual).max() <= _DURATION_TOLERANCE * usual:
        return len(durations) / total, local, root
    num_steps = max(1, round(total / usual))
    _log.info("%s: frames of unequal duration resampled to %.2f Hz", name, num_steps / total)
    times = np.concatenate(([0.0], durations.cumsum()))
    new_times = np.linspace(0.0, total, num_steps + 1)
    before = np.searchsorted(times, new_times, side="right").clip(1, len(durations)) - 1
    blend = torch.from_numpy((new_times - times[before]) / durations[before]).view(-1, 1, 1)
    start, end = torch.from_numpy(local[before]), torch.from_numpy(local[before + 1])
    turns = rotations.quat_unit(rotations.slerp(start, end, blend)).numpy()
    places = np.stack([np.interp(new_times, times, axis) for axis in root.T], axis=-1)
    return num_steps / total, turns, places


def _lifted(skeleton: Skeleton, local: FloatArray, root: FloatArray, name: str) -> FloatArray:
    """Return root positions (T, 3) m, raised until no corner of a foot is below z = 0."""
    if not skeleton.foot_body_ids:
        return root
    positions, turns = kinematics.forward_kinematics(
        skeleton.parent_indices, skeleton.local_translation, local, root
    )
    feet = (skeleton.foot_body_ids, skeleton.foot_corners)
    lowest_m = float(kinematics.world_points(*feet, positions, turns)[..., 2].min())
    if lowest_m >= 0.0:
        return root
    if lowest_m < -_LOGGED_LIFT_M:
        _log.info("%s: lifted by %.3f m, its feet went below the ground", name, -lowest_m)
    return root - np.array([0.0, 0.0, lowest_m])


def save_deepmimic(path: str | Path, clip: MotionClip) -> Path:
    """Write a clip of the humanoid with `Loop` "none", and return the path.

    The file does not contain hands, sword, shield, velocities and limb lengths.
    """
    clip.validate()
    missing = [body for body in MOVED_BODIES if body not in clip.body_names]
    if missing:
        raise MotionFileError(f"{clip.name}: has no {', '.join(missing)}, which DeepMimic moves")
    rows = np.zeros((clip.num_frames, NUM_COLUMNS))
    rows[:-1, DURATION] = 1.0 / clip.fps
    rows[:, ROOT_POSITION] = _vector_y_up(np.asarray(clip.root_translation, dtype=np.float64))
    turns = np.asarray(clip.local_rotation, dtype=np.float64)
    rows[:, ROOT_ROTATION] = _quaternion_y_up(turns[:, 0])
    for body, column in BALL_COLUMNS.items():
        rows[:, column : column + 4] = _quaternion_y_up(turns[:, clip.body_names.index(body)])
    for body, column in HINGE_COLUMNS.items():
        turn = torch.from_numpy(turns[:, clip.body_names.index(body)])
        # DeepMimic's hinge axis is this project's axis -y.
        rows[:, column] = -rotations.quat_log(turn)[:, 1].numpy()
    text = json.dumps({"Loop": "none", "Frames": rows.round(_DECIMALS).tolist()})
    with written_clip(Path(path)) as partial:
        partial.write_text(text + "\n", encoding="utf-8")
    return Path(path)


def _vector_y_up(xyz: FloatArray) -> FloatArray:
    """Convert vectors (T, 3) from axes with z up to y up, (x, y, z) -> (x, z, -y)."""
    return np.stack((xyz[:, 0], xyz[:, 2], -xyz[:, 1]), axis=-1)


def _quaternion_y_up(xyzw: FloatArray) -> FloatArray:
    """Convert quaternions (T, 4) from xyzw and z up to wxyz and y up."""
    turned = np.concatenate((_vector_y_up(xyzw[:, :3]), xyzw[:, 3:]), axis=-1)
    return rotations.wxyz_from_xyzw(torch.from_numpy(turned)).numpy()
