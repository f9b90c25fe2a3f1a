"""PPO with the rollout and update loops that the AMP, GenAMP and HRL agents share.

rl_games' `train()` calls `train_epoch` once per epoch. Agents override methods that the loops call,
but not the loops themselves. Shapes: N environments, horizon H, A actions, batch B = N * H.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from rl_games.algos_torch import torch_ext
from rl_games.algos_torch.central_value import CentralValueTrain
from rl_games.common.a2c_common import ContinuousA2CBase, swap_and_flatten01
from torch import Tensor

from isaacgymenvs_lite.config.train_params import torch_compile_setting
from isaacgymenvs_lite.distributed.group import current_group
from isaacgymenvs_lite.env_interface import Env, diverged_in, failures
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_datasets import AMPDataset
from isaacgymenvs_lite.learning.cpu.parallel import take_models
from isaacgymenvs_lite.learning.diverged import RolloutMask, fit_datasets, take_rows
from isaacgymenvs_lite.learning.modules.running_mean_std import (
    RunningMeanStd,
    count_in_jointly,
    normalize_advantages,
)
from isaacgymenvs_lite.learning.published_names import AGENT_NAMES, ExplainedNames
from isaacgymenvs_lite.learning.safeguards import PPOSafeguards, leave_out_nccl
from isaacgymenvs_lite.learning.warm_start import actor_parameters
from isaacgymenvs_lite.utils.threads import one_torch_thread

LossTerms = dict[str, tuple[float, Tensor]]
"""{name: (weight, term)}: the loss is the weighted sum of the terms. A term is a mean over rows and
is logged under its name. A term with weight 0 is only logged."""


class CommonAgent(ExplainedNames, PPOSafeguards):
    """PPO that resets ended episodes before a policy step, and bootstraps with values V(s').

    The methods have the names and arguments of the agents in IsaacGymEnvs and ASE. docs/amp.md
    lists the differences from rl_games.

    Attributes:
        scalars: TensorBoard tags of the collected scalars by their names.
        unsupported_keys: keys of `params.config` that rl_games' agents accept and these agents
            refuse.
        control_steps_per_action: number of control steps in one `env_step`; each counts as a frame.
        train_log: lists of scalars of the current epoch by name, with a value per minibatch or
            epoch.
        has_restored: whether a checkpoint has been loaded.
        frozen_until: last epoch in which the actor does not learn (`warm_start` sets it).

    Raises:
        ConfigError: a key is not supported by this family of agents.
        OverrideError: a subclass overrides a method that nothing calls here.
    """

    replaced: ClassVar[dict[str, str]] = AGENT_NAMES
    scalars: ClassVar[dict[str, str]] = {"actor_clip_frac": "info/clip_frac"}
    unsupported_keys: ClassVar[tuple[str, ...]] = ("self_play_config",)
    control_steps_per_action = 1
    has_restored = False
    frozen_until = 0
    stored_episodes = ("dataset",)

    # rl_games declares these attributes as None and sets them in its constructors.
    vec_env: Any
    writer: Any
    obs: Any
    train_result: Any
    tensor_list: list[str]

    # --- constructor -----------------------------------------------------------------------

    def __init__(
        self,
        base_name: str,
        params: dict[str, Any] | None = None,
        config: dict[str, Any] | None = None,
    ) -> None:
        self._section = given_params(params, config)
        if not isinstance(self._section.get("config"), Mapping):
            raise ConfigError(
                "params has no section config; expected the section params of a train file: algo,"
                " model, network and config"
            )
        self._precision = _prepare_settings(self._section["config"], self.unsupported_keys)
        # The constructor of A2CAgent is not called, because it builds the model before the keys are
        # read.
        ContinuousA2CBase.__init__(self, base_name, self._section)
        self._check_batch_size()
        self.network_path = self.nn_dir
        self._load_config_params(self.config)
        self._setup_action_space()
        self._build_model(self._precision)
        self._build_modules()
        self.last_lr = float(self.last_lr)
        self._learned = [p for p in self.model.parameters() if p.requires_grad]
        self._frozen: list[torch.nn.Parameter] = []  # Adam skips these parameters in this epoch.
        decay = self.weight_decay
        self.optimizer = torch.optim.Adam(
            self._parameter_groups(), self.last_lr, eps=1e-8, weight_decay=decay, fused=True
        )
        self.dataset = AMPDataset(
            self.batch_size,
            self.minibatch_size,
            self.is_discrete,
            self.is_rnn,
            self.ppo_device,
            self.seq_length,
            row_limits=self._dataset_row_limits(),
        )
        self.train_log: dict[str, list[Tensor]] = {}
        self._epoch_info: dict[str, Any] = {}
        self._rollout_rewards: dict[str, Tensor] = {}
        self._mask = RolloutMask(self.horizon_length)
        # A policy call already returns the model's values; a subclass may override the critic.
        self._has_own_critic = type(self)._eval_critic is not CommonAgent._eval_critic
        self._restored_best: float | None = None
        self.algo_observer.after_init(self)

    def _load_config_params(self, config: dict[str, Any]) -> None:
        """Read the agent's additional keys of `params.config`, before the networks are built."""

    def _setup_action_space(self) -> None:
        """Set dimension and limits of the actions, before the networks are built."""
        box = self.env_info["action_space"]
        self.actions_num = box.shape[0]
        self.actions_low = torch.from_numpy(box.low.copy()).float().to(self.ppo_device)
        self.actions_high = torch.from_numpy(box.high.copy()).float().to(self.ppo_device)

    def _build_net_config(self) -> dict[str, Any]:
        """Return the arguments with which the model is built."""
        return {
            "actions_num": self.actions_num,
            "input_shape": self.obs_shape,
            "num_seqs": self.num_actors * self.num_agents,
            "value_size": self.value_size,
            "normalize_value": self.normalize_value,
            "normalize_input": self.normalize_input,
        }

    def _build_model(self, mixed_precision: Any) -> None:
        with one_torch_thread():  # The last bits of orthogonal initialisers depend on the threads.
            self.model = self.network.build(self._build_net_config())
            if self.has_central_value:
                self.central_value_net = _make_central_value(self)
        self.model.to(self.ppo_device)
        self.executor = take_models(self, self.ppo_device, mixed_precision)
        # Like rl_games, train the policy network's critic in addition to the asymmetric one if the
        # key is True.
        own_learns = bool(self.config.get("use_experimental_cv", True))
        self.has_value_loss = own_learns or not self.has_central_value
        self.states = None
        self.init_rnn_from_model(self.model)
        if self.is_rnn:
            raise ConfigError("train.params.network.rnn is not supported by AMP-family agents")

    def _build_modules(self) -> None:
        """Build an agent's additional modules, after the model."""

    def _parameter_groups(self) -> list[dict[str, Any]]:
        """Return Adam's parameter groups; the learning rate schedule changes only the first."""
        return [{"params": list(self.model.parameters())}]

    # --- before the first epoch ------------------------------------------------------------

    def init_tensors(self) -> None:
        """Allocate the rollout buffers."""
        super().init_tensors()
        buffer = self.experience_buffer.tensor_dict
        buffer["next_values"] = torch.zeros_like(buffer["values"])

    def env_reset(self) -> Any:
        """Reset the environment at the start of training, and restore the best reward.

        rl_games resets the best reward after a checkpoint is restored, and then overwrites the best
        checkpoint by a worse one.
        """
        if self._restored_best is not None:
            self.last_mean_rewards, self._restored_best = self._restored_best, None
        torch.set_num_threads(1)  # The task's operations are too small for several threads.
        task = getattr(self.vec_env, "env", None)
        if hasattr(task, "is_training"):
            task.is_training = True  # type: ignore[union-attr]
        self._init_train()
        return super().env_reset()

    def _init_train(self) -> None:
        """Prepare the first rollout, after buffers are allocated and before the first reset."""

    # --- epoch -----------------------------------------------------------------------------

    def train_epoch(self) -> tuple[Any, ...]:
        """Roll out, update, and return the statistics that rl_games' `train()` expects."""
        self.vec_env.set_train_info(self.frame, self)
        self.set_eval()
        start = time.perf_counter()
        with torch.no_grad():
            batch = self.play_steps()
        played = time.perf_counter()
        self.set_train()
        self.curr_frames = batch.pop("played_frames")
        self.train_log = {}
        for name, rewards in self._rollout_rewards.items():
            one = name.removesuffix("s")
            self.collect({f"{one}_mean": rewards.mean(), f"{one}_std": rewards.std()})
        self.prepare_dataset(batch)
        self.algo_observer.after_steps()
        if self.has_central_value:
            self.train_central_value()
        kls = self._run_mini_epochs()
        self._after_update(batch)
        end = time.perf_counter()
        info = {
            **self.train_log,
            "last_lr": [self.last_lr],
            "lr_mul": [1.0],
            "play_time": played - start,
            "update_time": end - played,
            "total_time": end - start,
        }
        self._record_train_batch_info(batch, info)
        self._epoch_info = info
        return (
            batch["step_time"],
            info["play_time"],
            info["update_time"],
            info["total_time"],
            info["actor_loss"],
            info["critic_loss"],
            info["b_loss"] if self.bounds_loss_coef is not None else [],
            info["entropy"],
            kls,
            self.last_lr,
            1.0,
        )

    # --- rollout ---------------------------------------------------------------------------
    # If the episode continues, the policy call of the next step evaluates s' and gives V(s'). A
    # single call of the critic after the rollout evaluates all other states s'.

    def play_steps(self) -> dict[str, Any]:
        """Roll the policy out for `horizon_length` steps; row e * H + t is environment e at t."""
        buffer = self.experience_buffer
        next_values = buffer.tensor_dict["next_values"].zero_()
        queue: list[tuple[Tensor, dict[str, Tensor]]] = []
        is_reused = torch.zeros(0)  # (N,) whether V(s') comes from the next policy call
        step_time_s = 0.0
        for n in range(self.horizon_length):
            self.obs, reset_ids = self._env_reset_done()
            self._after_reset(reset_ids.to(self.ppo_device))
            result = self.get_action_values(self.obs)
            if n > 0:
                last = next_values[n - 1]
                torch.where(is_reused.unsqueeze(-1), result["values"], last, out=last)
            buffer.update_data("obses", n, self.obs["obs"])
            if self.has_central_value:
                buffer.update_data("states", n, self.obs["states"])
            for name in self.update_list:
                buffer.update_data(name, n, result[name])

            start = time.perf_counter()
            self.obs, rewards, self.dones, infos = self.env_step(result["actions"])
            step_time_s += time.perf_counter() - start

            shaped_rewards = self.rewards_shaper(rewards)
            buffer.update_data("rewards", n, shaped_rewards)
            buffer.update_data("dones", n, self.dones)
            needs_value = self._needs_next_value()
            if n == self.horizon_length - 1 or self._has_own_critic:
                needs_value = torch.ones_like(needs_value)
            is_reused = ~needs_value
            # V(s') stays zero after failures.
            has_future = ~failures(self.dones, infos).bool()
            queue.append(self._rows_to_evaluate(n, needs_value & has_future))
            self._mask.add(diverged_in(infos, self.ppo_device))
            self._record_step(n, infos)
            self._track_episodes(rewards, shaped_rewards, infos)

        places, queued = zip(*queue, strict=True)
        inputs = {name: torch.cat([rows[name] for rows in queued]) for name in queued[0]}
        if len(inputs["obs"]) > 0:
            next_values.flatten(0, 1)[torch.cat(places)] = self._eval_critic(inputs)
        return self._rollout_batch(step_time_s)

    def _env_reset_done(self) -> tuple[Any, Tensor]:
        """Reset ended episodes; return all observations, and the reset environments (n,)."""
        obs, env_ids = self.vec_env.reset_done()
        return self.obs_to_tensors(obs), env_ids

    def _after_reset(self, env_ids: Tensor) -> None:
        """Prepare a policy step, after the episodes of environments (n,) have started."""

    def get_action_values(self, obs: dict[str, Tensor]) -> dict[str, Tensor]:
        """Sample actions and evaluate their values, with the asymmetric critic if there is one."""
        result = self._evaluate_policy(obs, self._policy_inputs())
        if self.has_central_value:
            with torch.no_grad():
                values: Any = self.get_central_value({"states": obs["states"]})
            result["values"] = values
        return result

    def _policy_inputs(self) -> dict[str, Tensor]:
        """Return inputs of actor and critic in addition to the observation, (N, ...) each."""
        return {}

    def _evaluate_policy(
        self, obs: dict[str, Tensor], inputs: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        self.model.eval()
        with torch.no_grad():
            return self.model(
                {
                    "is_train": False,
                    "prev_actions": None,
                    "obs": self._preproc_obs(obs["obs"]),
                    "rnn_states": None,
                    **inputs,
                }
            )

    def _needs_next_value(self) -> Tensor:
        """Return (N,) bool, whether the next policy call does not evaluate s'."""
        return self.dones.bool()

    def _rows_to_evaluate(self, n: int, rows: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return indices of V(s') in the flat rollout, and critic inputs, for rows (N,) bool."""
        env_ids = rows.nonzero().flatten()
        inputs = {"obs": self._preproc_obs(self.obs["obs"]), **self._policy_inputs()}
        if self.has_central_value:
            inputs["states"] = self.obs["states"]
        queued = {name: value.index_select(0, env_ids) for name, value in inputs.items()}
        return n * len(rows) + env_ids, queued

    def _record_step(self, n: int, infos: dict[str, Any]) -> None:
        """Store an agent's own columns of step n."""

    def _track_episodes(
        self, rewards: Tensor, shaped_rewards: Tensor, infos: dict[str, Any]
    ) -> None:
        """Update episode statistics and observers."""
        finished = self.dones.nonzero(as_tuple=False)[:: self.num_agents]
        diverged = diverged_in(infos, finished.device)
        counted = finished if diverged is None else finished[~diverged[finished.flatten()]]
        going_on = 1.0 - self.dones.float()
        for total, meter, value in (
            (self.current_rewards, self.game_rewards, rewards),
            (self.current_shaped_rewards, self.game_shaped_rewards, shaped_rewards),
            (self.current_lengths, self.game_lengths, 1.0),
        ):
            total += value
            meter.update(total[counted])
            total *= going_on.view(-1, *(1,) * (total.ndim - 1))
        self.algo_observer.process_infos(infos, finished)

    def _eval_critic(self, obs_dict: dict[str, Tensor]) -> Tensor:
        """Return denormalised values (n, values) of raw `obs` or `states`, and policy inputs."""
        inputs = dict(obs_dict)
        with torch.no_grad():
            if self.has_central_value:
                values: Any = self.get_central_value({"states": inputs["states"]})
                return values
            self.model.eval()
            obs = self.model.norm_obs(inputs.pop("obs"))
            return self.model.denorm_value(self.model.a2c_network.eval_critic(obs, **inputs))

    def _rollout_batch(self, step_time_s: float) -> dict[str, Any]:
        buffer = self.experience_buffer.tensor_dict
        rewards = self._total_rewards(buffer["rewards"])
        kept = self._mask.kept
        if kept is not None:
            # With r = V and V' = 0 the advantage of a diverged row is zero, and the returns of
            # earlier rows end with its value.
            rewards = torch.where(kept.unsqueeze(-1), rewards, buffer["values"])
            buffer["next_values"].masked_fill_(~kept.unsqueeze(-1), 0.0)
        advantages = self.discount_values(
            buffer["dones"], buffer["values"], rewards, buffer["next_values"]
        )
        batch = self.experience_buffer.get_transformed_list(swap_and_flatten01, self.tensor_list)
        batch["returns"] = swap_and_flatten01(advantages + buffer["values"])
        for name, part in {**self._rollout_rewards, "rewards": rewards}.items():
            batch[name] = swap_and_flatten01(part)
        if kept is not None:
            batch = take_rows(batch, swap_and_flatten01(kept))
        batch["played_frames"] = self.batch_size * self.control_steps_per_action
        batch["step_time"] = step_time_s
        return batch

    def _total_rewards(self, task_rewards: Tensor) -> Tensor:
        """Return the rewards to learn from (H, N, values).

        Agents with several reward terms store them in `_rollout_rewards`, for example as
        `disc_rewards`; the log then has `disc_reward_mean` and `disc_reward_std`.
        """
        return task_rewards

    def discount_values(  # type: ignore[override]  # IsaacGymEnvs' CommonAgent has these arguments
        self, mb_fdones: Tensor, mb_values: Tensor, mb_rewards: Tensor, mb_next_values: Tensor
    ) -> Tensor:
        """Return generalised advantages (H, N, values) (Schulman et al. 2015, eq. 16).

        delta_t = r_t + gamma next_V_t - V_t;  A_t = delta_t + gamma tau (1 - done_t) A_{t+1}.

        Args:
            mb_fdones: (H, N) whether the episode ended in this step.
            mb_values: (H, N, values) values of the state before each step.
            mb_rewards: (H, N, values) rewards.
            mb_next_values: (H, N, values) values of the state after each step, zero after failures.
        """
        advantages = torch.empty_like(mb_rewards)
        not_done = (1.0 - mb_fdones.to(mb_rewards.dtype)).unsqueeze(-1)
        deltas = mb_rewards + self.gamma * mb_next_values - mb_values
        running = torch.zeros_like(mb_rewards[0])
        for t in reversed(range(len(mb_rewards))):
            running = deltas[t] + self.gamma * self.tau * not_done[t] * running
            advantages[t] = running
        return advantages

    def mean_policy(self, env: Env) -> Callable[[dict[str, Tensor]], Tensor]:
        """Return the policy without noise for `env`, another task of the same kind."""
        inputs = self._evaluation_inputs(env)

        def act(obs: dict[str, Tensor]) -> Tensor:
            tensors: Any = self.obs_to_tensors(obs)
            means = self._evaluate_policy(tensors, inputs())["mus"].float()
            actions: Any = self.preprocess_actions(means)
            return actions

        return act

    def _evaluation_inputs(self, env: Env) -> Callable[[], dict[str, Tensor]]:
        """Return a function that computes `_policy_inputs` for each step of `env`."""
        return dict

    # --- training set ----------------------------------------------------------------------

    def prepare_dataset(self, batch_dict: dict[str, Any]) -> None:
        """Normalise values and advantages, and fill the dataset."""
        is_frozen = self.frozen_until > 0 and self.epoch_num <= self.frozen_until
        self._frozen = actor_parameters(self.model.a2c_network) if is_frozen else []
        num_rows = current_group().smallest(self._enough_rows(len(batch_dict["returns"])))
        fit_datasets(self, num_rows)
        super().prepare_dataset(batch_dict)
        self.dataset.values_dict["advantages"] = self._calc_advs(batch_dict)

    def _calc_advs(self, batch_dict: dict[str, Any]) -> Tensor:
        """Return advantages (B,), normalised by the mean and deviation of rows that explored."""
        advantages = (batch_dict["returns"] - batch_dict["values"]).sum(dim=-1)
        if not self.normalize_advantage:
            return advantages
        return normalize_advantages(advantages, batch_dict.get("rand_action_mask"))

    def _dataset_row_limits(self) -> dict[str, int]:
        """Return the row limit of each dataset field (default: all)."""
        return {}

    def _run_mini_epochs(self) -> list[Tensor]:
        """Step through all minibatches `mini_epochs` times; return every KL."""
        kls: list[Tensor] = []
        for mini_epoch in range(self.mini_epochs_num):
            for index in range(len(self.dataset)):
                result: Any = self.train_actor_critic(self.dataset[index])
                kls.append(result["kl"])
                if self.schedule_type == "legacy":
                    self._schedule_learning_rate(result["kl"])
            if self.schedule_type == "standard":  # the mean KL of all mini-epochs so far
                self._schedule_learning_rate(torch_ext.mean_list(kls))
            self.diagnostics.mini_epoch(self, mini_epoch)
        if self.schedule_type == "standard_epoch":
            self._schedule_learning_rate(torch_ext.mean_list(kls))
        return kls

    def _after_update(self, batch_dict: dict[str, Any]) -> None:
        """Process the rollout after the last minibatch of an epoch."""

    # --- gradient step ---------------------------------------------------------------------

    def train_actor_critic(self, input_dict: dict[str, Any]) -> Any:
        """Take a gradient step, and collect the scalars to log."""
        self.set_train()
        self.calc_gradients(input_dict)
        result: Any = self.train_result
        self.collect(result)
        return result

    def calc_gradients(self, input_dict: dict[str, Tensor]) -> None:
        """Take one gradient step on a minibatch.

        The method sets `self.train_result` to means over the minibatch: `entropy`, `kl`, `last_lr`,
        `lr_mul`, `b_loss`, `actor_loss`, `actor_clip_frac`, `critic_loss`, and the agent's
        additional loss terms.
        """
        rows = self.prepare_minibatch(input_dict)
        gradients, values = self.executor.gradients(self.compute_loss, rows, self._learned)
        for parameter, gradient in zip(self._learned, gradients, strict=True):
            parameter.grad = gradient
        for parameter in self._frozen:
            parameter.grad = None  # Adam skips this parameter.
        self.trancate_gradients_and_step()

        neglogp = values.pop("neglogp")
        self.diagnostics.mini_batch(
            self,
            {
                "values": input_dict["old_values"],
                "returns": input_dict["returns"],
                "new_neglogp": neglogp,
                "old_neglogp": input_dict["old_logp_actions"],
                "masks": None,
            },
            self.e_clip,
            0,
        )
        self.train_result = {**values, "last_lr": self.last_lr, "lr_mul": 1.0}

    def prepare_minibatch(self, minibatch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Update the running statistics, and return the rows that `compute_loss` needs.

        Several threads compute slices of these rows. Random numbers, and values that depend on all
        rows, are therefore computed here and not in `compute_loss`. `row_weights` (M,), with mean
        1, are weights of the rows in the policy's losses.
        """
        inputs = self._normalizer_inputs(minibatch)
        for normalizer, *_ in inputs:
            normalizer.eval()  # `compute_loss` must not update it
        if current_group().size > 1:
            count_in_jointly(inputs)
        else:
            self.executor.map(RunningMeanStd.count_in, inputs)
        return dict(minibatch)

    def _normalizer_inputs(self, input_dict: dict[str, Tensor]) -> list[tuple[Any, ...]]:
        """Return tuples of a normaliser and the tensors (n, ...) that update it."""
        if not self.normalize_input:
            return []
        return [(self.model.running_mean_std, self._preproc_obs(input_dict["obs"]))]

    # --- loss ------------------------------------------------------------------------------
    # Several threads call the loss methods at the same time, each with a slice of the minibatch. A
    # loss method must not change the agent.

    def compute_loss(self, minibatch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of a minibatch from `prepare_minibatch`, and values to log.

        The values to log are the scalars `actor_clip_frac`, `kl` and all loss terms, and `neglogp`
        (n,).
        """
        batch = {
            "is_train": True,
            "prev_actions": minibatch["actions"],
            "obs": self._preproc_obs(minibatch["obs"]),
            **self._training_inputs(minibatch),
        }
        result = self.model(batch)
        neglogp, mu = result["prev_neglogp"], result["mus"]
        actor = self._actor_loss(
            minibatch["old_logp_actions"], neglogp, minibatch["advantages"], self.e_clip
        )
        critic = {"critic_loss": torch.zeros_like(minibatch["returns"])}
        if self.has_value_loss:
            values = (minibatch["old_values"], result["values"])
            critic = self._critic_loss(*values, self.e_clip, minibatch["returns"], self.clip_value)
        terms = {
            "actor_loss": (1.0, weighted_mean(actor["actor_loss"], minibatch)),
            "critic_loss": (self.critic_coef, critic["critic_loss"].mean()),
            "b_loss": (self.bounds_loss_coef or 0.0, weighted_mean(self.bound_loss(mu), minibatch)),
            "entropy": (-self.entropy_coef, weighted_mean(result["entropy"], minibatch)),
            **self._extra_losses(result, batch, minibatch),
        }
        logged: dict[str, Tensor] = {}
        weighted = []
        for name, (weight, term) in terms.items():
            logged[name] = term
            if weight != 0.0:
                weighted.append(weight * term)
        with torch.no_grad():
            logged["kl"] = torch_ext.policy_kl(
                mu, result["sigmas"], minibatch["mu"], minibatch["sigma"]
            )
        logged["neglogp"] = neglogp
        if "actor_clipped" in actor:
            clipped = actor["actor_clipped"].float()
            logged["actor_clip_frac"] = weighted_mean(clipped, minibatch)
        # The loss methods of a subclass may return more scalars.
        for name, value in {**actor, **critic}.items():
            if name not in logged and name != "actor_clipped" and isinstance(value, Tensor):
                logged[name] = value.detach().mean()
        return torch.stack(weighted).sum(), logged

    def _training_inputs(self, input_dict: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the model's inputs in addition to the observations."""
        return {}

    def _actor_loss(
        self,
        old_action_log_probs_batch: Tensor,
        action_log_probs: Tensor,
        advantage: Tensor,
        curr_e_clip: float,
    ) -> dict[str, Tensor]:
        """Return `actor_loss` (n,), and `actor_clipped` (n,) bool, which marks clipped ratios.

        The loss is PPO's negated clipped surrogate (Schulman et al. 2017, eq. 7). `ppo: False`
        selects the plain policy gradient. The arguments are negative log probabilities.
        """
        ratio = torch.exp(old_action_log_probs_batch - action_log_probs)
        clipped = (ratio - 1.0).abs() > curr_e_clip
        if not self.ppo:
            return {"actor_loss": action_log_probs * advantage, "actor_clipped": clipped}
        surrogate = advantage * ratio
        surrogate_clipped = advantage * ratio.clamp(1.0 - curr_e_clip, 1.0 + curr_e_clip)
        loss = torch.max(-surrogate, -surrogate_clipped)
        return {"actor_loss": loss, "actor_clipped": clipped}

    def _critic_loss(
        self,
        value_preds_batch: Tensor,
        values: Tensor,
        curr_e_clip: float,
        return_batch: Tensor,
        clip_value: bool,
    ) -> dict[str, Tensor]:
        """Return `critic_loss` (n, values), the squared errors of normalised values.

        rl_games returns half of them. If `clip_value` is True, the new values are clipped to
        +-`curr_e_clip` around the old values.
        """
        loss = (return_batch - values) ** 2
        if clip_value:
            change = (values - value_preds_batch).clamp(-curr_e_clip, curr_e_clip)
            loss = torch.max(loss, (return_batch - (value_preds_batch + change)) ** 2)
        return {"critic_loss": loss}

    def bound_loss(self, mu: Tensor) -> Tensor:
        """Return squared excesses (n,) of mean actions (n, A) over +-1 (rl_games: +-1.1)."""
        excess = mu.abs().sub(1.0).clamp(min=0.0)
        return (excess * excess).sum(dim=-1)

    def _extra_losses(
        self, result: dict[str, Tensor], batch: dict[str, Any], input_dict: dict[str, Tensor]
    ) -> LossTerms:
        """Return an agent's additional loss terms, given the model's outputs and inputs."""
        return {}

    # --- learning rate ---------------------------------------------------------------------

    def _schedule_learning_rate(self, kl: Tensor) -> None:
        # The KL divergence is read only for the adaptive schedule, because `item` waits for the
        # GPU.
        value = current_group().mean(kl).item() if self.is_adaptive_lr else 0.0
        self._advance_schedule(value)
        self.update_lr(self.last_lr)

    def _advance_schedule(self, kl: float) -> None:
        self.last_lr, self.entropy_coef = self.scheduler.update(
            self.last_lr, self.entropy_coef, self.epoch_num, 0, kl
        )

    def update_lr(self, lr: float) -> None:
        """Set the learning rate of the parameter groups that have no constant learning rate."""
        fixed = [group["lr"] for group in self.optimizer.param_groups[1:]]
        super().update_lr(lr)
        for group, own_lr in zip(self.optimizer.param_groups[1:], fixed, strict=True):
            group["lr"] = own_lr

    # --- log -------------------------------------------------------------------------------

    def collect(self, scalars: Mapping[str, Any]) -> None:
        """Append those scalars that are tensors to `train_log`."""
        for name, value in scalars.items():
            if isinstance(value, Tensor):
                self.train_log.setdefault(name, []).append(value)

    def train_info_means(self) -> dict[str, float]:
        """Return the mean of each collected scalar over the epoch."""
        return {name: torch_ext.mean_list(each).item() for name, each in self.train_log.items()}

    def _record_train_batch_info(
        self, batch_dict: dict[str, Any], train_info: dict[str, Any]
    ) -> None:
        """Add the rollout's reward terms to `train_info`, which `_log_train_info` writes."""
        for name in self._rollout_rewards:
            train_info[name] = batch_dict[name]

    def _log_train_info(self, train_info: dict[str, Any], frame: int) -> None:
        """Write an epoch's means to TensorBoard; `frame` is the first frame of the epoch."""
        for name, tag in self.scalars.items():
            if name in train_info:
                self.writer.add_scalar(tag, torch_ext.mean_list(train_info[name]).item(), frame)

    def write_stats(self, total_time: float, epoch_num: int, *args: Any) -> None:
        """Write rl_games' scalars, and the additional scalars of CommonAgent in IsaacGymEnvs."""
        self._check_finite({name: torch.stack(each) for name, each in self.train_log.items()})
        (_step_time, play_time, update_time, *_rest) = args
        frame, scaled_time, _scaled_play_time, curr_frames = args[-4:]
        writer = self.writer
        writer.add_scalar("performance/total_fps", curr_frames / scaled_time, frame)
        writer.add_scalar("performance/update_time", update_time, frame)
        writer.add_scalar("performance/play_time", play_time, frame)
        self._log_train_info(self._epoch_info, frame)
        if self.game_rewards.current_size > 0:
            mean_length = self.game_lengths.get_mean().item()
            mean_reward = self.game_rewards.get_mean()[0].item()
            writer.add_scalar("rewards/frame", mean_reward, frame)
            writer.add_scalar("episode_lengths/frame", mean_length, frame)
        super().write_stats(total_time, epoch_num, *args)

    # --- checkpoint ------------------------------------------------------------------------
    # `PPOSafeguards` reads and writes the checkpoint files.

    def set_full_state_weights(self, weights: dict[str, Any], set_epoch: bool = True) -> None:
        """Load a checkpoint, or raise CheckpointError."""
        super().set_full_state_weights(weights, set_epoch)
        if self.linear_lr:  # This sets the rate for the next epoch.
            self._advance_schedule(kl=0.0)
            # `update_lr` is not called, because it waits for other processes, which may restore
            # nothing.
            self.optimizer.param_groups[0]["lr"] = self.last_lr
        self._restored_best = self.last_mean_rewards
        self.has_restored = True


def given_params(params: dict[str, Any] | None, config: dict[str, Any] | None) -> dict[str, Any]:
    """Return the agent's section, which is `params` or, under its published name, `config`."""
    if (params is None) == (config is None):
        raise ConfigError(
            "an agent needs the section params of a train file: give either params= or config="
        )
    return params if config is None else config  # type: ignore[return-value]


def _prepare_settings(settings: dict[str, Any], unsupported: tuple[str, ...]) -> Any:
    """Refuse unsupported keys, adapt `config` for rl_games, and return its `mixed_precision`."""
    for key in unsupported:
        if settings.get(key):
            raise ConfigError(
                f"train.params.config.{key} is not supported by this agent; remove it"
            )
    mixed_precision = settings.get("mixed_precision", False)
    # In rl_games this key selects CUDA autocast with a gradient scaler, which bfloat16 does not
    # need.
    settings["mixed_precision"] = False
    leave_out_nccl(settings)
    settings["torch_compile"] = torch_compile_setting(
        settings.get("torch_compile"), str(settings.get("device", "cuda:0")), can_compile=False
    )
    return mixed_precision


def _make_central_value(agent: Any) -> CentralValueTrain:
    """Return the asymmetric critic, built like in rl_games' A2CAgent; refuse a recurrent critic."""
    settings = agent.central_value_config
    critic = CentralValueTrain(
        state_shape=agent.state_shape,
        value_size=agent.value_size,
        ppo_device=agent.ppo_device,
        num_agents=agent.num_agents,
        horizon_length=agent.horizon_length,
        num_actors=agent.num_actors,
        num_actions=agent.actions_num,
        seq_length=agent.seq_length,
        normalize_value=agent.normalize_value,
        network=settings["network"],
        config=settings,
        writter=agent.writer,
        max_epochs=agent.max_epochs,
        multi_gpu=agent.multi_gpu,
        zero_rnn_on_done=agent.zero_rnn_on_done,
    )
    if critic.is_rnn:
        raise ConfigError(
            "train.params.config.central_value_config.network.rnn is not supported by AMP-family"
            " agents; remove it"
        )
    return critic.to(agent.ppo_device)


def weighted_mean(values: Tensor, rows: dict[str, Tensor]) -> Tensor:
    """Return the mean of values (n,), weighted by `row_weights` if the rows have them."""
    weights = rows.get("row_weights")
    return values.mean() if weights is None else (weights * values).mean()
