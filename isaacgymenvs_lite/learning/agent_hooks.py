"""What an agent may override: the hooks that CommonAgent's loops call.

| hook | what an agent adds |
|---|---|
| `_load_config_params` | its own keys |
| `_setup_action_space` | what an action is |
| `_build_net_config` | its own arguments of the networks |
| `_parameter_groups` | parameters with a learning rate of their own |
| `_init_train` | work before the first epoch |
| `_env_reset_done` | how ended episodes start anew |
| `_after_reset`, `_before_step` | work where episodes start, and before each policy step |
| `_policy_inputs`, `_training_inputs` | inputs of the networks beside the observation |
| `_evaluation_inputs` | the same for another task that the policy plays |
| `_normalizer_inputs` | rows that its normalisers count in |
| `_needs_next_value` | rows whose next value the following step's policy call will not give |
| `_record_step` | what to keep of a step |
| `_total_rewards` | rewards beside the task's |
| `_eval_critic` | a critic of its own |
| `_calc_advs` | how advantages are normalised |
| `_before_update`, `_after_update` | work around the gradient steps |
| `_extra_dataset`, `_dataset_row_limits` | rows beside PPO's in the training set |
| `_minibatch_extras` | rows that a whole minibatch decides about |
| `_actor_loss`, `_critic_loss`, `bound_loss` | PPO's terms |
| `_extra_losses` | loss terms beside PPO's |
| `_record_train_batch_info`, `_log_train_info` | what to log of an epoch |
| `_parts` | what it takes over of a checkpoint |

Hooks that the agents of IsaacGymEnvs or ASE have, too, have their names and arguments there; the
others of theirs are listed in `published_names`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from isaacgymenvs_lite.learning.modules.running_mean_std import RunningMeanStd

LossTerms = dict[str, tuple[float, Tensor]]
"""{name: (weight, term)}: terms are numbers, means over rows or the same for all of them. Their
weighted sum is the loss, their names are what is logged; a weight of 0 only logs."""


class AgentHooks:
    """Hooks of CommonAgent that do nothing; N environments, horizon H, batch B = N * H."""

    dones: Tensor
    model: Any
    _rollout_rewards: dict[str, Tensor]

    def _load_config_params(self, config: dict[str, Any]) -> None:
        """Read an agent's own keys of `params.config`; the networks do not exist yet."""

    def _init_train(self) -> None:
        """Called once, before the first rollout; buffers exist, environments are not reset yet."""

    def _parameter_groups(self) -> list[dict[str, Any]]:
        """Return Adam's parameter groups; the first follows the learning rate's schedule.

        Groups keep the order of `model.parameters()` within them.
        """
        return [{"params": list(self.model.parameters())}]

    def _after_reset(self, env_ids: Tensor) -> None:
        """Called before each policy step with the environments (n,) whose episodes start there."""

    def _before_step(self) -> None:
        """Called before each policy step of a rollout."""

    def _policy_inputs(self) -> dict[str, Tensor]:
        """Return inputs of actor and critic beside the observation, (N, ...) each."""
        return {}

    def _evaluation_inputs(self, env: Any) -> Callable[[], dict[str, Tensor]]:
        """Return a function that gives such inputs, (n, ...), for each step of another task."""
        del env
        return dict

    def _training_inputs(self, input_dict: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return inputs of the model beside the observation for a slice of a minibatch.

        Several threads call it at the same time: it must not change the agent.
        """
        del input_dict
        return {}

    def _normalizer_inputs(
        self, input_dict: dict[str, Tensor]
    ) -> list[tuple[RunningMeanStd, list[Tensor]]]:
        """Return normalisers and the rows of a minibatch (n, ...) that they count in, in order."""
        del input_dict
        return []

    def _needs_next_value(self) -> Tensor:
        """Return (N,) bool: rows whose observation or inputs change before the next policy step."""
        return self.dones.bool()

    def _record_step(self, n: int, infos: dict[str, Any]) -> None:
        """Keep what an agent needs of step n."""

    def _total_rewards(self, task_rewards: Tensor) -> Tensor:
        """Return the rewards (H, N, values) to learn from, given the shaped task rewards.

        `self._rollout_rewards` are what they consist of: {name: (H, N, values)}, for the batch.
        """
        return task_rewards

    def _before_update(self, batch_dict: dict[str, Any]) -> None:
        """Called with the rollout's rows before the training set is made."""

    def _after_update(self, batch_dict: dict[str, Any]) -> None:
        """Called with the rollout's rows after the last minibatch."""

    def _record_train_batch_info(
        self, batch_dict: dict[str, Any], train_info: dict[str, Any]
    ) -> None:
        """Add to `train_info` what `_log_train_info` will need of the rollout's rows."""

    def _extra_dataset(self, batch_dict: dict[str, Any]) -> dict[str, Tensor]:
        """Return rows (B, ...) that join the training set."""
        del batch_dict
        return {}

    def _dataset_row_limits(self) -> dict[str, int]:
        """Return how many rows of a minibatch are read, for names where it is not all."""
        return {}

    def _minibatch_extras(self, input_dict: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return rows (M, ...) that join a minibatch before it is cut into slices.

        For what needs all rows at once, or random numbers: slices are computed by several threads.
        `row_weights` (M,), of mean 1, weigh the rows in the policy's losses.
        """
        del input_dict
        return {}

    def _extra_losses(
        self, result: dict[str, Tensor], batch: dict[str, Any], input_dict: dict[str, Tensor]
    ) -> LossTerms:
        """Return loss terms beside PPO's for a slice of a minibatch; see `LossTerms`.

        Several threads call it at the same time: it must not change the agent.

        Args:
            result: the model's output.
            batch: the model's input.
            input_dict: the rows of the slice.
        """
        del result, batch, input_dict
        return {}
