"""Where the bodies of a model are, from qpos alone, for many states at once.

MuJoCo's stage of positions makes inertias, tendons and collisions too; who only wants to know where
the bodies are pays for all of it. This is the part that tells where they are.

Arrays are component-major: a row for each component of each body, a column for each state, so that
every operation runs along contiguous memory. They are numpy's, whose operations start sooner than
torch's: on arrays this small that is most of their time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.utils.rotations import (
    quat_mul_components,
    rotate_components,
    xyzw_from_wxyz,
)

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_BALL = int(mujoco.mjtJoint.mjJNT_BALL)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
# A shorter quaternion is no rotation, as in MuJoCo.
MIN_LENGTH = 1e-15

Floats = npt.NDArray[np.float32]
Ids = npt.NDArray[np.intp]


@dataclass(frozen=True)
class _Joints:
    """J joints of one type, of J bodies, that can be moved together.

    Attributes:
        kind: their type.
        bodies: (J,) rows of their bodies.
        qpos: rows of qpos: (J,) of hinges and slides, (4, J) xyzw of balls, (7, J) of free joints.
        references: (J, 1) rad or m, qpos in the model's own pose, of hinges and slides.
        axes: (3, J, 1) in the body's frame, of hinges and slides.
        anchors: (3, J, 1) m, the points of the bodies about which they turn; None: the origins.
        turn_first: whether nothing has turned these bodies against their parents before.
    """

    kind: int
    bodies: Ids
    qpos: Ids
    references: Floats
    axes: Floats
    anchors: Floats | None
    turn_first: bool


@dataclass(frozen=True)
class _Level:
    """L bodies equally far from the world, which take their parents' poses together.

    Attributes:
        bodies: their rows.
        parents: (L,) rows of their parents.
        turned: whether any of them can be turned against its parent.
    """

    bodies: slice
    parents: Ids
    turned: bool


class ForwardKinematics:
    """World poses of the B bodies of a model (without the world itself).

    All types of joints, several of them on one body included. Mocap bodies stay where the model
    has them. Simulations on their way to infinity make numpy warn unless it is told not to.

    Args:
        model: the compiled model; what it says now counts.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        # Rows of the bodies nearest to the world first; the world itself has none.
        depth = _depths(model)
        order = depth.argsort(kind="stable")
        self._row_of_body = order.argsort()
        turns = xyzw_from_wxyz(torch.from_numpy(model.body_quat)).numpy()[1:][order]
        self._offsets = _columns(model.body_pos[1:][order])
        self._turns = _columns(turns)
        is_turned = (turns[:, :3] != 0.0).any(axis=1)
        self._joints = _joint_groups(model, self._row_of_body, is_turned)
        for joints in self._joints:
            if joints.kind != _SLIDE:
                is_turned[joints.bodies] = True
        parents = np.append(0, self._row_of_body)[model.body_parentid[1:][order]]
        self._levels: list[_Level] = []
        for distance in range(2, int(depth.max(initial=0)) + 1):
            rows = slice(*np.searchsorted(depth[order], [distance, distance + 1]).tolist())
            self._levels.append(_Level(rows, parents[rows], bool(is_turned[rows].any())))
        # The bodies that hang on others, and on which.
        self._hanging = slice(int((depth == 1).sum()), None)
        self._carriers = parents[self._hanging]

    def __call__(self, qpos: Floats, positions: Floats, rotations: Floats) -> None:
        """Compute the poses of all bodies in world axes.

        Args:
            qpos: (nq, n) in MuJoCo's conventions; quaternions need not be unit.
            positions: (3, B, n) m, filled in.
            rotations: (4, B, n) xyzw, filled in.
        """
        places, turns = np.empty_like(positions), np.empty_like(rotations)
        self._fill_poses_in_parents(qpos, places, turns)
        for level in self._levels:
            carried = turns.take(level.parents, axis=1)
            if level.turned:
                carried = quat_mul_components(carried, turns[:, level.bodies])
            _put(turns, level.bodies, carried)
        # All offsets into world axes at once, then their sums.
        carriers = turns.take(self._carriers, axis=1)
        offsets = rotate_components(carriers, places[:, self._hanging])
        _put(places, self._hanging, offsets)
        for level in self._levels:
            places[:, level.bodies] += places.take(level.parents, axis=1)
        places.take(self._row_of_body, axis=1, out=positions, mode="clip")
        turns.take(self._row_of_body, axis=1, out=rotations, mode="clip")

    def _fill_poses_in_parents(self, qpos: Floats, positions: Floats, rotations: Floats) -> None:
        """As `__call__`, relative to the parents."""
        positions[:] = self._offsets
        rotations[:] = self._turns
        for joints in self._joints:
            values = qpos.take(joints.qpos, axis=0)
            if joints.kind == _FREE:
                _put(positions, joints.bodies, values[:3])
                _put(rotations, joints.bodies, _unit(values[3:]))
            elif joints.kind == _BALL:
                _turn(joints, _unit(values), positions, rotations)
            elif joints.kind == _SLIDE:
                _slide(joints, values - joints.references, positions, rotations)
            else:
                angles = values - joints.references
                _turn(joints, _about(joints.axes, angles), positions, rotations)


