"""Computes world poses and velocities of a model's bodies from many rows of qpos and qvel.

MuJoCo's functions also compute inertias, tendons and collisions, which no caller of this module
needs, and MuJoCo's velocities do not belong to the bodies' origins.

The bodies have rows in the order of their depth in the tree. One operation therefore applies the
poses of the parents to all bodies of one depth, and one operation applies the positions of all
joints of a group.

Arrays over states are component-major: they have a row for each component of each body and a column
for each state, so that every operation runs along contiguous memory. They are numpy arrays, because
the overhead of torch's operations is longer and dominates the time for arrays of this size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.utils.rotations import (
    cross_components,
    quat_mul_components,
    rotate_components,
    xyzw_from_wxyz,
)

FREE = int(mujoco.mjtJoint.mjJNT_FREE)
BALL = int(mujoco.mjtJoint.mjJNT_BALL)
SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
# A shorter quaternion counts as the identity, as in MuJoCo.
MIN_LENGTH = 1e-15

Floats = npt.NDArray[np.float32]
Ids = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Joints:
    """A group of J joints of one type on J bodies, which are evaluated together.

    Attributes:
        kind: type of the joints.
        number: number of joints that each body has before the joint of this group.
        bodies: (J,) rows of the bodies.
        qpos: rows of qpos: (J,) for hinges and slides, (4, J) xyzw for balls, (7, J) for free
            joints.
        qvel: rows of qvel: (J,) for hinges and slides, (3, J) for balls, (6, J) for free joints.
        references: (J, 1) rad or m, qpos of hinges and slides in the model's reference pose.
        axes: (3, J, 1) axes of hinges and slides in the body's frame.
        anchors: (3, J, 1) m, points about which the bodies rotate; None means that the points are
            the origins of the bodies.
        is_first_rotation: whether the bodies have their parents' rotation before these joints.
        is_last: whether no body of the group has a later joint.
    """

    kind: int
    number: int
    bodies: Ids
    qpos: Ids
    qvel: Ids
    references: Floats
    axes: Floats
    anchors: Floats | None
    is_first_rotation: bool
    is_last: bool

    def rotations(self, qpos: Floats) -> Floats:
        """Return the rotations (4, J, n) xyzw of balls or hinges at qpos (nq, n)."""
        values = qpos.take(self.qpos, axis=0)
        if self.kind == BALL:
            return unit_quats(values)
        half = np.float32(0.5) * (values - self.references)
        return np.concatenate((self.axes * np.sin(half), np.cos(half)[None]))

    def displacements(self, qpos: Floats) -> Floats:
        """Return the displacements (J, n) m of slides at qpos (nq, n)."""
        return qpos.take(self.qpos, axis=0) - self.references


@dataclass(frozen=True)
class Level:
    """L bodies of one depth, to which the poses of their parents are applied together.

    Attributes:
        bodies: rows of the bodies.
        parents: (L,) rows of their parents.
        is_rotated: whether the rotation of any body may differ from the rotation of its parent.
    """

    bodies: slice
    parents: Ids
    is_rotated: bool


class KinematicTree:
    """The first B bodies of a model, without the world, and their joints in groups.

    Args:
        model: the compiled model; later changes of its values have no effect.
        num_bodies: B; these bodies must include their parents. None means all bodies.

    Attributes:
        order: (B,) the bodies in the order of their rows, nearest to the world first.
        row_of_body: (B,) the row of each body.
        offsets: (3, B, 1) m, positions in the parents' frames without joints, in the order of the
            rows.
        rotations: (4, B, 1) xyzw, rotations in the parents' frames without joints, in the order of
            the rows.
        joints: all groups of joints; groups of first joints on a body come before groups of second
            joints.
        levels: the bodies whose parent is not the world, nearest to the world first.
        children: the rows of all levels together.
        parents: rows of the parents of `children`.
    """

    def __init__(self, model: mujoco.MjModel, num_bodies: int | None = None) -> None:
        bodies = slice(1, model.nbody if num_bodies is None else 1 + num_bodies)
        depth = _depths(model)[bodies]
        self.order = depth.argsort(kind="stable")
        self.row_of_body = self.order.argsort()
        quats = xyzw_from_wxyz(torch.from_numpy(model.body_quat)).numpy()[bodies][self.order]
        self.offsets = _columns(model.body_pos[bodies][self.order])
        self.rotations = _columns(quats)
        is_rotated = (quats[:, :3] != 0.0).any(axis=1)
        self.joints = _joint_groups(model, self.row_of_body, is_rotated)
        for joints in self.joints:
            if joints.kind != SLIDE:
                is_rotated[joints.bodies] = True
        parents = np.append(0, self.row_of_body)[model.body_parentid[bodies][self.order]]
        self.levels: list[Level] = []
        for distance in range(2, int(depth.max(initial=0)) + 1):
            rows = slice(*np.searchsorted(depth[self.order], [distance, distance + 1]).tolist())
            self.levels.append(Level(rows, parents[rows], bool(is_rotated[rows].any())))
        self.children = slice(int((depth == 1).sum()), None)
        self.parents = parents[self.children]


class Kinematics:
    """Computes world poses and velocities of the first B bodies of a model.

    A body may have several joints of any type. Mocap bodies keep the poses that they have in the
    model. Diverging simulations cause warnings of numpy unless the caller silences the warnings.

    Args:
        model: the compiled model; later changes of its values have no effect.
        num_bodies: B; these bodies must include their parents. None means all bodies.
    """

    def __init__(self, model: mujoco.MjModel, num_bodies: int | None = None) -> None:
        self._tree = KinematicTree(model, num_bodies)
        # Poses between joints are needed only if a body has several joints.
        self._has_stacked_joints = any(joints.number > 0 for joints in self._tree.joints)

    def poses(self, qpos: Floats, positions: Floats, rotations: Floats) -> None:
        """Compute the poses of all bodies in the world frame.

        Args:
            qpos: (nq, n) in MuJoCo's conventions; quaternions need not have unit length.
            positions: (3, B, n) m, the output.
            rotations: (4, B, n) xyzw, the output.
        """
        tree = self._tree
        pos, rot = np.empty_like(positions), np.empty_like(rotations)  # in the order of the rows
        self._fill_poses_in_parents(qpos, pos, rot)
        for level in tree.levels:
            world = rot.take(level.parents, axis=1)
            if level.is_rotated:
                world = quat_mul_components(world, rot[:, level.bodies])
            scatter(rot, level.bodies, world)
        # Rotate the offsets of all bodies into world axes at once, then add the offsets up.
        offsets = rotate_components(rot.take(tree.parents, axis=1), pos[:, tree.children])
        scatter(pos, tree.children, offsets)
        for level in tree.levels:
            pos[:, level.bodies] += pos.take(level.parents, axis=1)
        pos.take(tree.row_of_body, axis=1, out=positions, mode="clip")
        rot.take(tree.row_of_body, axis=1, out=rotations, mode="clip")

    def _fill_poses_in_parents(self, qpos: Floats, positions: Floats, rotations: Floats) -> None:
        """Fill in the poses relative to the parents, in the order of the rows."""
        positions[:] = self._tree.offsets
        rotations[:] = self._tree.rotations
        for joints in self._tree.joints:
            if joints.kind == FREE:
                values = qpos.take(joints.qpos, axis=0)
                scatter(positions, joints.bodies, values[:3])
                scatter(rotations, joints.bodies, unit_quats(values[3:]))
            elif joints.kind == SLIDE:
                _apply_displacements(joints, joints.displacements(qpos), positions, rotations)
            else:
                _apply_rotations(joints, joints.rotations(qpos), positions, rotations)

    def velocities(
        self,
        qpos: Floats,
        qvel: Floats,
        positions: Floats,
        rotations: Floats,
        lin_vel: Floats,
        ang_vel: Floats,
    ) -> None:
        """Compute the velocities of all bodies' origins in world axes.

        The angular velocity w and the velocity v of the origin p in world axes are (Featherstone,
        Rigid Body Dynamics Algorithms, section 2)

            w = w_parent + sum over balls and hinges of w_joint
            v = v_parent + w_parent x (p - p_parent)
                + sum over balls and hinges of w_joint x (p - anchor)
                + sum over slides of axis * speed

        Offsets between bodies are differences of float32 positions. The rounding error of these
        positions grows with the distance from the environment's origin; the error is 4e-6 m at 50
        m.

        Args:
            qpos: (nq, n) in MuJoCo's conventions.
            qvel: (nv, n) in MuJoCo's conventions, except that the angular velocities of free joints
                are in world axes.
            positions: (3, B, n) m, the result of `poses`.
            rotations: (4, B, n) xyzw, the result of `poses`.
            lin_vel: (3, B, n) m/s, the output.
            ang_vel: (3, B, n) rad/s, the output.
        """
        tree = self._tree
        linear, angular = np.zeros_like(lin_vel), np.zeros_like(ang_vel)
        self._add_joint_velocities(qpos, qvel, positions, rotations, linear, angular)
        for level in tree.levels:
            angular[:, level.bodies] += angular.take(level.parents, axis=1)
        offsets = positions.take(tree.order[tree.children], axis=1)
        offsets -= positions.take(tree.order[tree.parents], axis=1)
        by_parents = cross_components(angular.take(tree.parents, axis=1), offsets)
        scatter_add(linear, tree.children, by_parents)
        for level in tree.levels:
            linear[:, level.bodies] += linear.take(level.parents, axis=1)
        linear.take(tree.row_of_body, axis=1, out=lin_vel, mode="clip")
        angular.take(tree.row_of_body, axis=1, out=ang_vel, mode="clip")

    def _add_joint_velocities(
        self,
        qpos: Floats,
        qvel: Floats,
        positions: Floats,
        rotations: Floats,
        linear: Floats,
        angular: Floats,
    ) -> None:
        """Add each body's velocity relative to its parent to its row of `linear` and `angular`.

        The loop goes from the last joint of each body to the first. The pose that a body has after
        all joints up to a joint gives the axis of this joint. Removing the displacement or rotation
        of this joint from the pose gives the pose after the previous joint.
        """
        if self._has_stacked_joints:
            pos, rot = positions.copy(), rotations.copy()
        else:
            pos, rot = positions, rotations
        for joints in reversed(self._tree.joints):
            rates = qvel.take(joints.qvel, axis=0)
            if joints.kind == FREE:
                scatter_add(linear, joints.bodies, rates[:3])
                scatter_add(angular, joints.bodies, rates[3:])
                continue
            bodies = self._tree.order[joints.bodies]
            after = rot.take(bodies, axis=1)
            if joints.kind == BALL:
                motion = rotate_components(after, rates)
            else:
                motion = [axis * rates for axis in rotate_components(after, joints.axes)]
            if joints.kind == SLIDE:
                scatter_add(linear, joints.bodies, motion)
            else:
                scatter_add(angular, joints.bodies, motion)
                if joints.anchors is not None or not joints.is_last:
                    arms = positions.take(bodies, axis=1) - pos.take(bodies, axis=1)
                    if joints.anchors is not None:
                        arms -= rotate_components(after, joints.anchors)
                    scatter_add(linear, joints.bodies, cross_components(motion, arms))
            if joints.number > 0:
                _undo(joints, bodies, qpos, pos, rot)


def _apply_rotations(joints: Joints, by: Floats, positions: Floats, rotations: Floats) -> None:
    """Rotate bodies by quaternions (4, J, n) about their anchors."""
    if joints.is_first_rotation and joints.anchors is None:
        scatter(rotations, joints.bodies, by)
        return
    before = rotations.take(joints.bodies, axis=1)
    after = quat_mul_components(before, by)
    scatter(rotations, joints.bodies, after)
    if joints.anchors is not None:
        # The anchor does not move.
        scatter_add(positions, joints.bodies, rotate_components(before, joints.anchors))
        scatter_add(positions, joints.bodies, rotate_components(after, -joints.anchors))


def _apply_displacements(joints: Joints, by: Floats, positions: Floats, rotations: Floats) -> None:
    """Move bodies by (J, n) m along their axes."""
    axes = rotate_components(rotations.take(joints.bodies, axis=1), joints.axes)
    scatter_add(positions, joints.bodies, [axis * by for axis in axes])


def _undo(joints: Joints, bodies: Ids, qpos: Floats, positions: Floats, rotations: Floats) -> None:
    """Replace the poses of `bodies` (J,) after these joints by the poses before these joints."""
    after = rotations.take(bodies, axis=1)
    if joints.kind == SLIDE:
        displacements = joints.displacements(qpos)
        axes = rotate_components(after, joints.axes)
        scatter_add(positions, bodies, [-axis * displacements for axis in axes])
        return
    x, y, z, w = joints.rotations(qpos)
    before = quat_mul_components(after, (-x, -y, -z, w))
    scatter(rotations, bodies, before)
    if joints.anchors is not None:
        # The anchor does not move.
        scatter_add(positions, bodies, rotate_components(after, joints.anchors))
        scatter_add(positions, bodies, rotate_components(before, -joints.anchors))


def scatter(rows: Floats, bodies: Ids | slice, components: Sequence[Floats] | Floats) -> None:
    """Write components (J, n) into the rows `bodies` of (components, B, n)."""
    for row, component in zip(rows, components, strict=True):
        row[bodies] = component


def scatter_add(rows: Floats, bodies: Ids | slice, components: Sequence[Floats] | Floats) -> None:
    """Add components (J, n) to the rows `bodies` of (components, B, n)."""
    for row, component in zip(rows, components, strict=True):
        row[bodies] += component


def unit_quats(quats: Floats) -> Floats:
    """Scale quaternions (4, J, n) to unit length; a quaternion of zeros becomes the identity."""
    length = np.sqrt(np.square(quats).sum(axis=0))
    is_none = length < MIN_LENGTH
    if is_none.any():
        quats[:3, is_none] = 0.0
        quats[3, is_none] = 1.0
        length[is_none] = 1.0
    return quats / length


def _depths(model: mujoco.MjModel) -> Ids:
    """Return the depth (nbody,) of each body in the tree, 0 for the world."""
    depth = np.zeros(model.nbody, dtype=np.intp)
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + 1
    return depth


def _joint_groups(
    model: mujoco.MjModel, row_of_body: Ids, is_rotated: npt.NDArray[np.bool_]
) -> list[Joints]:
    """Group the joints by type and by the number of joints before them on their body."""
    included = model.jnt_bodyid <= len(row_of_body)
    number = np.arange(model.njnt) - model.body_jntadr[model.jnt_bodyid]
    groups: list[Joints] = []
    rotated = is_rotated.copy()
    for place in range(int(number[included].max(initial=-1)) + 1):
        for kind in np.unique(model.jnt_type[included & (number == place)]):
            ids = np.flatnonzero(included & (number == place) & (model.jnt_type == kind))
            body_ids = model.jnt_bodyid[ids]
            bodies = row_of_body[body_ids - 1]
            anchors = model.jnt_pos[ids]
            groups.append(
                Joints(
                    kind=int(kind),
                    number=place,
                    bodies=bodies,
                    qpos=_qpos_rows(int(kind), model.jnt_qposadr[ids]),
                    qvel=_qvel_rows(int(kind), model.jnt_dofadr[ids]),
                    references=model.qpos0[model.jnt_qposadr[ids], None].astype(np.float32),
                    axes=_columns(model.jnt_axis[ids]),
                    anchors=_columns(anchors) if anchors.any() else None,
                    is_first_rotation=not rotated[bodies].any(),
                    is_last=bool((model.body_jntnum[body_ids] == place + 1).all()),
                )
            )
            if kind != SLIDE:
                rotated[bodies] = True
    return groups


def _qpos_rows(kind: int, addresses: npt.NDArray[np.integer]) -> Ids:
    """Return rows of qpos of joints that start at `addresses` (J,); quaternions are xyzw."""
    if kind == FREE:
        place = addresses + np.arange(3)[:, None]
        return np.concatenate((place, _qpos_rows(BALL, addresses + 3))).astype(np.intp)
    if kind == BALL:
        rows = torch.from_numpy(addresses[:, None] + np.arange(4))
        return xyzw_from_wxyz(rows).numpy().T.astype(np.intp)
    return addresses.astype(np.intp)


def _qvel_rows(kind: int, addresses: npt.NDArray[np.integer]) -> Ids:
    """Return rows of qvel of joints that start at `addresses` (J,)."""
    if kind in (FREE, BALL):
        return (addresses + np.arange(6 if kind == FREE else 3)[:, None]).astype(np.intp)
    return addresses.astype(np.intp)


def _columns(vectors: npt.NDArray[np.floating]) -> Floats:
    """Return constants (J, d) as (d, J, 1)."""
    return np.ascontiguousarray(vectors.T[..., None], dtype=np.float32)
