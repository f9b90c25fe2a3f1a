"""The pictures that environments of other libraries return from `render`."""

from __future__ import annotations

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.rendering.scene import Image
from isaacgymenvs_lite.rendering.tracks import TaskCamera
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask

RENDER_MODE = "rgb_array"


class AdapterCamera:
    """Draws every environment of a task for an adapter.

    Args:
        task: the task.
        render_mode: `rgb_array`, or None for no pictures.
        width: of a picture, pixels.
        height: pixels.

    Attributes:
        render_mode: as given.

    Raises:
        ConfigError: another render mode.
    """

    def __init__(
        self, task: VecTask, render_mode: str | None, width: int = 320, height: int = 240
    ) -> None:
        if render_mode not in (None, RENDER_MODE):
            raise ConfigError(unknown("render_mode", render_mode, [RENDER_MODE, "None"]))
        self.render_mode = render_mode
        self._env_ids = range(task.num_envs)
        self._camera = TaskCamera(task, width, height)

    def draw(self) -> list[Image]:
        """Return a picture (height, width, 3) of each environment.

        Raises:
            RenderingError: this machine cannot draw.
        """
        return self._camera.draw(self._env_ids)

    def render(self) -> list[Image] | None:
        """Return what `draw` returns; None without a render mode."""
        return self.draw() if self.render_mode else None

    def close(self) -> None:
        """Free the renderer; a second call does nothing."""
        self._camera.close()


class ShowsFirst:
    """An environment that shows environment 0 of its task.

    Attributes:
        stepper: steps the task.
    """

    stepper: AutoresetTask
    _camera: AdapterCamera

    def render(self) -> Image | None:
        """Return a picture (height, width, 3) of environment 0; None without a render mode.

        Raises:
            RenderingError: this machine cannot draw.
        """
        pictures = self._camera.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Free renderer and simulation; a second call does nothing."""
        self._camera.close()
        self.stepper.close()