def _turn(joints: _Joints, turns: Floats, positions: Floats, rotations: Floats) -> None:
    """Turn bodies by (4, J, n) about their anchors."""
    if joints.turn_first and joints.anchors is None:
        _put(rotations, joints.bodies, turns)
        return
    before = rotations.take(joints.bodies, axis=1)
    after = quat_mul_components(before, turns)
    _put(rotations, joints.bodies, after)
    if joints.anchors is not None:
        # The anchor stays where it was.
        _add(positions, joints.bodies, rotate_components(before, joints.anchors))
        _add(positions, joints.bodies, rotate_components(after, -joints.anchors))


def _slide(joints: _Joints, ways: Floats, positions: Floats, rotations: Floats) -> None:
    """Move bodies by (J, n) m along their axes."""
    axes = rotate_components(rotations.take(joints.bodies, axis=1), joints.axes)
    _add(positions, joints.bodies, [axis * ways for axis in axes])


def _put(rows: Floats, bodies: Ids | slice, components: Sequence[Floats] | Floats) -> None:
    """Write components (J, n) into the rows `bodies` of (components, B, n)."""
    for row, component in zip(rows, components, strict=True):
        row[bodies] = component


def _add(rows: Floats, bodies: Ids, components: Sequence[Floats] | Floats) -> None:
    """As `_put`, to what is there."""
    for row, component in zip(rows, components, strict=True):
        row[bodies] += component


def _depths(model: mujoco.MjModel) -> Ids:
    """Return how many bodies up the world is, (B,), 1 for bodies in the world."""
    depth = np.zeros(model.nbody, dtype=np.intp)
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + 1
    return depth[1:]


def _joint_groups(
    model: mujoco.MjModel, row_of_body: Ids, is_turned: npt.NDArray[np.bool_]
) -> list[_Joints]:
    """Group the joints: the first joints of all bodies by type, then the second ones, and so on."""
    number = np.arange(model.njnt) - model.body_jntadr[model.jnt_bodyid]
    groups: list[_Joints] = []
    turned = is_turned.copy()
    for turn in range(int(number.max(initial=-1)) + 1):
        for kind in np.unique(model.jnt_type[number == turn]):
            ids = np.flatnonzero((number == turn) & (model.jnt_type == kind))
            bodies = row_of_body[model.jnt_bodyid[ids] - 1]
            anchors = model.jnt_pos[ids]
            groups.append(
                _Joints(
                    kind=int(kind),
                    bodies=bodies,
                    qpos=_qpos_rows(int(kind), model.jnt_qposadr[ids]),
                    references=model.qpos0[model.jnt_qposadr[ids], None].astype(np.float32),
                    axes=_columns(model.jnt_axis[ids]),
                    anchors=_columns(anchors) if anchors.any() else None,
                    turn_first=not turned[bodies].any(),
                )
            )
            if kind != _SLIDE:
                turned[bodies] = True
    return groups


def _qpos_rows(kind: int, addresses: npt.NDArray[np.integer]) -> Ids:
    """Rows of qpos of joints that start at `addresses` (J,); quaternions as xyzw."""
    if kind == _FREE:
        place = addresses + np.arange(3)[:, None]
        return np.concatenate((place, _qpos_rows(_BALL, addresses + 3))).astype(np.intp)
    if kind == _BALL:
        rows = torch.from_numpy(addresses[:, None] + np.arange(4))
        return xyzw_from_wxyz(rows).numpy().T.astype(np.intp)
    return addresses.astype(np.intp)


def _columns(vectors: npt.NDArray[np.floating]) -> Floats:
    """Turn constants (J, d) into (d, J, 1)."""
    return np.ascontiguousarray(vectors.T[..., None], dtype=np.float32)


def _unit(quats: Floats) -> Floats:
    """Scale quaternions (4, J, n) to unit length; writes into those that have none."""
    length = np.sqrt(np.square(quats).sum(axis=0))
    is_none = length < MIN_LENGTH
    if is_none.any():
        quats[:3, is_none] = 0.0
        quats[3, is_none] = 1.0
        length[is_none] = 1.0
    return quats / length


def _about(axes: Floats, angles: Floats) -> Floats:
    """Return the quaternions (4, J, n) of turns by angles (J, n) about unit axes (3, J, 1)."""
    half = np.float32(0.5) * angles
    return np.concatenate((axes * np.sin(half), np.cos(half)[None]))
