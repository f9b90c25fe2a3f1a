"""Motion files: clips in every format, data sets, mappings and motion capture."""

from __future__ import annotations

import json
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fuzz import hostile_clips as hostile
from benchmarks.fuzz.kinds import Kind
from benchmarks.fuzz.mutators import (
    mutate_json,
    mutate_npz,
    mutate_object_npy,
    mutate_pickle,
    mutate_text,
    mutate_yaml,
)
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.editing import cut
from isaacgymenvs_lite.motion.formats.deepmimic import save_deepmimic
from isaacgymenvs_lite.motion.formats.joint_csv import save_joint_csv
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.formats.poselib import save_poselib_npy
from isaacgymenvs_lite.motion.formats.robot_clip import read_joint_clip
from isaacgymenvs_lite.motion.formats.robot_csv import save_robot_csv
from isaacgymenvs_lite.motion.formats.robot_npz import save_robot_npz
from isaacgymenvs_lite.motion.joint_clip import JointClip
from isaacgymenvs_lite.motion.loader import load_single_clip
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.motion.retargeting.bvh import read_bvh
from isaacgymenvs_lite.motion.retargeting.mapping import load_mapping, shipped_mappings
from isaacgymenvs_lite.motion.skeleton import skeleton_for_num_dofs

_NUM_DOFS = 28
_KEY_BODIES = (5, 8, 11, 14)
_LENGTHS_S = (0.1, 0.3)
_TIMES = 8


def _clips() -> list[MotionClip]:
    """Return short clips of the humanoid."""
    clip, _ = load_single_clip("run")
    return [cut(clip, 0.0, length_s) for length_s in _LENGTHS_S]


def _play(path: Path) -> MotionLib:
    """Read a clip or a data set as a training does, and read states from it.

    Raises:
        UserError: it cannot be used.
        ArithmeticError: it was accepted, but a training would get numbers that are not finite.
    """
    library = MotionLib(path, _NUM_DOFS, _KEY_BODIES, "cpu")
    ids = library.sample_motions(_TIMES)
    state = library.get_motion_state(ids, library.sample_time(ids))
    if not all(
        part.isfinite().all() for part in (*state, library.get_body_pos(ids, [0.0] * _TIMES))
    ):
        raise ArithmeticError("the library returns numbers that are not finite")
    if max(part.abs().max() for part in state) > 1e7:
        raise ArithmeticError("the library returns numbers beyond anything physical")
    return library


def _write_npz(folder: Path) -> list[Path]:
    return [save_npz(folder / f"clip{i}", clip) for i, clip in enumerate(_clips())]


def _write_poselib(folder: Path) -> list[Path]:
    return [save_poselib_npy(folder / f"clip{i}.npy", clip) for i, clip in enumerate(_clips())]


def _write_poselib_json(folder: Path) -> list[Path]:
    return [
        _written(folder / f"clip{i}.json", json.dumps(_poselib(clip)))
        for i, clip in enumerate(_clips())
    ]


def _poselib(clip: MotionClip) -> dict[str, Any]:
    """Return a clip as poselib's .json has it."""

    def tagged(values: Any, dtype: str) -> dict[str, Any]:
        array = np.asarray(values, dtype=dtype)
        stored = {"__ndarray__": array.tolist(), "dtype": dtype, "shape": list(array.shape)}
        return {"arr": stored, "context": {"dtype": dtype}}

    return {
        "rotation": tagged(clip.local_rotation, "float32"),
        "root_translation": tagged(clip.root_translation, "float32"),
        "global_velocity": tagged(clip.linear_velocity_w, "float32"),
        "global_angular_velocity": tagged(clip.angular_velocity_w, "float32"),
        "skeleton_tree": {
            "node_names": list(clip.body_names),
            "parent_indices": tagged(clip.parent_indices, "int64"),
            "local_translation": tagged(clip.local_translation, "float32"),
        },
        "is_local": True,
        "fps": clip.fps,
        "__name__": "SkeletonMotion",
    }


def _write_deepmimic(folder: Path) -> list[Path]:
    return [save_deepmimic(folder / f"clip{i}.txt", clip) for i, clip in enumerate(_clips())]


