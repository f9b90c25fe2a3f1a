"""The kinematic tree of a robot and its degrees of freedom, read from the MuJoCo model."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.robots.followers import Followers
from isaacgymenvs_lite.utils import rotations

# Maps numbers of DOFs to the model files of the shipped humanoids in the assets folder.
_HUMANOIDS = {28: "mjcf/amp_humanoid.xml", 31: "mjcf/amp_humanoid_sword_shield.xml"}
SHIPPED_NUM_DOFS = tuple(_HUMANOIDS)
_BALL, _HINGE = int(mujoco.mjtJoint.mjJNT_BALL), int(mujoco.mjtJoint.mjJNT_HINGE)
_DOFS_OF_JOINT = {_BALL: 3, _HINGE: 1}
_FREE_JOINT_QPOS = 7


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints and J bodies of a robot with a free root. Bodies are in depth-first order.

    A joint group is one joint. A ball joint has 3 DOFs (rotation vector in rad, child frame), and a
    hinge has 1 DOF (angle in rad). A body may have no joint, or several joints that rotate the body
    one after another.
    """

    body_names: tuple[str, ...]  # J names
    parent_indices: tuple[int, ...]  # J body ids, -1 for the root; parents come before children
    # (J, 3) m, origins of bodies in their parents' frames with joints at rest. The root's row is
    # the root's position in the model file, which kinematics does not use.
    local_translation: npt.NDArray[np.float64]
    dof_body_ids: tuple[int, ...]  # G body ids, one per joint group, in DOF order
    # (G + 1,) joint group g has the DOFs from dof_offsets[g] up to, but not including,
    # dof_offsets[g + 1]
    dof_offsets: tuple[int, ...]
    foot_body_ids: tuple[int, ...]  # K body ids of the feet in the rows of `foot_corners`
    # (K, 3) m, corners of the box geoms of bodies named *_foot, in body frames
    foot_corners: npt.NDArray[np.float64]
    # One name per DOF. The DOF of a hinge has the hinge's name. The DOFs of a ball joint have the
    # names of its three actuators (for example abdomen_x), or <joint>_x, <joint>_y and <joint>_z.
    dof_names: tuple[str, ...]
    # (num_dofs, 2) rad, limits of each DOF. Limits are infinite for unlimited hinges, and +-pi for
    # unlimited ball joints.
    dof_limits: npt.NDArray[np.float64]
    # (J, 4) xyzw, rotations of bodies in their parents' frames with joints at rest. The root's row
    # is the identity.
    rest_rotation: npt.NDArray[np.float64]
    joint_axes: npt.NDArray[np.float64]  # (G, 3) unit vectors, child frame; 0 for ball joints
    joint_anchors: npt.NDArray[np.float64]  # (G, 3) m, centres of rotation, child frame
    joint_refs: npt.NDArray[np.float64]  # (G,) rad, rest angles of hinges; 0 for ball joints
    model: mujoco.MjModel  # the compiled model
    followers: Followers | None  # joints that follow other joints, or None

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
        """The number of DOFs, 3 or 1, of each joint group."""
        return tuple(end - start for start, end in itertools.pairwise(self.dof_offsets))

    @property
    def shared_body_ids(self) -> tuple[int, ...]:
        """The ids of bodies with several joints; their rotations do not determine the DOFs."""
        ids = self.dof_body_ids
        return tuple(sorted({body for body in ids if ids.count(body) > 1}))

    @property
    def qpos_addresses(self) -> tuple[int, ...]:
        """(G + 1,) first index of each joint group in qpos, and the index after the last group."""
        sizes = (4 if size == 3 else 1 for size in self.dof_sizes)
        return tuple(itertools.accumulate(sizes, initial=_FREE_JOINT_QPOS))

    @functools.cached_property
    def up_b(self) -> tuple[float, ...]:
        """The upward direction (3,) in the root's frame, for the root's rotation in the model."""
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, self.model.qpos0[3:7])
        return tuple(matrix[6:])

    @functools.cached_property
    def has_offset_joints(self) -> bool:
        """Whether a joint is not at its body's origin, so that the joint moves the origin."""
        return bool(self.joint_anchors.any())

    @functools.cached_property
    def has_simple_joints(self) -> bool:
        """Whether each body has the same rotation as its joint, as in the shipped humanoids.

        This requires that a body has at most one joint, which is at the body's origin and is a ball
        joint or a hinge about y with rest angle 0, and that no body is rotated at rest. Clips of
        other skeletons have `dof_pos`.
        """
        is_hinge = np.array(self.dof_sizes) == 1
        return not (
            self.shared_body_ids
            or self.has_offset_joints
            or self.joint_refs.any()
            or self.rest_rotation[:, :3].any()
            or not np.allclose(self.joint_axes[is_hinge], (0.0, 1.0, 0.0))
        )

    @classmethod
    def from_mjcf(cls, path: str | Path) -> Skeleton:
        """Read the skeleton of an MJCF file."""
        try:
            model = mujoco.MjModel.from_xml_path(str(path))
        except ValueError as error:
            raise ConfigError(f"{path}: is no model that can be used ({error})") from error
        return cls.from_model(model, str(path))

    @classmethod
    def from_model(cls, model: mujoco.MjModel, name: str = "the model") -> Skeleton:
        """Read the robot's skeleton from a compiled model; objects are ignored.

        Raises ConfigError if the first joint is not the free joint of a root, or if the robot has a
        slide joint or a loop. Messages contain `name`.
        """
        if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
            raise ConfigError(
                f"{name}: its first joint is not the free joint of a root; a robot on a free joint"
                " is expected (the preparation in isaacgymenvs_lite.robots adds one)"
            )
        root = int(model.jnt_bodyid[0])
        # MuJoCo's ids of the bodies in a tree are consecutive. The skeleton's ids count from the
        # root.
        num_bodies = int(np.count_nonzero(model.body_rootid == root))
        bodies = slice(root, root + num_bodies)
        of_robot = (model.jnt_bodyid >= root) & (model.jnt_bodyid < root + num_bodies)
        joints = np.flatnonzero(of_robot)[1:]  # all joints except the free joint
        for joint in joints[model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE]:
            raise ConfigError(
                f"{name}: joint '{model.joint(joint).name}' is a slide; a clip moves hinges and"
                " ball joints (the preparation in isaacgymenvs_lite.robots fixes slides)"
            )
        sizes = [_DOFS_OF_JOINT[int(model.jnt_type[joint])] for joint in joints]
        is_hinge = model.jnt_type[joints] == _HINGE
        foot_body_ids, foot_corners = _foot_corners(model, root, num_bodies)
        dof_names, dof_limits = _names_and_limits(model, joints)
        rest = rotations.xyzw_from_wxyz(torch.from_numpy(model.body_quat[bodies].copy())).numpy()
        rest[0] = (0.0, 0.0, 0.0, 1.0)
        try:
            followers = Followers(model)
        except ConfigError as error:
            raise ConfigError(f"{name}: {error}") from error
        return cls(
            body_names=tuple(model.body(i).name or f"body{i}" for i in range(root, bodies.stop)),
            parent_indices=(-1, *(int(i) - root for i in model.body_parentid[bodies][1:])),
            local_translation=model.body_pos[bodies].copy(),
            dof_body_ids=tuple(int(model.jnt_bodyid[joint]) - root for joint in joints),
            dof_offsets=tuple(itertools.accumulate(sizes, initial=0)),
            foot_body_ids=foot_body_ids,
            foot_corners=foot_corners,
            dof_names=dof_names,
            dof_limits=dof_limits,
            rest_rotation=rest,
            joint_axes=np.where(is_hinge[:, None], model.jnt_axis[joints], 0.0),
            joint_anchors=model.jnt_pos[joints].copy(),
            joint_refs=np.where(is_hinge, model.qpos0[model.jnt_qposadr[joints]], 0.0),
            model=model,
            followers=followers if followers.joints else None,
        )


