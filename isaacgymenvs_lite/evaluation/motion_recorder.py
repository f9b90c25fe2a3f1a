"""Records the motion of a policy as a clip."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from isaacgymenvs_lite.env_interface import ReferenceEnv
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion.clip import JointClip, MotionClip
from isaacgymenvs_lite.motion.formats.npz import save_npz
from isaacgymenvs_lite.motion.formats.robot_clip import save_robot_npz
from isaacgymenvs_lite.motion.kinematics import FloatArray, local_rotations
from isaacgymenvs_lite.paths import user_path

log = logging.getLogger(__name__)


class MotionRecorder:
    """Records the first episode of environment 0 as an .npz file; the task needs reference motions.

    The clip of a humanoid contains the rotations of its bodies; the clip of a robot contains the
    positions of its joints, as do the clips that the command `convert` writes.
    """

    def __init__(self, env: ReferenceEnv, path: str) -> None:
        if not hasattr(env, "motion_lib"):
            raise ConfigError(
                f"train.params.config.player.record={path}: only tasks with reference motions can"
                " be recorded, such as task=HumanoidAMP"
            )
        self._env = env
        self._path = user_path(path)
        if not self._path.parent.is_dir() or self._path.suffix != ".npz":
            raise ConfigError(
                f"train.params.config.player.record={path}: expected a .npz file in a folder that"
                " exists"
            )
        self._rotations: list[Tensor] = []
        self._positions: list[Tensor] = []
        self._dofs: list[Tensor] = []
        self._done = False

    def step(self, dones: Tensor) -> None:
        """Store a control step; write the file when the episode ends."""
        if self._done:
            return
        simulation = self._env.simulation
        self._rotations.append(simulation.body_rot[0].clone())
        self._positions.append(simulation.root_states[0, :3].clone())
        self._dofs.append(simulation.dof_pos[0].clone())
        if bool(dones[0] != 0):
            self._done = True
            self._write()

    def _write(self) -> None:
        num_frames = len(self._positions)
        if num_frames < 2:
            log.warning("the recorded episode had only one step; no file was written")
            return
        if self._env.motion_lib.skeleton.has_simple_joints:
            save_npz(self._path, self._clip_of_bodies())
        else:
            save_robot_npz(self._path, self._clip_of_joints())
        distance_m = torch.linalg.vector_norm((self._positions[-1] - self._positions[0])[:2]).item()
        log.info(
            "recorded %d steps into %s: %.2f m/s along the ground",
            num_frames,
            self._path,
            distance_m / ((num_frames - 1) * self._env.dt),
        )

    def _clip_of_bodies(self) -> MotionClip:
        skeleton = self._env.motion_lib.skeleton
        return MotionClip.from_poses(
            str(self._path),
            1.0 / self._env.dt,
            skeleton.body_names,
            skeleton.parent_indices,
            skeleton.local_translation,
            local_rotations(skeleton.parent_indices, _stacked(self._rotations)),
            _stacked(self._positions),
        )

    def _clip_of_joints(self) -> JointClip:
        return JointClip(
            str(self._path),
            1.0 / self._env.dt,
            _stacked(self._positions),
            _stacked([of_bodies[0] for of_bodies in self._rotations]),
            _stacked(self._dofs),
            self._env.motion_lib.skeleton.dof_names,
        )


def _stacked(steps: list[Tensor]) -> FloatArray:
    return torch.stack(steps).double().numpy()
