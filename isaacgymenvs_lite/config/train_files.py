"""Reads a train file without a task: for your own Runner or a low-level controller."""

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

# Folders of train files in the paths that files of IsaacGymEnvs and ASE have.
_PUBLISHED_FOLDERS = (("isaacgymenvs", "cfg", "train"), ("ase", "data", "cfg", "train", "rlg"))


def load_train_file(
    path: Path | str, num_envs: int | None = None, rl_device: str = "cpu"
) -> dict[str, Any]:
    """Read a train file for rl_games' Runner: `Runner.load` takes the result as it is.

    In addition to the interpolations (see `read_train_file`) it resolves what rl_games does not
    know: `device`, `seed: -1`, which is drawn, and `mixed_precision: auto`, which is measured.

    Args:
        path: see `read_train_file`.
        num_envs: value of `task.env.numEnvs`, to which minibatches are fitted; None: 1, and
            minibatches stay as written.
        rl_device: device of agent and player.

    Raises:
        ConfigError: there is no such train file, or it cannot be used.
    """
    from isaacgymenvs_lite.utils.precision import resolve_mixed_precision  # torch

    content = read_train_file(path, num_envs or 1, rl_device)
    params = content["params"]
    config = params.get("config")
    if not isinstance(config, dict):
        return content
    config["device"] = config["device_name"] = rl_device  # agents read one, players the other
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
    """Read a train file with its `${....task.env.numEnvs}` and the like resolved.

    The interpolations of a train file lead into a composed tree. Here it has the defaults of
    cfg/config.yaml, a task without asymmetric observations, and the given values.

    Args:
        path: a file, relative to the working directory or to the project's, or the name of a file
            in cfg/train, which `isaacgymenvs/cfg/train/<name>.yaml` (IsaacGymEnvs) and
            `ase/data/cfg/train/rlg/<name>.yaml` (ASE) mean, too. The config.yaml of a run folder
            holds the train file of that run, overrides included.
        num_envs: value of `task.env.numEnvs`.
        rl_device: value of `rl_device`.

    Raises:
        ConfigError: there is no such train file.
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
        raise ConfigError(f"{file} is no train file: expected a mapping below the key 'params'")
    return train


def compose_file(file: Path, group: str) -> DictConfig:
    """Return the tree of a task or train file alone, unresolved, with its defaults list merged."""
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