@functools.lru_cache
def skeleton_for_num_dofs(num_dofs: int) -> Skeleton:
    """Return the skeleton of the shipped humanoid with `num_dofs` degrees of freedom."""
    if num_dofs not in _HUMANOIDS:
        choices = ", ".join(str(n) for n in _HUMANOIDS)
        raise ConfigError(
            f"no humanoid with {num_dofs} degrees of freedom is shipped; choices: {choices}; "
            "pass skeleton=Skeleton.from_mjcf(path) for a model of your own"
        )
    return Skeleton.from_mjcf(paths.assets_dir() / _HUMANOIDS[num_dofs])


def shipped_humanoid_with(body_names: Sequence[str]) -> str | None:
    """Return the path, relative to the assets folder, of the humanoid with these bodies, or None.

    The order of the names does not matter.
    """
    for num_dofs, file in _HUMANOIDS.items():
        if set(skeleton_for_num_dofs(num_dofs).body_names) == set(body_names):
            return file
    return None


def _foot_corners(
    model: mujoco.MjModel, root: int, num_bodies: int
) -> tuple[tuple[int, ...], npt.NDArray[np.float64]]:
    """Return body ids (K) and corners (K, 3) m of the feet's boxes in the feet's frames."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    body_ids: list[int] = []
    corners = [np.zeros((0, 3))]
    for i in range(model.ngeom):
        geom = model.geom(i)
        body = int(geom.bodyid[0]) - root
        is_box = geom.type[0] == mujoco.mjtGeom.mjGEOM_BOX and 0 <= body < num_bodies
        if is_box and model.body(geom.bodyid[0]).name.endswith("_foot"):
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, geom.quat)
            corners.append(geom.pos + (signs * geom.size) @ rotation.reshape(3, 3).T)
            body_ids.extend([body] * len(signs))
    return tuple(body_ids), np.concatenate(corners)


def _names_and_limits(
    model: mujoco.MjModel, joints: npt.NDArray[np.int64]
) -> tuple[tuple[str, ...], npt.NDArray[np.float64]]:
    """Return the names of the DOFs and their limits (num_dofs, 2) rad."""
    names: list[str] = []
    limits: list[tuple[float, float]] = []
    for joint in joints:
        name = model.joint(joint).name or f"joint{joint}"
        low, high = model.jnt_range[joint]
        is_limited = bool(model.jnt_limited[joint])
        if model.jnt_type[joint] == _HINGE:
            names.append(name)
            limits.append((low, high) if is_limited else (-math.inf, math.inf))
            continue
        # MuJoCo limits only the total angle of a ball joint, but its three actuators may limit the
        # axes.
        reach = high if is_limited else math.pi
        drives = np.flatnonzero(
            (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
            & (model.actuator_trnid[:, 0] == joint)
        )
        has_own = len(drives) == 3 and bool(model.actuator_lengthrange[drives].any())
        if has_own:
            names += [model.actuator(i).name for i in drives]
            limits += list(model.actuator_lengthrange[drives])
        else:
            names += [f"{name}_{axis}" for axis in "xyz"]
            limits += [(-reach, reach)] * 3
    return tuple(names), np.array(limits, dtype=np.float64).reshape(-1, 2)
