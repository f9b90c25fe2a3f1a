"""Computes states of clips between frames, by splines or by the interpolation of AMP and ASE.

The tensors hold the frames of all clips, one after the other. Quaternions are xyzw.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from isaacgymenvs_lite.motion import kinematics
from isaacgymenvs_lite.motion.clip import MotionClip
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.qpos import BodyPoses, dofs_of_clip, joint_rotations
from isaacgymenvs_lite.motion.skeleton import Skeleton
from isaacgymenvs_lite.utils import rotations


class MotionState(NamedTuple):
    """States of n samples with K key bodies, in float32 on the library's device."""

    root_pos: Tensor  # (n, 3) m, world
    root_rot: Tensor  # (n, 4), world
    dof_pos: Tensor  # (n, num_dofs) rad, rotation vectors of ball joints and angles of hinges
    root_vel: Tensor  # (n, 3) m/s, world
    root_ang_vel: Tensor  # (n, 3) rad/s, world
    # (n, num_dofs) rad/s, rates of hinge angles, and angular velocities of ball joints in the
    # child's frame
    dof_vel: Tensor
    key_pos: Tensor  # (n, K, 3) m, world


class Moments(NamedTuple):
    """Times (n,) in clips, each of which lies between two frames."""

    row: Tensor  # row of the last frame before the time, among the frames of all clips
    next_row: Tensor  # row of the first frame after the time, or `row` at the end of a clip
    blend: Tensor  # time since the frame `row`, in frames; negative before the start of a clip
    frame_s: Tensor  # time (s) from a frame to the next frame


class Frames:
    """The frames of all clips on a device. Subclasses interpolate between these frames.

    A joint is stored either as a rotation or as an angle; angles may exceed pi. The bodies of the
    clips are in the skeleton's order. `key_ids` are the ids of the K key bodies.
    """

    def __init__(
        self, skeleton: Skeleton, key_ids: Sequence[int], device: torch.device, with_angles: bool
    ) -> None:
        self._skeleton, self._device = skeleton, device
        self._key_ids = torch.tensor(list(key_ids), dtype=torch.long, device=device)
        self._with_angles = with_angles
        self._turned: list[int] = []  # joints stored as rotations
        self._hinges: list[int] = []  # joints stored as angles
        self._angles: list[int] = []  # DOFs of the joints stored as angles
        places = [0] * skeleton.num_dofs
        for group, (start, end) in enumerate(itertools.pairwise(skeleton.dof_offsets)):
            if self._with_angles and end - start == 1:
                places[start] = len(self._angles)
                self._hinges.append(group)
                self._angles.append(start)
                continue
            # Hinges that are stored as rotations have the axis y, the second component.
            components = range(3) if end - start == 3 else (1,)
            places[start:end] = [3 * len(self._turned) + i for i in components]
            self._turned.append(group)
        shift = 3 * len(self._turned)
        # Column of each DOF in an array of all rotation vectors followed by all angles.
        self._columns = [
            shift + place if dof in self._angles else place for dof, place in enumerate(places)
        ]
        self._dof_columns = torch.tensor(self._columns, device=device)

    def _joint_poses(self, clip: MotionClip) -> tuple[FloatArray, FloatArray]:
        """Return the angles (T, H) rad and the rotations (T, R, 4) xyzw of a clip's joints."""
        if not self._with_angles:
            turns = clip.local_rotation[:, list(self._skeleton.dof_body_ids)]
            return np.zeros((clip.num_frames, 0)), turns
        dofs = dofs_of_clip(self._skeleton, clip)
        turns = joint_rotations(self._skeleton, dofs).numpy()[:, self._turned]
        angles = dofs[:, self._angles]
        # Angles that come from rotations are within pi and may jump.
        return (np.unwrap(angles, axis=0) if clip.dof_pos is None else angles), turns

    def _tensor(self, rows: Sequence[FloatArray]) -> Tensor:
        return torch.from_numpy(np.concatenate(rows)).float().to(self._device)


