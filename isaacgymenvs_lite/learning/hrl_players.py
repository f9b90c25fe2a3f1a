"""The player of hierarchies: a high-level policy chooses latents for a frozen low-level policy."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from isaacgymenvs_lite.checkpoints.llc_reference import warn_of_another_llc
from isaacgymenvs_lite.learning.amp_config import HRLParams, read_agent_params
from isaacgymenvs_lite.learning.common_player import CommonPlayer
from isaacgymenvs_lite.learning.hrl_continuous import OverLowLevel
from isaacgymenvs_lite.learning.skills.latents import latent_space


class HRLPlayer(OverLowLevel, CommonPlayer):
    """The player of `hrl` and `hrl_continuous`; it reports the task reward."""

    def __init__(self, params: dict[str, Any]) -> None:
        self._section = params
        self._hrl = read_agent_params(params["config"], HRLParams)
        self.llc_steps = self._hrl.llc_steps
        super().__init__(params)
        self._policy = self.llc.policy_under(
            lambda obs: self.get_action({"obs": obs}, self.is_deterministic),
            self.llc_steps,
            self._compute_llc_action,
        )

    def _setup_action_space(self) -> None:
        """Build the low-level controller; its latents become the high-level policy's actions."""
        self._env, self._llc_device = self.env, self.device
        self._precision = self.config.get("mixed_precision", False)
        self.llc = self._build_llc(self._hrl)
        self.action_space = latent_space(self.llc.latent_dim)
        super()._setup_action_space()

    def restore(self, fn: str) -> dict[str, Any]:
        """Load the high-level policy from a checkpoint, and return the checkpoint's entries."""
        state = super().restore(fn)
        warn_of_another_llc(state, self.llc.reference, fn)
        return state

    def act(self, obs: dict[str, Tensor]) -> Tensor:
        """Return the task's actions (N, A); the latent changes every `llc_steps` calls."""
        return self._policy(self.obs_to_torch(obs)["obs"])
