"""The names of IsaacGymEnvs' `utils.wandb_utils`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from isaacgymenvs_lite.config.launch import LaunchSettings
from isaacgymenvs_lite.run.wandb_observer import WandbObserver
from isaacgymenvs_lite.schema import keys_of, plain, read_section
from isaacgymenvs_lite.utils.optional_packages import require


class WandbAlgoObserver(WandbObserver):
    """Opens a run of Weights & Biases with the agent's experiment name.

    The composed tree must have the keys wandb_project, wandb_entity, wandb_group, wandb_name, ...
    """

    def __init__(self, cfg: DictConfig | Mapping[str, Any]) -> None:
        require("wandb", "WandbAlgoObserver", otherwise="set wandb_activate=False")
        tree = plain(cfg if isinstance(cfg, DictConfig) else OmegaConf.create(dict(cfg)))
        keys = (key for key in keys_of(LaunchSettings) if key.startswith("wandb_") and key in tree)
        values = {"task_name": "", **{key: tree[key] for key in keys}}
        super().__init__(tree, read_section(LaunchSettings, values, where=""), run_name="")

    def before_init(self, base_name: str, config: dict[str, Any], experiment_name: str) -> None:
        """Open the run under the experiment's name."""
        self._run_name = experiment_name
        super().before_init(base_name, config, experiment_name)
