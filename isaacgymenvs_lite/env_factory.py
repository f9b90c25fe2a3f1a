"""Makes tasks from arguments or from a composed tree."""

from __future__ import annotations

import copy
import os
import random
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, open_dict

from isaacgymenvs_lite.checkpoints.run_config import read_run_config, run_config_file
from isaacgymenvs_lite.config.compose import compose, compose_task
from isaacgymenvs_lite.config.launch import (
    check_device,
    check_device_name,
    read_config,
    resolve_seed,
)
from isaacgymenvs_lite.config.staging import (
    CHECKOUT_KEY,
    checkout_of,
    clip_folders,
    model_folders,
)
from isaacgymenvs_lite.config.train_params import ISAAC_LAB_ACTIONS
from isaacgymenvs_lite.errors import ConfigError, MotionFileError
from isaacgymenvs_lite.motion.formats.deepmimic import is_package_name
from isaacgymenvs_lite.motion.loader import resolve_motion_file
from isaacgymenvs_lite.paths import assets_dir, user_path
from isaacgymenvs_lite.rendering.display import check_display
from isaacgymenvs_lite.rendering.gl import ensure_gl
from isaacgymenvs_lite.schema import plain, select
from isaacgymenvs_lite.tasks import find_task
from isaacgymenvs_lite.tasks.base.assets import shipped_assets
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.tasks.registry import TaskMaker
from isaacgymenvs_lite.utils.threads import limit_torch_threads, threads_for_envs
from isaacgymenvs_lite.viewers.window import Window

_DETERMINISM: Any = torch.utils.deterministic


def make_task(
    *,
    seed: int,
    task: str,
    num_envs: int | str,
    sim_device: str,
    rl_device: str,
    graphics_device_id: int,
    headless: bool,
    multi_gpu: bool,
    virtual_screen_capture: bool,
    force_render: bool,
    cfg: DictConfig | None,
) -> VecTask:
    """Make a task; see `isaacgymenvs_lite.make`."""
    check_device_name(sim_device, "sim_device")
    rl_device = check_device(rl_device, "rl_device")
    if cfg is None:
        cfg = compose_task(
            task,
            [
                f"num_envs={num_envs}" if num_envs != "" else "num_envs=''",
                f"seed={seed}",
                f"sim_device={sim_device}",
                f"rl_device={rl_device}",
                f"graphics_device_id={graphics_device_id}",
                f"headless={headless}",
                f"multi_gpu={multi_gpu}",
                f"force_render={force_render}",
            ],
        )
    else:
        cfg = _with_checkout(cfg)
    config = read_config(cfg)
    settings = config.settings
    seed_everything(resolve_seed(settings.seed, settings.torch_deterministic))
    # Capturing frames needs no display, although it needs one in Isaac Gym.
    opens_window = not headless and not virtual_screen_capture
    if opens_window:
        check_display()
    if virtual_screen_capture:
        ensure_gl()
    env = make_from_config(
        config.tree,
        sim_device=sim_device,
        rl_device=rl_device,
        graphics_device_id=graphics_device_id,
        headless=headless,
        virtual_screen_capture=virtual_screen_capture,
        force_render=force_render,
    )
    if opens_window:
        # The program ends when its window is closed, as in Isaac Gym.
        env.listeners.append(Window(env, Path("videos"), sys.exit, every_step=force_render))
    limit_torch_threads(env, threads_for_envs(env.num_envs), settings.num_threads)
    return env


def _with_checkout(cfg: DictConfig) -> DictConfig:
    """Add the checkout of the task file to a tree that a script of another project composed.

    The tree lacks the key `task_checkout`, and its task file names clips in the checkout of the
    file.
    """
    if CHECKOUT_KEY in cfg or not HydraConfig.initialized():
        return cfg
    runtime = HydraConfig.get().runtime
    (folder,) = (source.path for source in runtime.config_sources if source.provider == "main")
    task_file = Path(folder, "task", f"{runtime.choices.get('task')}.yaml").resolve()
    if not task_file.is_file():
        return cfg
    cfg = cfg.copy()
    with open_dict(cfg):
        cfg[CHECKOUT_KEY] = str(checkout_of(task_file))
    return cfg


def make_from_config(
    cfg: Mapping[Any, Any],
    *,
    sim_device: str,
    rl_device: str,
    graphics_device_id: int = -1,
    headless: bool = True,
    virtual_screen_capture: bool = False,
    force_render: bool = False,
) -> VecTask:
    """Make the task of a composed tree, whose interpolations may be resolved or not.

    Raises:
        ConfigError: `cfg.task.name` is unknown, or a key or value of the task is wrong.
        MotionFileError: a motion clip cannot be used.
    """
    tree = plain(cfg)
    task_cfg: Any = copy.deepcopy(tree["task"])
    maker = find_task(str(task_cfg["name"]))
    if checkout := tree.get(CHECKOUT_KEY):
        _find_files(task_cfg["env"], user_path(checkout).absolute(), maker)
    task = maker(
        cfg=task_cfg,
        rl_device=rl_device,
        sim_device=sim_device,
        graphics_device_id=graphics_device_id,
        headless=headless,
        virtual_screen_capture=virtual_screen_capture,
        force_render=force_render,
    )
    if limit := select(tree, ISAAC_LAB_ACTIONS):
        # rl_games scales actions to the limits of this space, as it does with Isaac Lab's wrapper.
        task.act_space = gymnasium.spaces.Box(-limit, limit, task.act_space.shape, np.float32)
    return task


