"""The model of the high-level policy: rl_games' Gaussian policy as it is."""

from __future__ import annotations

from typing import Any

from rl_games.algos_torch.models import BaseModel, ModelA2CContinuousLogStd


class ModelHRLContinuous(ModelA2CContinuousLogStd):
    """`model: name: continuous_hrl` or `hrl`; normalisers of observations and values inside it."""

    def __init__(self, network: Any) -> None:
        BaseModel.__init__(self, "hrl")
        self.network_builder = network
