"""Checks the keys of cfg/config.yaml: types, limits, and whether this version supports them."""

from __future__ import annotations

import dataclasses
import logging
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from isaacgymenvs_lite.config.compose import explain_interpolation
from isaacgymenvs_lite.config.pbt_settings import mutable_values, read_pbt_settings
from isaacgymenvs_lite.config.run_names import read_run_name, run_name_of
from isaacgymenvs_lite.config.train_params import apply_wrapper_limits
from isaacgymenvs_lite.errors import ConfigError, DeviceError
from isaacgymenvs_lite.schema import (
    as_mapping,
    missing_key,
    read_keys,
    read_section,
    select,
    setting,
)
from isaacgymenvs_lite.utils.optional_packages import require

log = logging.getLogger(__name__)

_GROUPS = ("task", "train", "pbt")
# Sections that other code reads before the task or the agent checks their keys.
_SECTIONS = (
    *("task.env", "task.sim", "task.task", "train.params"),
    *(f"train.params.{name}" for name in ("algo", "model", "network", "config")),
)
# Maps each required key to a hint about its source.
_REQUIRED = {
    "task.name": "a task file starts with name:",
    "task.env": "a task file has the settings of the task below env:",
    "task.sim": "a task file has dt and gravity below sim:, 'defaults: [Classic]' brings them",
    "train.params": "a train file starts with params:",
    "train.params.config": "a train file has the settings of the agent below config:",
}
_SEED_OF_DETERMINISTIC_RUNS = 42
_RANDOM_SEEDS = 10_000
_MAX_SEED = 2**32 - 1  # numpy's
MAX_THREADS = 1024
"""Upper limit of num_threads. Every thread needs memory, and no CPU has so many cores."""


@dataclass(frozen=True, kw_only=True)
class LaunchSettings:
    """The checked root of the configuration tree; cfg/config.yaml explains the keys.

    An optional value is None if the file has '', which means "not given".
    """

    task_name: str = setting()
    task_checkout: str = setting("")
    experiment: str = setting("")
    test: bool = setting(False)
    checkpoint: str = setting("")
    resume: str = setting("")
    sigma: float | None = setting(None, blank=True)
    latent: str = setting("")
    num_envs: int | None = setting(None, minimum=1, blank=True)
    max_iterations: int | None = setting(None, minimum=1, blank=True)
    seed: int = setting(42, minimum=-1, maximum=_MAX_SEED)
    torch_deterministic: bool = setting(False)

    sim_device: str = setting("cpu")
    rl_device: str = setting("cpu")
    pipeline: str = setting("cpu", choices=("cpu", "gpu"))
    num_threads: int = setting(0, minimum=0, maximum=MAX_THREADS)
    multi_gpu: bool = setting(False)
    distributed_timeout_s: float = setting(600.0, above=0, maximum=86400)

    progress_interval: float = setting(10.0, above=0)
    headless: bool = setting(True)
    force_render: bool = setting(True)
    viewer: str = setting("", choices=("", "web"))
    viewer_port: int = setting(8080, minimum=0, maximum=65535)
    capture_video: bool = setting(False)
    capture_video_freq: int = setting(1464, minimum=1)
    capture_video_len: int = setting(100, minimum=1)
    capture_video_envs: int = setting(1, minimum=1)

    wandb_activate: bool = setting(False)
    wandb_group: str = setting("")
    wandb_name: str = setting("")
    wandb_entity: str = setting("")
    wandb_project: str = setting("isaacgymenvs")
    wandb_tags: list[str] = setting([])
    wandb_logcode_dir: str = setting("")

    physics_engine: str = setting("physx", choices=("physx", "flex"))
    solver_type: int = setting(1, choices=(0, 1))
    num_subscenes: int = setting(4, minimum=0)
    graphics_device_id: int = setting(0, minimum=-1)

    full_experiment_name: str | None = setting(None, blank=True)
    """Exact name of the run folder. cfg/config.yaml lacks this key; `+full_experiment_name=` adds
    it."""
    pbt_restart: bool = setting(False)
    """Set by population based training when it restarts a process."""


@dataclass(frozen=True, kw_only=True)
class _EnvSize:
    """The key of task.env that every task has."""

    num_envs: int = setting(key="numEnvs", minimum=1, maximum=2**24)


@dataclass(frozen=True)
class CheckedConfig:
    """A composed tree that has been checked.

    Attributes:
        settings: the keys at the root of the tree.
        tree: the tree with its interpolations resolved.
        cfg: the tree as Hydra composed it.
    """

    settings: LaunchSettings
    tree: dict[str, Any]
    cfg: DictConfig

    def changed(self, values: Mapping[str, Any]) -> CheckedConfig:
        """Return a checked copy of the configuration; `values` maps paths of keys to new values."""
        cfg = self.cfg.copy()
        with open_dict(cfg):
            for path, value in values.items():
                OmegaConf.update(cfg, path, value, force_add=True)
        return read_config(cfg)


def check_config(cfg: DictConfig) -> LaunchSettings:
    """Check a composed tree as `read_config` does; return its root."""
    return read_config(cfg).settings


