"""Reads clips of all formats, and data sets of clips."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import ConfigError, MotionFileError, listed, suggest
from isaacgymenvs_lite.motion.clip import MotionClip, QuatOrder
from isaacgymenvs_lite.motion.formats import deepmimic
from isaacgymenvs_lite.motion.formats.deepmimic import PREFIX, find_in_package, is_package_name
from isaacgymenvs_lite.motion.formats.files import read_json, reading
from isaacgymenvs_lite.motion.formats.joint_csv import load_joint_csv
from isaacgymenvs_lite.motion.formats.npz import load_npz
from isaacgymenvs_lite.motion.formats.poselib import clip_from_poselib, load_poselib_npy
from isaacgymenvs_lite.motion.formats.robot_clip import (
    PICKLES,
    looks_like_joint_clip,
    read_joint_clips,
    several_motions,
    split_motion,
)
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import (
    clip_from_qpos,
    qpos_from_clip,
    qpos_from_dofs,
    rotations_from_dofs,
    turned_by_joints,
)
from isaacgymenvs_lite.motion.skeleton import (
    SHIPPED_NUM_DOFS,
    Skeleton,
    shipped_humanoid_with,
    skeleton_for_num_dofs,
)
from isaacgymenvs_lite.schema import read_section, setting
from isaacgymenvs_lite.utils.yaml_file import load_yaml

_log = logging.getLogger(__name__)

# Advice if a robot's clip is given where a humanoid's clip is needed, and for the opposite case.
ROBOT_HINT = "a clip of a robot needs task=RobotAMP in training, robot=FILE in the clip commands"
RETARGET_HINT = "retarget it with isaacgymenvs-lite convert IN OUT.npz robot=FILE"
# Files round offsets to 1e-4 m. A larger difference means that a clip belongs to another body.
_OFFSET_TOLERANCE_M = 0.01
# Rotations of knees and elbows about other axes are dropped; the motion looks different if such a
# rotation exceeds this angle (0.6 deg).
_HINGE_TOLERANCE_RAD = 0.01
# Interpolation causes differences between joint coordinates and poses that are smaller than this.
_DOF_TOLERANCE_RAD = 0.05
# Limits that human motion does not reach, but clips in centimetres exceed.
_USUAL_PLACE_M, _USUAL_SPEED_M_S, _USUAL_SPEED_RAD_S = 1_000.0, 60.0, 300.0
_DATASET_SUFFIXES = (".yaml", ".yml")
# Suffixes that are added, in this order, to a name without suffix to find a file.
_GUESSED_SUFFIXES = (".npz", ".npy", ".yaml", ".json")
_CONVERT = "isaacgymenvs-lite convert IN.bvh OUT.npz"
_EXAMPLE = 'expected `motions:` with a list of `- {file: "clip.npz", weight: 0.5}`'


@dataclass(frozen=True)
class JointFileSettings:
    """A user's settings for a file of a robot's joint coordinates."""

    fps: float | None = None
    """Frames per second of a table without a frame rate; None selects the format's default."""
    quat_order: QuatOrder | None = None
    """Order of the file's quaternions; None selects the order by the rules of `read_joint_clip`."""
    by_order: bool = False
    """Whether joints are matched by their order instead of their names."""


_AS_IN_THE_FILE = JointFileSettings()


def shipped_motions_dir() -> Path:
    """Return the folder of the shipped humanoid clips."""
    return paths.assets_dir() / "amp" / "motions"


def shipped_robot_motions_dir() -> Path:
    """Return the folder of the shipped robot clips."""
    return paths.assets_dir() / "amp" / "robot_motions"


def shipped_motions() -> list[str]:
    """Return the names, without suffix, of the shipped humanoid clips."""
    return _clips_in(shipped_motions_dir())


def shipped_robot_motions() -> list[str]:
    """Return the names, without suffix, of the shipped robot clips."""
    return _clips_in(shipped_robot_motions_dir())


def _clips_in(folder: Path) -> list[str]:
    return sorted({path.stem for path in folder.glob("*") if path.suffix in _GUESSED_SUFFIXES})


