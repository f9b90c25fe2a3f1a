"""Tracks: what a figure did, as MuJoCo joint positions over time, to be drawn.

    recorder = PoseRecorder(env, num_steps=150)
    ...                                             # recorder.step() after each env.step
    (track,) = recorder.tracks()
    reference = reference_track(env, track)         # the clip, from the same phase on

Recording copies a few numbers per step, so that a training or a measurement is not slowed down by
the drawing; see `video` for that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from isaacgymenvs_lite.marks import Mark
from isaacgymenvs_lite.motion.motion_lib import MotionLib
from isaacgymenvs_lite.rendering.scene import Track
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.simulation.state_planes import StateConverter

_ROOT = 7  # numbers of a free joint: position, quaternion
# Steps that tell the phase of a motion: one pose may occur twice, going up and going down.
_PHASE_STEPS = 6


class _TrackMaker:
    """Makes tracks of states in the layout of `SimulationBackend`."""

    def __init__(self, model: mujoco.MjModel) -> None:
        layout = ModelLayout.from_model(model)
        self._converter = StateConverter(model, layout)
        self.root_size = _ROOT if layout.has_free_root else 0

    def track(
        self, root_states: Tensor, dof_pos: Tensor, object_states: Tensor | None = None
    ) -> Track:
        """Return the track of what was at T times.

        Args:
            root_states: (T, 7 or more).
            dof_pos: (T, D).
            object_states: (T, K, 13); None: the objects stay at their places in the model.
        """
        roots = torch.zeros(len(dof_pos), 13)
        roots[:, :_ROOT] = root_states[:, :_ROOT]
        dofs = dof_pos.cpu()
        qpos = self._converter.rows(roots, dofs, torch.zeros_like(dofs))[0]
        if object_states is not None and object_states.shape[1] > 0:
            qpos = np.array(qpos)
            objects = self._converter.object_rows(object_states.cpu())[0]
            qpos[:, -objects[0].size :] = objects.reshape(len(qpos), -1)
        return qpos


class PoseRecorder:
    """Keeps what some environments of a task do.

    Args:
        env: a task (`VecTask`).
        num_steps: control steps to keep; later ones are not.
        env_ids: which environments.
    """

    def __init__(self, env: Any, num_steps: int, env_ids: Sequence[int] = (0,)) -> None:
        self._simulation = env.simulation
        self._maker = _TrackMaker(env.simulation.model)
        self._num_steps = num_steps
        self._ids = torch.tensor(env_ids, device=env.simulation.device)
        self._marks_of = getattr(env, "marks", lambda env_id: ())
        self._marks: list[tuple[tuple[Mark, ...], ...]] = []
        self._states: list[tuple[Tensor, Tensor, Tensor]] = []

    def step(self) -> None:
        """Keep the present state; call it after `env.step`, before resets."""
        if len(self._states) < self._num_steps:
            simulation = self._simulation
            state = (simulation.root_states, simulation.dof_pos, simulation.object_states)
            root_states, dof_pos, objects = (of_all.index_select(0, self._ids) for of_all in state)
            self._states.append((root_states, dof_pos, objects))
            self._marks.append(tuple(self._marks_of(env_id) for env_id in self._ids.tolist()))

    def tracks(self) -> list[Track]:
        """Return one track for each environment, of the steps kept so far; [] before the first."""
        if not self._states:
            return []
        columns = [torch.stack(column, dim=1) for column in zip(*self._states, strict=True)]
        return [self._maker.track(*states) for states in zip(*columns, strict=True)]

    def marks(self) -> list[tuple[tuple[Mark, ...], ...]]:
        """Return what was to be seen beside the figures: for each step, for each environment."""
        return list(self._marks)


class PoseReader:
    """Reads the present pose of environments of a task.

    Args:
        env: a task (`VecTask`).
    """

    def __init__(self, env: Any) -> None:
        self._simulation = env.simulation
        self._maker = _TrackMaker(env.simulation.model)

    def __call__(self, env_id: int) -> npt.NDArray[np.float64]:
        """Return the joint positions (nq,) of an environment, those of objects included."""
        simulation = self._simulation
        states = (simulation.root_states, simulation.dof_pos, simulation.object_states)
        return self._maker.track(*(of_all[env_id : env_id + 1] for of_all in states))[0]


class ReferenceClips:
    """The reference clips of a task as tracks.

    Args:
        env: a task with a motion library.
    """

    def __init__(self, env: Any) -> None:
        self._motion_lib: MotionLib = env.motion_lib
        self._dt_s = float(env.dt)
        self._maker = _TrackMaker(env.simulation.model)
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
    motion_lib: MotionLib, maker: _TrackMaker, motion_id: int, dt_s: float, steps: range
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
