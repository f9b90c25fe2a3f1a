"""Position drives as PhysX integrates them, for stiff drives and closed chains.

A drive of stiffness k and damping d acts on the state *after* a step of length h: with that state
q' = q + h v' the momentum of its joint is

    (I + h d + h^2 k) v' = I v + h k (target - q) + impulses of contacts, limits and the like.

The same v' comes from an armature of h d + h^2 k and a damping of d + h k that acts on the velocity
before the step. MuJoCo's own implicit integrators count the damping alone, and only after the
constraints were solved for a joint without it: the pins of a driven closed chain give way.
"""

from __future__ import annotations

import mujoco


def integrate_drives_implicitly(spec: mujoco.MjSpec, timestep: float) -> None:
    """Let the position actuators on joints of a model act on the state after each step.

    Args:
        spec: changed: armatures of driven joints, dampings of their actuators, the integrator.
        timestep: of a physics step (s).
    """
    for actuator in spec.actuators:
        if actuator.trntype != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        stiffness, damping = -actuator.biasprm[1], -actuator.biasprm[2]
        spec.joint(actuator.target).armature += timestep * (damping + timestep * stiffness)
        actuator.biasprm[2] = -(damping + timestep * stiffness)
    # The others would count the damping a second time.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
