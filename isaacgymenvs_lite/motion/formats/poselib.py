"""Reads clips in the poselib format (`SkeletonMotion`): `.npy`, as IsaacGymEnvs has, or `.json`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import MotionFileError, one_line
from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.restricted_pickle import load_object_npy

_CLIP_TAG = "SkeletonMotion"
_POSE_TAG = "SkeletonState"


def load_poselib_npy(path: str | Path) -> MotionClip:
    """Read a poselib `.npy` clip; nothing in the file is executed.

    Raises:
        MotionFileError: the file is unsafe, damaged, or holds no valid clip.
    """
    return clip_from_poselib(load_object_npy(path), str(path))


def clip_from_poselib(data: Any, name: str) -> MotionClip:
    """Make a clip from the dictionary that poselib stores.

    Args:
        data: the content of the file. Arrays may be numpy arrays or, as in the `.json` variant,
            {"__ndarray__": nested lists, "dtype": name, "shape": sizes}.
        name: the name of the clip, the file's path.

    Raises:
        MotionFileError: a key is missing or holds something else; the clip is not valid.
    """
    _check_tag(data, name)
    tree = _mapping(data, "skeleton_tree", name)
    clip = MotionClip(
        name=name,
        fps=_number(data, "fps", name),
        body_names=tuple(str(node) for node in np.ravel(_item(tree, "node_names", name))),
        parent_indices=tuple(int(body) for body in _array(tree, "parent_indices", name).ravel()),
        local_translation=_array(tree, "local_translation", name),
        local_rotation=_array(data, "rotation", name),
        root_translation=_array(data, "root_translation", name),
        linear_velocity_w=_array(data, "global_velocity", name),
        angular_velocity_w=_array(data, "global_angular_velocity", name),
    )
    clip.validate()
    if not _item(data, "is_local", name):
        local_rotation = kinematics.local_rotations(clip.parent_indices, clip.local_rotation)
        clip = dataclasses.replace(clip, local_rotation=local_rotation)
    return clip


def _check_tag(data: Any, name: str) -> None:
    if not isinstance(data, Mapping):
        raise MotionFileError(f"{name}: holds a {type(data).__name__}, expected a {_CLIP_TAG}")
    tag = data.get("__name__")
    if tag != _CLIP_TAG:
        hint = " (a single pose, such as a T-pose, has no duration)" if tag == _POSE_TAG else ""
        found = ", ".join(sorted(str(key) for key in data)) or "nothing"
        raise MotionFileError(
            f"{name}: __name__ is {tag!r}{hint}, expected '{_CLIP_TAG}'; found the keys {found}"
        )


def _item(data: Mapping[str, Any], key: str, name: str) -> Any:
    if key not in data:
        found = ", ".join(sorted(str(other) for other in data)) or "nothing"
        raise MotionFileError(f"{name}: lacks the key '{key}'; found {found}")
    return data[key]


def _mapping(data: Mapping[str, Any], key: str, name: str) -> Mapping[str, Any]:
    item = _item(data, key, name)
    if not isinstance(item, Mapping):
        raise MotionFileError(f"{name}: {key} is a {type(item).__name__}, expected a dictionary")
    return item


def _array(data: Mapping[str, Any], key: str, name: str) -> npt.NDArray[Any]:
    """Return the array of numbers {arr, context: {dtype}} under `key`, cast to its dtype."""
    item = _mapping(data, key, name)
    stored = _item(item, "arr", name)
    dtype = _item(_mapping(item, "context", name), "dtype", name)
    try:
        if isinstance(stored, Mapping):
            stored = np.reshape(stored["__ndarray__"], stored["shape"])
        array = np.asarray(stored)
        cast_to = np.dtype(str(dtype))
    except (KeyError, TypeError, ValueError) as error:
        reason = one_line(error)
        raise MotionFileError(f"{name}: {key} is no array of numbers ({reason})") from error
    if array.dtype.kind not in "fiu" or cast_to.kind not in "fiu":
        raise MotionFileError(
            f"{name}: {key} holds {array.dtype} to be read as {dtype}, expected numbers"
        )
    return array.astype(cast_to)


def _number(data: Mapping[str, Any], key: str, name: str) -> float:
    """Return the number under `key`: int, float or, as in IsaacGymEnvs' clips, a 0-d array."""
    item = _item(data, key, name)
    if isinstance(item, Mapping):
        item = item.get("__ndarray__", item)
    try:
        return float(np.asarray(item).item())
    except (TypeError, ValueError) as error:
        raise MotionFileError(f"{name}: {key} is {item!r}, expected a number") from error
