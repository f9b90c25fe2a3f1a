"""Reward and loss of the skill encoder, which infers the policy's latent from its motion.

Peng et al. 2022, "ASE: Large-Scale Reusable Adversarial Skill Embeddings" (arXiv 2205.01906).
The encoder's layers belong to the actor-critic network.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.env_interface import goal_size
from isaacgymenvs_lite.learning.amp_config import GenAMPParams
from isaacgymenvs_lite.learning.cpu.parallel import evaluate_in_chunks


class SkillEncoder:
    """Infers the policy's latents from AMP observations, which `normalize` normalises first."""

    def __init__(
        self, network: Any, normalize: Callable[[Tensor], Tensor], params: GenAMPParams
    ) -> None:
        self._network = network
        self._normalize = normalize
        self._params = params

    def reward(self, amp_obs: Tensor, latents: Tensor) -> Tensor:
        """Return rewards (..., 1): max(q(x) . z, 0) * enc_reward_scale.

        The arguments are AMP observations x (..., F), not normalised yet, and latents z (..., Z).
        """
        return self.reward_from_latents(self.read(amp_obs), latents)

    def reward_from_latents(self, found: Tensor, latents: Tensor) -> Tensor:
        """Return the encoder's reward, given the inferred and the policy's latents (..., Z)."""
        agreement = (found * latents).sum(dim=-1, keepdim=True)
        return agreement.clamp(min=0.0) * self._params.enc_reward_scale

    def read(self, amp_obs: Tensor) -> Tensor:
        """Return the latents (..., Z) that the encoder infers from AMP observations (..., F)."""
        return evaluate_in_chunks(
            lambda rows: self._network.eval_enc(self._normalize(rows)), amp_obs
        )

    def loss(
        self, found: Tensor, latents: Tensor, gradient: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return `enc_loss` and, if `gradient` is given, the unweighted `enc_grad_penalty`.

        `enc_loss` is the mean of -q . z, plus weight decay and gradient penalty. q (`found`) are
        the inferred latents and z the policy's latents, (K, Z) each. `gradient` (K, F) is the
        differentiable gradient of -q . z with respect to the normalised AMP observations.
        """
        loss = -(found.float() * latents).sum(dim=-1).mean()
        if self._params.enc_weight_decay != 0.0:
            squares = [weights.square().sum() for weights in self._network.get_enc_weights()]
            loss = loss + self._params.enc_weight_decay * torch.stack(squares).sum()
        if gradient is None:
            return {"enc_loss": loss}
        penalty = gradient.float().square().sum(dim=-1).mean()
        loss = loss + self._params.enc_grad_penalty * penalty
        return {"enc_loss": loss, "enc_grad_penalty": penalty.detach()}


class SkillRewards:
    """Mixin with the published reward methods of GenAMP agents and players.

    In a list of base classes, this mixin stands before AMP's class.
    """

    model: Any
    encoder: SkillEncoder
    # AMP's class sets these attributes.
    _amp: Any
    _calc_disc_rewards: Any
    _reward_latents: Any
    obs_shape: Any

    @property
    def _observes_goal(self) -> bool:
        """Whether the policy observes the task's goal, which it ignores if `task_reward_w` is 0."""
        return self._amp.task_reward_w != 0.0

    def _sizes_of_inputs(self, env: Any) -> dict[str, Any]:
        """Return the sizes of the network's latents and observations, without an ignored goal."""
        of_goal = 0 if self._observes_goal else goal_size(env)
        self.num_policy_obs = self.obs_shape[0] - of_goal
        return {"amp_latent_shape": (self._amp.latent_dim,), "input_shape": (self.num_policy_obs,)}

    def _preproc_obs(self, obs: Any) -> Any:
        """Remove an ignored goal from observations (..., O), and call rl_games' method."""
        base: Any = super()
        return base._preproc_obs(obs[..., : self.num_policy_obs])

    @property
    def _disc_is_conditional(self) -> bool:
        return self.model.a2c_network.disc_is_conditional

    def _calc_amp_rewards(
        self, amp_obs: Tensor, ase_latents: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Return "disc_rewards" and "enc_rewards" (..., 1) of raw AMP observations (..., F).

        `ase_latents` (..., Z) are the policy's latents. If `ase_latents` is None, the latents of
        the rollout are used.
        """
        latents = self._reward_latents()[0] if ase_latents is None else ase_latents
        of_disc = (latents,) if self._disc_is_conditional else ()
        return {
            "disc_rewards": self._calc_disc_rewards(amp_obs, *of_disc),
            "enc_rewards": self._calc_enc_rewards(amp_obs, latents),
        }

    def _calc_enc_rewards(self, amp_obs: Tensor, ase_latents: Tensor) -> Tensor:
        """Return the encoder's rewards (..., 1); see `SkillEncoder.reward`."""
        return self.encoder.reward_from_latents(self._eval_enc(amp_obs), ase_latents)

    def _eval_enc(self, amp_obs: Tensor) -> Tensor:
        """Return the latents (..., Z) inferred from raw AMP observations (..., F)."""
        return self.encoder.read(amp_obs)
