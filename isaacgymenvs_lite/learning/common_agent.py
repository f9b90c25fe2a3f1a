"""CommonAgent: PPO as IsaacGymEnvs' CommonAgent, and the one rollout and update loop here.

rl_games' own `train()` runs it, so that checkpoints, stop rules and diagnostics are rl_games'.
Agents override the hooks of `agent_hooks`, never the loops.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from rl_games.algos_torch import torch_ext
from rl_games.common.a2c_common import ContinuousA2CBase, swap_and_flatten01
from torch import Tensor

from isaacgymenvs_lite.config.train_params import torch_compile_setting
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_datasets import AMPDataset
from isaacgymenvs_lite.learning.cpu.parallel import parallelize
from isaacgymenvs_lite.learning.flat_config import given_section
from isaacgymenvs_lite.learning.minibatch_loss import MinibatchLoss
from isaacgymenvs_lite.learning.modules.running_mean_std import replace_normalizers
from isaacgymenvs_lite.learning.next_values import NextValues
from isaacgymenvs_lite.learning.published_names import ExplainedNames
from isaacgymenvs_lite.learning.training_log import TrainingLog

_UNSUPPORTED_KEYS = (
    "central_value_config",
    "normalize_rms_advantage",
    "self_play_config",
    "use_action_masks",
)


class CommonAgent(ExplainedNames, NextValues, MinibatchLoss, TrainingLog):
    """PPO that asks the environment for resets and bootstraps with the value after each step.

    Differences from rl_games' `A2CAgent`: see docs/amp.md and `losses`.

    Attributes:
        control_steps_per_action: steps of the environment that `env_step` makes; frames count them.

    Args:
        base_name: name for rl_games' bookkeeping.
        params: the section `params` of a train file, prepared by the Runner.
        config: the same under the name that the published agents have for it.

    Raises:
        ConfigError: a key that this family of agents does not support.
        OverrideError: a subclass overrides what is not called here; at its definition.
    """

    # rl_games declares these as None and fills them in its constructors.
    vec_env: Any
    writer: Any
    obs: Any
    train_result: Any
    tensor_list: list[str]
    control_steps_per_action = 1

    def __init__(
        self,
        base_name: str,
        params: dict[str, Any] | None = None,
        config: dict[str, Any] | None = None,
    ) -> None:
        section = given_section(params, config)
        settings: dict[str, Any] = section["config"]
        for key in _UNSUPPORTED_KEYS:
            if settings.get(key):
                raise ConfigError(
                    f"train.params.config.{key} is not supported by AMP-family agents; remove it"
                )
        wanted_precision = settings.get("mixed_precision", False)
        # rl_games' own switch means CUDA autocast with a gradient scaler; bfloat16 needs no scaler.
        settings["mixed_precision"] = False
        settings["torch_compile"] = torch_compile_setting(
            settings.get("torch_compile"), str(settings.get("device", "cuda:0")), can_compile=False
        )
        # Not A2CAgent's constructor: it builds the model before an agent can say with which inputs.
        ContinuousA2CBase.__init__(self, base_name, section)
        self._check_batch_size()
        self.network_path = self.nn_dir
        self._load_config_params(self.config)
        self._setup_action_space()

        self.model = self.network.build(self._build_net_config())
        self.model.to(self.ppo_device)
        replace_normalizers(self.model)
        self.executor = parallelize(self.model, self.ppo_device, wanted_precision)
        self.states = None
        self.init_rnn_from_model(self.model)
        if self.is_rnn:
            raise ConfigError("train.params.network.rnn is not supported by AMP-family agents")
        self.last_lr = float(self.last_lr)
        self._learned = [p for p in self.model.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(
            self._parameter_groups(),
            self.last_lr,
            eps=1e-8,
            weight_decay=self.weight_decay,
            fused=True,
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
        if self.normalize_value:
            self.value_mean_std = self.model.value_mean_std
        self._train_info: dict[str, list[Tensor]] = {}
        self._epoch_info: dict[str, Any] = {}
        self._rollout_rewards: dict[str, Tensor] = {}
        self._bootstrap_queue: list[tuple[Tensor, dict[str, Tensor]]] = []
        self._restored_best: float | None = None
        self.algo_observer.after_init(self)

    def _setup_action_space(self) -> None:
        """Take number and limits of the actions from `env_info`; the networks do not exist yet."""
        box = self.env_info["action_space"]
        self.actions_num = box.shape[0]
        self.actions_low = torch.from_numpy(box.low.copy()).float().to(self.ppo_device)
        self.actions_high = torch.from_numpy(box.high.copy()).float().to(self.ppo_device)

    def _build_net_config(self) -> dict[str, Any]:
        """Return the arguments that the model is built with."""
        return {
            "actions_num": self.actions_num,
            "input_shape": self.obs_shape,
            "num_seqs": self.num_actors * self.num_agents,
            "value_size": self.value_size,
            "normalize_value": self.normalize_value,
            "normalize_input": self.normalize_input,
        }

    def init_tensors(self) -> None:
        """Allocate the rollout buffers; rl_games calls this once before training."""
        super().init_tensors()
        buffer = self.experience_buffer.tensor_dict
        buffer["next_values"] = torch.zeros_like(buffer["values"])

    def env_reset(self) -> Any:
        """Reset the environment at the start of training, and keep the restored best reward.

        The networks have threads of their own; what is left is too small to be shared by torch's.
        rl_games forgets the best reward of a checkpoint between restoring and training, and
        would overwrite the best checkpoint by a worse one. Calls `_init_train`.
        """
        if self._restored_best is not None:
            self.last_mean_rewards, self._restored_best = self._restored_best, None
        torch.set_num_threads(1)
        self._init_train()
        return super().env_reset()

    def set_full_state_weights(self, weights: dict[str, Any], set_epoch: bool = True) -> None:
        """Take over a checkpoint; see `env_reset` for the best reward.

        Raises:
            CheckpointError: it holds a model without the state of its training, or does not fit.
        """
        own_rates = [group["lr"] for group in self.optimizer.param_groups]
        super().set_full_state_weights(weights, set_epoch)
        # The settings of this run count, as they do for the learning rate.
        for group, rate in zip(self.optimizer.param_groups, own_rates, strict=True):
            group["lr"] = rate
        self._restored_best = self.last_mean_rewards

    # --- rollout ---------------------------------------------------------------------------

    def play_steps(self) -> dict[str, Any]:
        """Roll the policy out for `horizon_length` steps; rows are (environment, step)-major."""
        buffer = self.experience_buffer
        step_time_s = 0.0
        for n in range(self.horizon_length):
            self.obs, reset_ids = self._env_reset_done()
            self._after_reset(reset_ids.to(self.ppo_device))
            self._before_step()
            result = self.get_action_values(self.obs)
            if n > 0:
                self._fill_next_values(n - 1, result["values"])
            buffer.update_data("obses", n, self.obs["obs"])
            for name in self.update_list:
                buffer.update_data(name, n, result[name])

            start = time.perf_counter()
            self.obs, rewards, self.dones, infos = self.env_step(result["actions"])
            step_time_s += time.perf_counter() - start

            shaped_rewards = self.rewards_shaper(rewards)
            buffer.update_data("rewards", n, shaped_rewards)
            buffer.update_data("dones", n, self.dones)
            self._queue_bootstrap_values(n, infos)
            self._record_step(n, infos)
            self._track_episodes(rewards, shaped_rewards, infos)
        return self._rollout_batch(step_time_s)

    def _env_reset_done(self) -> tuple[Any, Tensor]:
        """Let ended episodes start anew; return all observations, and the environments (n,)."""
        obs, env_ids = self.vec_env.reset_done()
        return self.obs_to_tensors(obs), env_ids

    def get_action_values(self, obs: dict[str, Tensor]) -> dict[str, Tensor]:
        """Sample actions for observations; values are denormalised."""
        with self._acting_in_rollout(obs):
            return self._evaluate_policy(obs, self._policy_inputs())

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

    def mean_policy(self, env: Any) -> Callable[[dict[str, Tensor]], Tensor]:
        """Return what plays `env`, another task of the same kind: mean actions without noise.

        Args:
            env: a `VecTask`; the policy may look at its `progress_buf`.
        """
        inputs = self._evaluation_inputs(env)

        def act(obs: dict[str, Tensor]) -> Tensor:
            tensors: Any = self.obs_to_tensors(obs)
            means = self._evaluate_policy(tensors, inputs())["mus"].float()
            actions: Any = self.preprocess_actions(means)
            return actions

        return act

    def _rollout_batch(self, step_time_s: float) -> dict[str, Any]:
        self._evaluate_bootstrap_queue()
        buffer = self.experience_buffer.tensor_dict
        rewards = self._total_rewards(buffer["rewards"])
        advantages = self.discount_values(
            buffer["dones"], buffer["values"], rewards, buffer["next_values"]
        )
        batch = self.experience_buffer.get_transformed_list(swap_and_flatten01, self.tensor_list)
        batch["returns"] = swap_and_flatten01(advantages + buffer["values"])
        for name, part in {**self._rollout_rewards, "rewards": rewards}.items():
            batch[name] = swap_and_flatten01(part)
        batch["played_frames"] = self.batch_size * self.control_steps_per_action
        batch["step_time"] = step_time_s
        return batch

    # --- update ----------------------------------------------------------------------------

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
        self._train_info = {}
        self._before_update(batch)
        self.prepare_dataset(batch)
        self.algo_observer.after_steps()
        lr_mul, kls = self._run_mini_epochs()
        self._after_update(batch)
        end = time.perf_counter()
        info = {
            **self._train_info,
            "last_lr": [self.last_lr],
            "lr_mul": [lr_mul],
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
            lr_mul,
        )

    def _run_mini_epochs(self) -> tuple[float, list[Tensor]]:
        """Step through all minibatches `mini_epochs` times; return lr_mul and every KL."""
        kls: list[Tensor] = []
        lr_mul = 1.0
        for mini_epoch in range(self.mini_epochs_num):
            for index in range(len(self.dataset)):
                result: Any = self.train_actor_critic(self.dataset[index])
                lr_mul = result["lr_mul"]
                kls.append(result["kl"])
                if self.schedule_type == "legacy":
                    self._schedule_learning_rate(result["kl"])
            if self.schedule_type == "standard":
                self._schedule_learning_rate(torch_ext.mean_list(kls))
            self.diagnostics.mini_epoch(self, mini_epoch)
        if self.schedule_type == "standard_epoch":
            self._schedule_learning_rate(torch_ext.mean_list(kls))
        return lr_mul, kls

    def train_actor_critic(self, input_dict: dict[str, Any]) -> Any:
        """Take a gradient step; unlike rl_games' it leaves the optimiser's step sizes alone."""
        self.set_train()
        self.calc_gradients(input_dict)
        result: Any = self.train_result
        self._collect({n: value for n, value in result.items() if isinstance(value, Tensor)})
        return result

    def update_lr(self, lr: float) -> None:
        """Set the step size of all parameters but those that have one of their own."""
        fixed = [group["lr"] for group in self.optimizer.param_groups[1:]]
        super().update_lr(lr)
        for group, own_lr in zip(self.optimizer.param_groups[1:], fixed, strict=True):
            group["lr"] = own_lr

    def _schedule_learning_rate(self, kl: Tensor) -> None:
        # Only the adaptive schedule looks at the KL, and reading it waits for the device.
        kl_value = kl.item() if self.is_adaptive_lr else 0.0
        self.last_lr, self.entropy_coef = self.scheduler.update(
            self.last_lr, self.entropy_coef, self.epoch_num, 0, kl_value
        )
        self.update_lr(self.last_lr)

    def prepare_dataset(self, batch_dict: dict[str, Any]) -> None:
        """Normalise values and advantages and hand all rows to the dataset."""
        super().prepare_dataset(batch_dict)
        self.dataset.values_dict["advantages"] = self._calc_advs(batch_dict)
        self.dataset.values_dict.update(self._extra_dataset(batch_dict))

    def _calc_advs(self, batch_dict: dict[str, Any]) -> Tensor:
        """Return (B,) the advantages to learn from, of raw `returns` and `values` (B, values)."""
        advantages = (batch_dict["returns"] - batch_dict["values"]).sum(dim=-1)
        if not self.normalize_advantage:
            return advantages
        return (advantages - advantages.mean()) / (advantages.std() + 1e-8)

    def calc_gradients(self, input_dict: dict[str, Tensor]) -> None:
        """Take one gradient step on a minibatch.

        `self.train_result` is then what the published agents keep of one: `entropy`, `kl`,
        `last_lr`, `lr_mul`, `b_loss`, `actor_loss`, `actor_clip_frac`, `critic_loss` and the terms
        that an agent adds, means over the minibatch without gradients.
        """
        self._update_normalizers(input_dict)
        rows = input_dict | self._minibatch_extras(input_dict)
        gradients, values = self.executor.gradients(self._compute_loss, rows, self._learned)
        for parameter, gradient in zip(self._learned, gradients, strict=True):
            parameter.grad = gradient
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
