"""Reads mapping files, which assign robots' bodies to humanoid bodies, and guesses mappings.

docs/motion_formats.md describes mapping files; the shipped files are in assets/retargeting/robots.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import body_poses
from isaacgymenvs_lite.motion.retargeting.mapping import WITH_ATTITUDE, read_mapping_keys
from isaacgymenvs_lite.motion.retargeting.solve import weights_of
from isaacgymenvs_lite.motion.retargeting.source import SIDES
from isaacgymenvs_lite.robots.followers import Followers
from isaacgymenvs_lite.robots.limbs import ancestors, free_joints, limb_ends, touching_bodies
from isaacgymenvs_lite.robots.start_pose import posed
from isaacgymenvs_lite.schema import read_section, setting
from isaacgymenvs_lite.utils import rotations

_ANGLES = 91  # number of tried angles of a hinge
_ASIDE = 0.1  # least distance of hands from the middle plane, in root heights
_LEG, _ARM = ("thigh", "shin", "foot"), ("upper_arm", "lower_arm", "hand")


def find_bend(
    model: mujoco.MjModel, start: FloatArray, top: int, end: int
) -> tuple[int, FloatArray, FloatArray] | None:
    """Find the knee or elbow that bends a limb, or return None if no hinge bends the limb.

    With all other joints in the pose `start` (nq,), the chosen hinge changes the distance between
    the bodies `top` and `end` most. Return the hinge's joint id, angles (rad) over the hinge's
    range, and the distances (m) at these angles.
    """
    between = itertools.takewhile(lambda body: body != top, ancestors(model, end)[1:])
    names = [model.body(top).name, model.body(end).name]
    followers, tried = Followers(model), []
    for joint in free_joints(model, list(between)):
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
            continue
        low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-math.pi, math.pi)
        angles = np.linspace(low, high, _ANGLES)
        poses = np.repeat(start[None], _ANGLES, axis=0)
        poses[:, model.jnt_qposadr[joint]] = angles
        places, _ = body_poses(model, followers.placed(poses), names)
        tried.append((joint, angles, np.linalg.norm(places[:, 0] - places[:, 1], axis=1)))
    return max(tried, key=lambda entry: float(np.ptp(entry[2])), default=None)


def find_limbs(model: mujoco.MjModel, start: FloatArray) -> dict[str, int]:
    """Return a dictionary from the humanoid's names to a biped's body ids, or {} without a biped.

    Legs are the limbs whose last body is on the floor in the pose `start` (nq,). Arms are the other
    limbs whose last bodies are farthest to the left and right. `find_bend` finds shins and lower
    arms. The robot must face along the x axis of its free root.
    """
    ends = [model.body(name).id for name in limb_ends(model, start)]
    grounded = {model.body_weldid[model.body(name).id] for name in touching_bodies(model, start)}
    feet = [end for end in ends if model.body_weldid[end] in grounded]
    legs = _pair(model, start, feet, _LEG, 0.0) if len(feet) == 2 else None
    if legs is None:
        return {}
    found = {"pelvis": legs[1], **legs[0]}
    others = [end for end in ends if end not in feet]
    arms = _pair(model, start, others, _ARM, _ASIDE * float(start[2])) if others else None
    if arms is not None:
        found |= arms[0]
        if arms[1] not in found.values():
            found["torso"] = arms[1]
    return found


def _pair(
    model: mujoco.MjModel,
    start: FloatArray,
    ends: list[int],
    parts: tuple[str, ...],
    aside_m: float,
) -> tuple[dict[str, int], int] | None:
    """Return the links of the limbs that reach farthest left and right, and the limbs' parent.

    The parent is the lowest body that has joints and carries both limbs, or the root. `parts` are
    the names of a limb's three links. Return None if no pair of limbs reaches at least `aside_m`
    from the middle.
    """
    places, turns = body_poses(model, start[None], [model.body(i).name for i in (1, *ends)])
    back = rotations.quat_conjugate(torch.from_numpy(turns[0, :1])).expand(len(ends), 4)
    from_root = torch.from_numpy(places[0, 1:] - places[0, :1])
    left_m = rotations.quat_apply(back, from_root).numpy()[:, 1]
    if left_m.max() <= aside_m or left_m.min() >= -aside_m:
        return None
    sides = {"left": ends[int(left_m.argmax())], "right": ends[int(left_m.argmin())]}
    # A chain holds the bodies with joints from below the root to the last body of a limb.
    chains = {
        side: [i for i in reversed(ancestors(model, end)[:-1]) if model.body_jntnum[i] > 0]
        for side, end in sides.items()
    }
    shared = set(chains["left"]) & set(chains["right"])
    found: dict[str, int] = {}
    for side, end in sides.items():
        links = [body for body in chains[side] if body not in shared]
        bend = find_bend(model, start, links[0], end) if links else None
        lower = int(model.jnt_bodyid[bend[0]]) if bend is not None else None
        if lower not in links[1:]:
            return None
        last = links[-1] if links[-1] != lower else end
        if last == lower:
            return None
        upper = links[links.index(lower) - 1]
        names = (f"{side}_{part}" for part in parts)
        found |= dict(zip(names, (upper, lower, last), strict=True))
    return found, max(shared, default=1)


NEEDED = ("pelvis", *(f"{side}_{part}" for side in SIDES for part in ("thigh", "shin", "foot")))
# Maps the humanoid's body names to the names of the parents; parents come first.
_PARENTS = {
    "torso": "pelvis",
    "head": "torso",
    **{
        f"{side}_{part}": parent if parent in ("pelvis", "torso") else f"{side}_{parent}"
        for side in SIDES
        for part, parent in (
            *(("upper_arm", "torso"), ("lower_arm", "upper_arm"), ("hand", "lower_arm")),
            *(("thigh", "pelvis"), ("shin", "thigh"), ("foot", "shin")),
        )
    },
}
ROBOT_BODIES = ("pelvis", *_PARENTS)
_OF_ARMS = ("lower_arm", "hand")  # bodies that are used only if their parents are found
_MAX_WEIGHT = 1e3


@dataclass(frozen=True, kw_only=True)
class _BodySettings:
    """An entry of the key `bodies`."""

    body: str = setting()
    position: float | None = setting(None, minimum=0, maximum=_MAX_WEIGHT)
    rotation: float | None = setting(None, minimum=0, maximum=_MAX_WEIGHT)


@dataclass(frozen=True, kw_only=True)
class _RobotMappingSettings:
    """The content of a mapping file for a robot."""

    bodies: Mapping[str, Any] = setting({})
    start_pose: str = setting("")
    start_rotation: tuple[float, ...] | None = setting(None, length=4)
    fastest_rad_s: float = setting(20.0, above=0, maximum=1e3)


@dataclass(frozen=True)
class RobotBody:
    """A body of the robot, with the weights of its position (1/m) and its rotation (1/rad)."""

    body: str
    position: float
    rotation: float


@dataclass(frozen=True, eq=False)
class RobotMapping:
    """A mapping from the humanoid's bodies to bodies of a robot."""

    name: str  # path of the mapping file, or the name of a shipped mapping
    # From the humanoid's names to the robot's bodies; parents come first. The names include
    # `NEEDED`, or the mapping is empty and `guess_robot_mapping` finds the bodies.
    bodies: Mapping[str, RobotBody]
    # Name of the keyframe in which the robot stands upright. "" selects the keyframe home, stand or
    # standing, or else the model's default pose.
    start_pose: str = ""
    fastest_rad_s: float = 20.0  # largest speed of hinges
    # The root's quaternion xyzw in the start pose, for `motion.convert`. If it is None, the start
    # pose is not changed.
    start_rotation: tuple[float, ...] | None = None

    def parent(self, name: str) -> str | None:
        """Return the nearest ancestor of `name` that is in the mapping, or None for the pelvis."""
        above = _PARENTS.get(name)
        return above if above is None or above in self.bodies else self.parent(above)