class PoseSplines(Frames):
    """Cubic splines through the poses. The derivatives of the splines are the velocities.

    The splines interpolate the root position, the hinge angles, and the quaternions of the root and
    the ball joints. The quaternions are then normalised. The splines' end condition is
    "not-a-knot", which does not prescribe a velocity. Forward kinematics of the robot's model
    places the bodies. Before the start of a clip, the pose is extrapolated with the first velocity.
    After the end of a clip, the last state is kept.
    """

    def __init__(
        self,
        clips: Sequence[MotionClip],
        skeleton: Skeleton,
        key_ids: Sequence[int],
        device: torch.device,
    ) -> None:
        super().__init__(skeleton, key_ids, device, with_angles=True)
        self._bodies = BodyPoses(skeleton)
        # (frames, 2, columns), values and the derivatives of the values per frame.
        self._rows = self._tensor([self._rows_of(clip) for clip in clips])

    def _rows_of(self, clip: MotionClip) -> FloatArray:
        """Return root position, hinge angles and quaternions with derivatives, (T, 2, columns)."""
        from scipy.interpolate import CubicSpline  # Only tasks with clips need scipy.

        angles, turns = self._joint_poses(clip)
        turns = np.concatenate((clip.local_rotation[:, :1], turns), axis=1).astype(np.float64)
        # A quaternion and its negative are the same rotation, but a spline needs continuous signs.
        is_other_side = (turns[1:] * turns[:-1]).sum(axis=-1) < 0.0
        turns[1:] *= np.where(np.cumsum(is_other_side, axis=0) % 2 == 1, -1.0, 1.0)[..., None]
        parts = (clip.root_translation, angles, turns.reshape(clip.num_frames, -1))
        values = np.concatenate(parts, axis=1).astype(np.float64)
        slopes = CubicSpline(np.arange(clip.num_frames), values)(np.arange(clip.num_frames), 1)
        return np.stack((values, slopes), axis=1)

    def states(self, at: Moments) -> MotionState:
        """Return the states at n times in clips."""
        values, rates = self._on_splines(at)
        num_angles = len(self._angles)
        root_pos, angles, turns = values.split([3, num_angles, values.shape[1] - 3 - num_angles], 1)
        root_vel, angle_rates, turn_rates = rates.split([3, num_angles, turns.shape[1]], dim=1)
        turns, turn_rates = turns.unflatten(1, (-1, 4)), turn_rates.unflatten(1, (-1, 4))
        length = turns.norm(dim=-1, keepdim=True)
        turns, turn_rates = turns / length, turn_rates / length
        # dq/dt is 1/2 w q for the angular velocity w in the world frame, 1/2 q w in the body frame.
        inverse = rotations.quat_conjugate(turns)
        root_ang_vel = 2.0 * rotations.quat_mul(turn_rates[:, 0], inverse[:, 0])[:, :3]
        joint_rates = 2.0 * rotations.quat_mul(inverse[:, 1:], turn_rates[:, 1:])[..., :3]
        joint_vectors = rotations.quat_to_exp_map(turns[:, 1:])
        dof_pos = torch.cat((joint_vectors.flatten(1), angles), dim=1)
        dof_vel = torch.cat((joint_rates.flatten(1), angle_rates), dim=1)
        return MotionState(
            root_pos=root_pos,
            root_rot=turns[:, 0],
            dof_pos=dof_pos.index_select(1, self._dof_columns),
            root_vel=root_vel,
            root_ang_vel=root_ang_vel,
            dof_vel=dof_vel.index_select(1, self._dof_columns),
            key_pos=self._place_bodies(values).index_select(1, self._key_ids),
        )

    def body_pos(self, at: Moments) -> Tensor:
        """Return the world positions (n, J, 3) m of all bodies at n times in clips."""
        return self._place_bodies(self._on_splines(at)[0])

    def _on_splines(self, at: Moments) -> tuple[Tensor, Tensor]:
        """Return the splines' values (n, columns) and the derivatives of the values per second."""
        before, slope = self._rows.index_select(0, at.row).unbind(1)
        after, next_slope = self._rows.index_select(0, at.next_row).unbind(1)
        # At the end of a clip there is no next frame.
        blend = torch.where(at.next_row == at.row, 0.0, at.blend).unsqueeze(1)
        s = blend.clamp(0.0, 1.0)
        # Hermite's form of the cubic between two frames, and its derivative.
        change = after - before
        bend = slope + next_slope - 2.0 * change
        turn = 3.0 * change - 2.0 * slope - next_slope
        values = before + s * (slope + s * (turn + s * bend)) + (blend - s) * slope
        rates = slope + s * (2.0 * turn + 3.0 * s * bend)
        return values, rates / at.frame_s.unsqueeze(1)

    def _place_bodies(self, values: Tensor) -> Tensor:
        """Return the positions (n, J, 3) m of all bodies by forward kinematics."""
        n, first_turn = len(values), 3 + len(self._angles)
        values = values.cpu()
        rows = values.numpy()
        turns = rotations.wxyz_from_xyzw(values[:, first_turn:].reshape(n, -1, 4)).numpy()
        addresses = self._skeleton.qpos_addresses
        qpos = np.empty((n, addresses[-1]), dtype=np.float32)
        qpos[:, :3], qpos[:, 3:7] = rows[:, :3], turns[:, 0]
        for place, group in enumerate(self._turned, start=1):
            qpos[:, addresses[group] : addresses[group + 1]] = turns[:, place]
        qpos[:, [addresses[group] for group in self._hinges]] = rows[:, 3:first_turn]
        positions, _ = self._bodies.at(qpos)
        return torch.from_numpy(positions).permute(2, 1, 0).to(self._device)


