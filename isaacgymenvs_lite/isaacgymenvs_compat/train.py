"""The names of IsaacGymEnvs' `train`."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig

from isaacgymenvs_lite.config.rl_games_settings import scale_units
from isaacgymenvs_lite.train import main


def launch_rlg_hydra(cfg: DictConfig | None = None) -> None:
    """Train or play a policy with the settings in `sys.argv` or in a composed tree."""
    if cfg is None:
        main()
        return
    from isaacgymenvs_lite.runner import run  # torch, MuJoCo and rl_games

    run(cfg)


def preprocess_train_config(cfg: DictConfig, config_dict: dict[str, Any]) -> dict[str, Any]:
    """Set a train section's device and run name, scale its MLP's units, and return the section."""
    pbt = cfg.pbt
    config_dict["params"]["config"] |= {
        "device": cfg.rl_device,
        "population_based_training": pbt.enabled,
        "pbt_idx": pbt.policy_idx if pbt.enabled else None,
        "full_experiment_name": cfg.get("full_experiment_name"),
    }
    scale_units(config_dict["params"]["network"])
    return config_dict
