"""The reference motion beside a character that imitates: a translucent figure in the same phase."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.viewers.reference_track import ReferenceClips

Pose = npt.NDArray[np.float64]

# m, from the character to its ghost, in the world's horizontal axes: to the side that a camera at
# its right does not look through.
_BESIDE_M = (0.0, 1.0)
_OPACITY = 0.35
# Steps of an episode after which its phase is sought once more: one pose may occur twice.
_SURE_STEPS = 6


class ReferenceOverlay:
    """Where the reference of one environment is; goes along with the character.

    Args:
        env: a task with a motion library.
        env_id: the environment.
    """

    def __init__(self, env: Any, env_id: int = 0) -> None:
        self._env = env
        self._env_id = env_id
        self._clips = ReferenceClips(env)
        self._beginning: list[Pose] = []
        self._last_step = 0
        self._steps = 0
        self._phase = (0, 0)

    def pose(self, qpos: Pose) -> Pose:
        """Return the reference's joint positions (nq,) beside a character at `qpos`.

        Call it for each control step, or less often.
        """
        step = int(self._env.progress_buf[self._env_id])
        passed = step - self._last_step
        if passed < 0 or not self._beginning:  # another episode
            self._beginning.clear()
            self._steps = passed = 0
        self._last_step = step
        self._steps += passed
        # As long as no step was left out the poses so far are a piece of a motion.
        if self._steps == len(self._beginning) < _SURE_STEPS:
            self._beginning.append(qpos)
            self._phase = self._clips.phase(np.stack(self._beginning))
        motion_id, first = self._phase
        now = first + self._steps
        pose = self._clips.track(motion_id, range(now, now + 1))[0]
        pose[:2] = qpos[:2] + _BESIDE_M
        return pose


class RobotOverlay:
    """Adds a translucent robot to a scene.

    Args:
        model: of the task; the robot is the tree of its first joint.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        self._option, self._perturbation = mujoco.MjvOption(), mujoco.MjvPerturb()
        self._root = int(model.jnt_bodyid[0])

    def add_to(self, scene: mujoco.MjvScene, qpos: Pose) -> None:
        """Add the robot at joint positions `qpos` (nq,) to a scene."""
        model, data = self._model, self._data
        data.qpos[: len(qpos)] = qpos
        mujoco.mj_kinematics(model, data)
        first = scene.ngeom
        moving = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
        mujoco.mjv_addGeoms(model, data, self._option, self._perturbation, moving, scene)
        for index in range(first, scene.ngeom):
            geom = scene.geoms[index]
            body = int(model.geom_bodyid[geom.objid])
            of_robot = int(model.body_rootid[body]) == self._root
            geom.rgba[3] = _OPACITY if of_robot else 0.0
            geom.category = int(mujoco.mjtCatBit.mjCAT_DECOR)
