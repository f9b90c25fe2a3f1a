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
from isaacgymenvs_lite.policies.llc_reference import llc_checkpoint_for, warn_of_another_llc


class HRLPlayer(CommonPlayer):
    """The player of `hrl` and `hrl_continuous`; the reward that it reports is the task's.

    Attributes:
        llc: the low-level controller.
    """

    def __init__(self, params: dict[str, Any]) -> None:
        self._hrl = read_hrl_params(params["config"])
        self._llc_checkpoint = llc_checkpoint_for(self._hrl.llc_checkpoint, params)
        super().__init__(params)
        self._policy = self.llc.policy_under(
            lambda obs: latents_of_actions(self.get_action(obs, self.is_deterministic)),
            self._hrl.llc_steps,
        )

    def _build_net_config(self) -> dict[str, Any]:
        self.llc = LowLevelPolicy(
            self._hrl.llc_config,
            self._llc_checkpoint,
            LowLevelSizes.of_task(self.env),
            self.device,
        )
        # The high level's actions are latents.
        self.actions_num = self.llc.latent_dim
        box = latent_space(self.actions_num)
        self.actions_low = torch.from_numpy(box.low.copy()).to(self.device)
        self.actions_high = torch.from_numpy(box.high.copy()).to(self.device)
        return super()._build_net_config()

    def restore(self, fn: str) -> dict[str, Any]:
        """Take over the high level of a checkpoint; see `RestoringPlayer.restore`."""
        state = super().restore(fn)
        warn_of_another_llc(state, self.llc.reference, fn)
        return state

    @property
    def llc_steps(self) -> int:
        """Control steps under one latent."""
        return self._hrl.llc_steps

    def act(self, obs: dict[str, Tensor]) -> Tensor:
        """Return the task's actions (N, A); the latent changes every `llc_steps` calls."""
        rows: Any = self.obs_to_torch(obs)
        return self._policy(rows)
