"""The loss of a slice of a minibatch: PPO's terms and those that an agent adds."""

from __future__ import annotations

from typing import Any

import torch
from rl_games.algos_torch import torch_ext
from torch import Tensor

from isaacgymenvs_lite.learning import losses
from isaacgymenvs_lite.learning.agent_hooks import AgentHooks, LossTerms
from isaacgymenvs_lite.learning.modules.running_mean_std import RunningMeanStd


class MinibatchLoss(AgentHooks):
    """What CommonAgent computes of rows, on several threads at the same time.

    Attributes: as rl_games' agents have them, from their configuration.
    """

    executor: Any
    normalize_input: bool
    ppo: bool
    e_clip: float
    clip_value: bool
    critic_coef: float
    bounds_loss_coef: float | None
    entropy_coef: float
    _preproc_obs: Any

    def _normalizer_inputs(
        self, input_dict: dict[str, Tensor]
    ) -> list[tuple[RunningMeanStd, list[Tensor]]]:
        if not self.normalize_input:
            return []
        return [(self.model.running_mean_std, [self._preproc_obs(input_dict["obs"])])]

    def _update_normalizers(self, minibatch: dict[str, Tensor]) -> None:
        """Let all normalisers count a minibatch in; slices of it are only normalised then."""

        def count(normalizer: RunningMeanStd, kinds: list[Tensor]) -> None:
            normalizer.eval()
            for rows in kinds:
                normalizer.count_in(rows)

        self.executor.map(count, self._normalizer_inputs(minibatch))

    def _compute_loss(self, rows: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of rows of the training set, and what to log of it.

        The values are the loss terms, `actor_clip_frac` and `kl`, numbers, and `neglogp` (n,).
        """
        batch = {
            "is_train": True,
            "prev_actions": rows["actions"],
            "obs": self._preproc_obs(rows["obs"]),
            **self._training_inputs(rows),
        }
        result = self.model(batch)
        terms, values = self._ppo_terms(result, rows)
        terms |= self._extra_losses(result, batch, rows)
        weighted = [weight * term for weight, term in terms.values() if weight != 0.0]
        values |= {name: term for name, (_, term) in terms.items()}
        return torch.stack(weighted).sum(), values

    def _ppo_terms(
        self, result: dict[str, Tensor], rows: dict[str, Tensor]
    ) -> tuple[LossTerms, dict[str, Tensor]]:
        neglogp, mu = result["prev_neglogp"], result["mus"]
        actor = self._actor_loss(rows["old_logp_actions"], neglogp, rows["advantages"], self.e_clip)
        critic = self._critic_loss(
            rows["old_values"], result["values"], self.e_clip, rows["returns"], self.clip_value
        )
        with torch.no_grad():
            kl = torch_ext.policy_kl(mu, result["sigmas"], rows["mu"], rows["sigma"])
        bound = self.bound_loss(mu)
        terms = {
            "actor_loss": (1.0, weighted_mean(actor["actor_loss"], rows)),
            "critic_loss": (self.critic_coef, critic["critic_loss"].mean()),
            "b_loss": (self.bounds_loss_coef or 0.0, weighted_mean(bound, rows)),
            "entropy": (-self.entropy_coef, weighted_mean(result["entropy"], rows)),
        }
        values = {"kl": kl, "neglogp": neglogp}
        if "actor_clipped" in actor:
            values["actor_clip_frac"] = weighted_mean(actor["actor_clipped"].float(), rows)
        # What a subclass adds to log: a number, as the published agents' `actor_clip_frac`.
        own = {*terms, "actor_clipped"}
        for name, value in {**actor, **critic}.items():
            if name not in own and isinstance(value, Tensor):
                values[name] = value.detach().mean()
        return terms, values

    def _actor_loss(
        self,
        old_action_log_probs_batch: Tensor,
        action_log_probs: Tensor,
        advantage: Tensor,
        curr_e_clip: float,
    ) -> dict[str, Tensor]:
        """Return `actor_loss` (n,) and `actor_clipped` (n,) bool, of negative log probabilities.

        Several threads call it at the same time: it must not change the agent.
        """
        loss, clipped = losses.actor_loss(
            old_action_log_probs_batch, action_log_probs, advantage, self.ppo, curr_e_clip
        )
        return {"actor_loss": loss, "actor_clipped": clipped}

    def _critic_loss(
        self,
        value_preds_batch: Tensor,
        values: Tensor,
        curr_e_clip: float,
        return_batch: Tensor,
        clip_value: bool,
    ) -> dict[str, Tensor]:
        """Return `critic_loss` (n, values), of normalised values; threads as `_actor_loss`."""
        loss = losses.critic_loss(value_preds_batch, values, return_batch, curr_e_clip, clip_value)
        return {"critic_loss": loss}

    def bound_loss(self, mu: Tensor) -> Tensor:
        """Return (M,) the squared excess of mean actions (M, A) over +-1."""
        return losses.bound_loss(mu)


def weighted_mean(values: Tensor, rows: dict[str, Tensor]) -> Tensor:
    """Return the mean of values (n,), by the weights that rows may have (`_minibatch_extras`)."""
    weights = rows.get("row_weights")
    return values.mean() if weights is None else (weights * values).mean()
