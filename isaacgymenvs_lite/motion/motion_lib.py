"""The motion library: states of reference clips at any time, in batches on the device.

All clips are concatenated in flat tensors, so that a call is a few gathers for any number of
clips. The semantics are the AMP and ASE motion libraries'; quaternions xyzw.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.loader import load_clips
from isaacgymenvs_lite.motion.qpos import dofs_of_clip, joint_rotations
from isaacgymenvs_lite.motion.skeleton import Skeleton, skeleton_for_num_dofs
from isaacgymenvs_lite.utils import rotations

_log = logging.getLogger(__name__)

# The time of a frame, rounded to float32, must not pick the frame before: its velocities differ.
_TIME_ROUNDING = 1.0 + 1e-7

_Ids = Tensor | npt.NDArray[np.integer] | Sequence[int]
_Times = Tensor | npt.NDArray[np.floating] | Sequence[float]


class MotionState(NamedTuple):
    """States of n samples, float32 on the library's device; K key bodies.

    Attributes:
        root_pos: (n, 3) m, world.
        root_rot: (n, 4), world.
        dof_pos: (n, num_dofs) rad, rotation vectors of ball joints and angles of hinges.
        root_vel: (n, 3) m/s, world.
        root_ang_vel: (n, 3) rad/s, world.
        dof_vel: (n, num_dofs) rad/s, rates of hinges' angles; of ball joints the angular velocity
            in the child's frame.
        key_pos: (n, K, 3) m, world.
    """

    root_pos: Tensor
    root_rot: Tensor
    dof_pos: Tensor
    root_vel: Tensor
    root_ang_vel: Tensor
    dof_vel: Tensor
    key_pos: Tensor


class MotionLib:
    """Clips of one humanoid or robot, sampled by weight and read at any time.

    Ball joints are interpolated as rotations. So are hinges of the shipped humanoids, as in the
    original; hinges of other skeletons, and all if a clip has `dof_pos`, by their angles, which may
    exceed pi.

    Args:
        motion_file: a clip or a data set, see `loader.load_clips`.
        num_dofs: degrees of freedom, which determine the skeleton of a shipped humanoid.
        key_body_ids: K body ids whose positions `get_motion_state` returns.
        device: of the tensors.
        repair_repeated_frames: drop the copies in clips that store every pose twice.
        skeleton: the robot, if it is none of the shipped humanoids.

    Raises:
        MotionFileError: a clip cannot be used.
        ConfigError: no such skeleton, or a key body that it does not have.
    """

    def __init__(
        self,
        motion_file: str | Path,
        num_dofs: int,
        key_body_ids: _Ids,
        device: str | torch.device,
        repair_repeated_frames: bool = False,
        skeleton: Skeleton | None = None,
    ) -> None:
        self.skeleton = skeleton or skeleton_for_num_dofs(num_dofs)
        if self.skeleton.num_dofs != num_dofs:
            raise ConfigError(
                f"num_dofs is {num_dofs}, but the skeleton has {self.skeleton.num_dofs}"
            )
        self.device = torch.device(device)
        key_ids = [int(body) for body in key_body_ids]
        for body in key_ids:
            if not 0 <= body < self.skeleton.num_bodies:
                raise ConfigError(
                    f"key body {body} does not exist, expected ids from 0 to "
                    f"{self.skeleton.num_bodies - 1}"
                )
        self._num_keys = len(key_ids)
        clips_and_weights = load_clips(motion_file, self.skeleton)
        self._clips = [
            _without_copies(clip, repair_repeated_frames) for clip, _ in clips_and_weights
        ]
        self._build_motion_table([weight for _, weight in clips_and_weights])
        has_dofs = any(clip.dof_pos is not None for clip in self._clips)
        self._joints = _JointColumns(
            self.skeleton, with_angles=has_dofs or not self.skeleton.has_simple_joints
        )
        self._build_frame_tables(key_ids)
        self._dof_columns = torch.tensor(self._joints.columns, dtype=torch.long, device=self.device)

    def num_motions(self) -> int:
        """Return the number of clips."""
        return len(self._clips)

    def get_total_length(self) -> float:
        """Return the duration of all clips together, in s."""
        return sum(clip.length_s for clip in self._clips)

    def fastest_clip_m_s(self) -> float:
        """Return the mean speed of the root along the ground, of the clip where it is highest."""
        velocities = (clip.linear_velocity_w[:, 0, :2] for clip in self._clips)
        return max(float(np.linalg.norm(v, axis=-1).mean()) for v in velocities)

    def get_motion(self, motion_id: int) -> MotionClip:
        """Return a clip, with its bodies in the order of the humanoid."""
        return self._clips[motion_id]

    def get_motion_length(self, motion_ids: _Ids) -> Tensor:
        """Return the durations (n,) of clips (n,), (frames - 1) / fps, in s."""
        return self._lengths_s[torch.as_tensor(motion_ids, dtype=torch.long, device=self.device)]

    def sample_motions(self, n: int) -> Tensor:
        """Return n clip ids (n,), drawn by weight with replacement from torch's generator."""
        uniform = torch.rand(n, device=self.device, dtype=torch.float64)
        return torch.searchsorted(self._cumulative_weights, uniform, right=True)

    def sample_time(self, motion_ids: _Ids, truncate_time: float | None = None) -> Tensor:
        """Return random times (n,) s in the clips (n,).

        Args:
            motion_ids: (n,) clip ids.
            truncate_time: leave out this much (s, >= 0) at the end of each clip; clips that are
                shorter give time 0.

        Raises:
            ConfigError: truncate_time is negative.
        """
        lengths = self.get_motion_length(motion_ids)
        if truncate_time is not None:
            if truncate_time < 0.0:
                raise ConfigError(f"truncate_time is {truncate_time} s, expected at least 0")
            lengths = (lengths - truncate_time).clamp(min=0.0)
        return torch.rand_like(lengths) * lengths

    def get_motion_state(self, motion_ids: _Ids, motion_times: _Times) -> MotionState:
        """Return the states of clips (n,) at times (n,) in s.

        Positions and rotations are interpolated between frames, velocities are taken from the frame
        at or before the time. Before the start the first two frames are extrapolated backwards;
        after the end the last pose is returned.
        """
        row, next_row, blend = self._rows(motion_ids, motion_times)
        frame = self._frames.index_select(0, row)
        next_frame = self._frames.index_select(0, next_row)
        num_rotations = 1 + len(self._joints.turned)
        num_lerped = 3 * (1 + self._num_keys) + len(self._joints.angles)
        sizes = [num_lerped, 4 * num_rotations, 3, 3, self.skeleton.num_dofs]
        lerped, turns, root_vel, root_ang_vel, dof_vel = frame.split(sizes, dim=-1)
        next_lerped, next_turns = next_frame.split(sizes, dim=-1)[:2]

        lerped = torch.lerp(lerped, next_lerped, blend.unsqueeze(-1))
        positions = lerped[:, : 3 * (1 + self._num_keys)].unflatten(-1, (-1, 3))
        turns = turns.unflatten(-1, (num_rotations, 4))
        next_turns = next_turns.unflatten(-1, (num_rotations, 4))
        turns = rotations.slerp(turns, next_turns, blend.view(-1, 1, 1))
        joint_vectors = rotations.quat_to_exp_map(turns[:, 1:]).flatten(1)
        if self._joints.angles:
            angles = lerped[:, 3 * (1 + self._num_keys) :]
            joint_vectors = torch.cat((joint_vectors, angles), dim=-1)
        return MotionState(
            root_pos=positions[:, 0],
            root_rot=turns[:, 0],
            dof_pos=joint_vectors.index_select(1, self._dof_columns),
            root_vel=root_vel,
            root_ang_vel=root_ang_vel,
            dof_vel=dof_vel,
            key_pos=positions[:, 1:],
        )

    def get_body_pos(self, motion_ids: _Ids, motion_times: _Times) -> Tensor:
        """Return the world positions (n, J, 3) m of all bodies, interpolated as the root's."""
        row, next_row, blend = self._rows(motion_ids, motion_times)
        return torch.lerp(self._body_pos[row], self._body_pos[next_row], blend.view(-1, 1, 1))

    def _rows(self, motion_ids: _Ids, motion_times: _Times) -> tuple[Tensor, Tensor, Tensor]:
        """Return the rows (n,) of the frames before and after the times, and blend factors (n,)."""
        ids = torch.as_tensor(motion_ids, dtype=torch.long, device=self.device)
        times = torch.as_tensor(motion_times, dtype=torch.float64, device=self.device)
        start, last, length, dt = self._motions.index_select(0, ids).unbind(-1)
        first = torch.floor((times / length).clamp(0.0, 1.0) * last * _TIME_ROUNDING)
        blend = (times - first * dt) / dt
        row = start + first
        next_row = start + torch.minimum(first + 1.0, last)
        return row.long(), next_row.long(), blend.float()

    def _build_motion_table(self, weights: Sequence[float]) -> None:
        """Make the per-clip tensors: first row, last frame, length, frame time; sampling."""
        cumulative = np.cumsum(np.asarray(weights, dtype=np.float64))
        self._cumulative_weights = torch.from_numpy(cumulative / cumulative[-1]).to(self.device)
        num_frames = np.array([clip.num_frames for clip in self._clips])
        first_rows = np.cumsum(num_frames) - num_frames
        lengths_s = [clip.length_s for clip in self._clips]
        frame_times_s = [1.0 / clip.fps for clip in self._clips]
        table = np.stack((first_rows, num_frames - 1, lengths_s, frame_times_s), axis=-1)
        self._motions = torch.from_numpy(table).to(self.device)
        self._lengths_s = self._motions[:, 2].float()

    def _build_frame_tables(self, key_ids: list[int]) -> None:
        """Make the per-frame tensors; a row of `_frames` holds the parts of a state."""
        frames, body_pos = [], []
        for clip in self._clips:
            positions, _ = clip.global_poses()
            body_pos.append(positions)
            frames.append(_frame_rows(clip, self._joints, positions[:, [0, *key_ids]]))
        self._frames = torch.from_numpy(np.concatenate(frames)).float().to(self.device)
        self._body_pos = torch.from_numpy(np.concatenate(body_pos)).float().to(self.device)