def read_config(cfg: DictConfig) -> CheckedConfig:
    """Check a composed tree before large packages are imported and before a task is made.

    The check covers the root's keys, the devices, the names of runs and the interpolations. It
    imports torch only if a device may be a GPU, after everything else has been checked.

    Raises:
        ConfigError: a key is missing, unknown or has a wrong value, or needs a missing feature.
        DeviceError: a device is misspelt, or `rl_device` does not exist on this machine.
    """
    written = OmegaConf.to_container(cfg, resolve=False)
    for path, hint in _REQUIRED.items():
        section, _, key = path.rpartition(".")
        keys = as_mapping(select(written, section), section)
        if key not in keys:
            raise missing_key(key, keys, [key], section, hint)
    for path in _SECTIONS:
        if not str(section := select(written, path)).startswith("${"):
            as_mapping(section, path)
    # ${default_rl_device:} imports torch and is therefore resolved last.
    postponed = {"rl_device"} if OmegaConf.is_interpolation(cfg, "rl_device") else set()
    try:
        root = {str(key): cfg[key] for key in cfg if key not in (*_GROUPS, *postponed)}
        settings = read_section(LaunchSettings, root, where="", ignored=postponed, complete=True)
        _check_combinations(settings)
        # The physics always runs on the CPU; the task logs it if sim_device names a GPU.
        check_device_name(settings.sim_device, "sim_device")
        device = "" if postponed else check_device(settings.rl_device, "rl_device")
        tree: Any = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise explain_interpolation(error) from error
    run_name_of(tree)
    if settings.full_experiment_name:
        read_run_name(settings.full_experiment_name, "full_experiment_name")
    read_keys(_EnvSize, tree["task"]["env"] or {}, "task.env")
    apply_wrapper_limits(tree)
    if (pbt := read_pbt_settings(tree)) is not None:
        mutable_values(tree, pbt)
    settings = dataclasses.replace(settings, rl_device=device or str(tree["rl_device"]))
    return CheckedConfig(settings, tree, cfg)


def resolve_seed(seed: int, torch_deterministic: bool = False, rank: int = 0) -> int:
    """Return the seed of the process `rank`.

    The rank is added to a given seed. A `seed` of -1 means 42 + rank in a deterministic run;
    otherwise the seed is drawn from [0, 10000) without using the state of any generator.
    """
    if seed != -1:
        return seed + rank
    if torch_deterministic:
        return _SEED_OF_DETERMINISTIC_RUNS + rank
    return secrets.randbelow(_RANDOM_SEEDS)


def _check_combinations(settings: LaunchSettings) -> None:
    """Refuse settings that contradict each other or that need a missing package."""
    if settings.multi_gpu and settings.test:
        raise ConfigError("multi_gpu=True trains in several processes; to play leave it out")
    if settings.wandb_activate:
        require("wandb", "wandb_activate=True", otherwise="leave wandb_activate out")
    if settings.resume and settings.test:
        raise ConfigError(
            f"resume={settings.resume} goes on with a training; to play a policy give checkpoint="
            " instead"
        )
    if settings.latent and not settings.test:
        raise ConfigError(
            f"latent={settings.latent} chooses what a trained policy shows: add test=True and"
            " checkpoint=, or remove it (training draws latents at random)"
        )


# --- devices ------------------------------------------------------------------------------------

_DEVICE = re.compile(r"cpu|cuda(?::(?P<index>\d+))?")
# The settings for which the use of the CPU has been logged. None means that a missing GPU is an
# error.
_fallback_keys: set[str] | None = None


def allow_cpu_fallback(allowed: bool = True) -> None:
    """Use the CPU in place of a missing GPU from now on, in this process.

    Scripts that name a GPU then run unedited. The log has one line for each setting.
    """
    global _fallback_keys
    _fallback_keys = (_fallback_keys or set()) if allowed else None


def check_device_name(name: str, key: str) -> int | None:
    """Return the index of the GPU that a setting names, or None if it names the CPU.

    Raises:
        DeviceError: the name is misspelt.
    """
    match = _DEVICE.fullmatch(str(name))
    if match is None:
        raise DeviceError(f"{key}={name}: expected cpu, cuda or cuda:N, for example cuda:0")
    return None if name == "cpu" else int(match["index"] or 0)


def check_device(name: str, key: str) -> str:
    """Return the device that a setting names, or the CPU if the GPU is missing and that is allowed.

    Raises:
        DeviceError: the name is misspelt, or torch does not see this GPU.
    """
    index = check_device_name(name, key)
    if index is None:
        return name
    import torch  # imported late: it takes a second

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count == 0 and _fallback_keys is not None:
        if key not in _fallback_keys:
            _fallback_keys.add(key)
            log.warning("%s=%s: torch sees no GPU on this machine; the CPU is used", key, name)
        return "cpu"
    if count == 0:
        raise DeviceError(f"{key}={name}: torch sees no GPU on this machine; use {key}=cpu")
    if index >= count:
        names = ", ".join(f"cuda:{i}" for i in range(count))
        raise DeviceError(f"{key}={name}: this machine has cpu, {names}; choose one of them")
    return name
