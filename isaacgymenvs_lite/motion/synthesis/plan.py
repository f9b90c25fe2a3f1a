"""The plan of a gait: how pelvis, centre of mass and feet move together."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.motion.qpos import qpos_from_poses
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.motion.synthesis.com_plan import ComPlan, plan_com
from isaacgymenvs_lite.motion.synthesis.cycle import PeriodicCurve
from isaacgymenvs_lite.motion.synthesis.foot_plan import FootPlan
from isaacgymenvs_lite.motion.synthesis.gait_data import Gait
from isaacgymenvs_lite.motion.synthesis.leg import Leg
from isaacgymenvs_lite.motion.synthesis.posture import target_rotations
from isaacgymenvs_lite.motion.synthesis.stance import Stance

FloatArray = npt.NDArray[np.float64]

_SAMPLES = 40  # poses per cycle for the path of the hip
_HEIGHT_STEPS = 30  # halvings of the search interval for the height


@dataclass(frozen=True, eq=False)
class GaitPlan:
    """Targets for the inverse kinematics, all as functions of the phase."""

    com: ComPlan
    feet: FootPlan


def plan_gait(gait: Gait, skeleton: Skeleton, model: mujoco.MjModel) -> GaitPlan:
    """Plan a gait for a humanoid.

    The body is as high as the legs allow when the straightest knee of the stance is as the gait
    has it. The path of the hips is that of the published posture, carried by the centre of mass.
    """
    stance = Stance(gait, Leg.from_skeleton(skeleton))
    hip_from_com = _right_hip_from_com(gait, skeleton, model)
    longest = stance.leg.reach(np.radians(gait.straightest_knee_deg))

    def plan(height_m: float) -> GaitPlan:
        com = plan_com(stance, height_m)

        def right_hip(phase: FloatArray) -> FloatArray:
            return com(phase) + np.stack([curve(phase) for curve in hip_from_com], axis=-1)

        return GaitPlan(com, FootPlan(stance, right_hip))

    low, high = 0.5 * longest, 2.0 * longest
    for _ in range(_HEIGHT_STEPS):
        middle = 0.5 * (low + high)
        if plan(middle).feet.stance_reach().max() > longest:
            high = middle
        else:
            low = middle
    return plan(low)


def _right_hip_from_com(gait: Gait, skeleton: Skeleton, model: mujoco.MjModel) -> list[PeriodicCurve]:
    """Return x, y, z (m) from the centre of mass to the right hip in the published posture."""
    phase = np.arange(_SAMPLES) / _SAMPLES
    poses = qpos_from_poses(
        skeleton, np.zeros((_SAMPLES, 3)), target_rotations(gait, skeleton, phase)
    )
    data = mujoco.MjData(model)
    offsets = np.empty((_SAMPLES, 3))
    for i, pose in enumerate(poses):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        offsets[i] = data.body("right_thigh").xpos - data.subtree_com[1]
    return [PeriodicCurve.through(offsets[:, axis]) for axis in range(3)]
