"""Wrappers that give our tasks the interfaces of other RL libraries.

    from isaacgymenvs_lite.wrappers import Sb3VecEnvWrapper

    env = Sb3VecEnvWrapper(isaacgymenvs_lite.make(task="Ant", num_envs=64))

The argument of our wrapper is a task; the result can be wrapped by the library's wrappers. The
module of a wrapper is imported when the wrapper is first used, because the libraries are optional.
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

# Maps the name of each wrapper to its module and to the optional package that the module needs.
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
    """Import a wrapper.

    Raises:
        MissingPackageError: the wrapper's library is not installed.
    """
    if name not in _PLACES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    module, package = _PLACES[name]
    if package is not None:
        require(package, name)
    return getattr(importlib.import_module(f"{__name__}.{module}"), name)