def load_clips(
    motion_file: str | Path, skeleton: Skeleton | None = None
) -> list[tuple[MotionClip, float]]:
    """Read a clip or all clips of a data set, and return the clips and their weights >= 0.

    Args:
        motion_file: a path (absolute or relative to the working directory), the name of a shipped
            clip, or `deepmimic:<name>`. A `.yaml` file is a data set. The clip formats are `.npz`,
            `.npy` and `.json` (poselib), `.txt` and `.json` (DeepMimic), `.csv` (joint angles), and
            robots' joint coordinates (`formats.robot_clip`). A `.pkl` or `.npy` of a robot may
            contain several motions, which get equal weights. `FILE:MOTION` selects one motion.
        skeleton: the clips' skeleton, by default the humanoid with 28 degrees of freedom. The clips
            get the skeleton's order of bodies.

    Raises:
        MotionFileError: a file is missing or not valid, or belongs to another humanoid.
    """
    skeleton = skeleton or skeleton_for_num_dofs(28)
    found = resolve_motion_file(motion_file)
    if Path(found).suffix not in _DATASET_SUFFIXES:
        return [(clip, weight) for clip, _, weight in _load(found, (skeleton,))]
    clips: list[tuple[MotionClip, float]] = []
    loaded: dict[str, list[tuple[MotionClip, Skeleton, float]]] = {}
    for i, entry in enumerate(read_dataset(found)):
        try:
            if entry.file not in loaded:
                file = resolve_motion_file(entry.file, [Path(found).parent])
                loaded[entry.file] = _load(file, (skeleton,))
        except MotionFileError as error:
            raise MotionFileError(f"{found}: motions[{i}]: {error}") from error
        clips.extend((clip, entry.weight * weight) for clip, _, weight in loaded[entry.file])
    return clips


def load_single_clip(
    motion_file: str | Path,
    skeletons: Sequence[Skeleton] = (),
    joint_file: JointFileSettings = _AS_IN_THE_FILE,
) -> tuple[MotionClip, Skeleton]:
    """Read one clip of a humanoid or a robot, and return the clip and its skeleton.

    Args:
        motion_file: a clip (see `load_clips`). A data set is refused.
        skeletons: the possible skeletons of the clip, by default all shipped humanoids. Joint
            coordinates of robots belong to the first skeleton, and clips of DeepMimic to the first
            humanoid.
        joint_file: settings for a file of joint coordinates.
    """
    skeletons = skeletons or [skeleton_for_num_dofs(number) for number in SHIPPED_NUM_DOFS]
    found = resolve_motion_file(motion_file)
    if Path(found).suffix in _DATASET_SUFFIXES:
        raise MotionFileError(f"{found}: is a data set; give one of its clips")
    loaded = _load(found, skeletons, joint_file)
    if len(loaded) > 1 and is_package_name(found):
        raise MotionFileError(f"'{found}' is a data set of {len(loaded)} clips; give one")
    if len(loaded) > 1:
        raise MotionFileError(several_motions(found, [clip.name for clip, _, _ in loaded]))
    return loaded[0][:2]


def resolve_motion_file(name: str | Path, folders: Sequence[Path] = (Path(),)) -> str:
    """Return the path of a motion file, whose suffix may be left out.

    A relative path is looked up in the folders and among the shipped clips. A suffix `:MOTION`
    after the path is kept, and names like `deepmimic:walk` are returned unchanged. Raises
    MotionFileError if no file is found.
    """
    if is_package_name(name):
        return str(name)
    folders = [*folders, shipped_motions_dir(), shipped_robot_motions_dir()]
    folders = [Path()] if Path(name).is_absolute() else folders
    with reading(name, "name of a motion file"):
        for folder in folders:
            for suffix in ("", *_GUESSED_SUFFIXES):
                path = folder / f"{name}{suffix}"
                if path.is_file() or Path(split_motion(path)[0]).is_file():
                    return str(path)
    looked = " and ".join(dict.fromkeys(str(folder.absolute()) for folder in folders))
    where = "" if Path(name).is_absolute() else f" in {looked}"
    shipped, of_robots = shipped_motions(), shipped_robot_motions()
    raise MotionFileError(
        f"motion file '{name}' not found{where}{suggest(Path(name).stem, (*shipped, *of_robots))}; "
        f"shipped clips: {', '.join(shipped) or 'none'}; of robots: {', '.join(of_robots)}; "
        f"{PREFIX}<name> for DeepMimic's"
    )


