"""Plays a hierarchy: the high-level policy chooses latents for the frozen low level."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from isaacgymenvs_lite.checkpoints.llc_reference import llc_checkpoint_for, warn_of_another_llc
from isaacgymenvs_lite.env_interface import HierarchyEnv, require
from isaacgymenvs_lite.learning.amp_config import HRLParams, read_agent_params
from isaacgymenvs_lite.learning.common_player import CommonPlayer
from isaacgymenvs_lite.learning.published_names import ReadOnly
from isaacgymenvs_lite.learning.skills.latents import latent_space
from isaacgymenvs_lite.learning.skills.low_level_policy import (
    LowLevelPolicy,
    LowLevelSizes,
    latents_of_actions,
)


class HRLPlayer(CommonPlayer):
    """The player of `hrl` and `hrl_continuous`; the reward that it reports is the task's.

    Attributes:
        llc: the low-level controller.
    """

    _latent_dim = ReadOnly("llc.latent_dim", "the low-level controller")
    _task_size = ReadOnly("llc.num_task_obs", "the task")
    _llc_steps = ReadOnly("_hrl.llc_steps")
    _llc_agent = ReadOnly("llc", "_build_llc, which returns it")

    def __init__(self, params: dict[str, Any]) -> None:
        self._hrl = read_agent_params(params["config"], HRLParams)
        self._llc_checkpoint = llc_checkpoint_for(self._hrl.llc_checkpoint, params)
        super().__init__(params)
        self._policy = self.llc.policy_under(
            lambda obs: self.get_action({"obs": obs}, self.is_deterministic),
            self._hrl.llc_steps,
            self._compute_llc_action,
        )

    def _setup_action_space(self) -> None:
        """Build the low-level controller, and make its latents the policy's actions."""
        self.llc = self._build_llc(self._hrl)
        self.action_space = latent_space(self.llc.latent_dim)
        super()._setup_action_space()

    def _build_llc(self, params: HRLParams) -> LowLevelPolicy:
        """Return the low-level controller that the keys name."""
        return LowLevelPolicy(
            params.llc_config,
            self._llc_checkpoint,
            self._build_llc_agent_config(),
            self.device,
            self.config.get("mixed_precision", False),
        )

    def _build_llc_agent_config(self) -> LowLevelSizes:
        """Return the sizes that the low-level controller has in this task."""
        task = require(self.env, HierarchyEnv, "train.params.algo: a hierarchy")
        return LowLevelSizes.from_task(task)

    def _compute_llc_action(self, obs: Tensor, actions: Tensor) -> Tensor:
        """Return the task's actions (N, A) under the latents that `actions` (N, Z) point to."""
        return self.llc.actions(self._extract_llc_obs(obs), latents_of_actions(actions))

    def _extract_llc_obs(self, obs: Tensor) -> Tensor:
        """Return observations (N, O) without the task's features."""
        return self.llc.extract_obs(obs)

    def restore(self, fn: str) -> dict[str, Any]:
        """Load the high level from a checkpoint; see `RestoringPlayer.restore`."""
        state = super().restore(fn)
        warn_of_another_llc(state, self.llc.reference, fn)
        return state

    @property
    def llc_steps(self) -> int:
        """Control steps under one latent."""
        return self._hrl.llc_steps

    def act(self, obs: dict[str, Tensor]) -> Tensor:
        """Return the task's actions (N, A); the latent changes every `llc_steps` calls."""
        return self._policy(self.obs_to_torch(obs)["obs"])