class _JointColumns:
    """How rows of frames hold joints: some groups as rotations, the others by their angles.

    Args:
        skeleton: its joint groups.
        with_angles: keep hinges by their angles; else as rotations about y.

    Attributes:
        skeleton: see above.
        turned: groups that are kept as rotations.
        angles: DOFs that are kept as angles.
        columns: (num_dofs,) where the DOFs are among the three components of the vectors of
            `turned`, followed by `angles`.
    """

    def __init__(self, skeleton: Skeleton, with_angles: bool) -> None:
        self.skeleton = skeleton
        self.turned: list[int] = []
        self.angles: list[int] = []
        starts = [0] * skeleton.num_dofs
        for group, (start, end) in enumerate(itertools.pairwise(skeleton.dof_offsets)):
            if with_angles and end - start == 1:
                starts[start] = len(self.angles)
                self.angles.append(start)
                continue
            # Hinges kept as rotations are about y: the second of the three.
            components = range(3) if end - start == 3 else (1,)
            starts[start:end] = [3 * len(self.turned) + i for i in components]
            self.turned.append(group)
        shift = 3 * len(self.turned)
        self.columns = [
            shift + place if dof in self.angles else place for dof, place in enumerate(starts)
        ]
        self.with_angles = with_angles

    def of_clip(self, clip: MotionClip) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rotations (T, R, 4), angles (T, H) rad and DOF velocities (T, D) rad/s."""
        if not self.with_angles:
            turns = clip.local_rotation[:, list(self.skeleton.dof_body_ids)]
            dofs = np.zeros((clip.num_frames, self.skeleton.num_dofs))
        else:
            dofs = dofs_of_clip(self.skeleton, clip)
            turns = joint_rotations(self.skeleton, dofs).numpy()[:, self.turned]
        angles = dofs[:, self.angles]
        if clip.dof_pos is None:
            angles = np.unwrap(angles, axis=0)
        rates = np.diff(angles, axis=0) * clip.fps
        velocity = kinematics.joint_velocities(turns, clip.fps).reshape(clip.num_frames, -1)
        velocity = np.concatenate((velocity, np.concatenate((rates, rates[-1:]))), axis=1)
        return turns, angles, velocity[:, self.columns]


def _frame_rows(clip: MotionClip, joints: _JointColumns, positions: FloatArray) -> FloatArray:
    """Return the frames (T, D): positions, angles of joints, rotations, velocities.

    `positions` (T, 1 + K, 3) m belong to the root and the key bodies. The rotations are the root's
    and the joints', the velocities the root's and the DOFs'.
    """
    turns, angles, joint_velocity = joints.of_clip(clip)
    parts = (
        positions,
        angles,
        clip.local_rotation[:, :1],
        turns,
        clip.linear_velocity_w[:, 0],
        clip.angular_velocity_w[:, 0],
        joint_velocity,
    )
    return np.concatenate([part.reshape(clip.num_frames, -1) for part in parts], axis=-1)


def _without_copies(clip: MotionClip, repair: bool) -> MotionClip:
    """Drop frames that are stored twice, or log a warning."""
    if clip.find_repeated_frames() is None:
        return clip
    if not repair:
        _log.warning(
            "%s: every frame is stored twice (%g Hz data at %g Hz): joint velocities alternate "
            "between 0 and twice the true speed; repair_repeated_frames=True "
            "(task.env.repairRepeatedFrames) drops the copies",
            clip.name,
            clip.fps / 2.0,
            clip.fps,
        )
        return clip
    repaired = clip.drop_repeated_frames()
    _log.info(
        "%s: every frame was stored twice: dropped the copies, %d frames at %g Hz remain",
        clip.name,
        repaired.num_frames,
        repaired.fps,
    )
    return repaired
