# pyright: reportMissingImports=false
"""Networks of skrl's agents: a Gaussian policy and a critic, without layers in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from torch import Tensor, nn


def mlp(inputs: int, units: Sequence[int], outputs: int, activation: type[nn.Module]) -> nn.Module:
    """Return layers with an activation after each but the last."""
    layers: list[nn.Module] = []
    for size in units:
        layers += [nn.Linear(inputs, size), activation()]
        inputs = size
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


class GaussianPolicy(GaussianMixin, Model):
    """Mean actions of observations (n, F); a log standard deviation of its own for each action.

    Args:
        units: of the hidden layers.
        activation: of the hidden layers.
        initial_log_std: of all actions.
        spaces: observation_space, state_space, action_space and device.
    """

    def __init__(
        self,
        units: Sequence[int],
        activation: type[nn.Module],
        initial_log_std: float,
        **spaces: Any,
    ) -> None:
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self, clip_actions=False)
        self.layers = mlp(self.num_observations, units, self.num_actions, activation)
        self.log_std_parameter = nn.Parameter(torch.full((self.num_actions,), initial_log_std))

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[Tensor, dict[str, Any]]:
        """Return mean actions (n, A) and the log standard deviation (A,)."""
        del role
        return self.layers(inputs["observations"]), {"log_std": self.log_std_parameter}


class Critic(DeterministicMixin, Model):
    """The value of states (n, S), or of observations (n, F) where a task has no states.

    Args:
        units: of the hidden layers.
        activation: of the hidden layers.
        spaces: observation_space, state_space, action_space and device.
    """

    def __init__(self, units: Sequence[int], activation: type[nn.Module], **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self._seen = "observations" if self.state_space is None else "states"
        inputs = self.num_observations if self.state_space is None else self.num_states
        self.layers = mlp(inputs, units, 1, activation)

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[Tensor, dict[str, Any]]:
        """Return values (n, 1)."""
        del role
        return self.layers(inputs[self._seen]), {}
