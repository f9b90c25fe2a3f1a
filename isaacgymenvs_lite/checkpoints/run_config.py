"""Reads config.yaml in a run folder, which is the configuration of a checkpoint's training."""

from __future__ import annotations

import copy
import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from isaacgymenvs_lite.checkpoints.training_state import resume_file, run_of_file
from isaacgymenvs_lite.config.compose import changed_by, compose
from isaacgymenvs_lite.config.launch import LaunchSettings
from isaacgymenvs_lite.config.resolvers import register_resolvers
from isaacgymenvs_lite.config.rl_games_settings import UnitsSettings, scale_units
from isaacgymenvs_lite.config.run_names import TRAIN_DIR, train_dir_of
from isaacgymenvs_lite.config.staging import read_yaml
from isaacgymenvs_lite.errors import ConfigError, one_line
from isaacgymenvs_lite.schema import keys_of, read_keys, select

log = logging.getLogger(__name__)

SECTIONS = ("task.env", "train.params.network", "train.params.config")
"""Sections that the configuration of a run must have."""

# `resume=` reads only these keys from a run's config.yaml, which may come from somebody else. Keys
# that open a viewer, make a video or upload to W&B are not among them.
_OF_RUN = frozenset(
    (
        *("task", "train", "pbt", "task_name", "task_checkout", "experiment"),
        *("full_experiment_name", "checkpoint", "sigma", "num_envs", "max_iterations", "seed"),
        *("torch_deterministic", "sim_device", "rl_device", "pipeline", "num_threads"),
        *("physics_engine", "solver_type", "num_subscenes", "graphics_device_id"),
    )
)
_SWITCHES = ("wandb_activate", "viewer", "capture_video", "multi_gpu")
_RL_DEVICES = ("cpu", "cuda:0")
# Patterns of the hidden layers' parameter names in a model, by the section of the network.
_LAYERS = {
    "mlp": r"actor_mlp(?:\._dense_layers)?",
    "style": r"actor_mlp\._style_mlp",
    "disc": r"_disc_mlp",
}


def run_config_file(checkpoint: Path) -> Path:
    """Return the path of config.yaml in the run folder of a checkpoint."""
    return checkpoint.absolute().parent.parent / "config.yaml"


def read_run_config(
    file: Path, model: Mapping[str, Any], *, to_play: bool = False
) -> dict[str, Any]:
    """Return a run's configuration tree, resolved for the device type (CPU or GPU) of its training.

    Default networks depend on the device type, and this machine may have another one. The device
    type is inferred from the model's layers; the CPU is assumed if no type matches.

    `model` holds parameters by name, or is empty. If `to_play` is True, values are resolved for a
    play (`test=True`).
    """
    register_resolvers()
    stored = read_yaml(file)
    if to_play:
        stored.test = True
    trees = [_resolved(stored, device, file) for device in _RL_DEVICES]
    try:
        fitting = (
            tree
            for tree in trees
            if (units := units_of_config(tree)) == units_of_model(model, units)
        )
        return next(fitting, trees[0])
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from error


def resumed_tree(words: Sequence[str]) -> DictConfig:
    """Return the configuration tree of a resumed run, changed by the user's arguments.

    The arguments `words` contain `resume=last`, `resume=FOLDER` or `resume=FILE`, and settings that
    change. `task=` and `train=` select the runs that `last` searches. In the returned tree,
    `resume` is a file.
    """
    given = {word.partition("=")[0].lstrip("+"): word for word in words}
    for word in words:
        if word.startswith("-"):
            raise ConfigError(f"{word}: with resume= only settings can be given, as key=value")
    values = {key: word.partition("=")[2] for key, word in given.items()}
    groups = [given[key] for key in ("task", "train") if key in given]
    wanted: dict[str, str] = {}
    if groups:
        composed = compose(groups)
        paths = ("task.name", "train.params.network.name")
        wanted = {path: str(OmegaConf.select(composed, path)) for path in paths}
    file = resume_file(values["resume"], train_dir_of(words), wanted)
    stored = read_yaml(run_of_file(file) / "config.yaml")
    # Keys that are not stored get their defaults.
    defaults = vars(LaunchSettings(task_name=""))
    left = [key for key in _SWITCHES if stored.get(key) not in (None, defaults[key])]
    if left := [key for key in left if key not in values]:
        log.info("not taken over from the run, type again what you want: %s", ", ".join(left))
    for key in set(stored) - keys_of(LaunchSettings) - {"task", "train", "pbt"}:
        del stored[key]  # Only an earlier version of the project wrote this key.
    for key in defaults.keys() - _OF_RUN:
        stored[key] = defaults[key]
    settings = [
        word for key, word in given.items() if key not in ("task", "train", "resume", TRAIN_DIR)
    ]
    try:
        cfg = changed_by(stored, settings)
    except ConfigError as error:
        raise ConfigError(
            f"{error}; the arguments change settings of the run {run_of_file(file)}"
        ) from error
    with open_dict(cfg):
        # A policy that population-based training restarts begins from its checkpoint and not from
        # `resume`.
        cfg.resume = "" if "pbt_restart" in given else str(file)
        # The run folder is not read from config.yaml, because somebody else may have written the
        # file.
        OmegaConf.update(cfg, TRAIN_DIR, str(train_dir_of(words)), force_add=True)
    return cfg


def _resolved(stored: DictConfig, rl_device: str, file: Path) -> dict[str, Any]:
    cfg = stored.copy()
    cfg.rl_device = rl_device
    try:
        tree = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"{file}: {one_line(error)}") from error
    sections = [select(tree, path) for path in SECTIONS]
    if not isinstance(tree, dict) or not all(isinstance(s, dict) and s for s in sections):
        raise ConfigError(f"{file}: expected the sections {', '.join(SECTIONS)}")
    return {str(key): value for key, value in tree.items()}


def units_of_config(tree: dict[str, Any]) -> dict[str, list[int]]:
    """Return the sizes of hidden layers in a configuration, {"mlp": [...], "disc": [...]}."""
    network = select(tree, "train.params.network")
    sections = {name: network[name] for name in _LAYERS if network.get(name) is not None}
    for name, section in sections.items():
        read_keys(UnitsSettings, section, f"train.params.network.{name}")
    sections = copy.deepcopy(sections)
    scale_units(sections)
    return {name: section["units"] for name, section in sections.items()}


def units_of_model(model: Mapping[str, Any], names: Iterable[str]) -> dict[str, list[int]]:
    """Return the sizes of the hidden layers of networks `names`, given a model's parameters."""
    units: dict[str, dict[int, int]] = {name: {} for name in names}
    for name, layers in units.items():
        for key, weight in model.items():
            found = re.fullmatch(rf"a2c_network\.{_LAYERS[name]}\.(?:linears\.)?(\d+)\.weight", key)
            if found and weight.ndim == 2:
                layers[int(found[1])] = weight.shape[0]
    return {name: [layers[i] for i in sorted(layers)] for name, layers in units.items()}
