"""Names of the tasks in Gymnasium's registry: `IsaacGymEnvsLite/Cartpole-v0`, `Isaac-Ant-v0`.

Under Isaac Lab's names, for its scripts, `gymnasium.make` returns all environments of a task in
one, as Isaac Lab does.

Importing Gymnasium takes longer than all else that happens before a user's mistake is reported. So
`import isaacgymenvs_lite` leaves it out: the tasks are registered at once if Gymnasium is imported
already, else right after its import. No task is imported; Gymnasium's registry holds the names of
the functions that make them.
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
"""Group of entry points with which an installed package names its tasks."""

# Isaac Lab has these tasks twice, in its two workflows.
_ISAAC_LAB_IDS = {
    f"Isaac-{task}{workflow}-v0": task
    for task in ("Ant", "Cartpole", "Humanoid")
    for workflow in ("", "-Direct")
}

_REGISTRY = "gymnasium.envs"
_FACTORY = "isaacgymenvs_lite.wrappers.gymnasium_env"

# Names to register once Gymnasium is imported.
_waiting: list[str] = []


def env_id(task: str) -> str:
    """Return Gymnasium's name of a task: `IsaacGymEnvsLite/Cartpole-v0`."""
    return f"{NAMESPACE}/{task}-v0"


def task_of_id(name: str) -> str:
    """Return the task of a name in Gymnasium's registry; other names unchanged."""
    match = re.fullmatch(rf"{NAMESPACE}/(.+)-v\d+", name)
    return match[1] if match else _ISAAC_LAB_IDS.get(name, name)


def register_tasks() -> None:
    """Register all tasks, also of installed packages, now or when Gymnasium is imported."""
    if _REGISTRY in sys.modules:
        _register_all()
    else:
        sys.meta_path.insert(0, _WhenImported())


def register_task_id(task: str) -> None:
    """Register one task by name, now or when Gymnasium is imported; a second time does nothing."""
    if _REGISTRY in sys.modules:
        _register(task)
    else:
        _waiting.append(task)


def _register_all() -> None:
    from importlib.metadata import entry_points  # takes longer to import than all of this package

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
                disable_env_checker=True,  # it expects numbers where batches are
                kwargs={"task": task},
            )


def _register(task: str) -> None:
    from gymnasium.envs.registration import register, registry

    # Gymnasium refuses other names; isaacgymenvs_lite.make makes such tasks.
    if env_id(task) in registry or not re.fullmatch(r"[\w.:-]+", task):
        return
    register(
        env_id(task),
        entry_point=f"{_FACTORY}:make_single_env",
        vector_entry_point=f"{_FACTORY}:make_vector_env",
        kwargs={"task": task},
    )


class _WhenImported(MetaPathFinder):
    """Leaves Gymnasium's import to the other finders, and registers the tasks after it."""

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
    """Runs a module's own loader, then registers the tasks."""

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
