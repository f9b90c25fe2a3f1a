"""Converts motion clips: isaacgymenvs-lite convert IN OUT [key=value ...].

    isaacgymenvs-lite convert amp_humanoid_walk.npy walk.npz
    isaacgymenvs-lite convert walk.npz walk.csv fps=30 start_s=0.5 end_s=2
    isaacgymenvs-lite convert dance.bvh dance.npz mapping=lafan1
    isaacgymenvs-lite convert walk g1_walk.npz robot=mjcf/g1.xml

IN is a .bvh file, or a clip that task.env.motion_file accepts (no data set). FILE.pkl:NAME selects
a motion in a file. The suffix of OUT determines the format: .npz (this project's format), .npy
(poselib), .txt or .json (DeepMimic), .csv (joint angles). A robot's clip needs .npz or .csv. Keys:

    fps=30              frames per second of OUT (default: the rate of IN)
    start_s=0 end_s=5   the part of IN to keep, in seconds
    mapping=cmu         for .bvh: cmu, lafan1, or a YAML file, see docs/motion_formats.md (default:
                        joints are matched by name)
    num_dofs=31         28 for the humanoid, 31 with sword and shield (default: as in IN, or 28)
    ground=True         raises or lowers the clip until its lowest points are on the ground
    overwrite=True      replaces an existing OUT

For a clip of a robot:

    robot=/robots/g1.xml  the robot's MJCF or URDF, or a name in assets/. A clip of another body is
                          retargeted to this robot
    mapping=g1            g1 or a YAML file of the robot's bodies; for .bvh also mapping=cmu,g1
                          (default: bodies are matched by name)
    file_fps=50           rate of IN if the file has none (default: 30, BONES-SEED 120)
    quat_order=wxyz       wxyz or xyzw: overrides the usual quaternion order of IN's format
    by_order=True         matches the joints of IN by their order instead of their names
"""

from __future__ import annotations

import dataclasses
import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.clip import QUAT_ORDERS, JointClip, MotionClip, QuatOrder
from isaacgymenvs_lite.motion.editing import cut, resample
from isaacgymenvs_lite.motion.formats.deepmimic import save_deepmimic
from isaacgymenvs_lite.motion.formats.files import check_output
from isaacgymenvs_lite.motion.formats.joint_csv import save_joint_csv, save_robot_csv
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.formats.poselib import save_poselib_npy
from isaacgymenvs_lite.motion.formats.robot_clip import save_robot_npz
from isaacgymenvs_lite.motion.loader import JointFileSettings, load_single_clip
from isaacgymenvs_lite.motion.plausibility import put_on_ground, warn_of_implausible
from isaacgymenvs_lite.motion.qpos import clip_from_qpos, dofs_of_clip
from isaacgymenvs_lite.motion.retargeting.mapping import load_mapping
from isaacgymenvs_lite.motion.retargeting.mapping_choice import (
    read_named_mappings,
    recognise_robot,
    recognise_skeleton,
)
from isaacgymenvs_lite.motion.retargeting.retarget import (
    load_bvh_source,
    retarget_bvh,
    retarget_to_robot,
)
from isaacgymenvs_lite.motion.retargeting.robot import robot_from_model
from isaacgymenvs_lite.motion.retargeting.source import source_from_clip
from isaacgymenvs_lite.motion.robot_file import load_clip_robot, run_file_command
from isaacgymenvs_lite.motion.skeleton import SHIPPED_NUM_DOFS, Skeleton, skeleton_for_num_dofs
from isaacgymenvs_lite.robots.settings import RobotSettings
from isaacgymenvs_lite.schema import setting

_log = logging.getLogger(__name__)


def joints_of_clip(clip: MotionClip, skeleton: Skeleton) -> JointClip:
    """Return the joint coordinates and joint names of a robot's clip."""
    root_rot, dofs = clip.local_rotation[:, 0], dofs_of_clip(skeleton, clip)
    return JointClip(clip.name, clip.fps, clip.root_translation, root_rot, dofs, skeleton.dof_names)


# Maps a suffix to the function that writes this format and to the data that the format cannot hold.
_Formats = dict[str, tuple[Callable[[Path, MotionClip, Skeleton], object], str]]
_VELOCITIES = "velocities (they are computed again from the poses)"
_POSES_ONLY = f"{_VELOCITIES} and limb lengths"
_DEEPMIMIC = (
    lambda path, clip, _skeleton: save_deepmimic(path, clip),
    f"{_POSES_ONLY}, rotations of the hands, sword and shield, and of knees and elbows out of "
    "their axes; reading lifts a clip whose feet are below the ground",
)
_FORMATS: _Formats = {
    ".npz": (lambda path, clip, _skeleton: save_npz(path, clip), "nothing"),
    ".npy": (
        lambda path, clip, _skeleton: save_poselib_npy(path, clip),
        "digits beyond single precision",
    ),
    ".txt": _DEEPMIMIC,
    ".json": _DEEPMIMIC,
    ".csv": (save_joint_csv, f"{_POSES_ONLY}; rotations of hinges out of their axes"),
}
_ROBOT_FORMATS: _Formats = {
    ".npz": (
        lambda path, clip, robot: save_robot_npz(path, joints_of_clip(clip, robot)),
        _VELOCITIES,
    ),
    ".csv": (
        lambda path, clip, robot: save_robot_csv(path, joints_of_clip(clip, robot)),
        _VELOCITIES,
    ),
}


