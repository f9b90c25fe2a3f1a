"""Makes environments of Gymnasium from tasks, with numpy arrays.

`gymnasium_ids` registers `make_vector_env` and `make_single_env`, so that

    gymnasium.make_vec("IsaacGymEnvsLite/Ant-v0", num_envs=64)
    gymnasium.make("IsaacGymEnvsLite/Ant-v0")

return a `GymnasiumVectorEnv` and a `GymnasiumEnv`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from omegaconf import DictConfig

from isaacgymenvs_lite.config.compose import compose_task
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.scene import Image
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.utils.random_stream import RandomStream
from isaacgymenvs_lite.utils.threads import limit_torch_threads, threads_for_envs
from isaacgymenvs_lite.wrappers.autoreset import RENDER_MODE, AutoresetTask, Transition

Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]
_Env = TypeVar("_Env", "GymnasiumVectorEnv", "GymnasiumEnv")


def make_vector_env(task: str, num_envs: int, **keywords: Any) -> GymnasiumVectorEnv:
    """Make the environment of `gymnasium.make_vec("IsaacGymEnvsLite/<Task>-v0", num_envs=N, ...)`.

    Args:
        task: name of a task file.
        num_envs: number of environments N.
        keywords: render_mode (`rgb_array` or None), width and height of a picture in pixels,
            overrides (settings as on train.py's command line), config_dir (a folder with more task
            files below task/), and keys of cfg/config.yaml such as `num_threads=2`. `seed` starts
            a separate random sequence for the task, like `reset(seed=...)`.

    Raises:
        ConfigError: a key is unknown, or a value cannot be used.
    """
    return _make(GymnasiumVectorEnv, task, num_envs, **keywords)


def make_single_env(task: str, **keywords: Any) -> GymnasiumEnv:
    """Make the environment of `gymnasium.make("IsaacGymEnvsLite/<Task>-v0", ...)`.

    See `make_vector_env` for the keywords.
    """
    return _make(GymnasiumEnv, task, 1, **keywords)


def _make(
    cls: type[_Env],
    task: str,
    num_envs: int,
    render_mode: str | None = None,
    *,
    width: int = 320,
    height: int = 240,
    overrides: Sequence[str] = (),
    config_dir: str | Path | None = None,
    **keys: Any,
) -> _Env:
    made, random = make_task(task, num_envs, keys, overrides, config_dir)
    return cls(made, render_mode, width=width, height=height, random=random)


def make_task(
    task: str,
    num_envs: int | str,
    keys: dict[str, Any],
    overrides: Sequence[str] = (),
    config_dir: str | Path | None = None,
    cfg: DictConfig | None = None,
) -> tuple[VecTask, RandomStream]:
    """Return a task and its random stream; see `make_vector_env`.

    Args:
        task: name of a task file.
        num_envs: number of environments; '' selects the number in the task file.
        keys: keys of cfg/config.yaml.
        overrides: settings as on train.py's command line.
        config_dir: a folder with more task files.
        cfg: a composed tree, which replaces all other arguments.
    """
    if cfg is None:
        number = f"num_envs={num_envs}" if num_envs != "" else "num_envs=''"
        words = [f"{key}={'null' if value is None else value}" for key, value in keys.items()]
        made_of = compose_task(task, [number, "rl_device=cpu", *words, *overrides], config_dir)
    else:
        made_of = cfg
    settings = check_config(made_of)
    random = RandomStream()
    if (cfg is not None or "seed" in keys) and settings.seed >= 0:
        random.seed(settings.seed)
    with random:
        made = make_from_config(
            made_of,
            sim_device=settings.sim_device,
            rl_device=settings.rl_device,
            graphics_device_id=settings.graphics_device_id,
        )
    limit_torch_threads(made, threads_for_envs(made.num_envs), settings.num_threads)
    return made, random


class GymnasiumVectorEnv(VectorEnv[Floats, Floats, npt.NDArray[Any]]):
    """N environments of a task; `gymnasium.make_vec("IsaacGymEnvsLite/<Task>-v0")` makes one.

    A step that ends an episode returns the first observation of the next episode
    (`AutoresetMode.SAME_STEP`). If an episode of environment i ended, row i of `infos["final_obs"]`
    is the last observation of this episode, and `infos["final_info"]` has its last infos.

    `infos["states"]` (N, S), for asymmetric critics, belongs to the returned observations. All
    other infos, for example `amp_obs` (N, F), describe the end of the step, before the next
    episodes start.

    See `AutoresetTask` for arguments and errors; the attribute `stepper` is an `AutoresetTask`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  Gymnasium declares this attribute like this.
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
        name = type(self).__name__
        self.stepper = AutoresetTask(task, name, random, render_mode, width, height)
        self.task = self.stepper.task
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.stepper.render_fps}
        self.num_envs = self.task.num_envs
        self.single_observation_space = self.task.observation_space
        self.single_action_space = self.task.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Start new episodes and return observations (N, F) and infos.

        Args:
            seed: seed of the random sequence that all environments of the task share.
            options: may have `reset_mask` (N,) bool, which selects at least one environment to
                reset.
        """
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        if mask is None:
            observations = self.stepper.reset(seed)
        else:
            mask = np.array(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
                raise ConfigError(
                    f"options['reset_mask']: got {mask.dtype} {mask.shape}, expected a numpy array"
                    f" of ({self.num_envs},) bool with at least one True"
                )
            observations = self.stepper.reset_some(torch.from_numpy(mask), seed)
        others = dict(observations)
        first = as_numpy(others.pop("obs"))
        return first, _masked(others, {}, np.ones(self.num_envs, dtype=bool))

    def step(self, actions: Floats) -> tuple[Floats, Floats, Bools, Bools, dict[str, Any]]:
        """Advance by one control step with actions (N, A); see the class docstring.

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

    def render(self) -> tuple[Image, ...] | None:
        """Return a picture (height, width, 3) per environment, or None without a render mode."""
        pictures = self.stepper.render()
        return None if pictures is None else tuple(pictures)

    def close_extras(self, **kwargs: Any) -> None:
        """Release the renderer and the simulation."""
        self.stepper.close()


