"""From the MJCF of the humanoid and the task's keys to the model that is simulated."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.amp.humanoid_amp_config import OWN_ASSET, HumanoidAMPConfig
from isaacgymenvs_lite.tasks.base.assets import asset_path, compile_model, hinge_limits
from isaacgymenvs_lite.tasks.base.task_config import SimConfig


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


def build_model(
    env: HumanoidAMPConfig,
    sim: SimConfig,
    change: Callable[[mujoco.MjSpec], None] = lambda spec: None,
) -> mujoco.MjModel:
    """Compile the MJCF with the task's time step, gravity, friction and kind of actuator.

    Args:
        env: `task.env`.
        sim: `task.sim`.
        change: what a task adds to the file, or changes in it, before it is compiled.

    Raises:
        ConfigError: the file is missing or MuJoCo refuses it.
    """
    path = asset_path(env.asset, OWN_ASSET)
    model = compile_model(path, sim, env.plane.dynamic_friction, change)
    if not env.pd_control:
        _make_torque_actuators(model)
        return model
    _keep_servo_errors(model)
    if not env.enforce_effort_limits:
        model.actuator_forcelimited[:] = 0
    return model


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


def _keep_servo_errors(model: mujoco.MjModel) -> None:
    """Make the drives' force kp (target - q) for any target.

    MuJoCo 4 wraps the error of a position servo on a ball joint into +-pi per axis, and knows a
    servo by gain = -bias exactly. float32's pi is above pi: a full action would turn the joint
    backwards. One unit in the last place of the bias is enough to be no servo.
    """
    model.actuator_biasprm[:, 1] = np.nextafter(model.actuator_biasprm[:, 1], 0.0)


def _make_torque_actuators(model: mujoco.MjModel) -> None:
    """Replace position servos by motors: the control is the torque in Nm.

    `powerScale` may ask for more than the efforts, so that they do not limit.
    """
    model.actuator_gainprm[:, 0] = 1.0
    model.actuator_biastype[:] = int(mujoco.mjtBias.mjBIAS_NONE)
    model.actuator_biasprm[:] = 0.0
    model.actuator_forcelimited[:] = 0
