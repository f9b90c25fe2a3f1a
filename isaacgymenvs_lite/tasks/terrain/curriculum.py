"""Terrain curriculum: a robot that walks far moves on to a harder tile."""

from __future__ import annotations

import torch
from torch import Tensor

from isaacgymenvs_lite.tasks.terrain.grid import Terrain, TerrainConfig
from isaacgymenvs_lite.utils.state import Stateful

_DEMOTED_SHARE = 0.25


def next_levels(
    levels: Tensor,
    distances_m: Tensor,
    commanded_m: Tensor,
    tile_length_m: float,
    num_levels: int,
) -> Tensor:
    """Return the levels (n,) after an episode, as in IsaacGymEnvs.

    A robot that went farther than half a tile moves up. A robot that covered less than a quarter of
    the commanded distance moves down. If both hold, it stays. Level 0 is the lowest, and level 0
    follows the last level.

    `distances_m` (n,) are measured over the ground from the middle of the tile. `commanded_m` (n,)
    is the commanded speed times the episode length.
    """
    up = (distances_m > tile_length_m / 2.0).long()
    down = (distances_m < _DEMOTED_SHARE * commanded_m).long()
    return (levels + up - down).clamp(min=0) % num_levels


class Curriculum(Stateful):
    """Levels and types (N,) int64 of the tiles of N robots.

    With `demotionAsPublished`, each robot's distance is compared with the norm of the commands of
    all robots that start at the same time, as in IsaacGymEnvs. More robots then go back a level.
    """

    stored = ("levels", "types")

    def __init__(
        self, cfg: TerrainConfig, terrain: Terrain, num_envs: int, device: torch.device
    ) -> None:
        self._cfg = cfg
        self._origins = torch.from_numpy(terrain.origins).float().to(device)
        num_levels, num_types = self._origins.shape[:2]
        # All levels are equally hard without a curriculum.
        highest = cfg.max_init_level if cfg.curriculum else num_levels - 1
        highest = min(highest, num_levels - 1)
        self.levels = torch.randint(highest + 1, (num_envs,), device=device)
        self.types = torch.randint(num_types, (num_envs,), device=device)

    def origins(self, env_ids: Tensor) -> Tensor:
        """Return the middles (n, 3) of the tiles of environments (n,) (m)."""
        return self._origins[self.levels[env_ids], self.types[env_ids]]

    def update(
        self, env_ids: Tensor, root_pos: Tensor, command: Tensor, episode_length_s: float
    ) -> None:
        """Move robots (n,) whose episode ended to their next level.

        `root_pos` (n, 3) is in m, `command` (n, 2) is the commanded velocity (m/s), and
        `episode_length_s` is the duration of the longest episode.
        """
        if not self._cfg.curriculum or len(env_ids) == 0:
            return
        distances = (root_pos - self.origins(env_ids))[:, :2].norm(dim=-1)
        speeds = command.norm(dim=None if self._cfg.demotion_as_published else -1)
        levels = next_levels(
            self.levels[env_ids],
            distances,
            speeds * episode_length_s,
            self._cfg.length_m,
            len(self._origins),
        )
        self.levels.index_copy_(0, env_ids, levels)
