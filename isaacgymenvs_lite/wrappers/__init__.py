"""Shape and dtype adapters between our tasks and RL libraries, nothing else.

    from isaacgymenvs_lite.wrappers import Sb3VecEnvWrapper

    env = Sb3VecEnvWrapper(isaacgymenvs_lite.make(task="Ant", num_envs=64))

An adapter goes around the task itself; wrappers of the library go around the adapter. An adapter's
module is imported when its name is first used, as the libraries are optional.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from isaacgymenvs_lite.utils.optional_packages import require

if TYPE_CHECKING:
    from isaacgymenvs_lite.wrappers.gymnasium_env import GymnasiumEnv, GymnasiumVectorEnv
    from isaacgymenvs_lite.wrappers.rl_games_env import RLGPUEnv
    from isaacgymenvs_lite.wrappers.rsl_rl_env import RslRlVecEnvWrapper
    from isaacgymenvs_lite.wrappers.sb3 import Sb3VecEnvWrapper
    from isaacgymenvs_lite.wrappers.skrl_env import SkrlVecEnvWrapper
    from isaacgymenvs_lite.wrappers.task_video import RecordVectorVideo, RecordVideo

__all__ = [
    "GymnasiumEnv",
    "GymnasiumVectorEnv",
    "RLGPUEnv",
    "RecordVectorVideo",
    "RecordVideo",
    "RslRlVecEnvWrapper",
    "Sb3VecEnvWrapper",
    "SkrlVecEnvWrapper",
]

# Name -> module here, and the optional package that it needs.
_PLACES: dict[str, tuple[str, str | None]] = {
    "GymnasiumEnv": ("gymnasium_env", None),
    "GymnasiumVectorEnv": ("gymnasium_env", None),
    "RLGPUEnv": ("rl_games_env", None),
    "RecordVectorVideo": ("task_video", "av"),
    "RecordVideo": ("task_video", "av"),
    "RslRlVecEnvWrapper": ("rsl_rl_env", "rsl_rl"),
    "Sb3VecEnvWrapper": ("sb3", "stable_baselines3"),
    "SkrlVecEnvWrapper": ("skrl_env", "skrl"),
}


def __getattr__(name: str) -> Any:
    """Import an adapter; without its library a `MissingPackageError` is raised."""
    if name not in _PLACES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    module, package = _PLACES[name]
    if package is not None:
        require(package, name)
    return getattr(importlib.import_module(f"{__name__}.{module}"), name)
