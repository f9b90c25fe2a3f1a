"""Replaces rl_games' Runner in scripts written for another machine or another rl_games version.

`isaacgymenvs-lite alias` imports this module when a script imports `rl_games.torch_runner`.
"""

from __future__ import annotations

import logging
from typing import Any

from rl_games import torch_runner
from rl_games.algos_torch.model_builder import ModelBuilder

from isaacgymenvs_lite.config.launch import check_device

_PACKAGE = __name__.partition(".")[0]


class Runner(torch_runner.Runner):
    """A Runner with our agents, on a device that exists.

    Agents that a script registers take precedence over agents of this package. `device` and
    `device_name` of a train section are set to a device of this machine, so that the CPU may
    replace a GPU. The loggers of this package are enabled again, because published configurations
    disable all loggers that exist when Hydra starts.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        # `registration` imports this module, so that a global import would be circular.
        from isaacgymenvs_lite.registration import register_algorithms

        super().__init__(*args, **kwargs)
        register_algorithms(self)
        # Scripts for rl_games 1.1 register models and networks in a runner's factories.
        self.model_builder: Any = ModelBuilder()
        self.model_builder.network_factory = self.model_builder.network_builder.network_factory
        for name, logger in logging.Logger.manager.loggerDict.items():
            if name.startswith(_PACKAGE) and isinstance(logger, logging.Logger):
                logger.disabled = False

    def load_config(self, params: dict[str, Any]) -> None:
        """Load a train section after setting its devices to a device that exists."""
        config = params["config"]
        device = check_device(config.get("device", "cuda:0"), "rl_device")
        # Players and agents read different keys; IsaacGymEnvs' train.py sets only one key.
        config["device"], config["device_name"] = device, device
        super().load_config(params)


def __getattr__(name: str) -> Any:
    """Return an object of rl_games' module that this module does not define."""
    return getattr(torch_runner, name)
