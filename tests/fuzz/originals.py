"""Whole files of every kind that strangers give away, and how each kind is read."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.checkpoints.files import load_checkpoint
from isaacgymenvs_lite.checkpoints.packed import read_policy_info
from isaacgymenvs_lite.checkpoints.run_config import read_run_config
from isaacgymenvs_lite.commands.check import describe
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.motion.clip import JointClip
from isaacgymenvs_lite.motion.formats.deepmimic import save_deepmimic
from isaacgymenvs_lite.motion.formats.joint_csv import save_joint_csv, save_robot_csv
from isaacgymenvs_lite.motion.formats.npz import load_npz, save_npz
from isaacgymenvs_lite.motion.formats.poselib import save_poselib_npy
from isaacgymenvs_lite.motion.formats.robot_clip import read_joint_clip, save_robot_npz
from isaacgymenvs_lite.motion.loader import load_clips, shipped_motions_dir
from isaacgymenvs_lite.motion.retargeting.bvh import read_bvh
from isaacgymenvs_lite.motion.retargeting.robot_mapping import load_robot_mapping
from isaacgymenvs_lite.motion.skeleton import skeleton_for_num_dofs
from isaacgymenvs_lite.paths import shipped_policies
from isaacgymenvs_lite.robots.load import load_robot
from tests.robots.texts import TETRAHEDRON, mjcf, urdf

_BVH = """HIERARCHY
ROOT a
{
OFFSET 0 0 0
CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
JOINT b
{
OFFSET 1 2 3
CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
End Site
{
OFFSET 7 7 7
}
}
}
MOTION
Frames: 2
Frame Time: 0.1
1 2 3 4 5 6 1 2 3 8 9 10
1 2 3 4 5 6 1 2 3 8 9 11
"""
_MESH = '<geom type="mesh" mesh="part"/>'
_ASSET = '<asset><mesh name="part" file="part.obj"/></asset><include file="more.xml"/>'


@dataclass(frozen=True)
class Kind:
    """A kind of files.

    Attributes:
        file: its name.
        write: writes a whole one to a path, with the files that belong to it beside it.
        read: reads one as the program does; UserError for a file that cannot be used.
        names_file: whether every error names the file; settings are named by their paths.
    """

    file: str
    write: Callable[[Path], object]
    read: Callable[[Path], object]
    names_file: bool = True


def _walk() -> Any:
    clip = load_npz(shipped_motions_dir() / "walk.npz")
    rows = {key: values[:12] for key, values in clip.timed_arrays().items()}
    return type(clip)(**{**clip.__dict__, **rows})


def _joints() -> JointClip:
    dofs = np.linspace(0.0, 0.1, 4)[:, None] + 0.01 * np.arange(3)
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (4, 1))
    return JointClip("a", 30.0, np.zeros((4, 3)), turns, dofs, ("a", "b", "c"))


def _write_gmr(path: Path) -> None:
    clip = _joints()
    content = {"fps": 30, "root_pos": clip.root_pos, "root_rot": clip.root_rot}
    path.write_bytes(pickle.dumps({**content, "dof_pos": clip.dof_pos}))


def _write_json(path: Path) -> None:
    """Write a clip of poselib as JSON."""
    clip = _walk()

    def tagged(values: Any) -> dict[str, Any]:
        values = np.asarray(values)
        array = {"__ndarray__": values.ravel().tolist(), "shape": values.shape}
        return {"arr": array, "context": {"dtype": "float32"}}

    tree = {"node_names": clip.body_names, "parent_indices": tagged(clip.parent_indices)}
    content = {
        "__name__": "SkeletonMotion",
        "fps": clip.fps,
        "is_local": True,
        "skeleton_tree": {**tree, "local_translation": tagged(clip.local_translation)},
        "rotation": tagged(clip.local_rotation),
        "root_translation": tagged(clip.root_translation),
        "global_velocity": tagged(clip.linear_velocity_w),
        "global_angular_velocity": tagged(clip.angular_velocity_w),
    }
    path.write_text(json.dumps(content))


def _write_mjcf(path: Path) -> None:
    path.with_name("part.obj").write_text(TETRAHEDRON)
    path.with_name("more.xml").write_text("<mujocoinclude><option impratio='2'/></mujocoinclude>")
    path.write_text(mjcf(rest=_ASSET).replace("</body>", f"{_MESH}</body>", 1))


def _write_urdf(path: Path) -> None:
    path.with_name("part.obj").write_text(TETRAHEDRON)
    path.write_text(urdf('<mesh filename="package://robot/part.obj" scale="1 1 1"/>'))


def _read_mesh(path: Path) -> None:
    """Read a robot that has the mesh."""
    robot = path.with_name("robot.xml")
    _write_mjcf(robot)
    text = robot.read_text().replace("part.obj", path.name)
    robot.write_text(text)
    load_robot(robot)


def _write_checkpoint(path: Path, zipped: bool = True) -> None:
    state = load_checkpoint(shipped_policies()["ant"])
    state["model"] = {name: value[:2] for name, value in state["model"].items() if value.ndim}
    torch.save(state, path, _use_new_zipfile_serialization=zipped)


def _write_legacy_checkpoint(path: Path) -> None:
    _write_checkpoint(path, zipped=False)


def _write_run(path: Path) -> None:
    words = ["task=Cartpole", "num_envs=2", "num_threads=1", "rl_device=cpu"]
    path.write_text(OmegaConf.to_yaml(compose(words)))


def _describe(path: Path) -> None:
    describe(str(path), ["num_envs=2"])


def _copy(source: str) -> Callable[[Path], object]:
    return lambda path: path.write_bytes((paths.cfg_dir().parent / source).read_bytes())


KINDS = {
    "clip_npz": Kind("a.npz", lambda path: save_npz(path, _walk()), load_clips),
    "clip_poselib": Kind("a.npy", lambda path: save_poselib_npy(path, _walk()), load_clips),
    "clip_json": Kind("a.json", _write_json, load_clips),
    "clip_deepmimic": Kind("a.txt", lambda path: save_deepmimic(path, _walk()), load_clips),
    "clip_csv": Kind(
        "a.csv",
        lambda path: save_joint_csv(path, _walk(), skeleton_for_num_dofs(28)),
        load_clips,
    ),
    "data_set": Kind(
        "a.yaml",
        lambda path: path.write_text("motions:\n- {file: walk, weight: 1}\n"),
        load_clips,
    ),
    "robot_npz": Kind("a.npz", lambda path: save_robot_npz(path, _joints()), read_joint_clip),
    "robot_csv": Kind("a.csv", lambda path: save_robot_csv(path, _joints()), read_joint_clip),
    "robot_pkl": Kind("a.pkl", _write_gmr, read_joint_clip),
    "bvh": Kind("a.bvh", lambda path: path.write_text(_BVH), read_bvh),
    "mjcf": Kind("a.xml", _write_mjcf, load_robot),
    "urdf": Kind("a.urdf", _write_urdf, load_robot),
    "mesh": Kind("a.obj", lambda path: path.write_text(TETRAHEDRON), _read_mesh, False),
    "mapping": Kind("a.yaml", _copy("assets/retargeting/robots/g1.yaml"), load_robot_mapping),
    "checkpoint": Kind("a.pth", _write_checkpoint, read_policy_info),
    "legacy_checkpoint": Kind("a.pth", _write_legacy_checkpoint, load_checkpoint),
    "run_folder": Kind("config.yaml", _write_run, lambda path: read_run_config(path, {})),
    "train_file": Kind("a.yaml", _copy("cfg/train/CartpolePPO.yaml"), _describe, False),
    "task_file": Kind("a.yaml", _copy("cfg/task/Cartpole.yaml"), _describe, False),
}
