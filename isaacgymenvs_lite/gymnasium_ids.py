"""Registers the tasks with Gymnasium: `IsaacGymEnvsLite/Cartpole-v0`, `Isaac-Ant-v0`.

The names `Isaac-...` come from Isaac Lab, so that its scripts find the tasks. With such a name
`gymnasium.make` returns one object for all environments of a task, as in Isaac Lab.

`import isaacgymenvs_lite` does not import Gymnasium, because that takes longer than everything else
before a user's mistake is reported. The tasks are registered at once if Gymnasium has been
imported, otherwise right after its import. Registering does not import the tasks: Gymnasium's
registry contains the names of the functions that make tasks.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

from isaacgymenvs_lite.paths import PARTS, cfg_dir

NAMESPACE = "IsaacGymEnvsLite"
ENTRY_POINTS = "isaacgymenvs_lite.tasks"
"""Group of entry points through which an installed package offers its tasks."""

# Isaac Lab has two versions of each of these tasks, one for each of its two workflows.
_ISAAC_LAB_IDS = {
    f"Isaac-{task}{workflow}-v0": task
    for task in ("Ant", "Cartpole", "Humanoid")
    for workflow in ("", "-Direct")
}

_REGISTRY = "gymnasium.envs"
_FACTORY = "isaacgymenvs_lite.wrappers.gymnasium_env"

# Tasks to register after Gymnasium's import.
_waiting: list[str] = []


def env_id(task: str) -> str:
    """Return a task's name in Gymnasium, for example `IsaacGymEnvsLite/Cartpole-v0`."""
    return f"{NAMESPACE}/{task}-v0"


def task_of_id(name: str) -> str:
    """Return the task that a name in Gymnasium's registry means; return other names unchanged."""
    match = re.fullmatch(rf"{NAMESPACE}/(.+)-v\d+", name)
    return match[1] if match else _ISAAC_LAB_IDS.get(name, name)


def register_tasks() -> None:
    """Register the tasks of this and of installed packages, now or after Gymnasium's import."""
    if _REGISTRY in sys.modules:
        _register_all()
    else:
        sys.meta_path.insert(0, _WhenImported())


def register_task_id(task: str) -> None:
    """Register one task by name, now or after Gymnasium's import; a second call does nothing."""
    if _REGISTRY in sys.modules:
        _register(task)
    else:
        _waiting.append(task)


def _register_all() -> None:
    from importlib.metadata import entry_points  # slower to import than this package

    from gymnasium.envs.registration import register, registry

    files = sorted((cfg_dir() / "task").glob("*.yaml"))
    shipped = (file.stem for file in files if file.stem not in PARTS)
    offered = (point.name for point in entry_points(group=ENTRY_POINTS))
    for task in (*shipped, *offered, *_waiting):
        _register(task)
    for name, task in _ISAAC_LAB_IDS.items():
        if name not in registry:
            register(
                name,
                entry_point="isaacgymenvs_lite.wrappers.isaac_lab_env:make_isaac_lab_env",
                vector_entry_point=f"{_FACTORY}:make_vector_env",
                disable_env_checker=True,  # the checker refuses batches
                kwargs={"task": task},
            )


def _register(task: str) -> None:
    from gymnasium.envs.registration import register, registry

    # Gymnasium refuses names of another form, which isaacgymenvs_lite.make accepts.
    if env_id(task) in registry or not re.fullmatch(r"[\w.:-]+", task):
        return
    register(
        env_id(task),
        entry_point=f"{_FACTORY}:make_single_env",
        vector_entry_point=f"{_FACTORY}:make_vector_env",
        kwargs={"task": task},
    )


class _WhenImported(MetaPathFinder):
    """Registers the tasks right after another finder has imported Gymnasium."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != _REGISTRY:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            spec.loader = _ThenRegister(spec.loader)
        return spec


class _ThenRegister(Loader):
    """Runs the usual loader of a module, then registers the tasks."""

    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        spec = module.__spec__
        if spec is not None:
            spec.loader = module.__loader__ = self._loader
        self._loader.exec_module(module)
        _register_all()
