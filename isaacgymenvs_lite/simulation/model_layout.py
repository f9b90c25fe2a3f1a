"""Computes the index arrays of a model's root, degrees of freedom, bodies and objects.

An object is a body with a free joint and without children; the model's first joint belongs to the
robot. All objects come after the robot's bodies, so that MuJoCo's qpos, qvel and body arrays begin
with the values of the robot.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from isaacgymenvs_lite.errors import ConfigError

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_BALL = int(mujoco.mjtJoint.mjJNT_BALL)
CONTACT_SENSOR_PREFIX = "contact_"


@dataclass(frozen=True)
class ModelLayout:
    """Names and addresses of one model: B bodies, D degrees of freedom, K objects."""

    # B names of bodies, without the world and the objects, in the order of the body tensors.
    body_names: tuple[str, ...]
    # D names of degrees of freedom in joint order; a ball joint has the names `<joint>_x`, `_y` and
    # `_z`.
    dof_names: tuple[str, ...]
    dof_body_ids: tuple[int, ...]  # (G,) body of each joint group, in the order of `body_names`
    # (G + 1,) first degree of freedom of each group; the last entry is D.
    dof_offsets: tuple[int, ...]
    dof_vel_adr: int  # first degree of freedom of the joints in qvel (6 after a free root)
    ball_qpos: np.ndarray  # (balls, 4) qpos columns of each ball joint's quaternion, as xyzw
    ball_dofs: np.ndarray  # (balls, 3) the degrees of freedom of each ball joint
    scalar_qpos: np.ndarray  # (scalars,) qpos columns of hinges and slides
    scalar_dofs: np.ndarray  # (scalars,) degrees of freedom of hinges and slides
    # (B, 3) columns of sensordata with the net contact force of each body, -1 for bodies without a
    # `contact_<body>` sensor. The value is None if no body has a sensor.
    contact_columns: np.ndarray | None
    has_free_root: bool  # whether the first joint is a free joint
    object_names: tuple[str, ...]  # K names; object tensors use this order
    object_contact_columns: np.ndarray | None  # (K, 3) columns of sensordata, per object
    sensor_columns: dict[str, slice]  # columns of sensordata of each named sensor

    @property
    def num_dofs(self) -> int:
        """D, which does not include the free joints of root and objects."""
        return self.dof_offsets[-1]

    @property
    def num_qpos(self) -> int:
        """Q, the length of the robot's part of qpos."""
        root = 7 if self.has_free_root else 0
        return root + self.ball_qpos.size + self.scalar_qpos.size

    @property
    def num_qvel(self) -> int:
        """The length of the robot's part of qvel."""
        return self.dof_vel_adr + self.num_dofs

    @classmethod
    def from_model(cls, model: mujoco.MjModel) -> ModelLayout:
        """Read the layout of a compiled model.

        Raises:
            ConfigError: a free joint belongs neither to the model's first body nor to an object
                after all other bodies.
        """
        num_objects = _count_objects(model)
        has_free_root = model.njnt > 0 and model.jnt_type[0] == _FREE
        joints = range(1 if has_free_root else 0, model.njnt - num_objects)
        dof_vel_adr = 6 if has_free_root else 0
        names: list[str] = []
        offsets = [0]
        ball_qpos, ball_dofs, scalar_qpos, scalar_dofs = [], [], [], []
        for joint in joints:
            kind, qpos, dof = model.jnt_type[joint], model.jnt_qposadr[joint], offsets[-1]
            name = model.joint(joint).name
            if kind == _BALL:
                ball_qpos.append([qpos + 1, qpos + 2, qpos + 3, qpos])
                ball_dofs.append([dof, dof + 1, dof + 2])
                names += [f"{name}_{axis}" for axis in "xyz"]
            else:
                scalar_qpos.append(qpos)
                scalar_dofs.append(dof)
                names.append(name)
            offsets.append(len(names))
        names_of_all = tuple(model.body(i).name for i in range(1, model.nbody))
        num_bodies = len(names_of_all) - num_objects
        body_names, object_names = names_of_all[:num_bodies], names_of_all[num_bodies:]
        ends = (model.sensor_adr + model.sensor_dim).tolist()
        sensors = {
            model.sensor(i).name: slice(int(model.sensor_adr[i]), end) for i, end in enumerate(ends)
        }
        return cls(
            body_names=body_names,
            dof_names=tuple(names),
            dof_body_ids=tuple(int(model.jnt_bodyid[joint]) - 1 for joint in joints),
            dof_offsets=tuple(offsets),
            dof_vel_adr=dof_vel_adr,
            ball_qpos=np.array(ball_qpos, dtype=np.int64).reshape(-1, 4),
            ball_dofs=np.array(ball_dofs, dtype=np.int64).reshape(-1, 3),
            scalar_qpos=np.array(scalar_qpos, dtype=np.int64),
            scalar_dofs=np.array(scalar_dofs, dtype=np.int64),
            contact_columns=_contact_columns(sensors, body_names),
            has_free_root=has_free_root,
            object_names=object_names,
            object_contact_columns=_contact_columns(sensors, object_names),
            sensor_columns=sensors,
        )


def _count_objects(model: mujoco.MjModel) -> int:
    """Return K; the last K bodies and the last K joints belong to the objects."""
    free_joints = np.flatnonzero(model.jnt_type == _FREE)
    objects = model.jnt_bodyid[free_joints[free_joints > 0]]
    for place, body in enumerate(objects):
        name = model.body(body).name
        children = np.flatnonzero(model.body_parentid == body)
        if children.size > 0:
            raise ConfigError(
                f"body '{name}' has a free joint and a child, '{model.body(children[0]).name}', but"
                " its joint is not the first joint of the model; expected at most one robot, before"
                " all other joints, and no children of other free bodies"
            )
        if model.nbody - body != len(objects) - place:
            others = (i for i in range(body + 1, model.nbody) if i not in objects)
            raise ConfigError(
                f"free body '{name}' comes before body '{model.body(next(others)).name}'; expected"
                " free bodies after all bodies of the robot: move it to the end"
            )
    return len(objects)


def _contact_columns(sensors: dict[str, slice], names: tuple[str, ...]) -> np.ndarray | None:
    columns = np.full((len(names), 3), -1)
    for place, name in enumerate(names):
        if (sensor := sensors.get(CONTACT_SENSOR_PREFIX + name)) is not None:
            columns[place] = np.arange(sensor.start, sensor.start + 3)
    return columns if (columns >= 0).any() else None
