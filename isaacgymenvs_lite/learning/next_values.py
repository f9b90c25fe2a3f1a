"""Values of the states after each step, and the advantages made of them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from isaacgymenvs_lite.learning import losses
from isaacgymenvs_lite.learning.agent_hooks import AgentHooks
from isaacgymenvs_lite.learning.published_names import is_overridden


class NextValues(AgentHooks):
    """What CommonAgent bootstraps with, at no more than one call of the critic per rollout.

    Attributes: as rl_games' agents have them.
    """

    horizon_length: int
    gamma: float
    tau: float
    obs: Any
    ppo_device: Any
    experience_buffer: Any
    _preproc_obs: Any
    _pending: Tensor
    _bootstrap_queue: list[tuple[Tensor, dict[str, Tensor]]]

    def _queue_bootstrap_values(self, n: int, infos: dict[str, Any]) -> None:
        """Keep the rows after step n that no later policy call values.

        Where the episode goes on, the policy call of step n + 1 evaluates the same observation,
        and `_fill_next_values` takes its value over. After a failure there is nothing to value.
        """
        asked = self._needs_next_value()
        # A policy call gives the model's values, not those of a subclass' own critic.
        own_critic = is_overridden(self, NextValues._eval_critic)
        if n == self.horizon_length - 1 or own_critic:
            asked = torch.ones_like(asked)
        self._pending = ~asked
        terminate = self._terminated(infos).bool()
        self.experience_buffer.tensor_dict["next_values"][n].zero_()
        rows = (asked & ~terminate).nonzero().flatten()
        inputs = {"obs": self._preproc_obs(self.obs["obs"]), **self._policy_inputs()}
        kept = {name: value.index_select(0, rows) for name, value in inputs.items()}
        self._bootstrap_queue.append((n * len(terminate) + rows, kept))

    def _fill_next_values(self, n: int, values: Tensor) -> None:
        next_values = self.experience_buffer.tensor_dict["next_values"][n]
        torch.where(self._pending.unsqueeze(-1), values, next_values, out=next_values)

    def _evaluate_bootstrap_queue(self) -> None:
        """Evaluate all rows that `_queue_bootstrap_values` kept of the rollout, in one call."""
        places, kept = zip(*self._bootstrap_queue, strict=True)
        self._bootstrap_queue = []
        inputs = {name: torch.cat([rows[name] for rows in kept]) for name in kept[0]}
        if len(inputs["obs"]) > 0:
            next_values = self.experience_buffer.tensor_dict["next_values"].flatten(0, 1)
            next_values[torch.cat(places)] = self._eval_critic(inputs)

    def _terminated(self, infos: dict[str, Any]) -> Tensor:
        """(N,) 1 where the episode ended by a failure: no future to bootstrap from."""
        if "terminate" in infos:
            return infos["terminate"].to(self.ppo_device)
        if "time_outs" in infos:
            return self.dones.bool() & ~infos["time_outs"].to(self.ppo_device).bool()
        return self.dones

    def _eval_critic(self, obs_dict: dict[str, Tensor]) -> Tensor:
        """Values (n, values), denormalised, of raw observations `obs` and the policy's inputs.

        The critic is called directly, so that the observation is normalised here.
        """
        self.model.eval()
        others = {name: value for name, value in obs_dict.items() if name != "obs"}
        with torch.no_grad():
            obs = self.model.norm_obs(obs_dict["obs"])
            return self.model.denorm_value(self.model.a2c_network.eval_critic(obs, **others))

    def discount_values(  # type: ignore[override]  # IsaacGymEnvs' CommonAgent has these arguments
        self, mb_fdones: Tensor, mb_values: Tensor, mb_rewards: Tensor, mb_next_values: Tensor
    ) -> Tensor:
        """Return advantages (H, N, values); see `losses.discount_values`."""
        return losses.discount_values(
            mb_fdones, mb_values, mb_rewards, mb_next_values, self.gamma, self.tau
        )