def _humanoid_of(skeletons: Sequence[Skeleton], motion_file: str | Path) -> Skeleton:
    """Return the first humanoid that has the bodies and joints of DeepMimic's clips."""
    for skeleton in skeletons:
        has_bodies = set(deepmimic.MOVED_BODIES) <= set(skeleton.body_names)
        # The humanoid of dm_control has the same bodies, but other joints.
        if has_bodies and skeleton.has_simple_joints:
            return skeleton
    raise MotionFileError(f"{motion_file}: is a DeepMimic clip of the humanoid; {RETARGET_HINT}")


def _load(
    found: str, skeletons: Sequence[Skeleton], joint_file: JointFileSettings = _AS_IN_THE_FILE
) -> list[tuple[MotionClip, Skeleton, float]]:
    """Read a resolved motion file, and return clips, skeletons, and weights whose sum is 1."""
    if is_package_name(found):
        humanoid = _humanoid_of(skeletons, found)
        return [
            (deepmimic.load_deepmimic(clip.path, humanoid, clip.name), humanoid, clip.weight)
            for clip in find_in_package(found)
        ]
    path = Path(found)
    suffix = Path(split_motion(path)[0]).suffix
    # A robot's joints may have the same names as the humanoid's joints.
    is_robots = suffix == ".csv" and not skeletons[0].has_simple_joints
    if is_robots or looks_like_joint_clip(path):
        clips = _clips_of_joints(path, skeletons[0], joint_file)
        return [(clip, skeletons[0], 1.0 / len(clips)) for clip in clips]
    if joint_file != _AS_IN_THE_FILE:
        raise MotionFileError(
            f"{path}: holds no joint coordinates of a robot; leave out file_fps=, quat_order= and"
            " by_order="
        )
    readers: dict[str, Callable[[Path], MotionClip]] = {
        ".npz": load_npz,
        ".npy": load_poselib_npy,
        ".json": lambda path: _load_json(path, skeletons),
        ".txt": lambda path: _load_json(path, skeletons),
        ".csv": lambda path: load_joint_csv(path, skeletons),
    }
    if suffix not in readers:
        of_whom = "mapping=NAME" if skeletons[0].has_simple_joints else "robot=FILE"
        hint = f"; convert it first: {_CONVERT} {of_whom}" if suffix == ".bvh" else ""
        raise MotionFileError(
            f"{path}: a clip ends in {', '.join((*readers, *PICKLES))} and a data set in .yaml, "
            f"found '{suffix}'{hint}"
        )
    with reading(path, "motion clip"):
        clip = readers[suffix](path)
        fitting = [body for body in skeletons if set(body.body_names) == set(clip.body_names)]
        skeleton = fitting[0] if fitting else skeletons[0]
        clip = fit_to_skeleton(clip, skeleton)
        if skeleton.followers is not None:
            clip = clip_from_qpos(clip.name, clip.fps, skeleton, qpos_from_clip(skeleton, clip))
        return [(clip, skeleton, 1.0)]


def _clips_of_joints(
    path: Path, skeleton: Skeleton, settings: JointFileSettings
) -> list[MotionClip]:
    """Read a robot's joint coordinates, and compute the poses by MuJoCo's kinematics."""
    clips = []
    following = skeleton.followers.names if skeleton.followers is not None else ()
    for read in read_joint_clips(
        path,
        settings.fps,
        quat_order=settings.quat_order,
        up_b=skeleton.up_b,
        root_body=skeleton.body_names[0],
    ):
        try:
            joints = read.fitted_to(skeleton.dof_names, settings.by_order, following)
        except MotionFileError as error:
            if shipped_humanoid_with(skeleton.body_names) is None:
                raise
            raise MotionFileError(f"{error}; {ROBOT_HINT}") from error
        joints.check_limits(skeleton.dof_limits)
        qpos = qpos_from_dofs(skeleton, joints.root_pos, joints.root_rot, joints.dof_pos)
        clips.append(clip_from_qpos(joints.name, joints.fps, skeleton, qpos))
    return clips


def _load_json(path: Path, skeletons: Sequence[Skeleton]) -> MotionClip:
    """Read a clip (`.txt` or `.json`) of DeepMimic, which has the key 'Frames', or of poselib."""
    data = read_json(path)
    if "Frames" in data or path.suffix == ".txt":
        return deepmimic.clip_from_deepmimic(data, _humanoid_of(skeletons, path), str(path))
    return clip_from_poselib(data, str(path))


@dataclass(frozen=True)
class _Dataset:
    motions: list[Any] = setting(min_length=1)


@dataclass(frozen=True)
class DatasetEntry:
    """A clip of a data set, with the path in the data set's file and the unnormalised weight."""

    file: str = setting()
    weight: float = setting(minimum=0, maximum=1e12)


