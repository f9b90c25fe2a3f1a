"""Where the bodies of a model are, from qpos alone, for many states at once.

MuJoCo's stage of positions makes inertias, tendons and collisions too; who only wants to know where
the bodies are pays for all of it. This is the part that tells where they are.
"""

from __future__ import annotations

import numpy as np

from isaacgymenvs_lite.simulation.kinematic_tree import (
    FREE,
    SLIDE,
    Floats,
    Joints,
    KinematicTree,
    add,
    put,
    unit_quats,
)
from isaacgymenvs_lite.utils.rotations import quat_mul_components, rotate_components


class ForwardKinematics:
    """World poses of the B bodies of a tree.

    All types of joints, several of them on one body included. Mocap bodies stay where the model
    has them. Simulations on their way to infinity make numpy warn unless it is told not to.

    Args:
        tree: the bodies and their joints.
    """

    def __init__(self, tree: KinematicTree) -> None:
        self._tree = tree

    def __call__(self, qpos: Floats, positions: Floats, rotations: Floats) -> None:
        """Compute the poses of all bodies in world axes.

        Args:
            qpos: (nq, n) in MuJoCo's conventions; quaternions need not be unit.
            positions: (3, B, n) m, filled in.
            rotations: (4, B, n) xyzw, filled in.
        """
        tree = self._tree
        places, turns = np.empty_like(positions), np.empty_like(rotations)
        self._fill_poses_in_parents(qpos, places, turns)
        for level in tree.levels:
            carried = turns.take(level.parents, axis=1)
            if level.turned:
                carried = quat_mul_components(carried, turns[:, level.bodies])
            put(turns, level.bodies, carried)
        # All offsets into world axes at once, then their sums.
        carriers = turns.take(tree.carriers, axis=1)
        offsets = rotate_components(carriers, places[:, tree.hanging])
        put(places, tree.hanging, offsets)
        for level in tree.levels:
            places[:, level.bodies] += places.take(level.parents, axis=1)
        places.take(tree.row_of_body, axis=1, out=positions, mode="clip")
        turns.take(tree.row_of_body, axis=1, out=rotations, mode="clip")

    def _fill_poses_in_parents(self, qpos: Floats, positions: Floats, rotations: Floats) -> None:
        """As `__call__`, relative to the parents."""
        positions[:] = self._tree.offsets
        rotations[:] = self._tree.turns
        for joints in self._tree.joints:
            if joints.kind == FREE:
                values = qpos.take(joints.qpos, axis=0)
                put(positions, joints.bodies, values[:3])
                put(rotations, joints.bodies, unit_quats(values[3:]))
            elif joints.kind == SLIDE:
                _slide(joints, joints.ways(qpos), positions, rotations)
            else:
                _turn(joints, joints.turns(qpos), positions, rotations)


def _turn(joints: Joints, turns: Floats, positions: Floats, rotations: Floats) -> None:
    """Turn bodies by (4, J, n) about their anchors."""
    if joints.turn_first and joints.anchors is None:
        put(rotations, joints.bodies, turns)
        return
    before = rotations.take(joints.bodies, axis=1)
    after = quat_mul_components(before, turns)
    put(rotations, joints.bodies, after)
    if joints.anchors is not None:
        # The anchor stays where it was.
        add(positions, joints.bodies, rotate_components(before, joints.anchors))
        add(positions, joints.bodies, rotate_components(after, -joints.anchors))


def _slide(joints: Joints, ways: Floats, positions: Floats, rotations: Floats) -> None:
    """Move bodies by (J, n) m along their axes."""
    axes = rotate_components(rotations.take(joints.bodies, axis=1), joints.axes)
    add(positions, joints.bodies, [axis * ways for axis in axes])
