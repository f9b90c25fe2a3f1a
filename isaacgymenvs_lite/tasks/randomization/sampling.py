"""Random numbers of domain randomisation, as IsaacGymEnvs draws them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.randomization.settings import AttributeSettings, NoiseSettings
from isaacgymenvs_lite.utils.state import Stateful


def draw(settings: AttributeSettings, frame: int, shape: tuple[int, ...]) -> Tensor:
    """Return numbers of `shape` (float64) to add to values, or to multiply them by.

    Args:
        settings: distribution, operation, schedule and buckets.
        frame: simulator calls so far.
        shape: of the result.
    """
    factor = settings.factor(frame)
    scaling = settings.operation == "scaling"
    first, second = settings.range
    rest = 1.0 - factor if scaling else 0.0  # what does nothing
    if factor == 0.0:
        return torch.full(shape, rest, dtype=torch.float64)
    if settings.distribution == "gaussian":
        drawn = torch.randn(shape, dtype=torch.float64) * (factor * second) + factor * first + rest
    else:
        low, high = factor * first + rest, factor * second + rest
        share = torch.rand(shape, dtype=torch.float64)
        if settings.distribution == "uniform":
            drawn = low + (high - low) * share
        else:
            drawn = torch.exp(math.log(low) + (math.log(high) - math.log(low)) * share)
    return drawn if settings.num_buckets is None else bucketed(drawn, settings)


def bucketed(drawn: Tensor, settings: AttributeSettings) -> Tensor:
    """Return the numbers rounded down to the grid of buckets; those outside go to its ends."""
    first, second = settings.range
    low, high = first, second
    if settings.distribution == "gaussian":
        # As published, which takes the second number for a variance here.
        low, high = first - 2.0 * math.sqrt(second), first + 2.0 * math.sqrt(second)
    count = settings.num_buckets or 1
    width = (high - low) / count
    if width == 0.0:
        return torch.full_like(drawn, low)
    places = ((drawn - low) / width).floor().clamp(0, count - 1)
    return low + width * places


class Noise(Stateful):
    """Noise on rows of numbers: a part that is new at each call, and one that stays.

    Args:
        settings: distributions, operation and schedule.
    """

    def __init__(self, settings: NoiseSettings) -> None:
        self._settings = settings
        self._held: Tensor | None = None
        self.refresh(0)

    def refresh(self, frame: int) -> None:
        """Draw a new held part, with the parameters of `frame` simulator calls."""
        settings = self._settings
        factor = settings.factor(frame)
        first, second = (factor * value for value in settings.range)
        held_first, held_second = (factor * value for value in settings.range_correlated)
        if settings.operation == "scaling":
            rest = 1.0 - factor
            first, held_first = first + rest, held_first + rest
            if settings.distribution == "uniform":
                second, held_second = second + rest, held_second + rest
        self._fresh = (first, second)
        self._correlated = (held_first, held_second)
        self._held = None

    def __call__(self, values: Tensor) -> Tensor:
        """Return `values` (N, D) with noise on every number."""
        if self._held is None:
            self._held = torch.randn_like(values)
        (first, second), (held_first, held_second) = self._fresh, self._correlated
        if self._settings.distribution == "gaussian":
            noise = self._held * held_second + held_first
            noise += torch.randn_like(values).mul_(second).add_(first)
        else:
            # The held part of uniform noise is Gaussian, as published.
            noise = self._held * (held_second - held_first) + held_first
            noise += torch.rand_like(values).mul_(second - first).add_(first)
        return values + noise if self._settings.operation == "additive" else values * noise
