"""Reads clips by the name of a motion file, in any of the formats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import MotionFileError, suggest
from isaacgymenvs_lite.motion.body_order import RETARGET_HINT, ROBOT_HINT, fit_to_skeleton
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.dataset import read_dataset
from isaacgymenvs_lite.motion.formats import deepmimic
from isaacgymenvs_lite.motion.formats.deepmimic_package import (
    PREFIX,
    find_in_package,
    is_package_name,
)
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
from isaacgymenvs_lite.motion.joint_clip import QuatOrder
from isaacgymenvs_lite.motion.qpos import clip_from_qpos, qpos_from_clip, qpos_from_dofs
from isaacgymenvs_lite.motion.skeleton import (
    SHIPPED_NUM_DOFS,
    Skeleton,
    shipped_humanoid_with,
    skeleton_for_num_dofs,
)

_DATASET_SUFFIXES = (".yaml", ".yml")
# Tried in this order behind a name without suffix.
_GUESSED_SUFFIXES = (".npz", ".npy", ".yaml", ".json")
_CONVERT = "isaacgymenvs-lite convert IN.bvh OUT.npz"


@dataclass(frozen=True, kw_only=True)
class JointFileSettings:
    """What a user says about a file of a robot's joint coordinates."""

    fps: float | None = None
    """Frames per second of a table without a rate; None: as usual for its form."""
    quat_order: QuatOrder | None = None
    """Of the file's quaternions; None: see `read_joint_clip`."""
    by_order: bool = False
    """The order of the joints counts, not their names."""


_AS_IN_THE_FILE = JointFileSettings()


def shipped_motions_dir() -> Path:
    """Return the folder of the clips that come with the project."""
    return paths.assets_dir() / "amp" / "motions"


def shipped_robot_motions_dir() -> Path:
    """Return the folder of the robots' clips that come with the project."""
    return paths.assets_dir() / "amp" / "robot_motions"


def shipped_motions() -> list[str]:
    """Return the names, without suffix, of the clips that come with the project."""
    return _clips_in(shipped_motions_dir())


def shipped_robot_motions() -> list[str]:
    """Return the names, without suffix, of the robots' clips that come with the project."""
    return _clips_in(shipped_robot_motions_dir())


def _clips_in(folder: Path) -> list[str]:
    return sorted({path.stem for path in folder.glob("*") if path.suffix in _GUESSED_SUFFIXES})


def load_clips(
    motion_file: str | Path, skeleton: Skeleton | None = None
) -> list[tuple[MotionClip, float]]:
    """Read a clip, or all clips of a data set, each with its weight >= 0.

    Args:
        motion_file: a path (absolute or relative to the working directory), the name of a shipped
            clip, or `deepmimic:<name>`. `.yaml` and some names of DeepMimic's are data sets, all
            others are clips with weight 1: `.npz`, `.npy` and `.json` of poselib, `.txt` and
            `.json` of DeepMimic, `.csv` of joint angles, and files of robots' joint coordinates
            (`formats.robot_clip`), of which `.pkl` and `.npy` may hold several motions:
            `FILE:MOTION` is one of them.
        skeleton: the humanoid; the bodies of the clips are reordered to match it. By default the
            one with 28 degrees of freedom.

    Raises:
        MotionFileError: a file is missing, is none of these formats, is not valid, or is of
            another humanoid.
    """
    skeleton = skeleton or skeleton_for_num_dofs(28)
    if is_package_name(motion_file):
        return _load_from_package(str(motion_file), _humanoid_of([skeleton], motion_file))
    path = resolve_motion_file(motion_file, (Path(), *_shipped_dirs()))
    if path.suffix not in _DATASET_SUFFIXES:
        return [(clip, 1.0) for clip, _ in _load_file(path, (skeleton,))]
    # Each file of a data set is read once.
    clips: list[tuple[MotionClip, float]] = []
    known: dict[str, list[tuple[MotionClip, float]]] = {}
    for i, entry in enumerate(read_dataset(path)):
        try:
            if entry.file not in known:
                known[entry.file] = _load_entry(entry.file, path.parent, skeleton)
        except MotionFileError as error:
            raise MotionFileError(f"{path}: motions[{i}]: {error}") from error
        clips.extend((clip, entry.weight * weight) for clip, weight in known[entry.file])
    return clips


def _shipped_dirs() -> tuple[Path, Path]:
    return shipped_motions_dir(), shipped_robot_motions_dir()


def _load_entry(name: str, folder: Path, skeleton: Skeleton) -> list[tuple[MotionClip, float]]:
    """Return the clips of an entry of a data set in `folder`, and their shares of its weight."""
    if is_package_name(name):
        return _load_from_package(name, _humanoid_of([skeleton], name))
    loaded = _load_file(resolve_motion_file(name, (folder, *_shipped_dirs())), (skeleton,))
    return [(clip, 1.0 / len(loaded)) for clip, _ in loaded]