def shipped_robot_mappings() -> dict[str, Path]:
    """Return a dictionary from the names of the shipped robot mappings to the files."""
    folder = paths.assets_dir() / "retargeting" / "robots"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def load_robot_mapping(mapping: str | Path) -> RobotMapping:
    """Read a robot's mapping, whose file or shipped name is given, or raise a ConfigError."""
    with reading(mapping, "mapping file"):
        path, content = read_mapping_keys(mapping, shipped_robot_mappings(), "bodies")
        settings = read_section(_RobotMappingSettings, content, where=str(path), complete=True)
        bodies = settings.bodies
        for name in bodies:
            if name not in ROBOT_BODIES:
                raise ConfigError(f"{path}: {unknown('body', str(name), ROBOT_BODIES)}")
        needed = [*NEEDED, *(_PARENTS[name] for name in bodies if name.endswith(_OF_ARMS))]
        missing = [name for name in dict.fromkeys(needed) if bodies and name not in bodies]
        if missing:
            raise ConfigError(f"{path}: bodies lacks {', '.join(missing)}")
        return RobotMapping(
            str(mapping),
            {
                name: _robot_body(name, bodies[name], f"{path}: bodies.{name}")
                for name in ROBOT_BODIES
                if name in bodies
            },
            settings.start_pose,
            settings.fastest_rad_s,
            settings.start_rotation,
        )


