"""The figure that a clip moves, as a model in its poses: what pictures and videos of clips need."""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import MotionFileError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.qpos import qpos_from_poses
from isaacgymenvs_lite.motion.skeleton import Skeleton, shipped_humanoid_with


def pose_figure(clip: MotionClip) -> tuple[mujoco.MjModel, npt.NDArray[np.float64]]:
    """Return the model of a clip's figure and its poses, qpos (T, nq).

    Args:
        clip: of a shipped humanoid, its bodies in that one's order, as `load_single_clip` gives it.

    Raises:
        MotionFileError: no shipped humanoid has these bodies.
    """
    file = shipped_humanoid_with(clip.body_names)
    if file is None:
        raise MotionFileError(
            f"{clip.name}: no shipped humanoid has its {len(clip.body_names)} bodies"
            f" ({', '.join(clip.body_names)})"
        )
    path = str(paths.assets_dir() / file)
    poses = qpos_from_poses(Skeleton.from_mjcf(path), clip.root_translation, clip.local_rotation)
    return mujoco.MjModel.from_xml_path(path), poses
