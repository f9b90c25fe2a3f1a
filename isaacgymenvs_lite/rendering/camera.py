"""Pictures of a task's environments as they are now."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from isaacgymenvs_lite.rendering.scene import Image, SceneRenderer
from isaacgymenvs_lite.rendering.tracks import PoseRecorder
from isaacgymenvs_lite.rendering.view import View


class TaskCamera:
    """Draws environments of a task; the machine's OpenGL is touched by the first picture.

    Args:
        task: a task (`VecTask`).
        width: of a picture, pixels.
        height: pixels.
    """

    def __init__(self, task: Any, width: int = 320, height: int = 240) -> None:
        self._task = task
        self._size = (width, height)
        self._renderer: SceneRenderer | None = None

    def draw(self, env_ids: Sequence[int]) -> list[Image]:
        """Return a picture (height, width, 3) of each of the environments.

        Raises:
            RenderingError: this machine cannot draw.
        """
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
        """Free the renderer; a second call does nothing."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
