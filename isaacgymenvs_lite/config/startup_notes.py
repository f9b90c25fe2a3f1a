"""Notes on a configuration that a start logs, one line each."""

from __future__ import annotations

import copy
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf, flag_override

from isaacgymenvs_lite.config.train_files import merge_defaults
from isaacgymenvs_lite.config.yaml_files import read_yaml
from isaacgymenvs_lite.paths import cfg_dir

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
_ABSENT = object()

# Keys whose shipped defaults differ on a CPU -> their short names for users.
_CPU_SETTINGS = {
    "task.env.numEnvs": "numEnvs",
    "train.params.config.minibatch_size": "minibatch_size",
    "train.params.config.amp_minibatch_size": "amp_minibatch_size",
    "train.params.config.amp_replay_buffer_size": "amp_replay_buffer_size",
    "train.params.config.amp_replay_keep_prob": "amp_replay_keep_prob",
    "train.params.config.amp_input_memory": "amp_input_memory",
    "train.params.config.disc_grad_penalty": "disc_grad_penalty",
    "train.params.config.disc_grad_penalty_final": "disc_grad_penalty_final",
    "train.params.config.mini_epochs": "mini_epochs",
    "train.params.config.learning_rate": "learning_rate",
    "train.params.config.lr_schedule": "lr_schedule",
    "train.params.config.max_epochs": "max_epochs",
    "train.params.network.mlp.units": "mlp.units",
    "train.params.network.disc.units": "disc.units",
    "train.params.network.disc.conditional": "disc.conditional",
    "train.params.network.enc.separate": "enc.separate",
    "train.params.network.latent_scale": "latent_scale",
    "train.params.config.gamma": "gamma",
    "train.params.config.disc_input_noise": "disc_input_noise",
    **{
        f"train.params.config.{key}": key
        for key in (
            "latent_dim",
            "disc_reward_w",
            "enc_reward_w",
            "amp_obs_steps",
            "enc_coef",
            "enc_alignment_coef",
            "enc_uniformity_coef",
            "clip_latents",
            "amp_diversity_bonus",
            "exploration_correlation",
        )
    },
}


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


def physx_only_keys(cfg: DictConfig) -> list[str]:
    """Return the keys that have no effect here and were set by the user.

    Set means: unlike our own YAML file of that name, or, in a task that we ship no file for,
    present. Values are compared as written, before interpolation.
    """
    tree, root = _as_written(cfg), _as_written(read_yaml(cfg_dir() / "config.yaml"))
    found = [key for key in _ROOT_KEYS if _value_at(tree, key) != _value_at(root, key)]
    task_file = cfg_dir() / "task" / f"{_value_at(tree, 'task.name')}.yaml"
    shipped = _as_written(merge_defaults(task_file)) if task_file.is_file() else {}
    task = tree.get("task")
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
        on_gpu.rl_device = "cuda:0"
    settings = []
    for path, name in _CPU_SETTINGS.items():
        here, there = OmegaConf.select(cfg, path), OmegaConf.select(on_gpu, path)
        if here != there:
            settings.append(f"{name} {_short(here)} ({_short(there)})")
    return settings


def _short(value: Any) -> str:
    if isinstance(value, ListConfig):
        return "-".join(str(entry) for entry in value)
    return "null" if value is None else str(value)


def _set_keys(task: Any, shipped: Any, section: str) -> list[str]:
    """Return the keys of `task.<section>` that the user set; the section's name if it is all."""
    keys = _value_at(task, section)
    if not isinstance(keys, dict) or not keys:
        return []
    found = [str(key) for key in keys if _is_set(task, shipped, f"{section}.{key}")]
    if len(found) == len(keys):
        return [f"task.{section}.*"]
    return [f"task.{section}.{key}" for key in found]


def _is_set(task: Any, shipped: Any, key: str) -> bool:
    value = _value_at(task, key)
    return value is not _ABSENT and value != _value_at(shipped, key)


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
