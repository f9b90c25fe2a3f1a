"""Which bodies hang on which, and the joints between them, sorted for many states at once.

The bodies get rows by their distance from the world: those equally far stand together, and what a
body takes from its parent is computed for all of them in one operation. Joints are grouped so that
all of a group can be moved together.

Arrays over states are component-major: a row for each component of each body, a column for each
state, so that every operation runs along contiguous memory. They are numpy's, whose operations
start sooner than torch's: on arrays this small that is most of their time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.utils.rotations import xyzw_from_wxyz

FREE = int(mujoco.mjtJoint.mjJNT_FREE)
BALL = int(mujoco.mjtJoint.mjJNT_BALL)
SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
# A shorter quaternion is no rotation, as in MuJoCo.
MIN_LENGTH = 1e-15

Floats = npt.NDArray[np.float32]
Ids = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Joints:
    """J joints of one type, of J bodies, that can be moved together.

    Attributes:
        kind: their type.
        number: how many joints their bodies have before these.
        bodies: (J,) rows of their bodies.
        qpos: rows of qpos: (J,) of hinges and slides, (4, J) xyzw of balls, (7, J) of free joints.
        qvel: rows of qvel: (J,) of hinges and slides, (3, J) of balls, (6, J) of free joints.
        references: (J, 1) rad or m, qpos in the model's own pose, of hinges and slides.
        axes: (3, J, 1) in the body's frame, of hinges and slides.
        anchors: (3, J, 1) m, the points of the bodies about which they turn; None: the origins.
        turn_first: whether nothing has turned these bodies against their parents before.
        move_last: whether none of these bodies has a joint after these.
    """

    kind: int
    number: int
    bodies: Ids
    qpos: Ids
    qvel: Ids
    references: Floats
    axes: Floats
    anchors: Floats | None
    turn_first: bool
    move_last: bool

    def turns(self, qpos: Floats) -> Floats:
        """Return the rotations (4, J, n) by which balls or hinges turn bodies in qpos (nq, n)."""
        values = qpos.take(self.qpos, axis=0)
        if self.kind == BALL:
            return unit_quats(values)
        half = np.float32(0.5) * (values - self.references)
        return np.concatenate((self.axes * np.sin(half), np.cos(half)[None]))

    def ways(self, qpos: Floats) -> Floats:
        """Return how far (J, n) m slides move bodies in qpos (nq, n)."""
        return qpos.take(self.qpos, axis=0) - self.references


@dataclass(frozen=True)
class Level:
    """L bodies equally far from the world, which take their parents' poses together.

    Attributes:
        bodies: their rows.
        parents: (L,) rows of their parents.
        turned: whether any of them can be turned against its parent.
    """

    bodies: slice
    parents: Ids
    turned: bool


class KinematicTree:
    """The first B bodies of a model, without the world.

    Args:
        model: the compiled model; what it says now counts.
        num_bodies: B; None for all. None of these bodies may hang on a later one.

    Attributes:
        order: (B,) the bodies in the order of their rows, nearest to the world first.
        row_of_body: (B,) the other way round.
        offsets: (3, B, 1) m, positions in their parents without joints, by rows.
        turns: (4, B, 1) xyzw, rotations in their parents without joints, by rows.
        joints: all joints of these bodies, groups of first joints before second ones.
        levels: the bodies that hang on others, nearest to the world first.
        hanging: the rows of all levels together.
        carriers: rows of the parents of `hanging`.
    """

    def __init__(self, model: mujoco.MjModel, num_bodies: int | None = None) -> None:
        bodies = slice(1, model.nbody if num_bodies is None else 1 + num_bodies)
        depth = _depths(model)[bodies]
        self.order = depth.argsort(kind="stable")
        self.row_of_body = self.order.argsort()
        turns = xyzw_from_wxyz(torch.from_numpy(model.body_quat)).numpy()[bodies][self.order]
        self.offsets = _columns(model.body_pos[bodies][self.order])
        self.turns = _columns(turns)
        is_turned = (turns[:, :3] != 0.0).any(axis=1)
        self.joints = _joint_groups(model, self.row_of_body, is_turned)
        for joints in self.joints:
            if joints.kind != SLIDE:
                is_turned[joints.bodies] = True
        parents = np.append(0, self.row_of_body)[model.body_parentid[bodies][self.order]]
        self.levels: list[Level] = []
        for distance in range(2, int(depth.max(initial=0)) + 1):
            rows = slice(*np.searchsorted(depth[self.order], [distance, distance + 1]).tolist())
            self.levels.append(Level(rows, parents[rows], bool(is_turned[rows].any())))
        self.hanging = slice(int((depth == 1).sum()), None)
        self.carriers = parents[self.hanging]


def put(rows: Floats, bodies: Ids | slice, components: Sequence[Floats] | Floats) -> None:
    """Write components (J, n) into the rows `bodies` of (components, B, n)."""
    for row, component in zip(rows, components, strict=True):
        row[bodies] = component


def add(rows: Floats, bodies: Ids | slice, components: Sequence[Floats] | Floats) -> None:
    """As `put`, to what is there."""
    for row, component in zip(rows, components, strict=True):
        row[bodies] += component


def unit_quats(quats: Floats) -> Floats:
    """Scale quaternions (4, J, n) to unit length; writes into those that have none."""
    length = np.sqrt(np.square(quats).sum(axis=0))
    is_none = length < MIN_LENGTH
    if is_none.any():
        quats[:3, is_none] = 0.0
        quats[3, is_none] = 1.0
        length[is_none] = 1.0
    return quats / length


def _depths(model: mujoco.MjModel) -> Ids:
    """Return how many bodies up the world is, (nbody,), 0 for the world itself."""
    depth = np.zeros(model.nbody, dtype=np.intp)
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + 1
    return depth


def _joint_groups(
    model: mujoco.MjModel, row_of_body: Ids, is_turned: npt.NDArray[np.bool_]
) -> list[Joints]:
    """Group the joints: the first joints of all bodies by type, then the second ones, and so on."""
    ours = model.jnt_bodyid <= len(row_of_body)
    number = np.arange(model.njnt) - model.body_jntadr[model.jnt_bodyid]
    groups: list[Joints] = []
    turned = is_turned.copy()
    for turn in range(int(number[ours].max(initial=-1)) + 1):
        for kind in np.unique(model.jnt_type[ours & (number == turn)]):
            ids = np.flatnonzero(ours & (number == turn) & (model.jnt_type == kind))
            body_ids = model.jnt_bodyid[ids]
            bodies = row_of_body[body_ids - 1]
            anchors = model.jnt_pos[ids]
            groups.append(
                Joints(
                    kind=int(kind),
                    number=turn,
                    bodies=bodies,
                    qpos=_qpos_rows(int(kind), model.jnt_qposadr[ids]),
                    qvel=_qvel_rows(int(kind), model.jnt_dofadr[ids]),
                    references=model.qpos0[model.jnt_qposadr[ids], None].astype(np.float32),
                    axes=_columns(model.jnt_axis[ids]),
                    anchors=_columns(anchors) if anchors.any() else None,
                    turn_first=not turned[bodies].any(),
                    move_last=bool((model.body_jntnum[body_ids] == turn + 1).all()),
                )
            )
            if kind != SLIDE:
                turned[bodies] = True
    return groups


def _qpos_rows(kind: int, addresses: npt.NDArray[np.integer]) -> Ids:
    """Rows of qpos of joints that start at `addresses` (J,); quaternions as xyzw."""
    if kind == FREE:
        place = addresses + np.arange(3)[:, None]
        return np.concatenate((place, _qpos_rows(BALL, addresses + 3))).astype(np.intp)
    if kind == BALL:
        rows = torch.from_numpy(addresses[:, None] + np.arange(4))
        return xyzw_from_wxyz(rows).numpy().T.astype(np.intp)
    return addresses.astype(np.intp)


def _qvel_rows(kind: int, addresses: npt.NDArray[np.integer]) -> Ids:
    """Rows of qvel of joints that start at `addresses` (J,)."""
    if kind in (FREE, BALL):
        return (addresses + np.arange(6 if kind == FREE else 3)[:, None]).astype(np.intp)
    return addresses.astype(np.intp)


def _columns(vectors: npt.NDArray[np.floating]) -> Floats:
    """Turn constants (J, d) into (d, J, 1)."""
    return np.ascontiguousarray(vectors.T[..., None], dtype=np.float32)