@dataclass(frozen=True, kw_only=True)
class ConvertSettings:
    """Keys of the command, which the module docstring describes."""

    fps: float | None = setting(None, above=0)
    start_s: float = setting(0.0, minimum=0)
    end_s: float | None = setting(None, above=0)
    num_dofs: int | None = setting(None, choices=SHIPPED_NUM_DOFS)
    mapping: str = setting("")
    robot: str = setting("")
    file_fps: float | None = setting(None, above=0)
    quat_order: str | None = setting(None, choices=QUAT_ORDERS)
    by_order: bool = setting(False)
    ground: bool = setting(False)
    overwrite: bool = setting(False)


def convert(source: str, out: str, settings: ConvertSettings) -> Path:
    """Convert one clip and return the path of the output; an error leaves no partial file."""
    path = Path(out)
    formats = _ROBOT_FORMATS if settings.robot else _FORMATS
    check_output(path, formats, settings.overwrite)
    clip, skeleton = _robots_clip(source, settings) if settings.robot else _clip(source, settings)
    if settings.ground:
        clip = put_on_ground(clip, skeleton)
    warn_of_implausible([clip], skeleton)
    save, lost = formats[path.suffix]
    save(path, clip, skeleton)
    _log.info(
        "%s: %d frames at %g Hz, %.2f s, %d degrees of freedom; lost: %s",
        path,
        clip.num_frames,
        clip.fps,
        clip.length_s,
        skeleton.num_dofs,
        lost,
    )
    return path


def _clip(source: str, settings: ConvertSettings) -> tuple[MotionClip, Skeleton]:
    """Read a clip of a humanoid, or retarget a BVH file to a humanoid."""
    if _joint_file(settings) != JointFileSettings():
        raise ConfigError("file_fps=, quat_order= and by_order= need robot=, the file of a robot")
    if Path(source).suffix.lower() == ".bvh":
        skeleton = skeleton_for_num_dofs(settings.num_dofs or SHIPPED_NUM_DOFS[0])
        mapping = settings.mapping
        used = load_mapping(mapping) if mapping else recognise_skeleton(source)
        times = (settings.start_s, settings.end_s, settings.fps)
        return retarget_bvh(source, used, skeleton, *times), skeleton
    if settings.mapping:
        raise ConfigError(f"mapping={settings.mapping}: needs a .bvh file or robot=; leave it out")
    skeletons = [skeleton_for_num_dofs(settings.num_dofs)] if settings.num_dofs else ()
    return _part(*load_single_clip(source, skeletons), settings)


def _part(
    clip: MotionClip, skeleton: Skeleton, settings: ConvertSettings
) -> tuple[MotionClip, Skeleton]:
    """Cut a clip and change its frame rate as the settings say."""
    clip = cut(clip, settings.start_s, settings.end_s)
    if settings.fps is not None:
        clip = resample(clip, settings.fps, skeleton)
    return clip, skeleton


def _robots_clip(source: str, settings: ConvertSettings) -> tuple[MotionClip, Skeleton]:
    """Read a clip of a robot, or retarget a humanoid's clip or a BVH file to the robot."""
    if settings.num_dofs is not None:
        raise ConfigError(
            f"num_dofs={settings.num_dofs} selects a humanoid and robot={settings.robot} a robot; "
            "leave one out"
        )
    joint_file = _joint_file(settings)
    of_skeleton, of_robot = read_named_mappings(settings.mapping)
    start = RobotSettings()
    if of_robot is not None:
        pose, rotation = of_robot.start_pose or None, of_robot.start_rotation
        start = RobotSettings(start_pose=pose, start_rotation=rotation)
    robot = load_clip_robot(settings.robot, start)
    for line in (robot.prepared.describe()[0], *robot.prepared.notes):
        _log.info("%s", line)
    if Path(source).suffix.lower() == ".bvh":
        if joint_file != JointFileSettings():
            raise ConfigError("file_fps=, quat_order= and by_order= are not for a .bvh file")
        of_skeleton = of_skeleton or recognise_skeleton(source)
        times = (settings.start_s, settings.end_s, settings.fps)
        motion = load_bvh_source(source, of_skeleton, *times)
    else:
        if of_skeleton is not None:
            raise ConfigError(f"mapping={of_skeleton.name}: needs a .bvh file; leave it out")
        humanoids = [skeleton_for_num_dofs(number) for number in SHIPPED_NUM_DOFS]
        read = load_single_clip(source, [robot.skeleton, *humanoids], joint_file)
        clip, skeleton = _part(*read, settings)
        if skeleton is robot.skeleton:
            if of_robot is None:
                return clip, skeleton
            raise ConfigError(
                f"mapping={of_robot.name}: {clip.name} is a clip of this robot, which needs no"
                " mapping"
            )
        motion = source_from_clip(clip)
    model, start_qpos = robot.prepared.model, robot.prepared.start_qpos
    if of_robot is None or not of_robot.bodies:
        try:
            found = recognise_robot(model, start_qpos)
        except ConfigError as error:
            message = f"robot={settings.robot}: {error}; name it by mapping=FILE"
            raise ConfigError(message) from error
        of_robot = dataclasses.replace(of_robot or found, bodies=found.bodies)
    result = retarget_to_robot(motion, robot_from_model(model, of_robot, start_qpos))
    return clip_from_qpos(motion.name, result.fps, robot.skeleton, result.qpos), robot.skeleton


def _joint_file(settings: ConvertSettings) -> JointFileSettings:
    quat_order: QuatOrder | None = next((o for o in QUAT_ORDERS if o == settings.quat_order), None)
    return JointFileSettings(settings.file_fps, quat_order, settings.by_order)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    files = {"IN": "the clip to read", "OUT": "the file to write"}
    return run_file_command("convert", __doc__, ConvertSettings, convert, arguments, **files)


if __name__ == "__main__":
    sys.exit(main())