def read_dataset(path: str | Path) -> list[DatasetEntry]:
    """Read the entries of the data set at `path`, in the order of the file."""
    with reading(path, "data set of clips"):
        try:
            data = load_yaml(Path(path))
        except ConfigError as error:
            raise MotionFileError(f"{error}; {_EXAMPLE}") from error
        try:
            motions = read_section(_Dataset, data, "", complete=True).motions
            entries = [
                read_section(DatasetEntry, entry, f"motions[{i}]", complete=True)
                for i, entry in enumerate(motions)
            ]
        except ConfigError as error:
            raise MotionFileError(f"{path}: {error}; {_EXAMPLE}") from error
        if sum(entry.weight for entry in entries) <= 0.0:
            raise MotionFileError(f"{path}: all {len(entries)} weights are 0, expected one above 0")
        return entries


def fit_to_skeleton(clip: MotionClip, skeleton: Skeleton) -> MotionClip:
    """Return the clip with its bodies in the order of `skeleton`.

    Rotations of hinges about other axes are dropped. A warning names dropped rotations, limbs whose
    lengths differ from the skeleton's, joint coordinates that contradict the poses, and implausible
    positions and speeds. Raises MotionFileError for a clip of another skeleton.
    """
    _refuse_other_bodies(clip, skeleton)
    clip = _reorder(clip, skeleton)
    _warn_of_other_offsets(clip, skeleton)
    if clip.dof_pos is None:
        _warn_of_hinge_violation(clip, skeleton)
    else:
        _check_dofs(clip, clip.dof_pos, skeleton)
    _warn_of_odd_values(clip)
    return clip


def _refuse_other_bodies(clip: MotionClip, skeleton: Skeleton) -> None:
    missing = [name for name in skeleton.body_names if name not in clip.body_names]
    extra = [name for name in clip.body_names if name not in skeleton.body_names]
    if not missing and not extra:
        return
    is_humanoid = shipped_humanoid_with(skeleton.body_names) is not None
    found = [f"lacks {listed(missing)}"] if missing else []
    found += [f"also has {listed(extra)}"] if extra else []
    whose = "humanoid" if is_humanoid else "robot"
    bodies = ", ".join(skeleton.body_names) if is_humanoid else listed(skeleton.body_names)
    other = shipped_humanoid_with(clip.body_names)
    if other:
        use = f"use task.env.asset.assetFileName={other} or another clip"
        advice = f"it is a clip of {other}: {use if is_humanoid else RETARGET_HINT}"
    else:
        is_robots = is_humanoid and clip.dof_pos is not None
        advice = ROBOT_HINT if is_robots else f"use a clip of this {whose}"
    raise MotionFileError(
        f"{clip.name}: its skeleton {' and '.join(found)}; expected the {skeleton.num_bodies} "
        f"bodies of the {whose}: {bodies}; {advice}"
    )


def _reorder(clip: MotionClip, skeleton: Skeleton) -> MotionClip:
    """Reorder the bodies, and check that each body has the same parent as in the skeleton."""
    order = [clip.body_names.index(name) for name in skeleton.body_names]
    for body, name in enumerate(skeleton.body_names):
        parent = _parent_name(clip.body_names, clip.parent_indices[order[body]])
        expected = _parent_name(skeleton.body_names, skeleton.parent_indices[body])
        if parent != expected:
            raise MotionFileError(
                f"{clip.name}: the parent of '{name}' is {parent}, expected {expected}"
            )
    if order == list(range(skeleton.num_bodies)):
        return clip
    if clip.dof_pos is not None:
        raise MotionFileError(
            f"{clip.name}: the order of its bodies differs from the model's, but its joint"
            " coordinates (dof_pos) need the same order; expected " + ", ".join(skeleton.body_names)
        )
    _log.info("%s: bodies reordered as in the humanoid", clip.name)
    return dataclasses.replace(
        clip,
        body_names=skeleton.body_names,
        parent_indices=skeleton.parent_indices,
        local_translation=clip.local_translation[..., order, :],
        local_rotation=clip.local_rotation[:, order],
        linear_velocity_w=clip.linear_velocity_w[:, order],
        angular_velocity_w=clip.angular_velocity_w[:, order],
    )


def _parent_name(names: tuple[str, ...], parent: int) -> str:
    return "the world" if parent < 0 else f"'{names[parent]}'"


