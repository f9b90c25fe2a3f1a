"""Solves the inverse kinematics for targets of feet, pelvis and centre of mass."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.utils.optional_packages import import_package

_SOLVER = "daqp"  # mink installs this quadratic-programming solver
_MAX_ITERATIONS = 200
_CONVERGED = 1e-8  # largest joint step in rad or m
# This distance to the joint limits keeps the knees bent. Bending a straight knee does not change
# the length of the leg to first order, which would stop the search.
_KEEP_OFF_RAD = np.radians(3.0)
# Weights of the errors in 1/m and 1/rad. The feet are most important and reach micrometres. The
# angles of the legs are least important, because they follow from the feet.
_FOOT, _COM, _PELVIS, _UPPER_BODY, _LEG = 100.0, 3.0, 3.0, 1.0, 0.05


class PoseSolver:
    """Finds poses of a MuJoCo humanoid with the library mink.

    Every pose is solved independently. Therefore equal targets give equal poses, and cycles close.

    Args:
        model: the humanoid; body 1 is its root, with a free joint.
        foot_names: bodies with target poses.

    Raises:
        MissingPackageError: mink is not installed.
    """

    def __init__(self, model: mujoco.MjModel, foot_names: tuple[str, ...]) -> None:
        self._mink = import_package("mink", "making motion clips")
        self._configuration = self._mink.Configuration(model)
        self._feet = [self._frame_task(name, _FOOT, _FOOT) for name in foot_names]
        self._pelvis = self._frame_task(model.body(1).name, 0.0, _PELVIS)
        self._com = self._mink.ComTask(cost=_COM)
        self._posture = self._mink.PostureTask(model, cost=_posture_costs(model, foot_names))
        self._limits = [
            self._mink.ConfigurationLimit(model, min_distance_from_limits=_KEEP_OFF_RAD)
        ]

    def solve(self, qpos: FloatArray, com: FloatArray, foot_poses: list[FloatArray]) -> FloatArray:
        """Return the pose (nq) that meets the targets and stays near `qpos`.

        Args:
            qpos: (nq), preferred pose and start of the search.
            com: (3) m, the centre of mass in the world.
            foot_poses: for each foot a quaternion wxyz and a position in m in the world, (7).

        Raises:
            RuntimeError: the search does not converge.
        """
        configuration = self._configuration
        configuration.update(qpos)
        self._posture.set_target(qpos)
        self._com.set_target(com)
        self._pelvis.set_target_from_configuration(configuration)
        for task, pose in zip(self._feet, foot_poses, strict=True):
            task.set_target(self._mink.SE3(wxyz_xyz=pose))
        tasks = [*self._feet, self._pelvis, self._com, self._posture]
        for _ in range(_MAX_ITERATIONS):
            step = self._mink.solve_ik(
                configuration, tasks, 1.0, solver=_SOLVER, limits=self._limits
            )
            configuration.integrate_inplace(step, 1.0)
            if np.abs(step).max() < _CONVERGED:
                return configuration.q.copy()
        raise RuntimeError(
            f"inverse kinematics did not converge in {_MAX_ITERATIONS} iterations "
            f"(last step {np.abs(step).max():.2e} rad); make the targets easier to reach"
        )

    def _frame_task(self, body: str, position_cost: float, orientation_cost: float) -> Any:
        return self._mink.FrameTask(body, "body", position_cost, orientation_cost)


def _posture_costs(model: mujoco.MjModel, foot_names: tuple[str, ...]) -> FloatArray:
    """Return the weights of all joint velocities (nv), which are small in the legs."""
    costs = np.full(model.nv, _UPPER_BODY)
    for name in foot_names:
        body = model.body(name).id
        while body > 1:
            first = model.body_dofadr[body]
            costs[first : first + model.body_dofnum[body]] = _LEG
            body = model.body_parentid[body]
    return costs
