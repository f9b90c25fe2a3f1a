"""How fast the bodies of a model move, from joint velocities and body poses, for many states.

MuJoCo's stage of velocities needs its stage of positions and gives velocities of other points; this
is the part that tells how the bodies' origins move. A body moves as its parent does, and by its
joints: with angular velocity w and origin p, in world axes,

    w = w_parent + sum over balls and hinges of w_joint
    v = v_parent + w_parent x (p - p_parent)
        + sum over balls and hinges of w_joint x (p - anchor) + sum over slides of axis * speed

as in any text on rigid bodies, such as Featherstone, Rigid Body Dynamics Algorithms, section 2.
"""

from __future__ import annotations

import numpy as np

from isaacgymenvs_lite.simulation.kinematic_tree import (
    BALL,
    FREE,
    SLIDE,
    Floats,
    Ids,
    Joints,
    KinematicTree,
    add,
    put,
)
from isaacgymenvs_lite.utils.rotations import (
    cross_components,
    quat_mul_components,
    rotate_components,
)


class BodyVelocities:
    """Velocities of the B bodies of a tree, with all types of joints and several on one body.

    Offsets between bodies are differences of float32 positions: their rounding grows with the
    distance from the environment's origin, by 4e-6 m at 50 m.

    Args:
        tree: the bodies and their joints.
    """

    def __init__(self, tree: KinematicTree) -> None:
        self._tree = tree
        # Only several joints on one body make it necessary to know how things were before the last.
        self._has_stacked_joints = any(joints.number > 0 for joints in tree.joints)

    def __call__(
        self,
        qpos: Floats,
        qvel: Floats,
        positions: Floats,
        rotations: Floats,
        lin_vel: Floats,
        ang_vel: Floats,
    ) -> None:
        """Compute the velocities of all bodies' origins in world axes.

        Args:
            qpos: (nq, n) in MuJoCo's conventions.
            qvel: (nv, n) in MuJoCo's conventions, but angular velocities of free joints in world
                axes.
            positions: (3, B, n) m, as `ForwardKinematics` gives them for `qpos`.
            rotations: (4, B, n) xyzw, likewise.
            lin_vel: (3, B, n) m/s, filled in.
            ang_vel: (3, B, n) rad/s, filled in.
        """
        tree = self._tree
        linear, angular = np.zeros_like(lin_vel), np.zeros_like(ang_vel)
        self._add_joint_velocities(qpos, qvel, positions, rotations, linear, angular)
        for level in tree.levels:
            angular[:, level.bodies] += angular.take(level.parents, axis=1)
        offsets = positions.take(tree.order[tree.hanging], axis=1)
        offsets -= positions.take(tree.order[tree.carriers], axis=1)
        carried = cross_components(angular.take(tree.carriers, axis=1), offsets)
        add(linear, tree.hanging, carried)
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
        """Add to `linear` and `angular`, by rows, what each body does relative to its parent.

        From the last joint of each body to the first: a joint's axis is known from the body's pose
        after it, and the pose before it is that after the one before.
        """
        if self._has_stacked_joints:
            positions_now, rotations_now = positions.copy(), rotations.copy()
        else:
            positions_now, rotations_now = positions, rotations
        for joints in reversed(self._tree.joints):
            rates = qvel.take(joints.qvel, axis=0)
            if joints.kind == FREE:
                add(linear, joints.bodies, rates[:3])
                add(angular, joints.bodies, rates[3:])
                continue
            bodies = self._tree.order[joints.bodies]
            turned = rotations_now.take(bodies, axis=1)
            if joints.kind == BALL:
                motion = rotate_components(turned, rates)
            else:
                motion = [axis * rates for axis in rotate_components(turned, joints.axes)]
            if joints.kind == SLIDE:
                add(linear, joints.bodies, motion)
            else:
                add(angular, joints.bodies, motion)
                if joints.anchors is not None or not joints.move_last:
                    arms = positions.take(bodies, axis=1) - positions_now.take(bodies, axis=1)
                    if joints.anchors is not None:
                        arms -= rotate_components(turned, joints.anchors)
                    add(linear, joints.bodies, cross_components(motion, arms))
            if joints.number > 0:
                _take_back(joints, bodies, qpos, positions_now, rotations_now)


def _take_back(
    joints: Joints, bodies: Ids, qpos: Floats, positions: Floats, rotations: Floats
) -> None:
    """Put `bodies` (J,) from where they are after these joints to where they were before."""
    after = rotations.take(bodies, axis=1)
    if joints.kind == SLIDE:
        ways = joints.ways(qpos)
        add(positions, bodies, [-axis * ways for axis in rotate_components(after, joints.axes)])
        return
    x, y, z, w = joints.turns(qpos)
    before = quat_mul_components(after, (-x, -y, -z, w))
    put(rotations, bodies, before)
    if joints.anchors is not None:
        # The anchor stays where it is.
        add(positions, bodies, rotate_components(after, joints.anchors))
        add(positions, bodies, rotate_components(before, -joints.anchors))
