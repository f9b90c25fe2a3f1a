"""Notes on a configuration for `isaacgymenvs-lite check`, one line each."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig, flag_override

from isaacgymenvs_lite.schema import leaves, plain, select

# Keys of a task that Isaac Gym's PhysX, its importer or its viewer read.
_NO_EFFECT = (
    "env.envSpacing",
    "env.enableDebugVis",
    "env.enableCameraSensors",
    "env.renderFPS",
    "env.plane.restitution",
    "sim.num_client_threads",
    "sim.flex",
)

# What a user need not type to find a key, the longest first.
_SECTIONS = ("task.env.", "task.", "train.params.config.", "train.params.network.", "train.params.")
_GPU = "cuda:0"


def keys_without_effect(tree: dict[str, Any]) -> list[str]:
    """Return the keys of a tree's task that only Isaac Gym reads."""
    found = [f"task.{key}" for key in _NO_EFFECT if select(tree, f"task.{key}") is not None]
    if set(select(tree, "task.sim.physx") or ()) - {"num_threads"}:
        found.append("task.sim.physx.* (except num_threads)")
    return found


def cpu_defaults_note(cfg: DictConfig) -> str | None:
    """Return one line that names the settings that depend on learning on a CPU, or None.

    Args:
        cfg: the tree as it was composed; its `rl_device` decides.
    """
    if "cuda" in str(cfg.rl_device):
        return None
    on_gpu = cfg.copy()
    with flag_override(on_gpu, "readonly", False):
        on_gpu.rl_device = _GPU
    here, there = (dict(leaves(plain(tree))) for tree in (cfg, on_gpu))
    changed = [
        f"{_short_name(path)} {_short(value)} ({_short(there.get(path))})"
        for path, value in here.items()
        if path.startswith(_SECTIONS) and value != there.get(path) and there.get(path) != _GPU
    ]
    return f"defaults for learning on a CPU (on a GPU): {', '.join(changed)}" if changed else None


def _short_name(path: str) -> str:
    return path.removeprefix(next(name for name in _SECTIONS if path.startswith(name)))


def _short(value: Any) -> str:
    if isinstance(value, list):
        return "-".join(str(entry) for entry in value)
    return "null" if value is None else str(value)
