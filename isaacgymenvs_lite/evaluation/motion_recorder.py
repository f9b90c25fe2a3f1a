"""Records a played policy as a motion clip, to look at it or compare it."""

from __future__ import annotations

import logging
from pathlib import Path

import torch
from torch import Tensor

from isaacgymenvs_lite.env_interface import ReferenceEnv
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.kinematics import local_rotations

log = logging.getLogger(__name__)


class MotionRecorder:
    """Records the first episode of environment 0 of a task with reference motions.

    Args:
        env: the task.
        path: the .npz file to write.

    Raises:
        ConfigError: the task has no reference motions, or the file cannot be written.
    """

    def __init__(self, env: ReferenceEnv, path: str) -> None:
        if not hasattr(env, "motion_lib"):
            raise ConfigError(
                f"train.params.config.player.record={path}: only tasks with reference motions can"
                " be recorded, such as task=HumanoidAMP"
            )
        self._env = env
        self._path = Path(path).expanduser()
        if not self._path.parent.is_dir() or self._path.suffix != ".npz":
            raise ConfigError(
                f"train.params.config.player.record={path}: expected a .npz file in a folder that"
                " exists"
            )
        self._rotations: list[Tensor] = []
        self._positions: list[Tensor] = []
        self._done = False

    def step(self, dones: Tensor) -> None:
        """Store a control step; the file is written when the episode ends."""
        if self._done:
            return
        self._rotations.append(self._env.simulation.body_rot[0].clone())
        self._positions.append(self._env.simulation.root_states[0, :3].clone())
        if bool(dones[0] != 0):
            self._done = True
            self._write()

    def _write(self) -> None:
        skeleton = self._env.motion_lib.skeleton
        if len(self._rotations) < 2:
            log.warning("the episode to record had one step only: nothing is written")
            return
        rotations = torch.stack(self._rotations).double().numpy()
        clip = MotionClip.from_poses(
            str(self._path),
            1.0 / self._env.dt,
            skeleton.body_names,
            skeleton.parent_indices,
            skeleton.local_translation,
            local_rotations(skeleton.parent_indices, rotations),
            torch.stack(self._positions).double().numpy(),
        )
        save_npz(self._path, clip)
        distance_m = torch.linalg.vector_norm((self._positions[-1] - self._positions[0])[:2]).item()
        log.info(
            "recorded %d steps into %s: %.2f m/s along the ground",
            clip.num_frames,
            self._path,
            distance_m / clip.length_s,
        )
