"""Small clips for the motion tests: a body of three links, and the standing humanoid."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from isaacgymenvs_lite.motion import convert
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.skeleton import Skeleton, skeleton_for_num_dofs
from isaacgymenvs_lite.utils import rotations


@pytest.fixture
def humanoid() -> Skeleton:
    return skeleton_for_num_dofs(28)


@pytest.fixture
def armed() -> Skeleton:
    """The humanoid with sword and shield."""
    return skeleton_for_num_dofs(31)


@pytest.fixture
def tiny() -> Skeleton:
    """A root, an arm on a ball joint 1 m above it, a hand on a hinge 1 m in front of the arm."""
    geom = '<geom size="0.1" contype="0" conaffinity="0"/>'
    text = f"""
<mujoco><worldbody><body name="root"><freejoint/>{geom}
  <body name="arm" pos="0 0 1"><joint name="arm" type="ball"/>{geom}
    <body name="hand" pos="1 0 0"><joint name="hand" axis="0 1 0"/>{geom}</body></body>
</body></worldbody></mujoco>"""
    return Skeleton.from_model(mujoco.MjModel.from_xml_string(text))


# It has rest rotations, an oblique hinge, a hinge with 0.3 rad at rest, three hinges on one body,
# joints away from the origins of their bodies, hinges before a ball joint, and an object.
ROBOT = """
<mujoco><compiler angle="radian"/><worldbody>
  <body name="rail"><geom size="0.1"/></body>
  <body name="base" pos="0 0 1" quat="0.9 0.1 0.3 0.2"><freejoint/><geom size="0.1"/>
    <body name="left_arm" pos="0.1 0.4 0.2" quat="0.8 0.1 -0.4 0.3"><geom size="0.1"/>
      <joint name="left_turn" axis="1 2 -0.5" range="-6 6"/>
      <body name="left_hand" pos="0 0.3 0.1" euler="0.3 0.5 -0.2"><geom size="0.1"/>
        <joint name="left_roll" axis="1 0 0" pos="0.05 0 -0.1"/>
        <joint name="left_pitch" axis="0 1 0" ref="0.3"/>
        <joint name="left_yaw" axis="0 0.6 0.8" pos="0 0.1 0"/></body></body>
    <body name="spine" pos="-0.2 0 0.3"><geom size="0.1"/>
      <joint name="bend" axis="0 0 -1" pos="0 0 -0.2" range="-1 2"/>
      <joint name="lean" axis="0.5 1 0"/><joint name="neck" type="ball" pos="0 0.02 0.1"/>
      <body name="skull" pos="0 0 0.2" euler="0.1 0 0"><geom size="0.05"/>
        <body name="jaw" pos="0.1 0 0"><geom size="0.02"/><joint name="jaw" type="ball"/></body>
      </body></body></body>
  <body name="box" pos="3 0 0"><freejoint/><geom size="0.1"/></body>
