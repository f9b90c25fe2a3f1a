"""Shows the reference motion of an imitation task as a track or as a translucent robot.

(track,) = recorder.tracks()                    # `recorder` is a `PoseRecorder`
reference = reference_track(env, track)         # the clip with the phase of `track`
"""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.rendering.markers import RobotOverlay
from isaacgymenvs_lite.rendering.scene import Track
from isaacgymenvs_lite.rendering.tracks import TrackMaker

Pose = npt.NDArray[np.float64]

# Number of control steps that identify the phase of a motion. A single pose may occur twice in a
# clip, for example in an upward and in a downward motion.
_PHASE_STEPS = 6
# Horizontal offset (m) of the reference from the character in the world frame. Seen from the right
# of a character that walks along x, the reference stands behind the character.
_OFFSET_M = (0.0, 1.0)


def reference_track(env: Any, like: Track) -> Track:
    """Return the reference clip of a task, with the length and phase of the track `like` (T, nq).

    The clip and the phase are those whose joint positions are nearest to the first steps of `like`.
    The clip repeats; a repetition starts where the root was at the end of the previous repetition.
    """
    clips = ReferenceClips(env)
    motion_id, first = clips.phase(like)
    return clips.track(motion_id, range(first, first + len(like)))


class ReferenceClips:
    """Finds phases in the reference clips of a task, and returns the clips as tracks."""

    def __init__(self, env: Any) -> None:
        self._motion_lib: MotionLib = env.motion_lib
        self._dt_s = float(env.dt)
        self._maker = TrackMaker(env.simulation.model)
        # Joint positions of each clip at every control step.
        self._joints: list[Track] = []
        for motion_id in range(env.motion_lib.num_motions()):
            length_s = float(self._motion_lib.get_motion_length([motion_id]))
            frames = range(max(1, math.ceil(length_s / self._dt_s)))
            self._joints.append(self.track(motion_id, frames)[:, self._maker.root_size :])

    def phase(self, like: Track) -> tuple[int, int]:
        """Return the clip and the control step that best match the first steps of `like`."""
        start = like[:_PHASE_STEPS, self._maker.root_size :]
        best = (math.inf, 0, 0)
        for motion_id, joints in enumerate(self._joints):
            windows = np.stack([np.roll(joints, -step, axis=0) for step in range(len(start))])
            distances = np.linalg.norm(windows - start[:, None], axis=-1).sum(axis=0)
            frame = int(distances.argmin())
            best = min(best, (float(distances[frame]), motion_id, frame))
        return best[1:]

    def track(self, motion_id: int, steps: range) -> Track:
        """Return the poses of a repeated clip at the given control steps."""
        length_s = float(self._motion_lib.get_motion_length([motion_id]))
        times_s = self._dt_s * torch.tensor(steps, dtype=torch.float64)
        # The last two times are the start and the end of the clip. From one repetition to the next
        # the root is displaced by the difference of its positions at these two times.
        in_clip_s = torch.cat((times_s % length_s, torch.tensor([0.0, length_s])))
        motion_ids = torch.full((len(in_clip_s),), motion_id)
        state = self._motion_lib.get_motion_state(motion_ids, in_clip_s)
        displacement_m = (state.root_pos[-1] - state.root_pos[-2]).cpu()
        displacement_m[2] = 0.0  # The height must not accumulate over repetitions.
        repetitions = torch.floor(times_s / length_s).unsqueeze(-1)
        root_pos = state.root_pos[:-2].cpu() + repetitions * displacement_m
        roots = torch.cat((root_pos, state.root_rot[:-2].cpu()), dim=-1)
        return self._maker.track(roots, state.dof_pos[:-2])


class ReferenceOverlay:
    """Adds the reference of environment 0 to a scene, as a robot next to the character."""

    def __init__(self, env: Any, model: mujoco.MjModel) -> None:
        self._env = env
        self._clips = ReferenceClips(env)
        self._robot = RobotOverlay(model)
        self._first_poses: list[Pose] = []
        self._last_step = 0
        self._steps = 0
        self._phase = (0, 0)

    @classmethod
    def for_task(cls, env: Any, model: mujoco.MjModel) -> ReferenceOverlay | None:
        """Return the overlay of a task, or None if the task has no reference motions."""
        return cls(env, model) if hasattr(env, "motion_lib") else None

    def add_to(self, scene: mujoco.MjvScene, qpos: Pose) -> None:
        """Add the reference to a scene, next to a character in the pose `qpos` (nq,)."""
        self._robot.add_to(scene, self.pose(qpos))

    def pose(self, qpos: Pose) -> Pose:
        """Return the reference's pose (nq,) next to a character in the pose `qpos`.

        Call this method at most once per control step.
        """
        step = int(self._env.progress_buf[0])
        passed = step - self._last_step
        if passed < 0 or not self._first_poses:  # A new episode has started.
            self._first_poses.clear()
            self._steps = passed = 0
        self._last_step = step
        self._steps += passed
        # The stored poses are consecutive only if this method was called in every control step.
        if self._steps == len(self._first_poses) < _PHASE_STEPS:
            self._first_poses.append(qpos)
            self._phase = self._clips.phase(np.stack(self._first_poses))
        motion_id, first = self._phase
        now = first + self._steps
        pose = self._clips.track(motion_id, range(now, now + 1))[0]
        pose[:2] = qpos[:2] + _OFFSET_M
        return pose