def model_of_recording(file: Path, words: Sequence[str]) -> mujoco.MjModel:
    """Return the model of a diverged simulation, for `simulation.replay`.

    Args:
        file: `<run>/diverged/<name>.npz`.
        words: settings such as `["task=Ant", "task.sim.dt=0.02"]`; if there are none, the run's
            config.yaml is read.

    Raises:
        ConfigError: no task is named, or its configuration cannot be used.
    """
    config = run_config_file(file)
    if words:
        tree = plain(compose([*words, "num_envs=1"]))
    elif config.is_file():
        tree = read_run_config(config, {})
        tree["task"]["env"]["numEnvs"] = 1
    else:
        raise ConfigError(
            f"{file}: the task is unknown; expected a file in <run>/diverged/ of a run with its"
            " config.yaml, or the settings of the training after FILE: task=Ant"
        )
    seed_everything(max(0, int(tree.get("seed") or 0)))
    task = make_from_config(tree, sim_device="cpu", rl_device="cpu")
    task.close()
    return task.simulation.model


def _find_files(env: dict[str, Any], checkout: Path, maker: TaskMaker) -> None:
    """Replace the names of clip and model in the section `task.env` by paths, in place.

    The search covers the working folder, the checkout of the task file, and this project's files.

    Raises:
        MotionFileError: the clip was not found; the message lists the searched folders.
        ConfigError: the model was not found; the message lists the searched folders.
    """
    clip = env.get("motion_file")
    if isinstance(clip, str) and clip and not is_package_name(clip):
        folders = [Path(), *clip_folders(checkout, clip)]
        try:
            env["motion_file"] = str(Path(resolve_motion_file(clip, folders)).absolute())
        except MotionFileError as error:
            message = _of_sword_humanoid(env, checkout) or error
            raise MotionFileError(f"task.env.motion_file: {message}") from error
    asset = env.get("asset")
    if isinstance(asset, dict) and isinstance(asset.get("assetFileName"), str):
        folder = _folder_of_model(asset, checkout, getattr(maker, "published_assets", ()))
        if folder is not None:
            asset["assetRoot"] = str(folder)


def _of_sword_humanoid(env: dict[str, Any], checkout: Path) -> str:
    """Return a hint for a missing clip if the model is ASE's humanoid with a sword, else ''."""
    asset = env.get("asset")
    model = str(asset.get("assetFileName")) if isinstance(asset, dict) else ""
    if Path(model).name != "amp_humanoid_sword_shield.xml":
        return ""
    return (
        f"'{env['motion_file']}' is not in {checkout}; give a clip or a dataset of the humanoid"
        " with sword and shield (ASE's are not shipped), or deepmimic:walk; the shipped clips are"
        " for the humanoid without weapons: task.env.motion_file=locomotion.yaml"
        " task.env.asset.assetFileName=mjcf/amp_humanoid.xml"
        " 'task.env.keyBodies=[right_hand,left_hand,right_foot,left_foot]'"
    )


def _folder_of_model(
    asset: dict[str, Any], checkout: Path, published: Collection[str]
) -> Path | None:
    """Return the folder of a model in a checkout, or None for a model of this project."""
    name, root = asset["assetFileName"], str(asset.get("assetRoot") or "")
    # Path.is_file would raise for a name that is too long.
    ours = not name or os.path.isfile(assets_dir() / name) or name in published
    if ours or os.path.isfile(Path(root) / name):
        return None
    folders = [] if ".." in Path(name).parts else model_folders(checkout, root)
    for folder in folders:
        if os.path.isfile(folder / name):
            return folder
    searched = ", ".join(str(folder.absolute()) for folder in (Path(root), *folders, assets_dir()))
    raise ConfigError(
        f"task.env.asset.assetFileName='{name}': no such file in {searched}; shipped:"
        f" {shipped_assets()}"
    )


def seed_everything(seed: int, torch_deterministic: bool = False) -> None:
    """Seed Python, numpy and torch; `torch_deterministic` also forbids nondeterministic kernels."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    torch.cuda.manual_seed_all(seed)
    if torch_deterministic:
        torch.use_deterministic_algorithms(True)
        # Filling new tensors (torch's default in this mode) takes a twentieth of a training's time.
        _DETERMINISM.fill_uninitialized_memory = False
        torch.backends.cudnn.benchmark = False
        torch.backends.cudnn.deterministic = True


@contextmanager
def torch_settings_kept() -> Iterator[None]:
    """At the end restore the settings of torch that `seed_everything` and rl_games change.

    The state of the random generators is not restored.
    """
    cudnn: Any = torch.backends.cudnn
    is_deterministic = torch.are_deterministic_algorithms_enabled()
    warns_only = torch.is_deterministic_algorithms_warn_only_enabled()
    precision = torch.get_float32_matmul_precision()
    former = cudnn.benchmark, cudnn.deterministic, _DETERMINISM.fill_uninitialized_memory
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(is_deterministic, warn_only=warns_only)
        torch.set_float32_matmul_precision(precision)
        cudnn.benchmark, cudnn.deterministic, _DETERMINISM.fill_uninitialized_memory = former
