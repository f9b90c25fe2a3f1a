"""Implicit integration of position drives, as in PhysX, for stiff drives and closed chains.

PhysX applies a drive of stiffness k and damping d to the state after a step of length h. The
position after the step is q' = q + h v', and the momentum of the joint is

    (I + h d + h^2 k) v' = I v + h k (target - q) + other impulses.

An armature of h d + h^2 k and a damping of d + h k on the previous velocity give the same v'.
MuJoCo's implicit integrators include only the damping. They apply the damping after the
constraints, which lets the pins of a driven closed chain come apart, and a light finger pass
through the object that it holds.
"""

from __future__ import annotations

import mujoco


def integrate_drives_implicitly(spec: mujoco.MjSpec, timestep: float) -> None:
    """Make the position actuators on the joints of a model act on the state after each step.

    The function changes armatures, actuator dampings and the integrator of `spec`. `timestep` is
    the length of a physics step (s).
    """
    for actuator in spec.actuators:
        if actuator.trntype != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        stiffness, damping = -actuator.biasprm[1], -actuator.biasprm[2]
        spec.joint(actuator.target).armature += timestep * (damping + timestep * stiffness)
        actuator.biasprm[2] = -(damping + timestep * stiffness)
    # The implicit integrators would apply the damping a second time.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