def _robot_body(name: str, entry: Any, where: str) -> RobotBody:
    if isinstance(entry, str):
        entry = {"body": entry}
    settings = read_section(_BodySettings, entry, where=where, complete=True)
    position, rotation = weights_of(name) or (0.0, 0.0)
    if name not in WITH_ATTITUDE:
        if settings.rotation:
            raise ConfigError(
                f"{where}.rotation is {settings.rotation:g}, but the source has rotations only of "
                f"{', '.join(WITH_ATTITUDE)}; leave it out"
            )
        rotation = 0.0
    return RobotBody(
        settings.body,
        position if settings.position is None else settings.position,
        rotation if settings.rotation is None else settings.rotation,
    )


# Maps the humanoid's names to patterns of body and joint names in files of robots. The first
# pattern with a match is used.
_WORDS = {
    "pelvis": ("pelvis", "hips", "waist_?base|base"),
    "torso": ("torso|chest|thorax", "trunk", "waist|spine|abdomen"),
    "head": ("head", "neck"),
    "thigh": ("thigh|upper_?leg|up_?leg|femur", "hip"),
    "shin": ("shin|calf|lower_?leg|tibia", "knee"),
    "foot": ("foot", "ankle"),
    "upper_arm": ("upper_?arm|up_?arm|humerus", "shoulder"),
    "lower_arm": ("lower_?arm|fore_?arm|radius", "elbow"),
    "hand": ("palm", "hand", "wrist"),
}
_NOT = re.compile(r"thumb|index|middle|ring_?\d|finger|pinky|little|toe|rubber")
_SIDES = {
    side: rf"{side}|(^|[_ .:]){side[0]}([_ .:]|$)|^[{side[0]}{side[0].upper()}](?=[A-Z])"
    for side in SIDES
}


