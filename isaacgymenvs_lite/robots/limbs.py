"""Finds chains of a robot's bodies, the ends of its limbs, and the bodies that touch the floor."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError, suggest
from isaacgymenvs_lite.robots.followers import Followers
from isaacgymenvs_lite.robots.start_pose import CLEARANCE, lowest_points, posed

# Ends of one branch are fingers of one hand if their distance is below this share of the robot's
# size.
_HAND_OF_SIZE = 0.12
# Bodies whose height above the robot's lowest point exceeds this tolerance (m, or a share of the
# base's height) do not touch the floor. The tolerance covers toes and heel of a jointed foot.
_TOUCH = 0.01
_TOUCH_SHARE = 0.02


def ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the ids of a body and of its ancestors up to the root, without the world."""
    chain = []
    while body > 0:
        chain.append(body)
        body = int(model.body_parentid[body])
    return chain


def free_joints(model: mujoco.MjModel, bodies: Sequence[int]) -> list[int]:
    """Return the ids of the joints of bodies, in the order of the bodies, without followers."""
    first, count = model.body_jntadr, model.body_jntnum
    followers = Followers(model).joints
    joints = (int(first[body]) + i for body in bodies for i in range(count[body]))
    return [joint for joint in joints if joint not in followers]


def bodies_named(model: mujoco.MjModel, names: Sequence[str], where: str) -> tuple[str, ...]:
    """Return the bodies that match names or patterns, in the order of the names.

    Raises:
        ConfigError: a name matches no body.
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
    """Return the last bodies of all limbs: hands, feet, and a head or tail with joints.

    A limb is a chain with at least one joint. Several bodies with shapes (rotors, sensors, feet)
    may be fixed to the last link of a limb. The end of the limb is the body that is farthest from
    the link in the pose `qpos` (Q,). A hand with fingers counts as one end.
    """
    places = posed(model, qpos).xpos
    size = float(np.ptp(places[1:], axis=0).max())
    chains = [ancestors(model, body) for body in range(model.nbody)]
    # A body that is fixed to a link may have children with joints, but a rotor never has them.
    carrying = {up for body in np.flatnonzero(model.body_jntnum) for up in chains[body]}

    def ends(body: int) -> list[int]:
        children = np.flatnonzero(model.body_parentid == body).tolist()
        found = [end for child in children if child in carrying for end in ends(child)]
        far = np.linalg.norm(places[found] - places[body], axis=1).max() if found else 0.0
        if len(found) > 1 and far < _HAND_OF_SIZE * size and model.body_parentid[body] != 0:
            return [body]
        return found or tip(body)

    def tip(link: int) -> list[int]:
        fixed = [i for i in range(model.nbody) if link in chains[i] and model.body_geomnum[i] > 0]
        if not fixed or model.body_weldid[link] == model.body_weldid[1]:
            return []
        return [max(fixed, key=lambda i: float(np.linalg.norm(places[i] - places[link])))]

    return tuple(model.body(end).name for end in ends(1))


def touching_bodies(model: mujoco.MjModel, qpos: npt.ArrayLike) -> tuple[str, ...]:
    """Return the bodies whose lowest points are near the robot's lowest point.

    The tolerance is the larger of 1 cm and 2% of the base's height above the floor.
    """
    data = posed(model, qpos)
    lows = lowest_points(model, data)
    lowest = min(lows.values())
    near = max(_TOUCH, _TOUCH_SHARE * (float(data.xpos[1, 2]) - lowest)) + CLEARANCE
    return tuple(model.body(body).name for body, low in lows.items() if low < lowest + near)
