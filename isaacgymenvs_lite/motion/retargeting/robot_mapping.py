"""Mapping files for robots: which body of a robot moves as which body of the humanoid.

docs/motion_formats.md describes them; assets/retargeting/robots has those that ship. Without a file
the bodies are guessed by their names.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.limbs import find_limbs
from isaacgymenvs_lite.motion.retargeting.mapping import WITH_ATTITUDE, read_mapping_keys
from isaacgymenvs_lite.motion.retargeting.solve import weights_of
from isaacgymenvs_lite.motion.retargeting.source import SIDES
from isaacgymenvs_lite.robots.limbs import ancestors
from isaacgymenvs_lite.robots.start_pose import posed
from isaacgymenvs_lite.schema import read_section, setting

NEEDED = ("pelvis", *(f"{side}_{part}" for side in SIDES for part in ("thigh", "shin", "foot")))
# Each body before those that need it as their parent.
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
_OF_ARMS = ("lower_arm", "hand")  # useless without the body before them
_MAX_WEIGHT = 1e3


@dataclass(frozen=True, kw_only=True)
class _BodySettings:
    """An entry of `bodies`."""

    body: str = setting()
    position: float | None = setting(None, minimum=0, maximum=_MAX_WEIGHT)
    rotation: float | None = setting(None, minimum=0, maximum=_MAX_WEIGHT)


@dataclass(frozen=True, kw_only=True)
class _RobotMappingSettings:
    """A mapping file for a robot."""

    bodies: Mapping[str, Any] = setting({})
    start_pose: str = setting("")
    start_rotation: tuple[float, ...] | None = setting(None, length=4)
    fastest_rad_s: float = setting(20.0, above=0, maximum=1e3)


@dataclass(frozen=True)
class RobotBody:
    """A body of the robot and the weights of its place (1/m) and attitude (1/rad)."""

    body: str
    position: float
    rotation: float


@dataclass(frozen=True, eq=False)
class RobotMapping:
    """How the humanoid's bodies move a robot.

    Attributes:
        name: the file, or the name of a shipped mapping.
        bodies: of the robot, by the humanoid's names, parents first; `NEEDED` and more. Empty: they
            are found by their names (`guess_robot_mapping`).
        start_pose: key of the model in which it stands upright; "": home, stand or standing, if
            there is one, else the pose of the model file.
        fastest_rad_s: how fast a hinge may be from frame to frame.
        start_rotation: xyzw, of the root in the start pose; None: as there. The clip commands use
            it (`motion.robot_clips`).
    """

    name: str
    bodies: Mapping[str, RobotBody]
    start_pose: str = ""
    fastest_rad_s: float = 20.0
    start_rotation: tuple[float, ...] | None = None

    def parent(self, name: str) -> str | None:
        """Return the nearest body before `name` that is mapped; None of the pelvis."""
        above = _PARENTS.get(name)
        return above if above is None or above in self.bodies else self.parent(above)


def shipped_robot_mappings() -> dict[str, Path]:
    """Return the files of the shipped mappings for robots by name."""
    folder = paths.assets_dir() / "retargeting" / "robots"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def load_robot_mapping(mapping: str | Path) -> RobotMapping:
    """Read a mapping file for a robot, or the shipped one of that name.

    Raises:
        ConfigError: no such file or name; no YAML; a key is unknown or has a value that cannot be
            used; a body is missing, unknown, or given without its parent.
    """
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
                f"{where}.rotation is {settings.rotation:g}, but limbs have no attitude of their "
                f"own in the source; only {', '.join(WITH_ATTITUDE)} have one"
            )
        rotation = 0.0
    return RobotBody(
        settings.body,
        position if settings.position is None else settings.position,
        rotation if settings.rotation is None else settings.rotation,
    )


# What a body is called, by the humanoid's names, in words of MJCF and URDF files of robots; the
# first pattern that fits any body counts. A joint's name serves as its body's second name.
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
    """Match the bodies of a robot to the humanoid's, by their names or else by the joints.

    Args:
        model: of the robot.
        start: (nq,), the pose in which it stands; None: the model's first one.

    Returns:
        The mapping, and one line that lists what was matched.

    Raises:
        ConfigError: a leg or the pelvis cannot be found; the message has what to write.
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
            f"{matched}); write a mapping file with a line for each under 'bodies:', such as "
            f"'left_foot: <body>'; its bodies: {', '.join(names.values())}"
        )
    bodies = {name: _robot_body(name, names[body], "guessed") for name, body in found.items()}
    return RobotMapping(f"guessed by {how}", bodies), f"bodies by {how}: {matched}"


def _plausible(model: mujoco.MjModel, found: Mapping[str, int]) -> dict[str, int]:
    """Return the bodies that fit each other, parents first.

    Bodies that are matched already and arms without the body before them are left out; so are
    shins, feet, lower arms and hands of another limb than the body before them, which keeps front
    and hind legs of a quadruped apart. A foot without geoms, a frame or a sensor, is replaced by
    the link that it is fixed to.
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
    for pattern in _WORDS[part]:
        for of in (lambda i: names[i], lambda i: _joint_names(model, i)):
            bodies = [i for i in names if names_body(of(i), pattern, side)]
            if bodies:
                return _of_chain(model, bodies, part)
    return None


def names_body(text: str, pattern: str, side: str) -> bool:
    """Return whether a name has the pattern of a body, and the side; "" is the middle."""
    lower = text.lower()
    if not re.search(pattern, lower) or _NOT.search(lower):
        return False
    sides = {
        name
        for name, of_side in _SIDES.items()
        if re.search(of_side, lower)
        or re.search(of_side, text)
        or re.match(f"{name[0]}({pattern})", lower)  # lfemur
    }
    return sides == ({side} if side else set())


def _joint_names(model: mujoco.MjModel, body: int) -> str:
    joints = np.flatnonzero(model.jnt_bodyid == body)
    return " ".join(model.joint(i).name for i in joints if i > 0)


def _of_chain(model: mujoco.MjModel, bodies: Sequence[int], part: str) -> int:
    """Choose among the links of one joint, such as hip pitch, roll and yaw.

    A limb begins at the last link near the first one; a later link may be far down the limb. The
    end of a limb is the last link.
    """
    if part in ("thigh", "upper_arm"):
        places = posed(model, model.qpos0).xpos[bodies]
        below = np.linalg.norm(places - places[0], axis=1)
        near = [i for i, far in zip(bodies, below, strict=True) if far < 0.5 * below.max()]
        return near[-1] if near else bodies[0]
    return bodies[-1] if part in ("foot", "hand", "torso") else bodies[0]
