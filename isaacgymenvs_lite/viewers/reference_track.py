"""The reference clip of a task as a track: what a figure that imitates is compared with.

(track,) = recorder.tracks()                    # of a `PoseRecorder`
reference = reference_track(env, track)         # the clip, from the same phase on
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.rendering.scene import Track
from isaacgymenvs_lite.rendering.tracks import TrackMaker

# Steps that identify the phase of a motion: one pose may occur twice, going up and going down.
_PHASE_STEPS = 6


class ReferenceClips:
    """The reference clips of a task as tracks.

    Args:
        env: a task with a motion library.
    """

    def __init__(self, env: Any) -> None:
        self._motion_lib: MotionLib = env.motion_lib
        self._dt_s = float(env.dt)
        self._maker = TrackMaker(env.simulation.model)
        self._joints = [self._joints_of(i) for i in range(env.motion_lib.num_motions())]

    def _joints_of(self, motion_id: int) -> Track:
        """Return what is not the root's of a clip's poses, one for each control step."""
        length_s = float(self._motion_lib.get_motion_length([motion_id]))
        frames = range(max(1, math.ceil(length_s / self._dt_s)))
        return self.track(motion_id, frames)[:, self._maker.root_size :]

    def phase(self, like: Track) -> tuple[int, int]:
        """Return the clip, and the control step in it, nearest to the first moments of `like`."""
        beginning = like[:_PHASE_STEPS, self._maker.root_size :]
        best = (math.inf, 0, 0)
        for motion_id, joints in enumerate(self._joints):
            windows = np.stack([np.roll(joints, -step, axis=0) for step in range(len(beginning))])
            distances = np.linalg.norm(windows - beginning[:, None], axis=-1).sum(axis=0)
            frame = int(distances.argmin())
            best = min(best, (float(distances[frame]), motion_id, frame))
        return best[1:]

    def track(self, motion_id: int, steps: range) -> Track:
        """Return a clip's poses at control steps; it goes on from where it ends."""
        return _clip_track(self._motion_lib, self._maker, motion_id, self._dt_s, steps)


def reference_track(env: Any, like: Track) -> Track:
    """Return the reference clip of a task, as long as `like` and beginning in the same phase.

    The phase, and of several clips the clip, is the one whose joints are nearest to the first
    moments of `like`. A clip that ends goes on from its start, at the place where its root has
    come to.

    Args:
        env: a task with a motion library.
        like: (T, nq), a track of the task.
    """
    clips = ReferenceClips(env)
    motion_id, first = clips.phase(like)
    return clips.track(motion_id, range(first, first + len(like)))


def _clip_track(
    motion_lib: MotionLib, maker: TrackMaker, motion_id: int, dt_s: float, steps: range
) -> Track:
    """Return the clip's poses at the times `steps` * dt_s, repeated beyond its length."""
    length_s = float(motion_lib.get_motion_length([motion_id]))
    times_s = dt_s * torch.tensor(steps, dtype=torch.float64)
    # The last two times are the clip's start and end: the way that a repetition goes on from.
    in_clip_s = torch.cat((times_s % length_s, torch.tensor([0.0, length_s])))
    state = motion_lib.get_motion_state(torch.full((len(in_clip_s),), motion_id), in_clip_s)
    way_m = (state.root_pos[-1] - state.root_pos[-2]).cpu()
    way_m[2] = 0.0  # a clip that ends higher than it began does not climb
    repetitions = torch.floor(times_s / length_s).unsqueeze(-1)
    root_pos = state.root_pos[:-2].cpu() + repetitions * way_m
    roots = torch.cat((root_pos, state.root_rot[:-2].cpu()), dim=-1)
    return maker.track(roots, state.dof_pos[:-2])
