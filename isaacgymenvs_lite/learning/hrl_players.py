"""The player of a hierarchy: the high-level policy chooses latents for the frozen low level."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.learning.common_player import CommonPlayer
from isaacgymenvs_lite.learning.hrl_config import read_hrl_params
from isaacgymenvs_lite.learning.latents import latent_space
from isaacgymenvs_lite.learning.low_level_policy import (
    LowLevelPolicy,
    LowLevelSizes,
    latents_of_actions,
)


class HRLPlayer(CommonPlayer):
    """The player of `hrl` and `hrl_continuous`; the reward that it reports is the task's.

    Attributes:
        llc: the low-level controller.
    """

    def __init__(self, params: dict[str, Any]) -> None:
        self._hrl = read_hrl_params(params["config"])
        self._step = 0
        super().__init__(params)

    def _build_net_config(self) -> dict[str, Any]:
        self.llc = LowLevelPolicy(
            self._hrl.llc_config,
            self._hrl.llc_checkpoint,
            LowLevelSizes(
                num_obs=self.obs_shape[0],
                num_task_obs=self.env.get_task_obs_size(),
                num_amp_obs=self.env.amp_observation_space.shape[0],
                action_space=self.action_space,
            ),
            self.device,
        )
        # The high level's actions are latents.
        self.actions_num = self.llc.latent_dim
        box = latent_space(self.actions_num)
        self.actions_low = torch.from_numpy(box.low.copy()).to(self.device)
        self.actions_high = torch.from_numpy(box.high.copy()).to(self.device)
        return super()._build_net_config()

    def _act(self, obs: dict[str, Tensor]) -> Tensor:
        rows: Any = self.obs_to_torch(obs)
        if self._step % self._hrl.llc_steps == 0:
            self._latents = latents_of_actions(self.get_action(rows, self.is_deterministic))
        self._step += 1
        return self.llc.actions(rows, self._latents)
