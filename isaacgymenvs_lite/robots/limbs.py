"""Guesses at a robot's bodies: the ends of its limbs, and what touches the floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError, suggest
from isaacgymenvs_lite.robots.start_pose import CLEARANCE, lowest_points

# Ends nearer to each other's branch than this part of the robot's size are fingers of one hand.
_HAND_OF_SIZE = 0.12
# Above the lowest point, in m or as a share of the base's height: toes and heel of a jointed foot.
_TOUCH = 0.01
_TOUCH_SHARE = 0.02


def bodies_named(model: mujoco.MjModel, names: Sequence[str], where: str) -> tuple[str, ...]:
    """Return the bodies that names or patterns match, in the order of the patterns.

    Raises:
        ConfigError: one matches no body.
    """
    choices = [model.body(body).name for body in range(1, model.nbody)]
    found: dict[str, None] = {}
    for name in names:
        matched = [choice for choice in choices if fnmatchcase(choice, name)]
        if not matched:
            raise ConfigError(
                f"{where}: '{name}' matches no body{suggest(name, choices)};"
                f" bodies: {', '.join(choices)}"
            )
        found.update(dict.fromkeys(matched))
    return tuple(found)


def limb_ends(model: mujoco.MjModel, qpos: npt.ArrayLike) -> tuple[str, ...]:
    """Return the last bodies of all limbs: hands, feet; a head or tail with joints of its own.

    A limb is a chain with at least one joint. Of the bodies that are fixed to its last link
    (rotors, shoulders, sensors, feet) the farthest one with a shape is the end; the fingers of a
    hand count as the hand.

    Args:
        model: of a robot with a free root.
        qpos: (Q,) a pose.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    size = float(np.ptp(data.xpos[1:], axis=0).max())
    children: dict[int, list[int]] = {}
    # A link's frame on a fixed joint may carry joints further down, a rotor's never does.
    carries_joints = model.body_jntnum > 0
    for body in range(model.nbody - 1, 0, -1):
        parent = int(model.body_parentid[body])
        children.setdefault(parent, []).insert(0, body)
        carries_joints[parent] |= carries_joints[body]

    def ends(body: int) -> list[int]:
        limbs = [child for child in children.get(body, []) if carries_joints[child]]
        below = [end for limb in limbs for end in ends(limb)]
        far = np.linalg.norm(data.xpos[below] - data.xpos[body], axis=1).max() if below else 0.0
        if len(below) > 1 and far < _HAND_OF_SIZE * size and model.body_parentid[body] != 0:
            return [body]
        return below or tip(body)

    def tip(link: int) -> list[int]:
        fixed = [body for body in _subtree(children, link) if model.body_geomnum[body] > 0]
        if not fixed or model.body_weldid[link] == model.body_weldid[1]:
            return []
        return [
            max(fixed, key=lambda body: float(np.linalg.norm(data.xpos[body] - data.xpos[link])))
        ]

    return tuple(model.body(end).name for end in ends(1))


def _subtree(children: Mapping[int, Sequence[int]], root: int) -> list[int]:
    """Return a body and all bodies below it, parents first."""
    found = [root]
    for body in found:
        found += children.get(body, [])
    return found


def touching_bodies(model: mujoco.MjModel, qpos: npt.ArrayLike) -> tuple[str, ...]:
    """Return the bodies whose lowest points are near the robot's lowest one.

    Near is 1 cm, or 2 % of the base's height above the floor if this is more.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    lows = lowest_points(model, data)
    lowest = min(lows.values())
    near = max(_TOUCH, _TOUCH_SHARE * (float(data.xpos[1, 2]) - lowest))
    return tuple(
        model.body(body).name for body, low in lows.items() if low < lowest + near + CLEARANCE
    )