class ShowsFirst:
    """Base class of environments that draw environment 0 of their task."""

    stepper: AutoresetTask

    def render(self) -> Image | None:
        """Return a picture (height, width, 3) of environment 0, or None without a render mode."""
        pictures = self.stepper.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Release the renderer and the simulation; a second call does nothing."""
        self.stepper.close()


class GymnasiumEnv(ShowsFirst, gymnasium.Env[Floats, Floats]):
    """One environment; `gymnasium.make("IsaacGymEnvsLite/<Task>-v0")` makes one.

    The last step of an episode returns the last observation, and `reset` starts the next episode.
    `info` has `states` (S,) for asymmetric critics and the task's other infos.

    See `AutoresetTask` for arguments and errors; the task must have one environment.
    """

    metadata: dict[str, Any] = {"render_modes": [RENDER_MODE]}  # noqa: RUF012

    def __init__(
        self,
        task: Any,
        render_mode: str | None = None,
        *,
        width: int = 320,
        height: int = 240,
        random: RandomStream | None = None,
    ) -> None:
        name = type(self).__name__
        self.stepper = AutoresetTask(task, name, random, render_mode, width, height)
        self.task = self.stepper.task
        if self.task.num_envs != 1:
            raise ConfigError(
                f"GymnasiumEnv: got a task with num_envs={self.task.num_envs}, expected 1;"
                " GymnasiumVectorEnv takes more"
            )
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.stepper.render_fps}
        self.observation_space = self.task.observation_space
        self.action_space = self.task.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Start a new episode; return its first observation (F,) and info."""
        super().reset(seed=seed)
        observations = self.stepper.reset(seed)
        return _row(observations.pop("obs")), {name: _row(v) for name, v in observations.items()}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Advance by one control step with an action (A,)."""
        step = self.stepper.step(torch.as_tensor(np.asarray(action, dtype=np.float32))[None])
        observations = dict(step.final_observations or step.observations)
        observation = _row(observations.pop("obs"))
        info = {name: _row(rows) for name, rows in {**step.per_env, **observations}.items()}
        return (
            observation,
            float(step.rewards[0]),
            bool(step.terminated[0]),
            bool(step.truncated[0]),
            {**info, **step.scalars},
        )


def as_numpy(tensor: torch.Tensor) -> npt.NDArray[Any]:
    """Return a tensor of any device as a numpy array."""
    return tensor.cpu().numpy()


def _masked(
    per_env: dict[str, torch.Tensor], scalars: dict[str, float], mask: Bools
) -> dict[str, Any]:
    """Return infos as in Gymnasium: `name` has an array of N rows, `_name` the array's mask."""
    infos: dict[str, Any] = {}
    for name, rows in per_env.items():
        infos[name] = as_numpy(rows).copy()
        infos[f"_{name}"] = mask.copy()
    for name, value in scalars.items():
        infos[name] = np.full(len(mask), value)
        infos[f"_{name}"] = mask.copy()
    return infos


def _row(rows: torch.Tensor) -> Any:
    """Return the only row of a tensor (1, ...) as an array or a number."""
    return as_numpy(rows)[0].copy()
