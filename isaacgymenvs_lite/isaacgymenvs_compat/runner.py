"""rl_games' Runner for a script that was written for another machine and another rl_games.

`isaacgymenvs-lite alias` imports this module where a script says `rl_games.torch_runner`.
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

    Names that a script registers itself win. A train section gets `device` and `device_name` of
    this machine, where the CPU may replace a GPU. The loggers of this package are enabled again:
    published configurations disable all loggers that exist when Hydra starts.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        # Not at the top: `registration` imports `rl_games.torch_runner`, which is this module.
        from isaacgymenvs_lite.registration import register_algorithms

        super().__init__(*args, **kwargs)
        register_algorithms(self)
        # Scripts for rl_games 1.1 register models and networks there.
        self.model_builder: Any = ModelBuilder()
        self.model_builder.network_factory = self.model_builder.network_builder.network_factory
        for name, logger in logging.Logger.manager.loggerDict.items():
            if name.startswith(_PACKAGE) and isinstance(logger, logging.Logger):
                logger.disabled = False

    def load_config(self, params: dict[str, Any]) -> None:
        """Load a train section, as rl_games does, with a device that exists."""
        config = params["config"]
        device = check_device(config.get("device", "cuda:0"), "rl_device")
        # Players read another key than agents, and IsaacGymEnvs' train.py sets only one of them.
        config["device"], config["device_name"] = device, device
        super().load_config(params)


def __getattr__(name: str) -> Any:
    """Return the other names of rl_games' module."""
    return getattr(torch_runner, name)
