"""Finds the configuration that belongs to a checkpoint, for its export."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf, open_dict

from isaacgymenvs_lite.checkpoints.files import (
    checkpoint_of_tree,
    load_checkpoint,
    resolve_checkpoint,
)
from isaacgymenvs_lite.checkpoints.policy_arguments import as_override, complete_arguments
from isaacgymenvs_lite.checkpoints.run_config import read_run_config, run_config_file
from isaacgymenvs_lite.config.compose import changed_by, compose
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import shipped_policies
from isaacgymenvs_lite.schema import plain

log = logging.getLogger(__name__)

_NUM_ENVS = 2
# Settings of the training that an export replaces.
_PLAIN = {
    "test": True,
    "num_envs": _NUM_ENVS,
    "num_threads": 1,
    "rl_device": "cpu",
    "sim_device": "cpu",
    "pipeline": "cpu",
    "multi_gpu": False,
    "headless": True,
    "force_render": False,
    "viewer": "",
    "capture_video": False,
    "wandb_activate": False,
    "seed": 1,
    "torch_deterministic": False,
    "latent": "",
    "sigma": "",
    "experiment": "",
}


def configuration_of(checkpoint: str, overrides: Sequence[str], runs: str) -> DictConfig:
    """Return the tree that a policy is played with, on the CPU, in a few environments.

    A shipped policy holds its settings, a checkpoint in a run folder belongs to the config.yaml
    there. With `train=`, or `task=` of another task, the tree is composed anew.

    Args:
        checkpoint: a path, `last`, or the name of a shipped policy. `last` is the newest of all
            runs, or, as in train.py, of the task and train file that the overrides name.
        overrides: of the configuration, as on the command line of train.py.
        runs: folder of the runs that `last` looks at.

    Raises:
        UserError: there is no such checkpoint, or the configuration cannot be read or composed.
    """
    if not checkpoint:
        raise ConfigError(
            "checkpoint= is missing; give a .pth file of a run, 'last', or a shipped policy:"
            f" {', '.join(shipped_policies())}"
        )
    typed = dict(word.split("=", 1) for word in overrides if "=" in word)
    is_shipped = checkpoint in shipped_policies()
    # What train.py would play with these words: it decides the task, and what `last` means.
    composes = "task" in typed or (checkpoint == "last" and "train" in typed)
    composed = compose(overrides) if composes else None
    if composed is None or is_shipped:
        path = resolve_checkpoint(checkpoint, runs, "")
    else:
        path = checkpoint_of_tree(plain(composed), checkpoint, runs)
    file = run_config_file(Path(path))
    if not is_shipped and file.is_file() and "train" not in typed:
        model = load_checkpoint(path).get("model", {})
        cfg = OmegaConf.create(read_run_config(file, model, to_play=True))
        if composed is None or composed.task.name == cfg.task.name:
            log.info("task and train settings: %s", file)
            words = [word for word in overrides if not word.startswith("task=")]
            return _for_export(changed_by(cfg, words), path)
    named = checkpoint if is_shipped else as_override(path)
    words = complete_arguments(["test=True", f"checkpoint={named}", *overrides])
    return _for_export(compose(words), path)


def _for_export(cfg: DictConfig, path: str) -> DictConfig:
    with open_dict(cfg):
        for key, value in {**_PLAIN, "checkpoint": path}.items():
            cfg[key] = value
        cfg.task.env.numEnvs = _NUM_ENVS
    return cfg