</worldbody></mujoco>
"""
FPS = 30.0


@pytest.fixture
def robot() -> Skeleton:
    """A robot with every kind of joint that the shipped humanoids lack; 6 hinges, 2 balls."""
    return Skeleton.from_model(mujoco.MjModel.from_xml_string(ROBOT))


@pytest.fixture
def moving() -> Callable[..., np.ndarray]:
    """Return `moving(skeleton)`, smooth motions (40, nq) of all joints; hinges reach 3.5 rad."""

    def move(skeleton: Skeleton, num_frames: int = 40) -> np.ndarray:
        random = np.random.default_rng(7)
        times_s = np.arange(num_frames)[:, None] / FPS
        places = np.concatenate((times_s, 0.1 * np.sin(4.0 * times_s), 1.0 + 0.0 * times_s), axis=1)
        parts = [places, _wxyz(np.sin(2.0 * times_s) * random.normal(size=3))]
        for size in skeleton.dof_sizes:
            wave = np.sin(random.uniform(2.0, 4.0) * times_s + random.uniform(0.0, 3.0))
            parts.append(3.5 * wave if size == 1 else _wxyz(wave * random.normal(size=3)))
        return np.concatenate(parts, axis=1)

    return move


@pytest.fixture
def about() -> Callable[[str, Any], np.ndarray]:
    """Return `about(axis, angles_rad)`, which makes quaternions about a coordinate axis."""
    return _about


@pytest.fixture
def tiny_clip(tiny: Skeleton) -> MotionClip:
    """Three frames at 10 fps with made-up root velocities.

    The root is at x = 0, 1, 4 m, the arm turns about z by 0, 0.1, 0.2 rad, the hand about y by 0,
    0.2, 0.6 rad.
    """
    rotation = np.stack(
        (_about("z", [0.0] * 3), _about("z", [0.0, 0.1, 0.2]), _about("y", [0.0, 0.2, 0.6])),
        axis=1,
    )
    linear, angular = np.zeros((3, 3, 3)), np.zeros((3, 3, 3))
    linear[:, 0, 0] = (10.0, 20.0, 30.0)
    angular[:, 0, 1] = (1.0, 2.0, 3.0)
    return MotionClip(
        "tiny",
        10.0,
        tiny.body_names,
        tiny.parent_indices,
        tiny.local_translation,
        rotation,
        np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [4.0, 0.0, 0.0]]),
        linear,
        angular,
    )


@pytest.fixture
def make_humanoid_clip(humanoid: Skeleton) -> Callable[..., MotionClip]:
    """Return a maker of clips of a humanoid in its zero pose, walking at 1 m/s; 30 fps."""

    def make(num_frames: int = 10, skeleton: Skeleton = humanoid, **changes: Any) -> MotionClip:
        num_bodies = skeleton.num_bodies
        rotation = np.zeros((num_frames, num_bodies, 4))
        rotation[..., 3] = 1.0
        root = np.zeros((num_frames, 3))
        root[:, 0] = np.arange(num_frames) / 30.0
        root[:, 2] = 0.9
        clip = MotionClip(
            "walk.npz",
            30.0,
            skeleton.body_names,
            skeleton.parent_indices,
            skeleton.local_translation,
            rotation,
            root,
            np.tile([1.0, 0.0, 0.0], (num_frames, num_bodies, 1)),
            np.zeros((num_frames, num_bodies, 3)),
        )
        return dataclasses.replace(clip, **changes)

    return make


@pytest.fixture
def as_poselib() -> Callable[[MotionClip], dict[str, Any]]:
    """Return `as_poselib(clip)`, poselib's dictionary of a clip in float32 with a whole fps."""

    def tagged(array: Any, dtype: str = "float32") -> dict[str, Any]:
        return {"arr": np.asarray(array).astype(dtype), "context": {"dtype": dtype}}

    def store(clip: MotionClip) -> dict[str, Any]:
        tree = OrderedDict(
            node_names=list(clip.body_names),
            parent_indices=tagged(clip.parent_indices, "int64"),
            local_translation=tagged(clip.local_translation),
        )
        return OrderedDict(
            rotation=tagged(clip.local_rotation),
            root_translation=tagged(clip.root_translation),
            global_velocity=tagged(clip.linear_velocity_w),
            global_angular_velocity=tagged(clip.angular_velocity_w),
            skeleton_tree=tree,
            is_local=True,
            fps=int(clip.fps),
            __name__="SkeletonMotion",
        )

    return store


@pytest.fixture
def save_object_npy() -> Callable[[Path, Any], Path]:
    """Return `save_object_npy(path, data)`, which writes data as a pickle like poselib."""

    def save(path: Path, data: Any) -> Path:
        array = np.empty((), dtype=object)
        array[()] = data
        np.save(path, array, allow_pickle=True)
        return path

    return save


@pytest.fixture
def in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Return `refused(*words)`, the one line that a conversion ends with; no file may appear."""

    def run(*words: str) -> str:
        before = sorted(Path().iterdir())
        with pytest.raises(SystemExit) as caught:
            convert.main(list(words))
        assert caught.value.code == 2
        assert sorted(Path().iterdir()) == before
        output = capsys.readouterr().err.splitlines()
        (line,) = [line for line in output if line.startswith("error: ")]
        return line

    return run


def _about(axis: str, angles_rad: Any) -> np.ndarray:
    """Return the quaternions (T, 4) xyzw of rotations by angles (T,) about a coordinate axis."""
    half = 0.5 * np.asarray(angles_rad, dtype=np.float64)
    quaternions = np.zeros((len(half), 4))
    quaternions[:, "xyz".index(axis)] = np.sin(half)
    quaternions[:, 3] = np.cos(half)
    return quaternions


def _wxyz(vectors: np.ndarray) -> np.ndarray:
    """Return the quaternions (T, 4) wxyz of rotation vectors (T, 3)."""
    turns = rotations.exp_map_to_quat(torch.from_numpy(vectors), keep_long=True)
    return rotations.wxyz_from_xyzw(turns).numpy()
