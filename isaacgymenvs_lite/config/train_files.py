"""Reads a train file without a task: for your own Runner or a low-level controller."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from isaacgymenvs_lite.config.expansion import check_expansion
from isaacgymenvs_lite.config.launch import resolve_seed
from isaacgymenvs_lite.config.resolvers import register_resolvers
from isaacgymenvs_lite.config.train_params import fit_to_envs, set_device
from isaacgymenvs_lite.config.yaml_files import read_yaml
from isaacgymenvs_lite.errors import ConfigError, one_line, unknown
from isaacgymenvs_lite.paths import PARTS, cfg_dir, user_path
from isaacgymenvs_lite.schema import plain

_MAX_FILES = 50
# Folders of train files in the paths that files of IsaacGymEnvs and ASE have.
_PUBLISHED_FOLDERS = (("isaacgymenvs", "cfg", "train"), ("ase", "data", "cfg", "train", "rlg"))


def load_train_file(
    path: Path | str, num_envs: int | None = None, rl_device: str = "cpu"
) -> dict[str, Any]:
    """Read a train file for rl_games' Runner: `Runner.load` takes the result as it is.

    Beside the interpolations (see `read_train_file`) it resolves what rl_games does not know:
    `device` and `device_name` are `rl_device`, `seed: -1` is drawn, and `mixed_precision: auto` is
    measured. With `num_envs` the minibatches are fitted to it, with a line of the log.

    Args:
        path: see `read_train_file`.
        num_envs: value of `task.env.numEnvs`; None: 1, and minibatches stay as written.
        rl_device: device of agent and player.

    Returns:
        The file's content with its one key, "params".

    Raises:
        ConfigError: there is no such file, it cannot be read, it is no train file, or a value
            cannot be used.
    """
    from isaacgymenvs_lite.utils.precision import resolve_mixed_precision  # torch

    content = read_train_file(path, num_envs or 1, rl_device)
    params = content["params"]
    config = params.get("config")
    if not isinstance(config, dict):
        return content
    set_device(config, rl_device)
    config.setdefault("reward_shaper", {})
    if params.get("seed") == -1:
        params["seed"] = resolve_seed(-1)
    if config.get("mixed_precision") == "auto":
        config["mixed_precision"] = resolve_mixed_precision("auto", rl_device)
    config.setdefault("num_actors", 1)
    if num_envs is not None:
        config["num_actors"] = num_envs
        fit_to_envs(params, num_envs)
    return content


def read_train_file(path: Path | str, num_envs: int = 1, rl_device: str = "cpu") -> dict[str, Any]:
    """Read a train file with its `${....task.env.numEnvs}` and the like resolved.

    The interpolations of a train file lead into a composed tree. Here it has the defaults of
    cfg/config.yaml, a task without asymmetric observations, and the given values.

    Args:
        path: a file, relative to the working directory or to the project's, or the name of one in
            cfg/train. `isaacgymenvs/cfg/train/<name>.yaml` of IsaacGymEnvs' files and
            `ase/data/cfg/train/rlg/<name>.yaml` of ASE's mean the last. The config.yaml of a run
            folder holds the train file of that run, overrides included.
        num_envs: value of `task.env.numEnvs`.
        rl_device: value of `rl_device`.

    Returns:
        The file's content with its one key, "params".

    Raises:
        ConfigError: there is no such file, it cannot be read, or it is no train file.
    """
    register_resolvers()
    file = _find(path)
    root = read_yaml(cfg_dir() / "config.yaml")
    for key in ("defaults", "hydra"):
        root.pop(key, None)
    content = merge_defaults(file)
    if "params" not in content and "train" in content:
        tree = OmegaConf.merge(content, {"rl_device": rl_device})
    else:
        env = {"numEnvs": num_envs, "asymmetric_observations": False}
        task = {"name": "", "env": env}
        own = {"num_envs": num_envs, "rl_device": rl_device, "task": task, "train": content}
        tree = OmegaConf.merge(root, own)
    check_expansion(tree)
    content = plain(tree.train)
    if not isinstance(content, dict) or not isinstance(content.get("params"), dict):
        raise ConfigError(f"{file} is no train file: expected a mapping below the key 'params'")
    return content


def _find(path: Path | str, group: str = "train") -> Path:
    """Return the train file that `path` names, or the file of another group."""
    file = user_path(path)
    if file.is_file():
        return file
    folder = cfg_dir() / group
    if file.name == str(path):
        named = folder / f"{file.stem}.yaml"
        if named.is_file():
            return named
        names = [other.stem for other in folder.glob("*.yaml") if other.stem not in PARTS]
        raise ConfigError(unknown(f"{group} file", str(path), names, "or give the path of a file"))
    in_project = cfg_dir().parent / file
    in_package = folder / file.name
    if in_project.is_file():
        return in_project
    if file.parts[:-1] in _PUBLISHED_FOLDERS and in_package.is_file():
        return in_package
    raise ConfigError(
        f"the {group} file '{path}' does not exist (looked in {Path.cwd()}, {cfg_dir().parent})"
    )


def merge_defaults(
    file: Path,
    above: tuple[Path, ...] = (),
    group: str = "train",
    read: list[Path] | None = None,
) -> DictConfig:
    """Read `file` and merge the files of its defaults list, in the order given there.

    Args:
        file: a train or task file.
        above: the files whose lists led here.
        group: folder of cfg/ with the files that a list may name beside those next to `file`.
        read: the files that were read before; this one is added. Each may be named by many.

    Raises:
        ConfigError: the list names itself in a circle, or an entry is not the name of a file.
    """
    read = [] if read is None else read
    if file in above:
        raise ConfigError(f"the defaults lists of {', '.join(map(str, above))} run in a circle")
    read.append(file)
    if len(read) > _MAX_FILES:
        raise ConfigError(
            f"the defaults lists of {read[0]} name more than {_MAX_FILES} files, repeats included;"
            " expected fewer"
        )
    content = read_yaml(file)
    defaults = plain(content.pop("defaults", None) or [])
    if not isinstance(defaults, list):
        raise ConfigError(f"{file}: defaults: got {defaults!r}, expected a list of file names")
    if "_self_" not in defaults:
        defaults.append("_self_")
    merged = OmegaConf.create()
    for entry in defaults:
        if not isinstance(entry, str):
            raise ConfigError(f"{file}: the entry {entry} of its defaults list is no file name")
        try:
            part = content
            if entry != "_self_":
                named = _named_beside(file, entry, group)
                part = merge_defaults(named, (*above, file), group, read)
            merged.merge_with(part)
        except (OmegaConfBaseException, OSError) as error:  # a name may be too long for a file
            raise ConfigError(f"{file}: defaults: {entry}: {one_line(error)}") from error
    return merged


def _named_beside(file: Path, entry: str, group: str) -> Path:
    """Return the file that an entry of a defaults list means."""
    beside = file.with_name(f"{entry}.yaml")
    return beside if beside.is_file() else _find(entry, group)
