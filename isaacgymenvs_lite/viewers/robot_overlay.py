"""A translucent robot, such as the reference motion of a task that imitates, beside another one.

It does without torch, as the process of a page has none.
"""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

_OPACITY = 0.35


class RobotOverlay:
    """Adds a translucent robot to a scene.

    Args:
        model: of the scene; the robot is the tree of its first joint.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        self._option, self._perturbation = mujoco.MjvOption(), mujoco.MjvPerturb()

    def add_to(self, scene: mujoco.MjvScene, qpos: npt.NDArray[np.float64]) -> None:
        """Add the robot at joint positions `qpos` (nq,) to a scene."""
        model, data = self._model, self._data
        root = int(model.jnt_bodyid[0])
        data.qpos[: len(qpos)] = qpos
        mujoco.mj_kinematics(model, data)
        first = scene.ngeom
        moving = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
        mujoco.mjv_addGeoms(model, data, self._option, self._perturbation, moving, scene)
        for index in range(first, scene.ngeom):
            geom = scene.geoms[index]
            body = int(model.geom_bodyid[geom.objid])
            of_robot = int(model.body_rootid[body]) == root
            geom.rgba[3] = _OPACITY if of_robot else 0.0
            geom.category = int(mujoco.mjtCatBit.mjCAT_DECOR)