def _write_csv(folder: Path) -> list[Path]:
    skeleton = skeleton_for_num_dofs(_NUM_DOFS)
    return [
        save_joint_csv(folder / f"clip{i}.csv", clip, skeleton) for i, clip in enumerate(_clips())
    ]


def _write_mappings(folder: Path) -> list[Path]:
    return [
        _written(folder / f"{name}.yaml", file.read_text(encoding="utf-8"))
        for name, file in shipped_mappings().items()
    ]


def _write_dataset(folder: Path) -> list[Path]:
    _write_npz(folder)
    _write_deepmimic(folder)
    files = ("clip0.npz", "clip1.npz", "clip0.txt", "walk", "deepmimic:walk")
    entries = [f'  - {{file: "{file}", weight: {i + 0.5}}}' for i, file in enumerate(files)]
    return [
        _written(folder / f"set{i}.yaml", "\n".join(("motions:", *entries[:count], "")))
        for i, count in enumerate((1, 3, 4))
    ]


# The joints of mapping=lafan1: name, parent, offset in cm.
_BVH_JOINTS: tuple[tuple[str, str, tuple[int, int, int]], ...] = (
    ("Hips", "", (0, 90, 0)),
    *(
        joint
        for side, sign in (("Left", 1), ("Right", -1))
        for joint in (
            (f"{side}UpLeg", "Hips", (0, 0, 10 * sign)),
            (f"{side}Leg", f"{side}UpLeg", (42, 0, 0)),
            (f"{side}Foot", f"{side}Leg", (42, 0, 0)),
        )
    ),
    ("Spine2", "Hips", (25, 0, 0)),
    ("Head", "Spine2", (30, 0, 0)),
    *(
        joint
        for side, sign in (("Left", 1), ("Right", -1))
        for joint in (
            (f"{side}Arm", "Spine2", (20, 0, 15 * sign)),
            (f"{side}ForeArm", f"{side}Arm", (28, 0, 0)),
            (f"{side}Hand", f"{side}ForeArm", (26, 0, 0)),
        )
    ),
)
_TURNS = ("Zrotation", "Yrotation", "Xrotation")
_PLACES = ("Xposition", "Yposition", "Zposition")


def _write_bvh(folder: Path) -> list[Path]:
    """Write motions with positions of the root only, and with constant ones of all joints."""
    return [
        _written(folder / "root.bvh", _bvh(inner_positions=False)),
        _written(folder / "all.bvh", _bvh(inner_positions=True)),
    ]


def _bvh(inner_positions: bool) -> str:
    lines = ["HIERARCHY"]

    def add(name: str, offset: Sequence[int], depth: int) -> None:
        indent = "  " * depth
        has_place = depth == 0 or inner_positions
        channels = (*(_PLACES if has_place else ()), *_TURNS)
        lines.append(f"{indent}{'JOINT' if depth else 'ROOT'} {name}")
        lines.append(f"{indent}{{")
        lines.append(f"{indent}  OFFSET {' '.join(map(str, offset))}")
        lines.append(f"{indent}  CHANNELS {len(channels)} {' '.join(channels)}")
        columns.append((offset if has_place else (), depth))
        children = [joint for joint in _BVH_JOINTS if joint[1] == name]
        for child, _, child_offset in children:
            add(child, child_offset, depth + 1)
        if not children:
            lines.extend(f"{indent}  {word}" for word in ("End Site", "{", "  OFFSET 5 0 0", "}"))
        lines.append(f"{indent}}}")

    columns: list[tuple[Sequence[int], int]] = []
    root, _, place = _BVH_JOINTS[0]
    add(root, place, 0)
    rng = np.random.default_rng(0)
    angles_deg = rng.normal(scale=10.0, size=(1, len(columns), 3))
    angles_deg = angles_deg + rng.normal(scale=1.0, size=(5, len(columns), 3))
    lines += ["MOTION", f"Frames: {len(angles_deg)}", "Frame Time: 0.033333"]
    for frame in angles_deg:
        values = [
            value
            for (offset, _), turn in zip(columns, frame, strict=True)
            for value in (*offset, *turn.round(4))
        ]
        lines.append(" ".join(str(value) for value in values))
    return "\n".join((*lines, ""))


