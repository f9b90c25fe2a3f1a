"""The model of the high-level policy, which is rl_games' Gaussian policy model."""

from __future__ import annotations

from typing import Any

from rl_games.algos_torch.models import BaseModel, ModelA2CContinuousLogStd


class ModelHRLContinuous(ModelA2CContinuousLogStd):
    """`model: name: continuous_hrl` or `hrl`; it contains the normalisers."""

    def __init__(self, network: Any) -> None:
        BaseModel.__init__(self, "hrl")
        self.network_builder = network
