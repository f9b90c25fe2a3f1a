"""Height scan: ground heights at a grid of points around a robot."""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.terrain.grid import HORIZONTAL_M, VERTICAL_M, Terrain

# Distances in front and behind, left and right, in the heading frame (m).
_SIDE_X = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
_SIDE_Y = (0.1, 0.2, 0.3, 0.4, 0.5)
NUM_POINTS = 4 * len(_SIDE_X) * len(_SIDE_Y)


def scan_points() -> Tensor:
    """Return the points (2, 140) around a robot (m) in IsaacGymEnvs' order: y varies fastest."""
    x = torch.tensor([*(-v for v in reversed(_SIDE_X)), *_SIDE_X])
    y = torch.tensor([*(-v for v in reversed(_SIDE_Y)), *_SIDE_Y])
    return torch.stack(torch.meshgrid(x, y, indexing="ij")).flatten(1)


class HeightScan:
    """Measures the ground around N robots.

    The height at a point is the lower of two opposite corners of its grid square, as in
    IsaacGymEnvs.
    """

    def __init__(self, terrain: Terrain, device: torch.device) -> None:
        samples = torch.from_numpy(terrain.samples)
        lower = torch.minimum(samples[:-1, :-1], samples[1:, 1:])
        self._heights = (lower * VERTICAL_M).to(device)
        self._last = [n - 1 for n in self._heights.shape]
        self._border = terrain.border_m
        self._points = scan_points().to(device)[..., None]

    def __call__(self, root_pos: Tensor, root_rot: Tensor) -> Tensor:
        """Return the ground heights (140, N) in m around robots at `root_pos` (N, 3) m.

        Of `root_rot` (N, 4) xyzw only z and w are used, as a rotation about z.
        """
        z, w = root_rot[:, 2], root_rot[:, 3]
        length = (z * z + w * w).clamp(min=1e-12)
        cos, sin = (w * w - z * z) / length, 2.0 * w * z / length
        ahead, aside = self._points
        x = ahead * cos - aside * sin + root_pos[:, 0]
        y = ahead * sin + aside * cos + root_pos[:, 1]
        rows, columns = self._samples_at(x, self._last[0]), self._samples_at(y, self._last[1])
        return self._heights.take(rows.mul_(self._heights.shape[1]).add_(columns))

    def _samples_at(self, coordinates: Tensor, last: int) -> Tensor:
        return coordinates.add_(self._border).div_(HORIZONTAL_M).clamp_(0, last).long()
