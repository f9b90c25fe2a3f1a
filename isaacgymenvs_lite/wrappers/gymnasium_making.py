"""What Gymnasium calls for the environments that `gymnasium_ids` registers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from isaacgymenvs_lite.config.compose import compose_task
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.env_factory import make_from_config
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.utils.random_stream import RandomStream
from isaacgymenvs_lite.utils.threads import limit_torch_threads, threads_for_envs
from isaacgymenvs_lite.wrappers.gymnasium_single import GymnasiumEnv
from isaacgymenvs_lite.wrappers.gymnasium_vector import GymnasiumVectorEnv


def make_vector_env(
    task: str,
    num_envs: int,
    render_mode: str | None = None,
    *,
    width: int = 320,
    height: int = 240,
    overrides: Sequence[str] = (),
    config_dir: str | Path | None = None,
    **keys: Any,
) -> GymnasiumVectorEnv:
    """Make what `gymnasium.make_vec("IsaacGymEnvsLite/<Task>-v0", num_envs=N, ...)` returns.

    Args:
        task: name of a task file.
        num_envs: N.
        render_mode: `rgb_array` or None.
        width: of a picture, pixels.
        height: pixels.
        overrides: as on train.py's command line, `["task.env.episodeLength=200"]`.
        config_dir: a folder with further task files, below task/.
        keys: keys of cfg/config.yaml: `num_threads=2`. With `seed` the task draws from a sequence
            of its own from the start, as after `reset(seed=...)`.

    Raises:
        ConfigError: an unknown key or a value that cannot be used.
    """
    made, random = _make(task, num_envs, overrides, config_dir, keys)
    return GymnasiumVectorEnv(made, render_mode, width=width, height=height, random=random)


def make_single_env(
    task: str,
    render_mode: str | None = None,
    *,
    width: int = 320,
    height: int = 240,
    overrides: Sequence[str] = (),
    config_dir: str | Path | None = None,
    **keys: Any,
) -> GymnasiumEnv:
    """Make what `gymnasium.make("IsaacGymEnvsLite/<Task>-v0", ...)` returns; see the other."""
    made, random = _make(task, 1, overrides, config_dir, keys)
    return GymnasiumEnv(made, render_mode, width=width, height=height, random=random)


def _make(
    task: str,
    num_envs: int,
    overrides: Sequence[str],
    config_dir: str | Path | None,
    keys: dict[str, Any],
) -> tuple[VecTask, RandomStream]:
    words = [f"num_envs={num_envs}", "rl_device=cpu"]
    words += [f"{key}={_as_word(value)}" for key, value in keys.items()]
    cfg = compose_task(task, [*words, *overrides], config_dir)
    settings = check_config(cfg)
    random = RandomStream()
    if "seed" in keys and settings.seed >= 0:
        random.seed(settings.seed)
    with random:
        made = make_from_config(
            cfg,
            sim_device=settings.sim_device,
            rl_device=settings.rl_device,
            graphics_device_id=settings.graphics_device_id,
        )
    limit_torch_threads(made, threads_for_envs(num_envs), settings.num_threads)
    return made, random


def _as_word(value: Any) -> str:
    """Return a value as train.py's command line takes it."""
    return "null" if value is None else str(value)
