"""Finds the mappings of a retargeting: as the user names them, else by the names of joints."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco

from isaacgymenvs_lite.errors import ConfigError, listed
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.bvh import (
    bvh_hierarchy,
    chain,
    read_bvh,
    shared_chain,
)
from isaacgymenvs_lite.motion.retargeting.mapping import (
    BodySource,
    SkeletonMapping,
    load_mapping,
    read_mapping_keys,
    shipped_mappings,
)
from isaacgymenvs_lite.motion.retargeting.mapping_fit import fitted
from isaacgymenvs_lite.motion.retargeting.robot_mapping import (
    RobotMapping,
    guess_robot_mapping,
    load_robot_mapping,
    names_body,
    shipped_robot_mappings,
)
from isaacgymenvs_lite.motion.retargeting.source import SIDES

_log = logging.getLogger(__name__)

# Joints of the shipped mappings' skeletons that other skeletons do not have. LAFAN1's has all
# joints that CMU's mapping uses, but other axes.
_MARKS = {
    "cmu": {"LHipJoint", "RHipJoint", "LowerBack"},
    "lafan1": {"Spine2", "LeftToe", "RightToe"},
}

_HELPER = re.compile("twist|roll", re.IGNORECASE)


def read_named_mappings(mapping: str) -> tuple[SkeletonMapping | None, RobotMapping | None]:
    """Read the mappings that a user names: of a BVH file's skeleton, and of a robot.

    Args:
        mapping: names of shipped mappings or YAML files, at most one of each kind, separated by a
            comma; "" for none. The keys of a file show which kind it is.

    Raises:
        ConfigError: two of one kind, or see `load_mapping` and `load_robot_mapping`.
    """
    skeleton: SkeletonMapping | None = None
    robot: RobotMapping | None = None
    for name in filter(None, map(str.strip, mapping.split(","))):
        is_robots = _is_of_robot(name)
        if (robot if is_robots else skeleton) is not None:
            kind = "a robot" if is_robots else "a BVH file's skeleton"
            raise ConfigError(
                f"mapping={mapping}: has two mappings of {kind}; expected at most one of a BVH "
                f"file's skeleton ({', '.join(shipped_mappings())}, a file) and one of a robot "
                f"({', '.join(shipped_robot_mappings())}, a file)"
            )
        if is_robots:
            robot = load_robot_mapping(name)
        else:
            skeleton = load_mapping(name)
    return skeleton, robot


def _is_of_robot(name: str) -> bool:
    """Return whether a mapping is of a robot: its bodies have no joints of another skeleton."""
    _, keys = read_mapping_keys(name, shipped_mappings() | shipped_robot_mappings(), "bodies")
    bodies = keys.get("bodies")
    entries = bodies.values() if isinstance(bodies, Mapping) else ()
    joints = any(isinstance(entry, Mapping) and "joint" in entry for entry in entries)
    return not ("up" in keys or "unit_m" in keys or joints)


def recognise_skeleton(path: str | Path) -> SkeletonMapping:
    """Return a mapping for the joints of a BVH file, and log which one it is.

    It is the shipped one with these joints, else a guess by the names of feet, hands and head; in
    both cases as `fitted`.

    Raises:
        MissingPackageError: pybvh is not installed.
        MotionFileError: the file cannot be read.
        ConfigError: no mapping is made for its joints, the message lists them; or none fits.
    """
    names, parents = bvh_hierarchy(path)
    for name, marks in _MARKS.items():
        mapping = load_mapping(name)
        used = {source.joint for source in mapping.sources.values()}
        if set(names) >= marks | used:
            found = fitted(read_bvh(path, used), mapping)
            own = {
                f"up: {found.up}": found.up != mapping.up,
                f"unit_m: {found.unit_m:g}": found.unit_m != mapping.unit_m,
                "x and z of its joints": found.sources is not mapping.sources,
            }
            changes = ", ".join(change for change, is_own in own.items() if is_own)
            but = f" but for its own {changes}" if changes else ""
            _log.info("%s: has the joints of mapping=%s, which is used%s", path, name, but)
            return found
    joints = _guess_joints(names, parents)
    if not joints:
        raise ConfigError(
            f"{path}: has the joints of no shipped mapping ({listed(names)}); give mapping=, one "
            f"of {', '.join(shipped_mappings())} or a YAML file (docs/motion_formats.md)"
        )
    sources = {body: BodySource(joint, None, False) for body, joint in joints.items()}
    guess = SkeletonMapping("guessed by names", "+y", 0.01, sources)
    found = fitted(read_bvh(path, joints.values()), guess)
    _log.info(
        "%s: joints by name: %s; up: %s, unit_m: %g, x and z as in its rest pose; a mapping file "
        "changes it (docs/motion_formats.md)",
        path,
        ", ".join(f"{body}: {joint}" for body, joint in joints.items()),
        found.up,
        found.unit_m,
    )
    return found


def _guess_joints(names: Sequence[str], parents: Sequence[int]) -> dict[str, str]:
    """Return the joint of each body by the names of feet, hands and head, {} if one is missing.

    The two joints above a foot or a hand are its limb; helper joints for twist are left out. Pelvis
    and torso are the last joints above both legs and both arms. Ankles and wrists are tried before
    feet and hands: in a skeleton with both, foot and hand are the toes and the fingers.
    """
    found: dict[str, int] = {}
    for side in SIDES:
        for patterns, bodies in (
            (("ankle", "foot"), ("thigh", "shin", "foot")),
            (("wrist", "hand"), ("upper_arm", "lower_arm", "hand")),
        ):
            end = _first_named(names, patterns, side)
            limb = chain(parents, end) if end is not None else []
            limb = [i for i in limb if not _HELPER.search(names[i]) or i == end]
            found |= zip([f"{side}_{body}" for body in bodies], limb[-3:], strict=False)
    head = _first_named(names, ("head", "neck"), "")
    if head is None or len(found) != 12:
        return {}
    for body, limb in (("pelvis", "thigh"), ("torso", "upper_arm")):
        found[body] = shared_chain(parents, [found[f"{side}_{limb}"] for side in SIDES])[-1]
    found["head"] = head
    return {body: names[i] for body, i in found.items()}


def _first_named(names: Sequence[str], patterns: Sequence[str], side: str) -> int | None:
    """Return the first joint with the first pattern that any name has; None: no name has one."""
    fitting = (
        i for pattern in patterns for i, name in enumerate(names) if names_body(name, pattern, side)
    )
    return next(fitting, None)


def recognise_robot(model: mujoco.MjModel, start: FloatArray) -> RobotMapping:
    """Return the shipped mapping for the bodies of a robot, else a guessed one; log which.

    `start` (nq,) is the pose in which it stands. Raises ConfigError as `guess_robot_mapping`.
    """
    bodies = {model.body(i).name for i in range(model.nbody)}
    for name in shipped_robot_mappings():
        mapping = load_robot_mapping(name)
        if bodies >= {entry.body for entry in mapping.bodies.values()}:
            _log.info("the robot has the bodies of mapping=%s, which is used", name)
            return mapping
    mapping, line = guess_robot_mapping(model, start)
    _log.info("%s; a mapping file changes it (docs/motion_formats.md)", line)
    return mapping
