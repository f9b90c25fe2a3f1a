"""Writes clips as poselib does (`SkeletonMotion`, `.npy`), for IsaacGymEnvs, ASE and their kin.

The file is a pickle: numpy's own header, then one object array that holds a dictionary. Old
numpy, which Isaac Gym's Python needs, does not know the module names of numpy 2: the names of
numpy 1, which both know, are put in their place.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.writing import written_clip

# That of the published files; in it a module name is plain text that ends with its line.
_PICKLE_PROTOCOL = 3
_NEW_MODULES, _OLD_MODULES = "numpy._core.", "numpy.core."


def save_poselib_npy(path: str | Path, clip: MotionClip) -> Path:
    """Write a clip in single precision, as the published ones are; returns the path.

    Raises:
        MotionFileError: the clip is not valid, or the file cannot be written.
    """
    clip.validate()
    path = Path(path)
    content = np.empty((), dtype=object)
    content[()] = _as_skeleton_motion(clip)
    stream = io.BytesIO()
    header = np.lib.format.header_data_from_array_1_0(content)
    np.lib.format.write_array_header_1_0(stream, header)
    stream.write(_with_old_names(pickle.dumps(content, protocol=_PICKLE_PROTOCOL)))
    with written_clip(path) as partial:
        partial.write_bytes(stream.getvalue())
    return path


def _as_skeleton_motion(clip: MotionClip) -> OrderedDict[str, Any]:
    tree = OrderedDict(
        node_names=list(clip.body_names),
        parent_indices=_tagged(clip.parent_indices, "int64"),
        local_translation=_tagged(clip.local_translation, "float32"),
    )
    return OrderedDict(
        rotation=_tagged(clip.local_rotation, "float32"),
        root_translation=_tagged(clip.root_translation, "float32"),
        global_velocity=_tagged(clip.linear_velocity_w, "float32"),
        global_angular_velocity=_tagged(clip.angular_velocity_w, "float32"),
        skeleton_tree=tree,
        is_local=True,
        # A whole number where it is one: poselib's own scripts index with it.
        fps=int(clip.fps) if float(clip.fps).is_integer() else float(clip.fps),
        __name__="SkeletonMotion",
    )


def _tagged(array: Any, dtype: str) -> dict[str, Any]:
    values: npt.NDArray[Any] = np.ascontiguousarray(array, dtype=dtype)
    return {"arr": values, "context": {"dtype": dtype}}


def _with_old_names(data: bytes) -> bytes:
    """Return the pickle with numpy's modules called as numpy 1 calls them."""
    parts, done = [], 0
    for code, argument, position in pickletools.genops(data):
        if code.name == "GLOBAL" and str(argument).startswith(_NEW_MODULES):
            start = (position or 0) + 1  # behind the code of the instruction
            parts += [data[done:start], _OLD_MODULES.encode()]
            done = start + len(_NEW_MODULES)
    return b"".join((*parts, data[done:]))
