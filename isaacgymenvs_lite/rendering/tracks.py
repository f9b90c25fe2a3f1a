"""Records motion as tracks (MuJoCo's qpos over time), and draws pictures of the current state.

    recorder = PoseRecorder(env, num_steps=150)
    ...                                             # recorder.step() after each env.step
    (track,) = recorder.tracks()

Recording copies a few values per step and does not slow down a training or a measurement; `video`
draws tracks later.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from isaacgymenvs_lite.rendering.markers import Marker
from isaacgymenvs_lite.rendering.scene import Image, SceneRenderer, Track
from isaacgymenvs_lite.rendering.view import View
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.simulation.state_buffers import StateConverter

_ROOT = 7  # a free joint has a position and a quaternion


class TrackMaker:
    """Makes tracks from states in the layout of `SimulationBackend`."""

    def __init__(self, model: mujoco.MjModel) -> None:
        layout = ModelLayout.from_model(model)
        self._converter = StateConverter(model, layout)
        self.root_size = _ROOT if layout.has_free_root else 0

    def track(
        self, root_states: Tensor, dof_pos: Tensor, object_states: Tensor | None = None
    ) -> Track:
        """Return the track of root states (T, 7 or more), DOFs (T, D), object states (T, K, 13).

        Objects without states keep the positions that the model file gives them.
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
    """Records the motion of some environments of a task, up to `num_steps` control steps."""

    def __init__(self, env: Any, num_steps: int, env_ids: Sequence[int] = (0,)) -> None:
        self._simulation = env.simulation
        self._maker = TrackMaker(env.simulation.model)
        self._num_steps = num_steps
        self._ids = torch.tensor(env_ids, device=env.simulation.device)
        self._markers_of = markers_of(env)
        self._markers: list[tuple[tuple[Marker, ...], ...]] = []
        self._states: list[tuple[Tensor, Tensor, Tensor]] = []

    def step(self) -> None:
        """Record the current state; call this method after `env.step` and before resets."""
        if len(self._states) < self._num_steps:
            simulation = self._simulation
            state = (simulation.root_states, simulation.dof_pos, simulation.object_states)
            root_states, dof_pos, objects = (of_all.index_select(0, self._ids) for of_all in state)
            self._states.append((root_states, dof_pos, objects))
            self._markers.append(tuple(self._markers_of(env_id) for env_id in self._ids.tolist()))

    def tracks(self) -> list[Track]:
        """Return a track for each environment, or [] if no step has been recorded."""
        if not self._states:
            return []
        columns = [torch.stack(column, dim=1) for column in zip(*self._states, strict=True)]
        return [self._maker.track(*states) for states in zip(*columns, strict=True)]

    def markers(self) -> list[tuple[tuple[Marker, ...], ...]]:
        """Return the markers of each environment at each recorded step."""
        return list(self._markers)


def markers_of(env: Any) -> Callable[[int], tuple[Marker, ...]]:
    """Return a function from the index of an environment to its markers."""
    return getattr(env, "markers", lambda env_id: ())


class PoseReader:
    """Reads the current pose of environments of a task (`VecTask`)."""

    def __init__(self, env: Any) -> None:
        self._simulation = env.simulation
        self._maker = TrackMaker(env.simulation.model)

    def __call__(self, env_id: int) -> npt.NDArray[np.float64]:
        """Return qpos (nq,) of an environment, which includes the objects."""
        simulation = self._simulation
        states = (simulation.root_states, simulation.dof_pos, simulation.object_states)
        return self._maker.track(*(of_all[env_id : env_id + 1] for of_all in states))[0]


class TaskCamera:
    """Draws the current state of a task's environments; OpenGL is loaded at the first picture."""

    def __init__(self, task: Any, width: int = 320, height: int = 240) -> None:
        self._task = task
        self._size = (width, height)
        self._renderer: SceneRenderer | None = None

    def draw(self, env_ids: Sequence[int]) -> list[Image]:
        """Return a picture (height, width, 3) for each of the given environments."""
        if self._renderer is None:
            model = self._task.simulation.model
            view = View.of_model(model)
            self._renderer = SceneRenderer(model, *self._size, view=view, fast=True)
        recorder = PoseRecorder(self._task, num_steps=1, env_ids=env_ids)
        recorder.step()
        (markers,) = recorder.markers()
        tracks = zip(recorder.tracks(), markers, strict=True)
        return [self._renderer.draw(track[0], markers=beside) for track, beside in tracks]

    def close(self) -> None:
        """Release the renderer; a second call does nothing."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