def guess_robot_mapping(
    model: mujoco.MjModel, start: FloatArray | None = None
) -> tuple[RobotMapping, str]:
    """Guess a robot's mapping from body names, or from the joints if no body names match.

    The robot stands in the pose `start` (nq,); None selects the model's default pose. Return the
    mapping, and a line of text that lists the bodies. Raises ConfigError with advice if a part of a
    leg is not found.
    """
    names = {i: model.body(i).name for i in range(1, model.nbody)}
    found = {
        name: body for name in ROBOT_BODIES if (body := _guess(model, names, name)) is not None
    }
    if "pelvis" not in found:
        found["pelvis"] = 1  # the root
    found = _plausible(model, {name: found[name] for name in ROBOT_BODIES if name in found})
    how = "name"
    pose = model.qpos0.copy() if start is None else start
    by_joints = {} if found.keys() >= set(NEEDED) else find_limbs(model, pose)
    if by_joints:
        how, found = "their joints", {n: by_joints[n] for n in ROBOT_BODIES if n in by_joints}
    matched = ", ".join(f"{name}: {names[body]}" for name, body in found.items())
    missing = [name for name in NEEDED if name not in found]
    if missing:
        raise ConfigError(
            f"cannot find {', '.join(missing)} of the robot by the names of its bodies (matched "
            f"{matched}); write a mapping file with a line for each under 'bodies:', for "
            f"example 'left_foot: <body>'; its bodies: {', '.join(names.values())}"
        )
    bodies = {name: _robot_body(name, names[body], "guessed") for name, body in found.items()}
    return RobotMapping(f"guessed by {how}", bodies), f"bodies by {how}: {matched}"


def _plausible(model: mujoco.MjModel, found: Mapping[str, int]) -> dict[str, int]:
    """Remove contradictory matches, and return the others; parents come first.

    A match is dropped if its link is already matched, if it is a lower arm or hand whose parent is
    missing, or if its link is not below the parent's link (for example a quadruped's hind foot). A
    foot without geoms is replaced by the foot's parent link.
    """
    kept: dict[str, int] = {}
    for name, body in found.items():
        if body not in kept.values() and not (
            name.endswith(_OF_ARMS) and _PARENTS[name] not in kept
        ):
            kept[name] = body
    for name in [name for name in kept if name.endswith(("shin", "foot", *_OF_ARMS))]:
        if kept.get(_PARENTS[name]) not in ancestors(model, kept[name])[1:]:
            del kept[name]
    for side in SIDES:
        foot = kept.get(f"{side}_foot")
        if foot is not None and model.body_geomnum[foot] == 0:
            link = int(model.body_weldid[foot])
            kept[f"{side}_foot"] = foot if link == kept.get(f"{side}_shin") else link
    return kept


def _guess(model: mujoco.MjModel, names: Mapping[int, str], name: str) -> int | None:
    side, _, part = name.partition("_") if name.startswith(SIDES) else ("", "", name)
    joints = {
        i: " ".join(model.joint(j).name for j in np.flatnonzero(model.jnt_bodyid == i) if j > 0)
        for i in names
    }
    for pattern in _WORDS[part]:
        for texts in (names, joints):
            bodies = [i for i in names if names_body(texts[i], pattern, side)]
            if bodies:
                return _of_chain(model, bodies, part)
    return None


def names_body(text: str, pattern: str, side: str) -> bool:
    """Return whether a name matches a body's pattern and side, which is "" for middle bodies."""
    lower = text.lower()
    if not re.search(pattern, lower) or _NOT.search(lower):
        return False
    sides = {
        name
        for name, of_side in _SIDES.items()
        if re.search(of_side, lower)
        or re.search(of_side, text)
        or re.match(f"{name[0]}({pattern})", lower)  # for example lfemur
    }
    return sides == ({side} if side else set())


def _of_chain(model: mujoco.MjModel, bodies: Sequence[int], part: str) -> int:
    """Choose one of several links that match the same part, for example hip pitch, roll and yaw.

    For a thigh or upper arm, the last link near the first link is chosen. For a foot, hand or
    torso, the last link is chosen, and for other parts the first link.
    """
    if part in ("thigh", "upper_arm"):
        places = posed(model, model.qpos0).xpos[bodies]
        below = np.linalg.norm(places - places[0], axis=1)
        near = [i for i, far in zip(bodies, below, strict=True) if far < 0.5 * below.max()]
        return near[-1] if near else bodies[0]
    return bodies[-1] if part in ("foot", "hand", "torso") else bodies[0]
