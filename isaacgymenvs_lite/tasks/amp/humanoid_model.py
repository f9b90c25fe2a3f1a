"""Actuators and joint limits of the humanoid's model."""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.amp.humanoid_amp_config import HumanoidAMPConfig
from isaacgymenvs_lite.tasks.base.assets import hinge_limits


def dof_limits(model: mujoco.MjModel, layout: ModelLayout) -> npt.NDArray[np.float64]:
    """Return the lower and upper limits (D, 2) of a humanoid's degrees of freedom in rad.

    MuJoCo limits only the total angle of a ball joint. The limits of its rotation vector are the
    length ranges of its three actuators, or 0 if the file has none. Actuators have the order of the
    degrees of freedom.
    """
    limits = hinge_limits(model, layout)
    balls = layout.ball_dofs.ravel()
    limits[balls] = model.actuator_lengthrange[balls]
    return limits


def set_actuators(model: mujoco.MjModel, env: HumanoidAMPConfig) -> None:
    """Set the actuator type and effort limits of a compiled model."""
    if not env.pd_control:  # the control is the torque in Nm; `powerScale` may exceed the efforts
        model.actuator_gainprm[:, 0] = 1.0
        model.actuator_biastype[:] = int(mujoco.mjtBias.mjBIAS_NONE)
        model.actuator_biasprm[:] = 0.0
        model.actuator_forcelimited[:] = 0
        return
    # MuJoCo 4 wraps the error of a position servo on a ball joint into +-pi. A full action is
    # float32's pi, which is above pi and would turn the joint backwards. MuJoCo recognises a servo
    # by gain = -bias, so a bias that differs in the last bit avoids the wrapping.
    model.actuator_biasprm[:, 1] = np.nextafter(model.actuator_biasprm[:, 1], 0.0)
    if not env.enforce_effort_limits:
        model.actuator_forcelimited[:] = 0


def copy_drives(source: mujoco.MjSpec, spec: mujoco.MjSpec) -> None:
    """Copy gains, efforts and armatures from actuators and joints of the same names."""
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
