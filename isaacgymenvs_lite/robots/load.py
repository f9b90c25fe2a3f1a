"""Makes a model for tasks, converters and viewers from a user's robot file.

    robot = load_robot("/robots/g1.xml", RobotSettings())
    for line in robot.describe():
        log.info(line)
    model = robot.model

`reading` reads the file. Missing parts are added to the MjSpec; the file does not change.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.errors import ConfigError, one_line, printable
from isaacgymenvs_lite.robots import structure
from isaacgymenvs_lite.robots.drives import (
    Drive,
    action_range,
    add_drives,
    choose_drives,
    motors_of_file,
)
from isaacgymenvs_lite.robots.followers import TOLERANCE_RAD, Followers
from isaacgymenvs_lite.robots.limbs import bodies_named, limb_ends, touching_bodies
from isaacgymenvs_lite.robots.reading import read_robot_file
from isaacgymenvs_lite.robots.settings import RobotSettings, read_drives
from isaacgymenvs_lite.robots.stance import bend_legs
from isaacgymenvs_lite.robots.start_pose import (
    initial_positions,
    posed,
    start_height,
    start_pose,
)
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.utils.rotations import wxyz_from_xyzw

_ABSURD = 10.0  # no motor reaches this multiple of weight times height


@dataclass(frozen=True)
class PreparedRobot:
    """A robot with a free root, drives, contact sensors and a floor."""

    spec: mujoco.MjSpec  # a task that adds parts compiles the spec again
    model: mujoco.MjModel  # `spec`, compiled
    layout: ModelLayout  # names and addresses of `model`
    drives: tuple[Drive, ...]  # drives of all hinges and ball joints, in the order of the joints
    # Names of the bodies whose positions are observed, usually hands and feet.
    key_bodies: tuple[str, ...]
    contact_bodies: tuple[str, ...]  # names of the bodies that may touch the floor
    start_qpos: npt.NDArray[np.float64]  # (Q,) the start pose, on the floor at x = y = 0
    mass_height: float  # height (m) of the centre of mass above the floor in the start pose
    action_range_rad: float  # offset of the drives' targets for an action of 1
    notes: tuple[str, ...]  # sentences about added, removed and repaired parts

    @property
    def start_height(self) -> float:
        """Height of the base's origin in the start pose (m)."""
        return float(self.start_qpos[2])

    @property
    def trunk_height(self) -> float:
        """Height of the trunk in the start pose (m).

        The trunk's height is the base's height. If the base is on the ground, lower than half of
        the height of the centre of mass, the trunk's height is the height of the centre of mass.
        """
        on_ground = self.start_height < 0.5 * self.mass_height
        return self.mass_height if on_ground else self.start_height

    def describe(self) -> list[str]:
        """Return text lines for the user about the robot and its drives."""
        gains: dict[str, list[str]] = {}
        for drive in self.drives:
            key = f"{drive.kp:.4g} / {drive.kd:.3g} / {drive.effort:.4g}"
            gains.setdefault(key, []).append(drive.joint)
        drives = [f"  {key}: {', '.join(names)}" for key, names in gains.items()]
        mass = float(self.model.body_subtreemass[0])
        return [
            printable(line)
            for line in (
                f"robot '{self.spec.modelname}': {len(self.layout.body_names)} bodies,"
                f" {self.layout.num_dofs} degrees of freedom, {mass:.4g} kg",
                f"joints in order: {', '.join(self.layout.dof_names)}",
                f"key bodies: {', '.join(self.key_bodies)}",
                f"contact bodies: {', '.join(self.contact_bodies)}",
                f"start height: {self.start_height:.3f} m",
                "drives, kp (Nm/rad) / kd (Nm s/rad) / effort (Nm):",
                *drives,
                *self.notes,
            )
        ]


def load_robot(
    path: str | Path, settings: RobotSettings | None = None, where: str = "robot"
) -> PreparedRobot:
    """Read and prepare a robot's MJCF or URDF; see `read_robot_file` and `prepare_robot`.

    Messages contain `where`, the path of the section with the settings.
    """
    file = read_robot_file(path)
    try:
        robot = prepare_robot(file.spec, settings, where)
    except ConfigError as error:
        message = str(error)
        raise ConfigError(message if message.startswith(where) else f"{path}: {message}") from error
    notes = (*file.notes, *robot.notes)
    return PreparedRobot(**{**vars(robot), "notes": notes})


