"""Clips for a robot: its own in any form, BVH files and clips of the humanoid by retargeting."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.editing import cut, resample
from isaacgymenvs_lite.motion.joint_clip import JointClip
from isaacgymenvs_lite.motion.loader import JointFileSettings, load_single_clip
from isaacgymenvs_lite.motion.qpos import clip_from_qpos, dofs_of_clip
from isaacgymenvs_lite.motion.retargeting.mapping_choice import (
    read_named_mappings,
    recognise_robot,
    recognise_skeleton,
)
from isaacgymenvs_lite.motion.retargeting.retarget import load_bvh_source, retarget_to_robot
from isaacgymenvs_lite.motion.retargeting.robot import robot_from_model
from isaacgymenvs_lite.motion.retargeting.robot_mapping import RobotMapping
from isaacgymenvs_lite.motion.retargeting.source import SourceMotion, source_from_clip
from isaacgymenvs_lite.motion.robot_file import ClipRobot, load_clip_robot
from isaacgymenvs_lite.motion.skeleton import SHIPPED_NUM_DOFS, Skeleton, skeleton_for_num_dofs
from isaacgymenvs_lite.robots.settings import RobotSettings

_log = logging.getLogger(__name__)

_NO_JOINT_FILE = JointFileSettings()


def clip_for_robot(
    source: str,
    robot: str,
    mapping: str = "",
    start_s: float = 0.0,
    end_s: float | None = None,
    fps: float | None = None,
    joint_file: JointFileSettings = _NO_JOINT_FILE,
) -> tuple[MotionClip, Skeleton]:
    """Read a clip for a robot; what is of another skeleton is retargeted, and the errors logged.

    Args:
        source: a clip of the robot, a clip of a shipped humanoid, or a BVH file.
        robot: the robot's file, see `load_clip_robot`.
        mapping: see `read_named_mappings`; what is missing is found by names.
        start_s: where to start in the source.
        end_s: where to end; None: at its end.
        fps: frames per second of the clip; None: the source's.
        joint_file: about a source of joint coordinates.

    Returns:
        The clip, with joint coordinates, and the robot's skeleton.

    Raises:
        MissingPackageError: pybvh or mink is not installed.
        ConfigError: robot or mapping cannot be used.
        MotionFileError: the source cannot be read, or belongs to another robot.
    """
    of_skeleton, of_robot = read_named_mappings(mapping)
    loaded = load_clip_robot(robot, _start_of(of_robot))
    for line in (loaded.prepared.describe()[0], *loaded.prepared.notes):
        _log.info("%s", line)
    if Path(source).suffix.lower() == ".bvh":
        if joint_file != _NO_JOINT_FILE:
            raise ConfigError("file_fps=, quat_order= and by_order= are not for a .bvh file")
        of_skeleton = of_skeleton or recognise_skeleton(source)
        motion = load_bvh_source(source, of_skeleton, start_s, end_s, fps)
        return _retarget(motion, loaded, robot, of_robot)
    if of_skeleton is not None:
        raise ConfigError(f"mapping={of_skeleton.name}: only a .bvh file needs one of this kind")
    humanoids = [skeleton_for_num_dofs(number) for number in SHIPPED_NUM_DOFS]
    clip, skeleton = load_single_clip(source, [loaded.skeleton, *humanoids], joint_file)
    clip = cut(clip, start_s, end_s)
    if fps is not None:
        clip = resample(clip, fps, skeleton)
    if skeleton is not loaded.skeleton:
        return _retarget(source_from_clip(clip), loaded, robot, of_robot)
    if of_robot is not None:
        raise ConfigError(
            f"mapping={of_robot.name}: {clip.name} is a clip of this robot, which needs no mapping"
        )
    return clip, skeleton


def _start_of(mapping: RobotMapping | None) -> RobotSettings:
    if mapping is None:
        return RobotSettings()
    return RobotSettings(
        start_pose=mapping.start_pose or None, start_rotation=mapping.start_rotation
    )


def _retarget(
    motion: SourceMotion, robot: ClipRobot, file: str, mapping: RobotMapping | None
) -> tuple[MotionClip, Skeleton]:
    if mapping is None or not mapping.bodies:
        try:
            found = recognise_robot(robot.prepared.model, robot.prepared.start_qpos)
        except ConfigError as error:
            raise ConfigError(f"robot={file}: {error}; name it by mapping=FILE") from error
        mapping = found if mapping is None else dataclasses.replace(mapping, bodies=found.bodies)
    target = robot_from_model(robot.prepared.model, mapping, robot.prepared.start_qpos)
    result = retarget_to_robot(motion, target)
    return clip_from_qpos(motion.name, result.fps, robot.skeleton, result.qpos), robot.skeleton


def joints_of_clip(clip: MotionClip, skeleton: Skeleton) -> JointClip:
    """Return the joint coordinates of a robot's clip, with the names of its joints.

    Raises:
        MotionFileError: as `qpos.dofs_of_clip`.
    """
    return JointClip(
        name=clip.name,
        fps=clip.fps,
        root_pos=clip.root_translation,
        root_rot=clip.local_rotation[:, 0],
        dof_pos=dofs_of_clip(skeleton, clip),
        joint_names=skeleton.dof_names,
    )
