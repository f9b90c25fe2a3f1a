"""A task as a vector environment of Gymnasium: numpy in and out, episodes without a gap."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.scene import Image
from isaacgymenvs_lite.utils.random_stream import RandomStream
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask, Transition
from isaacgymenvs_lite.wrappers.camera import RENDER_MODE, TaskCamera, checked_render_mode

Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]


class GymnasiumVectorEnv(VectorEnv[Floats, Floats, npt.NDArray[Any]]):
    """N environments of a task; `gymnasium.make_vec("IsaacGymEnvsLite/<Task>-v0")` makes one.

    A step that ends an episode returns the first observation of the next one
    (`AutoresetMode.SAME_STEP`). `infos["final_obs"]` then holds the last observation of the old one
    at its environment's place, and `infos["final_info"]` what else was told of it.

    Of `infos`: `states` (N, S) for asymmetric critics belong to the returned observations;
    everything else, such as `amp_obs` (N, F), to the step, so that an ended episode's is its last.

    Args:
        task: what `isaacgymenvs_lite.make` returns.
        render_mode: `rgb_array` or None.
        width: of a picture, pixels.
        height: pixels.
        random: what the task draws from.

    Attributes:
        task: the task.
        stepper: steps the task.

    Raises:
        WrapperError: `task` is no task.
        ConfigError: another render mode.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  as Gymnasium declares it
        "render_modes": [RENDER_MODE],
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

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
        self.render_mode = checked_render_mode(render_mode)
        self.metadata = {**self.metadata, "render_fps": render_fps(self.task.simulation.dt)}
        self._camera = TaskCamera(self.task, width, height)
        self.num_envs = self.task.num_envs
        self.single_observation_space = self.task.observation_space
        self.single_action_space = self.task.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Start new episodes in all environments, or where `options["reset_mask"]` (N,) says so.

        Args:
            seed: what the task draws from now on depends on it alone. One number: the environments
                draw from one sequence.
            options: `reset_mask`, (N,) bool with at least one True; other keys are not read.

        Returns:
            observations (N, F) and infos.

        Raises:
            ConfigError: another kind of mask.
        """
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        if mask is None:
            observations = self.stepper.reset(seed)
        else:
            observations = self.stepper.reset_some(self._checked_mask(mask), seed)
        told = {name: rows for name, rows in observations.items() if name != "obs"}
        everywhere = np.ones(self.num_envs, dtype=bool)
        return as_numpy(observations["obs"]), _masked(told, {}, everywhere)

    def step(self, actions: Floats) -> tuple[Floats, Floats, Bools, Bools, dict[str, Any]]:
        """Advance by one control step; see the class docstring.

        Args:
            actions: (N, A).

        Returns:
            observations (N, F), rewards (N,), terminated (N,), truncated (N,) and infos.
        """
        step = self.stepper.step(torch.as_tensor(np.asarray(actions, dtype=np.float32)))
        return (
            as_numpy(step.observations["obs"]),
            as_numpy(step.rewards),
            as_numpy(step.terminated),
            as_numpy(step.truncated),
            self._infos(step),
        )

    def _infos(self, step: Transition) -> dict[str, Any]:
        now = {name: rows for name, rows in step.observations.items() if name != "obs"}
        everywhere = np.ones(self.num_envs, dtype=bool)
        infos = _masked({**step.per_env, **now}, step.scalars, everywhere)
        if step.final_observations is not None:
            ended = as_numpy(step.ended)
            end = dict(step.final_observations)
            last = as_numpy(end.pop("obs"))
            final = np.full(self.num_envs, None, dtype=object)
            for env_id in ended.nonzero()[0]:
                final[env_id] = last[env_id].copy()
            infos |= {"final_obs": final, "_final_obs": ended.copy()}
            final_info = _masked({**step.per_env, **end}, step.scalars, ended)
            infos |= {"final_info": final_info, "_final_info": ended.copy()}
        return infos

    def _checked_mask(self, mask: Any) -> torch.Tensor:
        shape = (self.num_envs,)
        fits = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == shape
        if not fits or not mask.any():
            given = f"{mask.dtype} {mask.shape}" if isinstance(mask, np.ndarray) else repr(mask)
            raise ConfigError(
                f"options['reset_mask']: got {given}, expected a numpy array of {shape} bool with"
                " at least one True"
            )
        return torch.from_numpy(mask.copy())

    def render(self) -> tuple[Image, ...] | None:
        """Return a picture (height, width, 3) of each environment; None without a render mode.

        Raises:
            RenderingError: this machine cannot draw.
        """
        if self.render_mode is None:
            return None
        return tuple(self._camera.draw(range(self.num_envs)))

    def close_extras(self, **kwargs: Any) -> None:
        """Free renderer and simulation."""
        del kwargs
        self._camera.close()
        self.stepper.close()


def as_numpy(tensor: torch.Tensor) -> npt.NDArray[Any]:
    """Return a tensor of any device as an array."""
    return tensor.cpu().numpy()


def render_fps(control_dt_s: float) -> int:
    """Return the pictures per second that show a task in real time, as Gymnasium wants them."""
    return max(1, round(1.0 / control_dt_s))


def _masked(
    per_env: dict[str, torch.Tensor], scalars: dict[str, float], mask: Bools
) -> dict[str, Any]:
    """Return infos in Gymnasium's form: an array of N rows by each name, and `_<name>`, whose."""
    infos: dict[str, Any] = {}
    for name, rows in per_env.items():
        infos[name] = as_numpy(rows).copy()
        infos[f"_{name}"] = mask.copy()
    for name, value in scalars.items():
        infos[name] = np.full(len(mask), value)
        infos[f"_{name}"] = mask.copy()
    return infos
