"""Stores the positions of a character's bodies in an episode or a clip."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from isaacgymenvs_lite.motion.motion_lib import MotionLib


@dataclass(frozen=True, eq=False)
class Track:
    """T control steps of a character, float32 on the CPU.

    Attributes:
        body_pos_w: (T, J, 3) m in the world, z up; body 0 is the root.
        root_rot_w: (T, 4) xyzw.
    """

    body_pos_w: Tensor
    root_rot_w: Tensor

    def __len__(self) -> int:
        """Return T."""
        return len(self.body_pos_w)


def tracks_of_clips(motion_lib: MotionLib, dt_s: float) -> list[Track]:
    """Sample every clip of a motion library at the times 0, dt_s, 2 dt_s, ... before its end.

    The tracks lack the pose at the end, because the last pose of a cyclic clip equals its first
    pose.
    """
    tracks = []
    for motion_id in range(motion_lib.num_motions()):
        length_s = float(motion_lib.get_motion_length([motion_id]))
        # If the length is a whole number of steps, it may have a rounding error.
        num_frames = max(1, math.ceil(length_s / dt_s - 1e-4))
        ids = torch.full((num_frames,), motion_id)
        times_s = torch.arange(num_frames, dtype=torch.float64) * dt_s
        root_rot_w = motion_lib.get_motion_state(ids, times_s).root_rot
        tracks.append(Track(motion_lib.get_body_pos(ids, times_s).cpu(), root_rot_w.cpu()))
    return tracks
