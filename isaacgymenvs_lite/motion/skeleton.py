"""The kinematic tree of a humanoid and its degrees of freedom, read from the MuJoCo model."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.kinematics import FloatArray, world_points

# The model file, relative to the assets folder, of the humanoid with a number of DOFs.
_HUMANOIDS = {28: "mjcf/amp_humanoid.xml", 31: "mjcf/amp_humanoid_sword_shield.xml"}
SHIPPED_NUM_DOFS = tuple(_HUMANOIDS)
_DOFS_OF_JOINT = {mujoco.mjtJoint.mjJNT_BALL: 3, mujoco.mjtJoint.mjJNT_HINGE: 1}


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Bodies and degrees of freedom of a humanoid; J bodies in depth-first order, root first.

    A joint group is the joint of one body: 3 DOFs (ball joint, rotation vector in rad in the child
    frame) or 1 DOF (hinge about the child's y axis, rad). Bodies without a joint are rigid.

    Attributes:
        body_names: J names.
        parent_indices: J body ids, -1 for the root; parents come before children.
        local_translation: (J, 3) m, origin of a body in its parent's frame. The root's row is its
            position in the model file, which kinematics does not use.
        dof_body_ids: G body ids, one per joint group, in DOF order.
        dof_offsets: G + 1 numbers; group g owns the DOFs dof_offsets[g] to dof_offsets[g + 1].
        foot_body_ids: K body ids, the foot that each row of `foot_corners` belongs to.
        foot_corners: (K, 3) m, corners of the box geoms of the bodies named *_foot, body frame.
        dof_names: one name per DOF, such as abdomen_x or right_elbow, from the actuators. Empty if
            the model does not have one actuator per DOF.
        dof_limits: (num_dofs, 2) rad, lowest and highest value of each DOF; (0, 2) without names.
    """

    body_names: tuple[str, ...]
    parent_indices: tuple[int, ...]
    local_translation: npt.NDArray[np.float64]
    dof_body_ids: tuple[int, ...]
    dof_offsets: tuple[int, ...]
    foot_body_ids: tuple[int, ...]
    foot_corners: npt.NDArray[np.float64]
    dof_names: tuple[str, ...] = ()
    dof_limits: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def num_bodies(self) -> int:
        """The number of bodies J."""
        return len(self.body_names)

    @property
    def num_dofs(self) -> int:
        """The number of degrees of freedom."""
        return self.dof_offsets[-1]

    @property
    def dof_sizes(self) -> tuple[int, ...]:
        """The number of DOFs of each joint group: 3 or 1."""
        return tuple(end - start for start, end in itertools.pairwise(self.dof_offsets))

    @property
    def hinge_body_ids(self) -> tuple[int, ...]:
        """The bodies that rotate about their y axis only."""
        groups = zip(self.dof_body_ids, self.dof_sizes, strict=True)
        return tuple(body for body, size in groups if size == 1)

    @classmethod
    def from_mjcf(cls, path: str | Path) -> Skeleton:
        """Read the skeleton of the MJCF file at `path` from MuJoCo's compiled model.

        Raises:
            ConfigError: it is no model that MuJoCo can compile, or a body has several joints, or
                another one than a ball joint or y hinge.
        """
        try:
            model = mujoco.MjModel.from_xml_path(str(path))
        except ValueError as error:
            raise ConfigError(f"{path}: is no model that can be used ({error})") from error
        # Body 0 is MuJoCo's world: it is left out and all ids move down by one.
        bodies = [model.body(i) for i in range(1, model.nbody)]
        dof_body_ids, dof_offsets = _joint_groups(model, path)
        foot_body_ids, foot_corners = _foot_corners(model)
        dof_names, dof_limits = _actuators(model, dof_offsets[-1])
        return cls(
            body_names=tuple(body.name for body in bodies),
            parent_indices=tuple(int(body.parentid[0]) - 1 for body in bodies),
            local_translation=model.body_pos[1:].copy(),
            dof_body_ids=dof_body_ids,
            dof_offsets=dof_offsets,
            foot_body_ids=foot_body_ids,
            foot_corners=foot_corners,
            dof_names=dof_names,
            dof_limits=dof_limits,
        )

    def sole_corners(self, positions: FloatArray, rotation: FloatArray) -> FloatArray:
        """Return the world positions (T, 2, 4, 3) m of the soles' corners, right foot first.

        Args:
            positions: (T, J, 3) m, world positions of the bodies.
            rotation: (T, J, 4) xyzw, world rotations of the bodies.
        """
        soles = []
        for name in ("right_foot", "left_foot"):
            foot = self.body_names.index(name)
            corners = self.foot_corners[[body == foot for body in self.foot_body_ids]]
            sole = corners[corners[:, 2] == corners[:, 2].min()]
            soles.append(world_points([foot] * len(sole), sole, positions, rotation))
        return np.stack(soles, axis=1)


