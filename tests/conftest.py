"""Fixtures of several test folders: clips of the humanoids, models, a machine that can draw."""

from __future__ import annotations

import gc
import logging
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.skeleton import Skeleton, skeleton_for_num_dofs
from isaacgymenvs_lite.rendering.gl import RenderingError, ensure_gl
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import HumanoidAMPBase
from isaacgymenvs_lite.utils import precision

_FPS = 30.0
_NUM_FRAMES = 46  # 1.5 s


def pytest_configure() -> None:
    """Prepare the process of the tests, and what the processes that tests start inherit."""
    # A shell ignores Ctrl-C for what it runs in the background, nohup SIGHUP.
    for number, handler in (
        (signal.SIGINT, signal.default_int_handler),
        (signal.SIGHUP, signal.SIG_DFL),
    ):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, handler)
    # There is a worker for each CPU: more threads would spin beside each other's.
    if "PYTEST_XDIST_WORKER" in os.environ:
        torch.set_num_threads(1)


def pytest_collection_finish() -> None:
    """Spare the garbage collector what lives as long as the process: modules and tests."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _log_as_before() -> Iterator[None]:
    """Restore the root logger after commands that a test calls in this process."""
    root = logging.getLogger()
    level, last_resort = root.level, logging.lastResort
    handlers = list(root.handlers)
    yield
    root.setLevel(level)
    logging.lastResort = last_resort
    for handler in list(root.handlers):
        if handler not in handlers and not type(handler).__module__.startswith("_pytest"):
            root.removeHandler(handler)


@pytest.fixture
def in_tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, which is empty."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute in bfloat16 where it is asked for, on CPUs without instructions for it, too."""
    monkeypatch.setattr(precision, "supports_bfloat16", lambda: True)


@pytest.fixture(scope="session")
def walk_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return `walk.npz`, 1.5 s at 30 Hz of the humanoid going forward on a curve, limbs swinging.

    The root is at x = t, y = 0, z = 0.88 + 0.05 t (m, s): the height is a clock. The library
    computes the velocities from the poses.
    """
    path = tmp_path_factory.mktemp("motions") / "walk.npz"
    return save_npz(path, _walk(skeleton_for_num_dofs(28)))


@pytest.fixture(scope="session")
def armed_walk_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the same clip of the humanoid with sword and shield."""
    path = tmp_path_factory.mktemp("armed_motions") / "walk.npz"
    return save_npz(path, _walk(skeleton_for_num_dofs(31)))


@pytest.fixture(scope="session")
def gl() -> str:
    """The OpenGL library that draws here."""
    try:
        return ensure_gl()
    except RenderingError as error:
        pytest.skip(str(error))


def _walk(skeleton: Skeleton) -> MotionClip:
    t = np.arange(_NUM_FRAMES) / _FPS
    swing = 0.2 * np.sin(2.0 * np.pi * t / 1.2)
    local_rotation = np.zeros((_NUM_FRAMES, skeleton.num_bodies, 4))
    local_rotation[..., 3] = 1.0
    heading = Rotation.from_euler("z", 0.3 * t[:, None])
    lean = Rotation.from_euler("yx", np.stack((0.05 + 0.2 * swing, 0.1 * swing), axis=1))
    local_rotation[:, 0] = (heading * lean).as_quat()
    for group, (body, size) in enumerate(
        zip(skeleton.dof_body_ids, skeleton.dof_sizes, strict=True)
    ):
        sign = -1.0 if "left" in skeleton.body_names[body] else 1.0
        vector = np.zeros((_NUM_FRAMES, 3))
        if size == 3:
            # Another size about each axis and for each joint, so that none can be mistaken; away
            # from no rotation, where the library's acos in float32 has few digits.
            weights = np.array([-0.4, 1.0, 0.6]) * (0.5 + 0.1 * group)
            vector = sign * (0.3 + swing[:, None]) * weights
        else:
            bent = 0.5 + sign * swing
            vector[:, 1] = bent if "shin" in skeleton.body_names[body] else -bent
        local_rotation[:, body] = Rotation.from_rotvec(vector).as_quat()
    root = np.stack((t, np.zeros_like(t), 0.88 + 0.05 * t), axis=1)
    return MotionClip.from_poses(
        "walk.npz",
        _FPS,
        skeleton.body_names,
        skeleton.parent_indices,
        skeleton.local_translation,
        local_rotation,
        root,
    )


# Every type of joint, several on one body, anchors beside the origin, turned bodies, references,
# bodies without joints below and above bodies with some, two trees.
MADE_UP = """
<mujoco><compiler angle="radian"/><worldbody>
  <body name="drone" pos="1 2 3" quat="0.5 0.5 -0.5 0.5"><freejoint/><geom size="0.1"/>
    <body name="mast" pos="0.1 0.2 0.3" euler="0.4 -0.2 0.7"><geom size="0.1"/>
      <body name="arm" pos="0 0.1 0.5" euler="0.1 0.2 0.3">
        <joint type="slide" axis="1 2 -1" pos="0.3 0 0" ref="0.2"/>
        <joint type="hinge" axis="0 1 1" pos="0.1 -0.2 0.3" ref="-0.4"/>
        <joint type="slide" axis="0 0 1"/>
        <geom size="0.1"/>
        <body name="hand" pos="0.4 0 0"><joint type="ball" pos="0.05 0.02 -0.1"/><geom size="0.1"/>
          <body name="finger" pos="0 0 0.2"><geom size="0.1"/></body></body>
      </body>
      <body name="tail" pos="0 -0.3 0"><joint type="ball"/><joint type="slide" axis="0 1 0"/>
        <geom size="0.1"/></body>
    </body>
  </body>
  <body name="post" pos="-1 0 0.5" euler="0 0 1"><geom size="0.1"/>
    <body name="door" pos="0.2 0 0">
      <joint type="hinge" axis="1 0 0"/><joint type="hinge" axis="0 0 1" pos="0.1 0.1 0"/>
      <geom size="0.1"/></body></body>
</worldbody></mujoco>
"""


@pytest.fixture(scope="session")
def made_up_model() -> mujoco.MjModel:
    """A model with all types of joints (`MADE_UP`); do not change it."""
    model = mujoco.MjModel.from_xml_string(MADE_UP)
    assert set(model.jnt_type) == {0, 1, 2, 3}
    return model


@pytest.fixture(scope="session")
def humanoid_model() -> mujoco.MjModel:
    """The AMP humanoid with the published keys; do not change it."""
    task = HumanoidAMPBase({"env": {"numEnvs": 1}, "sim": {"dt": 0.0166}}, "cpu", "cpu", -1, True)
    task.close()
    return task.simulation.model
