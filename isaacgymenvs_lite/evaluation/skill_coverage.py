"""Measures how many clips of its dataset a skill policy reproduces.

The method is the nearest-neighbour analysis of Peng et al. 2022, "ASE: Large-Scale Reusable
Adversarial Skill Embeddings" (arXiv 2205.01906). Every window (a short sequence of steps) of the
policy's motion belongs to the clip with the most similar window; a clip is covered if enough
windows belong to the clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

COVERED_SHARE = 0.01
"""A clip is covered if at least this share of the policy's windows belongs to it."""

_CHUNK_ROWS = 1024
# Smallest scale of a feature in its unit (m, m/s, rad/s, or parts of a unit vector). Without this
# limit, features that hardly vary in the clips would be magnified.
_LEAST_SCALE = 0.01


@dataclass(frozen=True)
class ClipShares:
    """For each clip the share of the windows that belong to the clip, in descending order."""

    shares: dict[str, float]

    @property
    def coverage(self) -> float:
        """Share of the clips to which at least `COVERED_SHARE` of the windows belong."""
        covered = sum(share >= COVERED_SHARE for share in self.shares.values())
        return covered / len(self.shares)

    def __str__(self) -> str:
        """Return one line for users."""
        clips = ", ".join(f"{name} {100 * share:.0f}%" for name, share in self.shares.items())
        return f"coverage {self.coverage:.2f} of {len(self.shares)} clips ({clips})"


class ClipMatcher:
    """Finds the nearest clip of a window of motion.

    The distance is Euclidean, after features have been scaled by their spread over the clips; all
    clips have the same weight. `windows` contains (W, F) for each clip, W >= 1.
    """

    def __init__(self, windows: Sequence[Tensor], names: Sequence[str]) -> None:
        self._names = list(names)
        means = torch.stack([rows.mean(0) for rows in windows])
        squares = torch.stack([rows.square().mean(0) for rows in windows])
        variance = (squares.mean(0) - means.mean(0).square()).clamp(min=0.0)
        self._scale = variance.sqrt().clamp(min=_LEAST_SCALE)
        self._rows = torch.cat(list(windows)) / self._scale
        ids = [torch.full((len(rows),), i) for i, rows in enumerate(windows)]
        self._clip_ids = torch.cat(ids).to(self._rows.device)

    def nearest_clips(self, windows: Tensor) -> Tensor:
        """Return the indices of the nearest clips, (n,) int64, for windows (n, F)."""
        found = [
            self._clip_ids[torch.cdist(rows / self._scale, self._rows).argmin(dim=1)]
            for rows in windows.split(_CHUNK_ROWS)
        ]
        return torch.cat(found) if found else torch.empty(0, dtype=torch.int64)

    def shares(self, windows: Tensor) -> ClipShares:
        """Return the shares of the clips among the nearest clips of windows (n, F), n >= 1."""
        counts = self.nearest_clips(windows).bincount(minlength=len(self._names)).tolist()
        order = sorted(range(len(counts)), key=lambda i: -counts[i])
        return ClipShares({self._names[i]: counts[i] / len(windows) for i in order})
