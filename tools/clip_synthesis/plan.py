"""The plan of a gait: how pelvis, centre of mass and feet move together."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from isaacgymenvs_lite.motion.kinematics import FloatArray
from tools.clip_synthesis import dynamics
from tools.clip_synthesis.com_plan import ComPlan, plan_com
from tools.clip_synthesis.cycle import PeriodicCurve
from tools.clip_synthesis.foot_plan import FootPlan
from tools.clip_synthesis.stance import Stance

_HIP_HARMONICS = 10
_HEIGHT_STEPS = 4  # of the search for the height; each leaves a tenth of the error or less


@dataclass(frozen=True, eq=False)
class GaitPlan:
    """Targets for the inverse kinematics, all as functions of the phase."""

    com: ComPlan
    feet: FootPlan


def plan_gait(stance: Stance, hip_from_com: FloatArray) -> GaitPlan:
    """Plan the motion of the centre of mass and of the feet.

    The body is as high as the legs allow when the straightest knee of the stance is as the gait
    has it.

    Args:
        stance: the feet on the ground.
        hip_from_com: (N, 3) m, from the centre of mass to the right hip at N evenly spaced phases.
    """
    curves = [PeriodicCurve.through(hip_from_com[:, axis], _HIP_HARMONICS) for axis in range(3)]
    knee = np.radians(np.array([stance.gait.straightest_knee_deg]))
    longest = float(stance.leg.reach(knee).item())

    def plan(height_m: float) -> GaitPlan:
        com = plan_com(stance, height_m)

        def right_hip(phase: FloatArray) -> FloatArray:
            return com(phase) + np.stack([curve(phase) for curve in curves], axis=-1)

        return GaitPlan(com, FootPlan(stance, right_hip))

    height_m = longest
    for _ in range(_HEIGHT_STEPS):
        # Legs near vertical get longer about as fast as the body rises, so this closes in quickly.
        height_m += longest - plan(height_m).feet.stance_reach().max()
    return plan(height_m)


def right_hip_from_com(model: mujoco.MjModel, poses: FloatArray) -> FloatArray:
    """Return the vectors (N, 3) m from centre of mass to right hip in poses qpos (N, nq)."""
    com, hips = dynamics.com_and_hips(model, poses)
    return hips[:, 0] - com
