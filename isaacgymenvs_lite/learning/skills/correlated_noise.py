"""Exploration noise that is correlated in time, so that an exploratory action has an effect.

Independent noise on a latent selects another skill six times a second, and none is carried out.
Hollenstein et al. 2024, "Colored Noise in PPO" (arXiv 2312.11091), with a first-order
autoregressive process in place of their coloured one.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from isaacgymenvs_lite.utils.state import Stateful


class CorrelatedNoise(Stateful):
    """Makes the noise of a Gaussian policy a process in time; each sample stays standard normal.

    Args:
        correlation: of the noise of two steps that follow each other, 0 to below 1. PPO's
            probability of an action still assumes independent noise, as in the paper.
    """

    stored = ("_last",)

    def __init__(self, correlation: float) -> None:
        self._correlation = correlation
        self._last: Tensor | None = None

    def apply(self, actions: Tensor, mus: Tensor, sigmas: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions (N, A) and their negative log probabilities (N,) under the policy.

        Args:
            actions: mus + sigmas * standard normal noise.
            mus: mean actions (N, A).
            sigmas: standard deviations (N, A).
        """
        noise = (actions - mus) / sigmas
        if self._last is not None:
            rho = self._correlation
            noise = rho * self._last + math.sqrt(1.0 - rho * rho) * noise
        self._last = noise
        constant = 0.5 * math.log(2.0 * math.pi) * noise.shape[-1]
        neglogp = 0.5 * noise.square().sum(dim=-1) + torch.log(sigmas).sum(dim=-1) + constant
        return mus + sigmas * noise, neglogp
