"""Finds the mappings of a retargeting: those that a user names, else those that the names fit."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import mujoco

from isaacgymenvs_lite.errors import ConfigError, listed
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.retargeting.bvh import bvh_joint_names, read_bvh
from isaacgymenvs_lite.motion.retargeting.mapping import (
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
    shipped_robot_mappings,
)

_log = logging.getLogger(__name__)

# Joints of the shipped mappings' skeletons that other skeletons do not have. LAFAN1's has all
# joints that CMU's mapping uses, but other axes.
_MARKS = {
    "cmu": {"LHipJoint", "RHipJoint", "LowerBack"},
    "lafan1": {"Spine2", "LeftToe", "RightToe"},
}


def read_named_mappings(
    mapping: str,
) -> tuple[SkeletonMapping | None, RobotMapping | None]:
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
    shipped = {**shipped_mappings(), **shipped_robot_mappings()}
    if name in shipped:
        return name in shipped_robot_mappings()
    _, keys = read_mapping_keys(name, shipped, "bodies")
    bodies = keys.get("bodies")
    entries = bodies.values() if isinstance(bodies, Mapping) else ()
    joints = any(isinstance(entry, Mapping) and "joint" in entry for entry in entries)
    return not ("up" in keys or "unit_m" in keys or joints)


def recognise_skeleton(path: str | Path) -> SkeletonMapping:
    """Return the shipped mapping for the joints of a BVH file, as `fitted`; log which one it is.

    Raises:
        MissingPackageError: pybvh is not installed.
        MotionFileError: the file cannot be read.
        ConfigError: no shipped mapping is made for its joints; the message lists them. Or its axes
            fit none.
    """
    joints = bvh_joint_names(path)
    for name, marks in _MARKS.items():
        mapping = load_mapping(name)
        used = {source.joint for source in mapping.sources.values()}
        if set(joints) >= marks | used:
            _log.info("%s: has the joints of mapping=%s, which is used", path, name)
            return fitted(read_bvh(path, used), mapping)
    raise ConfigError(
        f"{path}: has the joints of no shipped mapping ({listed(joints)}); give mapping=, one of "
        f"{', '.join(shipped_mappings())} or a YAML file (docs/motion_formats.md)"
    )


def recognise_robot(model: mujoco.MjModel, start: FloatArray) -> RobotMapping:
    """Return the shipped mapping for the bodies of a robot, else a guessed one; log which.

    Args:
        model: of the robot.
        start: (nq,), the pose in which it stands.

    Raises:
        ConfigError: as `guess_robot_mapping`.
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
