"""rl_games' Runner of a script that was written for another machine and another rl_games."""

from __future__ import annotations

import logging
from typing import Any

from rl_games.algos_torch.model_builder import ModelBuilder
from rl_games.torch_runner import Runner

from isaacgymenvs_lite.config.launch import check_device
from isaacgymenvs_lite.registration import register_algorithms, register_networks

_original_init = Runner.__init__
_original_load_config = Runner.load_config


def adapt_runner() -> None:
    """Give every Runner of this process our agents, and a device that exists.

    Names that a script registers itself win. A train section gets `device` and `device_name` of
    this machine, where the CPU may replace a GPU. The loggers of this package are enabled again:
    published configurations disable all loggers that exist when Hydra starts.
    """
    register_networks()
    Runner.__init__ = _init
    Runner.load_config = _load_config


def _init(self: Runner, *args: Any, **kwargs: Any) -> None:
    _original_init(self, *args, **kwargs)
    register_algorithms(self)
    # Where scripts for rl_games 1.1 register models and networks.
    builder: Any = ModelBuilder()
    builder.network_factory = builder.network_builder.network_factory
    vars(self)["model_builder"] = builder
    package = __name__.partition(".")[0]
    for name, logger in logging.Logger.manager.loggerDict.items():
        if name.startswith(package) and isinstance(logger, logging.Logger):
            logger.disabled = False


def _load_config(self: Runner, params: dict[str, Any]) -> None:
    config = params["config"]
    device = check_device(config.get("device", "cuda:0"), "rl_device")
    # Players read another key than agents, which IsaacGymEnvs' train.py does not set.
    config["device"], config["device_name"] = device, device
    _original_load_config(self, params)