def prepare_robot(
    spec: mujoco.MjSpec, settings: RobotSettings | None = None, where: str = "robot"
) -> PreparedRobot:
    """Add free root, drives, contact sensors, floor and start pose to a spec.

    Raises:
        ConfigError: the spec has no robot, several robots or a robot with loops; MuJoCo refuses it;
            a name or pattern of the settings matches nothing; or a joint has no drive.
    """
    settings = settings or RobotSettings()
    notes = structure.name_everything(spec)
    notes += structure.check_equalities(spec)
    keys = _compile(spec)
    Followers(keys)  # refuses loops before any joint is removed
    motors = motors_of_file(keys)
    if spec.actuators:
        notes.append(f"replaced {len(spec.actuators)} actuators of the file by position drives")
    for thing in [*spec.keys, *spec.actuators]:
        spec.delete(thing)
    root, more = structure.keep_one_robot(spec)
    notes += [*more, *structure.free_root(spec, root), *structure.fix_slides(spec)]
    model = _compile(spec)
    if not any(kind != mujoco.mjtJoint.mjJNT_FREE for kind in model.jnt_type):
        raise ConfigError("has no joints: expected a robot with hinges or ball joints")
    structure.check_numbers(model)
    qpos, more = _start(keys, model, settings, f"{where}.startPose")
    notes += more
    patterns = read_drives(settings.drives, f"{where}.drives")
    mass_height = _mass_height(model, qpos)
    # Weight times height (Nm); the height is that of the base or of the centre of mass, whichever
    # is higher.
    weight = float(model.body_subtreemass[0]) * 9.81
    moment = weight * max(start_height(model, qpos), mass_height)
    key_bodies, contacts, more = _key_bodies_and_contacts(model, qpos, settings, where)
    notes += more
    drives = choose_drives(model, motors, moment, patterns, f"{where}.drives", contacts)
    notes += [*_absurd_efforts(drives, moment), *_rotors_added(model, drives)]
    notes += structure.part_overlapping_bodies(spec, model, qpos)
    add_drives(spec, drives)
    structure.add_contact_sensors(spec)
    notes.append("reused the file's floor" if spec.worldbody.geoms else "added a floor")
    structure.add_stage(spec)
    final = _compile(spec)
    final.qpos0[3:7] = qpos[3:7]  # clips are checked relative to this upright rotation
    return PreparedRobot(
        spec=spec,
        model=final,
        layout=ModelLayout.from_model(final),
        drives=tuple(drives),
        key_bodies=key_bodies,
        contact_bodies=contacts,
        start_qpos=qpos,
        mass_height=mass_height,
        action_range_rad=action_range(drives, moment),
        notes=tuple(notes),
    )


def _start(
    keys: mujoco.MjModel, model: mujoco.MjModel, settings: RobotSettings, where: str
) -> tuple[npt.NDArray[np.float64], list[str]]:
    """Return the start pose (Q,), and a note if neither the settings nor a keyframe give the pose.

    `keys` is the model of the robot's file, which has the keyframes; `model` has the free root.
    """
    positions = initial_positions(keys, settings.start_pose, where)
    if settings.start_rotation is not None:
        root = np.array([0, 0, 0, *wxyz_from_xyzw(torch.tensor(settings.start_rotation))])
        positions = {**positions, model.joint(0).name: root}
    height = settings.start_height
    qpos = start_pose(model, positions, height)
    if settings.start_pose is not None or keys.nkey > 0:
        notes = []
        for name in Followers(model).names:
            angle, given = float(qpos[model.joint(name).qposadr[0]]), float(positions[name][0])
            if abs(angle - given) > TOLERANCE_RAD:
                notes.append(f"start pose: '{name}' follows at {angle:.3f} rad, not {given:.3f}")
        return qpos, notes
    note = "start pose: no keyframe in the file: joints at zero within limits"
    bent = bend_legs(model, qpos)
    if bent is None:
        return qpos, [note]
    bent[2] = start_height(model, bent) if height is None else height
    return bent, [f"{note}, legs bent with each foot below its hip"]


def _key_bodies_and_contacts(
    model: mujoco.MjModel, qpos: npt.NDArray[np.float64], settings: RobotSettings, where: str
) -> tuple[tuple[str, ...], tuple[str, ...], list[str]]:
    """Return key bodies, bodies that touch the floor, and a note if the robot seems to lie down."""
    key_bodies = bodies_named(model, settings.key_bodies, f"{where}.keyBodies")
    contacts = bodies_named(model, settings.contact_bodies, f"{where}.contactBodies")
    contacts = contacts or touching_bodies(model, qpos)
    ends = limb_ends(model, qpos)
    stands_on = set(ends) & set(contacts)
    if len(stands_on) >= min(2, len(ends)):
        return key_bodies or ends, contacts, []
    number = "one end" if stands_on else "no end"
    note = f"stands on {', '.join(contacts)}, {number} of a limb: startRotation turns it"
    return key_bodies or ends, contacts, [note]


def _absurd_efforts(drives: list[Drive], weight_moment: float) -> list[str]:
    """Return a note if drives are far too strong for the robot's weight."""
    strong = [drive for drive in drives if drive.effort > _ABSURD * weight_moment]
    if not strong:
        return []
    names = ", ".join(f"{drive.joint} {drive.effort:.4g}" for drive in strong[:4])
    more = f" and {len(strong) - 4} more" if len(strong) > 4 else ""
    return [
        f"check the efforts (Nm) of the file: {names}{more}; weight times height of the whole robot"
        f" is {weight_moment:.4g} Nm"
    ]


def _rotors_added(model: mujoco.MjModel, drives: list[Drive]) -> list[str]:
    """Return a note on joints whose armature comes from the drive because the file has none."""
    without = [d for d in drives if model.dof_armature[model.joint(d.joint).dofadr[0]] == 0]
    added = [drive.armature for drive in without if drive.armature > 0]
    if not added:
        return []
    return [f"rotors' inertia for {len(added)} joints, {min(added):.2g} to {max(added):.2g} kg m^2"]


def _mass_height(model: mujoco.MjModel, qpos: npt.NDArray[np.float64]) -> float:
    """Return the height (m) of the centre of mass of a robot that stands on the floor."""
    standing = np.array(qpos)
    standing[2] = start_height(model, qpos)
    data = posed(model, standing)
    mujoco.mj_comPos(model, data)
    return float(data.subtree_com[1, 2])


def _compile(spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # deprecated attributes in a user's file
            return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ConfigError(f"MuJoCo refuses the robot: {one_line(error)}") from error
