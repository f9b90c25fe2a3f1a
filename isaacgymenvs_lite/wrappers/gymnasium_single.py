"""A single environment for Gymnasium: a task with one environment, episodes on request."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.scene import Image
from isaacgymenvs_lite.utils.random_stream import RandomStream
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask
from isaacgymenvs_lite.wrappers.camera import RENDER_MODE, TaskCamera, checked_render_mode
from isaacgymenvs_lite.wrappers.gymnasium_vector import Floats, as_numpy, render_fps


class GymnasiumEnv(gymnasium.Env[Floats, Floats]):
    """One environment; `gymnasium.make("IsaacGymEnvsLite/<Task>-v0")` makes one.

    The step that ends an episode returns its last observation, and `reset` begins the next. `info`
    holds `states` (S,) for asymmetric critics, and what else the task tells, `amp_obs` for example.

    Args:
        task: a task with `num_envs=1`.
        render_mode: `rgb_array` or None.
        width: of a picture, pixels.
        height: pixels.
        random: what the task draws from.

    Attributes:
        task: the task.
        stepper: steps the task.

    Raises:
        WrapperError: `task` is no task.
        ConfigError: a task with more environments, or another render mode.
    """

    metadata: dict[str, Any] = {"render_modes": [RENDER_MODE]}  # noqa: RUF012  as Gymnasium

    def __init__(
        self,
        task: Any,
        render_mode: str | None = None,
        *,
        width: int = 320,
        height: int = 240,
        random: RandomStream | None = None,
    ) -> None:
        self.stepper = AutoresetTask(task, type(self).__name__, random)
        self.task = self.stepper.task
        if self.task.num_envs != 1:
            raise ConfigError(
                f"GymnasiumEnv: got a task with num_envs={self.task.num_envs}, expected 1;"
                " GymnasiumVectorEnv takes more"
            )
        self.render_mode = checked_render_mode(render_mode)
        self.metadata = {**self.metadata, "render_fps": render_fps(self.task.simulation.dt)}
        self._camera = TaskCamera(self.task, width, height)
        self.observation_space = self.task.observation_space
        self.action_space = self.task.action_space
        self._is_closed = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Start a new episode; `options` are not read.

        Returns:
            observation (F,) and info.
        """
        super().reset(seed=seed)
        del options
        observations = self.stepper.reset(seed)
        return _row(observations.pop("obs")), {name: _row(v) for name, v in observations.items()}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Advance by one control step with an action (A,)."""
        step = self.stepper.step(torch.as_tensor(np.asarray(action, dtype=np.float32))[None])
        observations = dict(step.final_observations or step.observations)
        observation = _row(observations.pop("obs"))
        told = {name: _row(rows) for name, rows in {**step.per_env, **observations}.items()}
        return (
            observation,
            float(step.rewards[0]),
            bool(step.terminated[0]),
            bool(step.truncated[0]),
            {**told, **step.scalars},
        )

    def render(self) -> Image | None:  # type: ignore[override]
        """Return a picture (height, width, 3); None without a render mode.

        Raises:
            RenderingError: this machine cannot draw.
        """
        return None if self.render_mode is None else self._camera.draw([0])[0]

    def close(self) -> None:
        """Free renderer and simulation; a second call does nothing."""
        if not self._is_closed:
            self._is_closed = True
            self._camera.close()
            self.stepper.close()


def _row(rows: torch.Tensor) -> Any:
    """Return the only row of (1, ...), as an array, a single number as such."""
    return as_numpy(rows)[0].copy()
