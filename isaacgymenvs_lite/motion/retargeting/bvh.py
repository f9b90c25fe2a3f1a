"""Reads motion capture in the BVH format with the library pybvh."""

from __future__ import annotations

import re
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from isaacgymenvs_lite.errors import MotionFileError, one_line
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.bvh_channels import drop_inner_positions
from isaacgymenvs_lite.utils import rotations
from isaacgymenvs_lite.utils.optional_packages import import_package

# What the library raises for a file that is damaged or is something else.
_READ_ERRORS = (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError)
# What it reads in place of the file, and how its messages name that.
_COPY = "motion.bvh"
_PLACE = re.compile(rf" in (file )?\S*{re.escape(_COPY)}")


def load_bvh(path: str | Path, to_z_up: FloatArray, unit_m: float) -> MotionClip:
    """Read a BVH file as a clip of its own skeleton, in our axes and in metres.

    Args:
        path: of the file. Its root has three position and three rotation channels, in any order;
            all other joints have three rotation channels, and positions if these stay the same.
        to_z_up: (4,) xyzw, the rotation from the axes of the file to ours, z up.
        unit_m: m per unit of length of the file.

    Raises:
        MissingPackageError: pybvh is not installed.
        MotionFileError: the file is missing, truncated, damaged or is no BVH file; a number is NaN
            or infinite; there are fewer than two frames.
    """
    path = Path(path)
    pybvh = import_package("pybvh", "reading BVH files")
    if not path.is_file():
        raise MotionFileError(f"{path}: no such file")
    try:
        text = drop_inner_positions(path.read_text(encoding="utf-8", errors="replace"), str(path))
        motion, root, wxyz = _parse(pybvh, text)
    except _READ_ERRORS as error:
        reason = _PLACE.sub("", one_line(error))
        raise MotionFileError(f"{path}: is no BVH file that can be read ({reason})") from error
    joints = [node for node in motion.nodes if not node.is_end_site()]
    offsets = np.array([node.offset for node in joints], dtype=np.float64)
    _check_numbers(path, root, wxyz, offsets)
    turns = rotations.xyzw_from_wxyz(torch.from_numpy(wxyz))
    up = torch.from_numpy(to_z_up)
    turns[:, 0] = rotations.quat_mul(up.expand(len(turns), 4), turns[:, 0])
    places = rotations.quat_apply(up.expand(len(root), 4), torch.from_numpy(root))
    names = [node.name for node in joints]
    parents = [names.index(node.parent.name) if node.parent else -1 for node in joints]
    return MotionClip.from_poses(
        str(path),
        1.0 / motion.frame_time,
        names,
        parents,
        offsets * unit_m,
        turns.numpy(),
        places.numpy() * unit_m,
    )


def _parse(pybvh: Any, text: str) -> tuple[Any, FloatArray, FloatArray]:
    """Return the library's motion, root positions (T, 3) and rotations (T, J, 4) wxyz."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # A file without frames is an error later; numpy's warning of it would be a second line.
        warnings.simplefilter("ignore")
        copy = Path(folder) / _COPY  # the library reads files only
        copy.write_text(text, encoding="utf-8")
        # The axis that points up is the mapping's to say.
        motion = pybvh.read_bvh_file(copy, world_up="+y")
        return motion, *motion.to_quat()


def _check_numbers(path: Path, *arrays: FloatArray) -> None:
    if not all(np.isfinite(array).all() for array in arrays):
        raise MotionFileError(f"{path}: holds numbers that are NaN or infinite")
