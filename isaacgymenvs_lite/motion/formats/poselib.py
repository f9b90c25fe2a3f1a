"""Reads and writes clips in the poselib format (`SkeletonMotion`) of IsaacGymEnvs and ASE.

Clips are read from `.npy` or `.json` files, and written to `.npy` files, which consist of numpy's
header and a pickled dictionary. The pickle uses numpy 1's module names, because both numpy 1 (for
Isaac Gym) and numpy 2 can load these.
"""

from __future__ import annotations

import dataclasses
import io
import pickle
import pickletools
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.files import native_floats, reading, written_clip
from isaacgymenvs_lite.motion.formats.restricted_pickle import load_object_npy

_CLIP_TAG = "SkeletonMotion"
_POSE_TAG = "SkeletonState"
# Pickle protocol of the published files; it stores module names as lines of text.
_PICKLE_PROTOCOL = 3
_NEW_MODULES, _OLD_MODULES = "numpy._core.", "numpy.core."


def load_poselib_npy(path: str | Path) -> MotionClip:
    """Read a poselib clip from a `.npy` file without running code from it."""
    return clip_from_poselib(load_object_npy(path), str(path))


def clip_from_poselib(data: Any, name: str) -> MotionClip:
    """Make a clip from poselib's dictionary; `name` is the path of the file.

    A `.json` file stores an array as {"__ndarray__": nested lists, "dtype": name, "shape": sizes}.
    """
    with reading(name, "poselib clip (SkeletonMotion)"):
        tag = data.get("__name__") if isinstance(data, Mapping) else None
        if tag != _CLIP_TAG:
            hint = " (a single pose, such as a T-pose, has no duration)" if tag == _POSE_TAG else ""
            found = ", ".join(sorted(str(key) for key in data)) or "nothing"
            raise MotionFileError(
                f"{name}: __name__ is {tag!r}{hint}, expected '{_CLIP_TAG}'; found the keys {found}"
            )
        tree, fps = _item(data, "skeleton_tree", name), _item(data, "fps", name)
        if isinstance(fps, Mapping):  # In IsaacGymEnvs' clips fps is a 0-d array.
            fps = fps["__ndarray__"]
        clip = MotionClip(
            name=name,
            fps=float(np.asarray(fps).item()),
            body_names=tuple(str(node) for node in np.ravel(_item(tree, "node_names", name))),
            parent_indices=tuple(
                int(body) for body in _array(tree, "parent_indices", name).ravel()
            ),
            local_translation=native_floats(_array(tree, "local_translation", name)),
            local_rotation=native_floats(_array(data, "rotation", name)),
            root_translation=native_floats(_array(data, "root_translation", name)),
            linear_velocity_w=native_floats(_array(data, "global_velocity", name)),
            angular_velocity_w=native_floats(_array(data, "global_angular_velocity", name)),
        )
        clip.validate()
        if not _item(data, "is_local", name):
            local_rotation = kinematics.local_rotations(clip.parent_indices, clip.local_rotation)
            clip = dataclasses.replace(clip, local_rotation=local_rotation)
        return clip


def _item(data: Mapping[str, Any], key: str, name: str) -> Any:
    if key not in data:
        found = ", ".join(sorted(str(other) for other in data)) or "nothing"
        raise MotionFileError(f"{name}: lacks the key '{key}'; found {found}")
    return data[key]


def _array(data: Mapping[str, Any], key: str, name: str) -> npt.NDArray[Any]:
    """Return the array `key` with the stored dtype; the file has {arr, context: {dtype}}."""
    item = _item(data, key, name)
    stored = _item(item, "arr", name)
    if isinstance(stored, Mapping):
        stored = np.reshape(stored["__ndarray__"], stored["shape"])
    array, cast_to = np.asarray(stored), np.dtype(str(_item(item, "context", name)["dtype"]))
    if array.dtype.kind not in "fiu" or cast_to.kind not in "fiu":
        raise MotionFileError(
            f"{name}: {key} holds {array.dtype} and declares {cast_to}, expected numbers"
        )
    return array.astype(cast_to)


def save_poselib_npy(path: str | Path, clip: MotionClip) -> Path:
    """Write a clip in single precision, like the published files, and return the path."""
    clip.validate()
    if np.ndim(clip.local_translation) != 2:
        raise MotionFileError(
            f"{clip.name}: poselib's format needs joints at the origins of their bodies, but this"
            " skeleton has other joints; write a .npz file"
        )
    tree = OrderedDict(
        node_names=list(clip.body_names),
        parent_indices=_tagged(clip.parent_indices, "int64"),
        local_translation=_tagged(clip.local_translation, "float32"),
    )
    content = np.empty((), dtype=object)
    content[()] = OrderedDict(
        rotation=_tagged(clip.local_rotation, "float32"),
        root_translation=_tagged(clip.root_translation, "float32"),
        global_velocity=_tagged(clip.linear_velocity_w, "float32"),
        global_angular_velocity=_tagged(clip.angular_velocity_w, "float32"),
        skeleton_tree=tree,
        is_local=True,
        # fps must be an int, because poselib's scripts use fps as an index.
        fps=int(clip.fps) if float(clip.fps).is_integer() else float(clip.fps),
        __name__=_CLIP_TAG,
    )
    stream = io.BytesIO()
    header = np.lib.format.header_data_from_array_1_0(content)
    np.lib.format.write_array_header_1_0(stream, header)
    stream.write(_with_old_names(pickle.dumps(content, protocol=_PICKLE_PROTOCOL)))
    with written_clip(Path(path)) as partial:
        partial.write_bytes(stream.getvalue())
    return Path(path)


def _tagged(array: Any, dtype: str) -> dict[str, Any]:
    values: npt.NDArray[Any] = np.ascontiguousarray(array, dtype=dtype)
    return {"arr": values, "context": {"dtype": dtype}}


def _with_old_names(data: bytes) -> bytes:
    """Replace numpy 2's module names in a pickle by numpy 1's module names."""
    parts, done = [], 0
    for code, argument, position in pickletools.genops(data):
        if code.name == "GLOBAL" and str(argument).startswith(_NEW_MODULES):
            start = (position or 0) + 1  # after the opcode
            parts += [data[done:start], _OLD_MODULES.encode()]
            done = start + len(_NEW_MODULES)
    return b"".join((*parts, data[done:]))
