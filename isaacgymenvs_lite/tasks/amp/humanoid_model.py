"""From the MJCF of the humanoid and the task's keys to the model that is simulated."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.amp.humanoid_amp_config import HumanoidAMPConfig, SimConfig

log = logging.getLogger(__name__)


def asset_path(env: HumanoidAMPConfig) -> Path:
    """Return the MJCF that `task.env.asset` names.

    Raises:
        ConfigError: there is no such file.
    """
    root = Path(env.asset.asset_root) if env.asset.asset_root else assets_dir()
    if not root.is_dir() and (assets_dir() / env.asset.asset_file_name).is_file():
        # Published files name the assets folder of their own project.
        log.info("task.env.asset.assetRoot=%s does not exist: using %s", root, assets_dir())
        root = assets_dir()
    path = root / env.asset.asset_file_name
    if not path.is_file():
        raise ConfigError(
            f"task.env.asset.assetFileName='{env.asset.asset_file_name}': no file {path};"
            f" shipped: {shipped_assets()}"
        )
    return path


def shipped_assets() -> str:
    """Return the names of the MJCF files that come with the project, for messages."""
    return ", ".join(
        sorted(str(p.relative_to(assets_dir())) for p in assets_dir().glob("mjcf/*.xml"))
    )


def dof_limits(model: mujoco.MjModel, layout: ModelLayout) -> npt.NDArray[np.float64]:
    """Return the lower and upper limits (D, 2) in rad of a humanoid's degrees of freedom.

    Of hinges: the joints' ranges. MuJoCo limits a ball joint by its whole angle only; the limits
    of its rotation vector's components are the length ranges of the three actuators on it, 0 in a
    file that does not give them. Actuators are in the order of the degrees of freedom.
    """
    limits = np.zeros((layout.num_dofs, 2))
    for dof, name in enumerate(layout.dof_names):
        if dof in layout.scalar_dofs:
            limits[dof] = model.joint(name).range
        else:
            limits[dof] = model.actuator_lengthrange[dof]
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
    path = asset_path(env)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        change(spec)
        model = spec.compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"task.env.asset: MuJoCo cannot load {path}: {reason}") from error
    model.opt.timestep = sim.dt / sim.substeps
    model.opt.gravity[:] = sim.gravity
    floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
    # MuJoCo takes the larger coefficient of two touching geoms: set all to the plane's value.
    if floor >= 0:
        model.geom_friction[:, 0] = env.plane.dynamic_friction
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
