"""Reads the configuration that a checkpoint was trained with: config.yaml in its run folder."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from isaacgymenvs_lite.config.expansion import check_expansion
from isaacgymenvs_lite.config.resolvers import register_resolvers
from isaacgymenvs_lite.config.rl_games_settings import scale_units
from isaacgymenvs_lite.config.yaml_files import read_yaml
from isaacgymenvs_lite.errors import ConfigError, one_line

SECTIONS = ("task.env", "train.params.network", "train.params.config")
"""Sections that the configuration of a run must have."""

_RL_DEVICES = ("cpu", "cuda:0")
# Hidden layers: section of the network -> pattern of the name in the model.
_LAYERS = {
    "mlp": r"actor_mlp(?:\._dense_layers)?",
    "style": r"actor_mlp\._style_mlp",
    "disc": r"_disc_mlp",
}


def run_config_file(checkpoint: Path) -> Path:
    """Return where the configuration of a checkpoint is, if it lies in a run folder."""
    return checkpoint.absolute().parent.parent / "config.yaml"


def read_run_config(file: Path, model: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's tree, resolved for the kind of device that it was trained on.

    The default networks depend on the device, and this machine may have another one: the layers of
    the model decide. If they match no device, the tree is resolved for the CPU.

    Args:
        file: config.yaml of a run folder.
        model: parameters by name; empty if they are not known.

    Raises:
        ConfigError: the file cannot be read, or is no configuration of a run.
    """
    register_resolvers()
    stored = read_yaml(file)
    check_expansion(stored)
    trees = [_resolved(stored, device, file) for device in _RL_DEVICES]
    return next((tree for tree in trees if has_units_of(tree, model)), trees[0])


def _resolved(stored: DictConfig, rl_device: str, file: Path) -> dict[str, Any]:
    cfg = stored.copy()
    cfg.rl_device = rl_device
    try:
        tree = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"{file}: {one_line(error)}") from error
    if not isinstance(tree, dict) or any(not select(tree, path) for path in SECTIONS):
        raise ConfigError(f"{file}: expected the sections {', '.join(SECTIONS)}")
    return {str(key): value for key, value in tree.items()}


def select(tree: Any, path: str) -> Any:
    """Return what is at `path` in nested dictionaries, None if nothing is."""
    for key in path.split("."):
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def has_units_of(tree: dict[str, Any], model: Mapping[str, Any]) -> bool:
    """Return whether the networks of a tree have the hidden layers of a model."""
    units = units_of_config(tree)
    return units == units_of_model(model, units)


def units_of_config(tree: dict[str, Any]) -> dict[str, list[int]]:
    """Return the hidden layers of the networks, {"mlp": [...], "disc": [...]}, of a tree."""
    network = copy.deepcopy(select(tree, "train.params.network"))
    scale_units(network)
    return {name: network[name]["units"] for name in _LAYERS if name in network}


def units_of_model(model: Mapping[str, Any], names: Iterable[str]) -> dict[str, list[int]]:
    """Return the same for the networks `names`, from the shapes of a model's parameters."""
    units: dict[str, dict[int, int]] = {name: {} for name in names}
    for name, layers in units.items():
        for key, weight in model.items():
            found = re.fullmatch(rf"a2c_network\.{_LAYERS[name]}\.(?:linears\.)?(\d+)\.weight", key)
            if found and weight.ndim == 2:
                layers[int(found[1])] = weight.shape[0]
    return {name: [layers[i] for i in sorted(layers)] for name, layers in units.items()}
