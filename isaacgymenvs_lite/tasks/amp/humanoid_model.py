"""Actuators and joint limits of the humanoid's model."""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.amp.humanoid_amp_config import HumanoidAMPConfig
from isaacgymenvs_lite.tasks.base.assets import hinge_limits


def dof_limits(model: mujoco.MjModel, layout: ModelLayout) -> npt.NDArray[np.float64]:
    """Return the lower and upper limits (D, 2) in rad of a humanoid's degrees of freedom.

    Of hinges: the joints' ranges. MuJoCo limits a ball joint by its whole angle only; the limits
    of its rotation vector's components are the length ranges of the three actuators on it, 0 in a
    file that does not give them. Actuators are in the order of the degrees of freedom.
    """
    limits = hinge_limits(model, layout)
    balls = layout.ball_dofs.ravel()
    limits[balls] = model.actuator_lengthrange[balls]
    return limits


def set_actuators(model: mujoco.MjModel, env: HumanoidAMPConfig) -> None:
    """Give a compiled model the kind of actuator and the limits of efforts that the keys name."""
    if not env.pd_control:  # the control is the torque in Nm; `powerScale` may exceed the efforts
        model.actuator_gainprm[:, 0] = 1.0
        model.actuator_biastype[:] = int(mujoco.mjtBias.mjBIAS_NONE)
        model.actuator_biasprm[:] = 0.0
        model.actuator_forcelimited[:] = 0
        return
    # MuJoCo 4 wraps the error of a position servo on a ball joint into +-pi per axis, which it
    # recognises by gain = -bias exactly. float32's pi is above pi: a full action would turn the
    # joint backwards. With a bias that is one unit in the last place off nothing is wrapped.
    model.actuator_biasprm[:, 1] = np.nextafter(model.actuator_biasprm[:, 1], 0.0)
    if not env.enforce_effort_limits:
        model.actuator_forcelimited[:] = 0


def copy_drives(source: mujoco.MjSpec, spec: mujoco.MjSpec) -> None:
    """Give actuators and joints of `spec` gains, efforts and armatures of their namesakes."""
    drives = {actuator.name: actuator for actuator in source.actuators}
    joints = {joint.name: joint for joint in source.joints}
    for actuator in spec.actuators:
        if actuator.name in drives:
            drive = drives[actuator.name]
            actuator.gainprm, actuator.biasprm = drive.gainprm, drive.biasprm
            actuator.forcerange = drive.forcerange
    for joint in spec.joints:
        if joint.name in joints:
            joint.armature = joints[joint.name].armature