class PublishedFrames(Frames):
    """The interpolation of the AMP and ASE motion libraries.

    World positions are interpolated linearly, and rotations by slerp. Before the start of a clip,
    positions and rotations are extrapolated from the first two frames. Velocities are not
    interpolated; they are the velocities of the last frame before the time. The velocities of the
    root are stored in the clip, and joint velocities are differences to the next frame.

    As in AMP and ASE, ball joints and hinges of the shipped humanoids are stored as rotations.
    Hinges of other skeletons, or of clips with `dof_pos`, are stored as angles.
    """

    def __init__(
        self,
        clips: Sequence[MotionClip],
        skeleton: Skeleton,
        key_ids: Sequence[int],
        device: torch.device,
    ) -> None:
        has_dofs = any(clip.dof_pos is not None for clip in clips)
        with_angles = has_dofs or not skeleton.has_simple_joints
        super().__init__(skeleton, key_ids, device, with_angles)
        self._num_positions = 1 + len(key_ids)
        frames, body_pos = [], []
        for clip in clips:
            positions, _ = clip.global_poses()
            body_pos.append(positions)
            frames.append(self._rows_of(clip, positions[:, [0, *key_ids]]))
        self._rows, self._body_pos = self._tensor(frames), self._tensor(body_pos)

    def _rows_of(self, clip: MotionClip, positions: FloatArray) -> FloatArray:
        """Return the frames (T, columns): positions, hinge angles, rotations, velocities.

        `positions` (T, 1 + K, 3) m belong to the root and the key bodies. Rotations and velocities
        of the root precede the values of the joints.
        """
        angles, turns = self._joint_poses(clip)
        rates = np.diff(angles, axis=0) * clip.fps
        turning = kinematics.joint_velocities(turns, clip.fps).reshape(clip.num_frames, -1)
        dof_vel = np.concatenate((turning, np.concatenate((rates, rates[-1:]))), axis=1)
        parts = (
            positions,
            angles,
            clip.local_rotation[:, :1],
            turns,
            clip.linear_velocity_w[:, 0],
            clip.angular_velocity_w[:, 0],
            dof_vel[:, self._columns],
        )
        return np.concatenate([part.reshape(clip.num_frames, -1) for part in parts], axis=-1)

    def states(self, at: Moments) -> MotionState:
        """Return the states at n times in clips."""
        frame = self._rows.index_select(0, at.row)
        next_frame = self._rows.index_select(0, at.next_row)
        num_rotations = 1 + len(self._turned)
        num_lerped = 3 * self._num_positions + len(self._angles)
        sizes = [num_lerped, 4 * num_rotations, 3, 3, len(self._columns)]
        lerped, turns, root_vel, root_ang_vel, dof_vel = frame.split(sizes, dim=-1)
        next_lerped, next_turns = next_frame.split(sizes, dim=-1)[:2]

        lerped = torch.lerp(lerped, next_lerped, at.blend.unsqueeze(-1))
        positions = lerped[:, : 3 * self._num_positions].unflatten(-1, (-1, 3))
        turns = turns.unflatten(-1, (num_rotations, 4))
        next_turns = next_turns.unflatten(-1, (num_rotations, 4))
        turns = rotations.slerp(turns, next_turns, at.blend.view(-1, 1, 1))
        joint_vectors = rotations.quat_to_exp_map(turns[:, 1:]).flatten(1)
        if self._angles:
            angles = lerped[:, 3 * self._num_positions :]
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

    def body_pos(self, at: Moments) -> Tensor:
        """Return the world positions (n, J, 3) m of all bodies at n times in clips."""
        before, after = self._body_pos[at.row], self._body_pos[at.next_row]
        return torch.lerp(before, after, at.blend.view(-1, 1, 1))


FRAMES: dict[str, type[PoseSplines | PublishedFrames]] = {
    "spline": PoseSplines,
    "published": PublishedFrames,
}
"""Maps each value of `task.env.clipInterpolation` to its class."""
INTERPOLATIONS = tuple(FRAMES)
