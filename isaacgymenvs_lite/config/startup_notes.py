"""Notes on a configuration that a start logs, one line each."""

from __future__ import annotations

import copy
from typing import Any

from omegaconf import DictConfig, OmegaConf, flag_override

from isaacgymenvs_lite.config.train_files import merge_defaults
from isaacgymenvs_lite.config.yaml_files import read_yaml
from isaacgymenvs_lite.paths import cfg_dir
from isaacgymenvs_lite.schema import leaves, plain

# Read by Isaac Gym's PhysX, its importer or its viewer, by nothing here.
_ROOT_KEYS = ("physics_engine", "solver_type", "num_subscenes", "graphics_device_id")
_TASK_KEYS = (
    "env.envSpacing",
    "env.enableDebugVis",
    "env.enableCameraSensors",
    "env.renderFPS",
    "env.plane.restitution",
    "sim.num_client_threads",
)
_TASK_SECTIONS = ("sim.physx", "sim.flex")
# All our other task files inherit from these.
_BASES = ("Classic", "HumanoidAMP")
_ABSENT = object()

# What a user need not type to find a key, the longest first.
_SECTIONS = ("task.env.", "task.", "train.params.config.", "train.params.network.", "train.params.")
# They follow another default.
_FOLLOWING_KEYS = ("train.params.config.num_actors",)
_GPU = "cuda:0"


def startup_notes(cfg: DictConfig, check_command: str) -> list[str]:
    """Return the lines that a start logs about `cfg`; none for the defaults on a GPU.

    Args:
        cfg: the composed tree.
        check_command: what a user types to get `cpu_defaults_note`.
    """
    notes = []
    if without_effect := physx_only_keys(cfg):
        notes.append(f"no effect here, PhysX or viewer only: {', '.join(without_effect)}")
    if not cfg.test and (settings := _cpu_defaults(cfg)):
        notes.append(
            f"{len(settings)} defaults are for learning on a CPU, listed by: {check_command}"
        )
    return notes


def physx_only_keys(cfg: DictConfig, *, with_defaults: bool = False) -> list[str]:
    """Return the keys that have no effect here and were set by the user.

    A key is set if its value differs from our YAML file of that name, or, without one, from all
    files that it may inherit from. Values are compared as written, before interpolation.

    Args:
        cfg: the composed tree.
        with_defaults: return all keys of the task that have no effect, and none of the root.
    """
    tree, root = _as_written(cfg), _as_written(read_yaml(cfg_dir() / "config.yaml"))
    task = tree.get("task")
    if with_defaults:
        found, shipped = [], []
    else:
        found = [key for key in _ROOT_KEYS if _value_at(tree, key) != _value_at(root, key)]
        task_file = cfg_dir() / "task" / f"{_value_at(tree, 'task.name')}.yaml"
        bases = [task_file.with_name(f"{base}.yaml") for base in _BASES]
        files = [task_file] if task_file.is_file() else bases
        shipped = [_as_written(merge_defaults(file)) for file in files]
    found += [f"task.{key}" for key in _TASK_KEYS if _is_set(task, shipped, key)]
    for section in _TASK_SECTIONS:
        found += _set_keys(task, shipped, section)
    return found


def cpu_defaults_note(cfg: DictConfig) -> str | None:
    """Return one line that names the settings that depend on learning on a CPU, or None."""
    settings = _cpu_defaults(cfg)
    return f"defaults for learning on a CPU (on a GPU): {', '.join(settings)}" if settings else None


def _cpu_defaults(cfg: DictConfig) -> list[str]:
    """Return `<setting> <value here> (<value on a GPU>)` of each; empty on a GPU."""
    if "cuda" in str(cfg.rl_device):
        return []
    on_gpu = copy.deepcopy(cfg)
    with flag_override(on_gpu, "readonly", False):
        on_gpu.rl_device = _GPU
    here, there = _settings(cfg), _settings(on_gpu)
    return [
        f"{_short_name(path)} {_short(value)} ({_short(there.get(path))})"
        for path, value in here.items()
        if value != there.get(path) and there.get(path) != _GPU and path not in _FOLLOWING_KEYS
    ]


def _settings(cfg: DictConfig) -> dict[str, Any]:
    """Return the values of the task and of the training by their paths."""
    found: dict[str, Any] = {}
    for section in ("task", "train.params"):
        found |= leaves(plain(OmegaConf.select(cfg, section)), section)
    return found


def _short_name(path: str) -> str:
    section = next((name for name in _SECTIONS if path.startswith(name)), "")
    return path.removeprefix(section)


def _short(value: Any) -> str:
    if isinstance(value, list):
        return "-".join(str(entry) for entry in value)
    return "null" if value is None else str(value)


def _set_keys(task: Any, shipped: list[Any], section: str) -> list[str]:
    """Return the keys of `task.<section>` that the user set; the section's name if it is all.

    The task reads physx.num_threads.
    """
    keys = _value_at(task, section)
    if not isinstance(keys, dict):
        return []
    unread = [str(key) for key in keys if key != "num_threads"]
    found = [key for key in unread if _is_set(task, shipped, f"{section}.{key}")]
    if found and found == unread:
        return [f"task.{section}.*" + (" (except num_threads)" if len(keys) > len(found) else "")]
    return [f"task.{section}.{key}" for key in found]


def _is_set(task: Any, shipped: list[Any], key: str) -> bool:
    value = _value_at(task, key)
    return value is not _ABSENT and all(value != _value_at(tree, key) for tree in shipped)


def _value_at(tree: Any, path: str) -> Any:
    """Return the value at a dotted path of nested dictionaries, `_ABSENT` without one."""
    for key in path.split("."):
        if not isinstance(tree, dict) or key not in tree:
            return _ABSENT
        tree = tree[key]
    return tree


def _as_written(cfg: DictConfig) -> Any:
    """Return a tree as nested dictionaries, interpolations unresolved."""
    return OmegaConf.to_container(cfg, resolve=False)
