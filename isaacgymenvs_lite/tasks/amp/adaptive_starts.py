"""Starts episodes where the policy fails: more practice at the moments that need it.

Episodes that start just before a take-off or a landing end soon, and teach what the others need
later. Peng et al. 2018, "DeepMimic" (arXiv 1804.02717), start anywhere in a clip; that the share of
a moment grows with its failures is common practice in motion tracking (Luo et al. 2023, "PHC",
arXiv 2305.06456, by clips).
"""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.utils.state import Stateful

_BIN_S = 0.1
# Weight of an episode in the failure rate of its bin.
_UPDATE = 0.02


class AdaptiveStarts(Stateful):
    """Draws moments of clips by how often episodes that start there fail soon.

    Clips are cut into bins of a tenth of a second. At first all moments are equal.

    Args:
        lengths_s: (M,) of the clips.
        weights: (M,) how often each clip is drawn, sum 1.
        soon_steps: control steps; a failure in them is one of the start.
    """

    stored = ("failure_rate",)

    def __init__(self, lengths_s: Tensor, weights: Tensor, soon_steps: int) -> None:
        counts = (lengths_s / _BIN_S).ceil().long().clamp(min=1)
        self._counts = counts
        self._first = counts.cumsum(0) - counts
        clips = torch.arange(len(counts), device=counts.device)
        self._clip = clips.repeat_interleave(counts)
        self._width_s = (lengths_s / counts)[self._clip]
        place = torch.arange(len(self._clip), device=counts.device) - self._first[self._clip]
        self._start_s = place * self._width_s
        self._share = weights.to(self._width_s)[self._clip] / counts[self._clip]
        self._soon_steps = soon_steps
        self.failure_rate = torch.full_like(self._start_s, 0.5)
        """(B,) of the episodes that started in each bin, the newest count most."""

    def draw(self, n: int) -> tuple[Tensor, Tensor]:
        """Return clips (n,) and times (n,) s."""
        weights = self._share * self.failure_rate
        if not bool(weights.sum() > 0):
            weights = self._share
        bins = torch.multinomial(weights, n, replacement=True)
        within = torch.rand(n, device=bins.device)
        return self._clip[bins], self._start_s[bins] + within * self._width_s[bins]

    def bins_of(self, motion_ids: Tensor, times_s: Tensor) -> Tensor:
        """Return the bins (n,) of moments (n,)."""
        place = (times_s / self._width_s[self._first[motion_ids]]).long()
        return self._first[motion_ids] + torch.minimum(place, self._counts[motion_ids] - 1)

    def count(self, bins: Tensor, steps: Tensor, failed: Tensor) -> None:
        """Take in episodes that ended; those that were cut off early do not count.

        Args:
            bins: (n,) where they started.
            steps: (n,) control steps that they lasted.
            failed: (n,) bool.
        """
        failed_soon = failed & (steps <= self._soon_steps)
        is_known = failed_soon | (steps > self._soon_steps)
        bins, failed_soon = bins[is_known], failed_soon[is_known]
        episodes = torch.bincount(bins, minlength=len(self._clip))
        failures = torch.bincount(bins[failed_soon], minlength=len(self._clip))
        kept = (1.0 - _UPDATE) ** episodes
        mean = failures / episodes.clamp(min=1)
        self.failure_rate = kept * self.failure_rate + (1.0 - kept) * mean