def _warn_of_other_offsets(clip: MotionClip, skeleton: Skeleton) -> None:
    # The root's offset is only the character's position in the model file.
    difference = np.linalg.norm(clip.local_translation - skeleton.local_translation, axis=-1)
    # A joint that is not at its body's origin moves this origin in the parent's frame.
    anchored = np.array(skeleton.dof_body_ids, dtype=int)[skeleton.joint_anchors.any(axis=1)]
    difference[..., anchored] = 0.0
    difference = difference.reshape(-1, skeleton.num_bodies).max(axis=0)[1:]
    if difference.max() > _OFFSET_TOLERANCE_M:
        body = int(difference.argmax()) + 1
        _log.warning(
            "%s: was made for a body of other dimensions; the offset of '%s' differs by %.3f m "
            "from the humanoid's, and feet may sink or slide",
            clip.name,
            skeleton.body_names[body],
            difference[body - 1],
        )


def _warn_of_odd_values(clip: MotionClip) -> None:
    for what, values, usual, unit in (
        ("the root is", clip.root_translation, _USUAL_PLACE_M, "m from the origin"),
        ("a body moves at", clip.linear_velocity_w, _USUAL_SPEED_M_S, "m/s"),
        ("a body rotates at", clip.angular_velocity_w, _USUAL_SPEED_RAD_S, "rad/s"),
    ):
        largest = float(np.linalg.norm(values, axis=-1).max())
        if largest > usual:
            _log.warning(
                "%s: %s up to %.4g %s; are units and fps right?", clip.name, what, largest, unit
            )


def _warn_of_hinge_violation(clip: MotionClip, skeleton: Skeleton) -> None:
    try:
        turns = turned_by_joints(skeleton, clip.local_rotation).numpy()
    except MotionFileError as error:
        raise MotionFileError(f"{clip.name}: {error}") from error
    groups = [group for group, size in enumerate(skeleton.dof_sizes) if size == 1]
    if not groups:
        return
    hinges = [skeleton.dof_body_ids[group] for group in groups]
    # The component of the quaternion's vector perpendicular to the axis has the length sin(angle /
    # 2), with the angle between the axis and the rotated axis.
    off_axis = np.linalg.norm(np.cross(turns[:, hinges, :3], skeleton.joint_axes[groups]), axis=-1)
    frame, hinge = (int(i) for i in np.unravel_index(off_axis.argmax(), off_axis.shape))
    angle_rad = 2.0 * math.asin(min(float(off_axis[frame, hinge]), 1.0))
    if angle_rad > _HINGE_TOLERANCE_RAD:
        _log.warning(
            "%s: '%s' is a hinge about %s but rotates %.3f rad out of that axis in frame %d; "
            "this part of the motion is dropped",
            clip.name,
            skeleton.body_names[hinges[hinge]],
            "({:.3g}, {:.3g}, {:.3g})".format(*skeleton.joint_axes[groups[hinge]]),
            angle_rad,
            frame,
        )


def _check_dofs(clip: MotionClip, dofs: FloatArray, skeleton: Skeleton) -> None:
    """Refuse a wrong number of joint coordinates, and warn if they contradict the poses."""
    if dofs.shape[1] != skeleton.num_dofs:
        raise MotionFileError(
            f"{clip.name}: dof_pos has {dofs.shape[1]} columns, expected the {skeleton.num_dofs} "
            f"degrees of freedom of the model: {', '.join(skeleton.dof_names)}"
        )
    turns = rotations_from_dofs(skeleton, clip.local_rotation[:, 0], dofs)
    # |a - b| or |a + b| of unit quaternions a and b is 2 sin(angle between them / 4).
    stored = np.asarray(clip.local_rotation, dtype=np.float64)
    sines = [np.linalg.norm(turns + sign * stored, axis=-1) / 2.0 for sign in (-1.0, 1.0)]
    difference = 4.0 * np.arcsin(np.minimum(*sines).clip(max=1.0))
    frame, body = (int(i) for i in np.unravel_index(difference.argmax(), difference.shape))
    if difference[frame, body] > _DOF_TOLERANCE_RAD:
        _log.warning(
            "%s: joint coordinates (dof_pos) and poses differ by %.3f rad at '%s' in frame %d; "
            "was the clip made for another model?",
            clip.name,
            difference[frame, body],
            skeleton.body_names[body],
            frame,
        )
