"""Computes joints that follow other joints: URDF's <mimic> and MJCF's <equality><joint>.

The physics enforces these constraints. Kinematics (start poses, clips, gaits, inverse kinematics)
computes the position of a follower from the position of its leader.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError

_Floats = npt.NDArray[np.floating]
TOLERANCE_RAD = 0.005
"""A smaller deviation of a follower is not reported, because numbers in files are rounded."""
_LOOPS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


@dataclass(frozen=True)
class _Follower:
    """A joint whose position y follows its leader's position x: y - y0 = p(x - x0), as in MuJoCo.

    `start` is y0, the joint's position in the model's initial pose, and `leader_start` is x0. A
    joint without a leader is held at y0 + p(0).
    """

    joint: int
    leader: int | None
    polynomial: np.polynomial.Polynomial
    start: float
    leader_start: float


class Followers:
    """The followers of a compiled model with Q coordinates and V degrees of freedom.

    Raises:
        ConfigError: an equality joins two bodies in a loop, a joint has two leaders, or joints
            follow each other in a circle.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        found: dict[int, _Follower] = {}
        for equality in np.flatnonzero(model.eq_active0).tolist():
            if model.eq_type[equality] in _LOOPS:
                _refuse_loop(model, equality)
            if model.eq_type[equality] != mujoco.mjtEq.mjEQ_JOINT:
                continue
            joint, leader = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
            if joint in found:
                raise ConfigError(
                    f"joint '{model.joint(joint).name}' has two <equality> constraints; a joint can"
                    " follow one other joint: remove one of them"
                )
            polynomial = np.polynomial.Polynomial(model.eq_data[equality, :5])
            start, leader_start = model.qpos0[model.jnt_qposadr[[joint, leader]]].tolist()
            leads = leader if leader >= 0 else None
            found[joint] = _Follower(joint, leads, polynomial, start, leader_start)
        self._in_order = _leaders_first(model, found)

    @property
    def joints(self) -> tuple[int, ...]:
        """The ids of the joints that follow other joints or are held at a position."""
        return tuple(follower.joint for follower in self._in_order)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of `joints`."""
        return tuple(self._model.joint(joint).name for joint in self.joints)

    @property
    def columns(self) -> tuple[int, ...]:
        """The indices of `joints` in qpos."""
        return tuple(int(self._model.jnt_qposadr[joint]) for joint in self.joints)

    def placed(self, qpos: _Floats) -> npt.NDArray[np.float64]:
        """Return poses (..., Q) in which positions of followers are computed from their leaders.

        The poses may lack the coordinates of objects, which come after the coordinates of the
        robot.
        """
        address = self._model.jnt_qposadr
        poses = np.array(qpos, dtype=np.float64)
        for follower in self._in_order:
            moved = np.asarray(0.0)  # a held joint has a constant polynomial
            if follower.leader is not None:
                moved = poses[..., address[follower.leader]] - follower.leader_start
            place = follower.start + follower.polynomial(moved)
            poses[..., address[follower.joint]] = place
        return poses

    def led(self, jacobian: _Floats, qpos: _Floats) -> npt.NDArray[np.float64]:
        """Return a Jacobian (..., V) in which a leader's column includes its followers' motion.

        In the given Jacobian, at the pose `qpos` (Q,), all joints move independently. The columns
        of followers become zero.
        """
        dofs, address = self._model.jnt_dofadr, self._model.jnt_qposadr
        columns = np.array(jacobian, dtype=np.float64)
        for follower in reversed(self._in_order):
            if follower.leader is not None:
                moved = float(qpos[address[follower.leader]]) - follower.leader_start
                slope = float(follower.polynomial.deriv()(moved))
                columns[..., dofs[follower.leader]] += slope * columns[..., dofs[follower.joint]]
            columns[..., dofs[follower.joint]] = 0.0
        return columns


def _leaders_first(model: mujoco.MjModel, followers: dict[int, _Follower]) -> tuple[_Follower, ...]:
    """Return the followers in an order in which every follower comes after its leader."""
    placed: dict[int, _Follower] = {}
    while len(placed) < len(followers):
        ready = {
            joint: follower
            for joint, follower in followers.items()
            if joint not in placed
            and (follower.leader not in followers or follower.leader in placed)
        }
        if not ready:
            names = [model.joint(joint).name for joint in followers if joint not in placed]
            raise ConfigError(
                f"joints {', '.join(names)} follow each other in a circle: remove one <equality>"
                " or <mimic>"
            )
        placed |= ready
    return tuple(placed.values())


def _refuse_loop(model: mujoco.MjModel, equality: int) -> None:
    """Refuse a constraint that closes a kinematic loop."""
    ids = (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))
    if model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE:
        ids = tuple(int(model.site_bodyid[site]) for site in ids)
    if 0 in ids or model.body_weldid[ids[0]] == model.body_weldid[ids[1]]:
        return
    kind = mujoco.mjtEq(int(model.eq_type[equality])).name[5:].lower()
    name = model.equality(equality).name
    one, other = (model.body(body).name for body in ids)
    raise ConfigError(
        f"has a loop: the <{kind}>{f' {name!r}' if name else ''} in <equality> joins '{one}' and"
        f" '{other}', which the kinematics of clips cannot follow; remove it, or use a model"
        " without the linkage"
    )
