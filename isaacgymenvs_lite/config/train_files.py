"""Reads a train file without a task, for the Runner of a user or for a low-level controller."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from isaacgymenvs_lite.config.compose import compose, explain_interpolation
from isaacgymenvs_lite.config.launch import resolve_seed
from isaacgymenvs_lite.config.staging import read_yaml
from isaacgymenvs_lite.config.train_params import complete_ppo
from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.paths import PARTS, cfg_dir, user_path

# IsaacGymEnvs and ASE name their train files by paths in these folders.
_PUBLISHED_FOLDERS = (("isaacgymenvs", "cfg", "train"), ("ase", "data", "cfg", "train", "rlg"))


def load_train_file(
    path: Path | str, num_envs: int | None = None, rl_device: str = "cpu"
) -> dict[str, Any]:
    """Read a train file and return the argument of rl_games' `Runner.load`.

    In addition to `read_train_file` the function sets the device, draws a seed for `seed: -1` and
    measures which precision is faster for `mixed_precision: auto`.

    Args:
        path: see `read_train_file`.
        num_envs: value of `task.env.numEnvs`, to which minibatches are fitted. If it is None, the
            task has 1 environment and the minibatches keep the sizes in the file.
        rl_device: device of agent and player.

    Raises:
        ConfigError: the file does not exist or cannot be used.
    """
    from isaacgymenvs_lite.utils.precision import resolve_mixed_precision  # torch

    content = read_train_file(path, num_envs or 1, rl_device)
    params = content["params"]
    config = params.get("config")
    if not isinstance(config, dict):
        return content
    # Agents read `device`, players read `device_name`.
    config["device"] = config["device_name"] = rl_device
    config.setdefault("reward_shaper", {})
    if params.get("seed") == -1:
        params["seed"] = resolve_seed(-1)
    if config.get("mixed_precision") == "auto":
        config["mixed_precision"] = resolve_mixed_precision("auto", rl_device)
    config.setdefault("num_actors", 1)
    if num_envs is not None:
        config["num_actors"] = num_envs
        if "horizon_length" in config:
            complete_ppo(params, num_envs)
    return content


def read_train_file(path: Path | str, num_envs: int = 1, rl_device: str = "cpu") -> dict[str, Any]:
    """Read a train file and resolve its interpolations, for example `${....task.env.numEnvs}`.

    The interpolations refer to a tree with the defaults of cfg/config.yaml, a task without
    asymmetric observations, and the given values.

    Args:
        path: a path relative to the working directory or to this project, or the name of a file in
            cfg/train. `isaacgymenvs/cfg/train/<name>.yaml` (IsaacGymEnvs) and
            `ase/data/cfg/train/rlg/<name>.yaml` (ASE) also mean the file in cfg/train. The
            config.yaml of a run folder contains the train file of this run with its overrides.
        num_envs: value of `task.env.numEnvs`.
        rl_device: value of `rl_device`.

    Raises:
        ConfigError: the file does not exist or cannot be used.
    """
    file = _find(path)
    content = read_yaml(file)
    if "params" not in content and "train" in content:
        tree = OmegaConf.merge(content, {"rl_device": rl_device})
    else:
        tree = compose(
            [
                *("task=Cartpole", f"train={file}", f"num_envs={num_envs}"),
                *(f"rl_device={rl_device}", "++task.env.asymmetric_observations=False"),
            ],
            trains=False,
        )
    try:
        train: Any = OmegaConf.to_container(OmegaConf.select(tree, "train"), resolve=True)
    except OmegaConfBaseException as error:
        raise explain_interpolation(error) from error
    if not isinstance(train, dict) or not isinstance(train.get("params"), dict):
        raise ConfigError(f"{file} is not a train file: expected a mapping below the key 'params'")
    return train


def compose_file(file: Path, group: str) -> DictConfig:
    """Return the unresolved section of a task or train file, with its defaults list merged."""
    task, train = {"task": (file, "CartpolePPO"), "train": ("Cartpole", file)}[group]
    section: DictConfig = compose([f"task={task}", f"train={train}"], trains=False)[group]
    return section


def _find(path: Path | str) -> Path:
    """Return the train file that `path` names."""
    file = user_path(path)
    if file.is_file():
        return file
    folder = cfg_dir() / "train"
    if file.name == str(path):
        named = folder / f"{file.stem}.yaml"
        if named.is_file():
            return named
        names = [other.stem for other in folder.glob("*.yaml") if other.stem not in PARTS]
        raise ConfigError(unknown("train file", str(path), names, "or give the path of a file"))
    in_project = cfg_dir().parent / file
    in_package = folder / file.name
    if in_project.is_file():
        return in_project
    if file.parts[:-1] in _PUBLISHED_FOLDERS and in_package.is_file():
        return in_package
    raise ConfigError(
        f"the train file '{path}' does not exist (looked in {Path.cwd()}, {cfg_dir().parent})"
    )