@functools.lru_cache
def skeleton_for_num_dofs(num_dofs: int) -> Skeleton:
    """Return the skeleton of the shipped humanoid with `num_dofs` degrees of freedom.

    Raises:
        ConfigError: no shipped humanoid has so many.
    """
    if num_dofs not in _HUMANOIDS:
        choices = ", ".join(str(n) for n in _HUMANOIDS)
        raise ConfigError(
            f"no humanoid with {num_dofs} degrees of freedom is shipped; choices: {choices}; "
            "pass skeleton=Skeleton.from_mjcf(path) for a model of your own"
        )
    return Skeleton.from_mjcf(paths.assets_dir() / _HUMANOIDS[num_dofs])


def shipped_humanoid_with(body_names: Sequence[str]) -> str | None:
    """Return the model file, relative to the assets folder, of the humanoid with these bodies.

    Their order does not matter. None: no shipped humanoid has exactly these.
    """
    for num_dofs, file in _HUMANOIDS.items():
        if set(skeleton_for_num_dofs(num_dofs).body_names) == set(body_names):
            return file
    return None


def _joint_groups(
    model: mujoco.MjModel, path: str | Path
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the body ids and the DOF offsets of the joint groups; the free joint is skipped."""
    body_ids: list[int] = []
    offsets = [0]
    for i in range(model.njnt):
        joint = model.joint(i)
        kind = mujoco.mjtJoint(int(joint.type[0]))
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            continue
        body_id = int(joint.bodyid[0]) - 1
        is_y_hinge = kind == mujoco.mjtJoint.mjJNT_HINGE and np.allclose(joint.axis, (0, 1, 0))
        if body_id in body_ids or not (kind == mujoco.mjtJoint.mjJNT_BALL or is_y_hinge):
            raise ConfigError(
                f"{path}: joint '{joint.name}': a body of a humanoid has one joint, "
                "a ball joint or a hinge about y"
            )
        body_ids.append(body_id)
        offsets.append(offsets[-1] + _DOFS_OF_JOINT[kind])
    return tuple(body_ids), tuple(offsets)


def _foot_corners(model: mujoco.MjModel) -> tuple[tuple[int, ...], npt.NDArray[np.float64]]:
    """Return body ids (K) and corners (K, 3) m of the feet's boxes, in the frames of the feet."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    body_ids: list[int] = []
    corners = [np.zeros((0, 3))]
    for i in range(model.ngeom):
        geom = model.geom(i)
        body = model.body(geom.bodyid[0])
        if geom.type[0] == mujoco.mjtGeom.mjGEOM_BOX and body.name.endswith("_foot"):
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, geom.quat)
            corners.append(geom.pos + (signs * geom.size) @ rotation.reshape(3, 3).T)
            body_ids.extend([int(geom.bodyid[0]) - 1] * len(signs))
    return tuple(body_ids), np.concatenate(corners)


def _actuators(
    model: mujoco.MjModel, num_dofs: int
) -> tuple[tuple[str, ...], npt.NDArray[np.float64]]:
    """Return the names of the actuators, in DOF order, and their limits (num_dofs, 2)."""
    if model.nu != num_dofs:
        return (), np.zeros((0, 2))
    # The actuator of a ball joint's axis has the axis' limits; a hinge has its own.
    hinges = model.jnt_type[model.actuator_trnid[:, 0]] == mujoco.mjtJoint.mjJNT_HINGE
    limits = np.where(
        hinges[:, None], model.jnt_range[model.actuator_trnid[:, 0]], model.actuator_lengthrange
    )
    return tuple(model.actuator(i).name for i in range(model.nu)), limits