def _load_bvh(path: Path) -> MotionClip:
    mapping = load_mapping("lafan1")
    return read_bvh(path).clip(mapping.to_z_up, mapping.unit_m)


def _written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def _convert(path: Path, *settings: str) -> list[str]:
    """Return the words that convert a file, to one beside the folder of the inputs."""
    out = path.parent.with_suffix(".npz")
    return ["isaacgymenvs_lite.motion.convert", str(path), str(out), "overwrite=True", *settings]


def _convert_bvh(path: Path) -> list[str]:
    return _convert(path, "mapping=lafan1")


def _convert_by_mapping(path: Path) -> list[str]:
    source = path.parent.with_suffix(".bvh")
    _written(source, _bvh(inner_positions=False))
    return [
        "isaacgymenvs_lite.motion.convert",
        str(source),
        str(source.with_suffix(".npz")),
        "overwrite=True",
        f"mapping={path}",
    ]


def _joint_clips() -> list[JointClip]:
    """Return short clips of a robot with three named joints."""
    rng = np.random.default_rng(0)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (5, 1))
    return [
        JointClip("robot", 30.0, np.zeros((5, 3)), still, rng.normal(size=(5, 3)), names)
        for names in (("hip", "knee", "ankle"), None)
    ]


def _write_robot_csv(folder: Path) -> list[Path]:
    return [
        save_robot_csv(folder / f"robot{i}.csv", clip, header=clip.joint_names is not None)
        for i, clip in enumerate(_joint_clips())
    ]


def _write_robot_npz(folder: Path) -> list[Path]:
    return [save_robot_npz(folder / f"robot{i}", clip) for i, clip in enumerate(_joint_clips())]


def _write_robot_pickles(folder: Path) -> list[Path]:
    clip = _joint_clips()[0]
    frames = np.hstack((clip.root_pos, clip.root_rot[:, :3], clip.dof_pos)).tolist()
    keys = ("fps", "root_pos", "root_rot", "dof_pos")
    written = []
    for name, protocol, data in (
        ("gmr", 4, {key: getattr(clip, key) for key in keys}),
        ("gmr_5", 5, {key: getattr(clip, key) for key in keys}),
        ("mimickit", 4, {"fps": 30, "loop_mode": 0, "frames": frames}),
    ):
        written.append(folder / f"{name}.pkl")
        written[-1].write_bytes(pickle.dumps(data, protocol=protocol))
    return written


KINDS = (
    Kind("robot_csv", ".csv", _write_robot_csv, read_joint_clip, mutate_text, hostile.csv),
    Kind("robot_npz", ".npz", _write_robot_npz, read_joint_clip, mutate_npz, hostile.robot_npz),
    Kind(
        "robot_pickle",
        ".pkl",
        _write_robot_pickles,
        read_joint_clip,
        mutate_pickle,
        hostile.robot_pickles,
    ),
    Kind("npz", ".npz", _write_npz, _play, mutate_npz, hostile.npz, _convert),
    Kind("poselib", ".npy", _write_poselib, _play, mutate_object_npy, hostile.poselib, _convert),
    Kind(
        "poselib_json",
        ".json",
        _write_poselib_json,
        _play,
        mutate_json,
        hostile.json_clips,
        _convert,
    ),
    Kind("deepmimic", ".txt", _write_deepmimic, _play, mutate_json, hostile.deepmimic, _convert),
    Kind("csv", ".csv", _write_csv, _play, mutate_text, hostile.csv, _convert),
    Kind("bvh", ".bvh", _write_bvh, _load_bvh, mutate_text, hostile.bvh, _convert_bvh),
    Kind(
        "mapping",
        ".yaml",
        _write_mappings,
        load_mapping,
        mutate_yaml,
        hostile.yaml_texts,
        _convert_by_mapping,
    ),
    Kind("dataset", ".yaml", _write_dataset, _play, mutate_yaml, hostile.datasets),
)