def load_single_clip(
    motion_file: str | Path,
    skeletons: Sequence[Skeleton] = (),
    joint_file: JointFileSettings = _AS_IN_THE_FILE,
) -> tuple[MotionClip, Skeleton]:
    """Read one clip of any of the humanoids, or of a robot.

    Args:
        motion_file: as in `load_clips`, but no data set.
        skeletons: those that the clip may belong to, by default all shipped humanoids. A robot's
            file of joint coordinates is read for the first, DeepMimic's for the first humanoid.
        joint_file: about a file of joint coordinates.

    Returns:
        The clip, with its bodies in the order of its skeleton, and the skeleton.

    Raises:
        MotionFileError: as in `load_clips`, or the file is a data set.
    """
    skeletons = skeletons or [skeleton_for_num_dofs(number) for number in SHIPPED_NUM_DOFS]
    if is_package_name(motion_file):
        humanoid = _humanoid_of(skeletons, motion_file)
        clips = _load_from_package(str(motion_file), humanoid)
        if len(clips) > 1:
            raise MotionFileError(f"'{motion_file}' is a data set of {len(clips)} clips; give one")
        return clips[0][0], humanoid
    path = resolve_motion_file(motion_file, (Path(), *_shipped_dirs()))
    if path.suffix in _DATASET_SUFFIXES:
        raise MotionFileError(f"{path}: is a data set; give one of its clips")
    loaded = _load_file(path, skeletons, joint_file)
    if len(loaded) > 1:
        raise MotionFileError(several_motions(path, [clip.name for clip, _ in loaded]))
    return loaded[0]


def resolve_motion_file(name: str | Path, search_dirs: Sequence[Path]) -> Path:
    """Return the path of the motion file `name`.

    Args:
        name: an absolute path, or one relative to one of `search_dirs`; the suffix may be left out.
            `FILE:MOTION` is returned with the motion.
        search_dirs: the folders to look in, in this order.

    Raises:
        MotionFileError: there is no such file; the message lists the folders and the shipped clips.
    """
    folders = [Path()] if Path(name).is_absolute() else search_dirs
    with reading(name, "name of a motion file"):
        for folder in folders:
            for suffix in ("", *_GUESSED_SUFFIXES):
                path = folder / f"{name}{suffix}"
                if path.is_file() or Path(split_motion(path)[0]).is_file():
                    return path
    looked = " and ".join(dict.fromkeys(str(folder.absolute()) for folder in folders))
    where = "" if Path(name).is_absolute() else f" in {looked}"
    shipped, of_robots = shipped_motions(), shipped_robot_motions()
    raise MotionFileError(
        f"motion file '{name}' not found{where}{suggest(Path(name).stem, (*shipped, *of_robots))}; "
        f"shipped clips: {', '.join(shipped) or 'none'}; of robots: {', '.join(of_robots)}; "
        f"{PREFIX}<name> for DeepMimic's"
    )


def _load_from_package(name: str, skeleton: Skeleton) -> list[tuple[MotionClip, float]]:
    """Read the clip or the data set `deepmimic:<name>`."""
    return [
        (deepmimic.load_deepmimic(clip.path, skeleton, clip.name), clip.weight)
        for clip in find_in_package(name)
    ]


def _humanoid_of(skeletons: Sequence[Skeleton], motion_file: str | Path) -> Skeleton:
    """Return the first humanoid that has the bodies and joints of DeepMimic's clips.

    Robots may have the same bodies, as dm_control's humanoid, with other joints.

    Raises:
        MotionFileError: all are skeletons of robots.
    """
    for skeleton in skeletons:
        has_bodies = set(deepmimic.MOVED_BODIES) <= set(skeleton.body_names)
        if has_bodies and skeleton.has_simple_joints:
            return skeleton
    raise MotionFileError(f"{motion_file}: is a DeepMimic clip of the humanoid; {RETARGET_HINT}")


def _load_file(
    path: Path, skeletons: Sequence[Skeleton], joint_file: JointFileSettings = _AS_IN_THE_FILE
) -> list[tuple[MotionClip, Skeleton]]:
    """Read the clips of a file by its suffix, each for the skeleton that has its bodies.

    A robot's file of joint coordinates is read for the first.
    """
    suffix = Path(split_motion(path)[0]).suffix
    # A robot's joints may have the names of the humanoid's.
    is_robots = suffix == ".csv" and not skeletons[0].has_simple_joints
    if is_robots or looks_like_joint_clip(path):
        clips = _clips_of_joints(path, skeletons[0], joint_file)
        return [(clip, skeletons[0]) for clip in clips]
    if joint_file != _AS_IN_THE_FILE:
        raise MotionFileError(
            f"{path}: is no robot's file of joint coordinates, which is what file_fps=, quat_order="
            " and by_order= are about; leave them out"
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
        return [(clip, skeleton)]


def _clips_of_joints(
    path: Path, skeleton: Skeleton, settings: JointFileSettings
) -> list[MotionClip]:
    """Read a file of joint coordinates for a robot; MuJoCo's kinematics gives the poses."""
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
    """Read a `.txt` or `.json` clip: DeepMimic's holds 'Frames', poselib's '__name__'."""
    data = read_json(path)
    if "Frames" in data or path.suffix == ".txt":
        deepmimic.check_columns(data, str(path))
        return deepmimic.clip_from_deepmimic(data, _humanoid_of(skeletons, path), str(path))
    return clip_from_poselib(data, str(path))
