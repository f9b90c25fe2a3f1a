"""rl_games' PPO agent with this project's fast networks for CPUs, and its player."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from rl_games.algos_torch.players import PpoPlayerContinuous
from rl_games.common.a2c_common import swap_and_flatten01
from torch import Tensor

from isaacgymenvs_lite.config.train_params import torch_compile_setting
from isaacgymenvs_lite.distributed.group import current_group
from isaacgymenvs_lite.env_interface import Env, diverged_in
from isaacgymenvs_lite.learning.common_player import EpisodePlayer
from isaacgymenvs_lite.learning.cpu.parallel import take_models
from isaacgymenvs_lite.learning.diverged import EpisodeMeters, RolloutMask, fit_datasets, take_rows
from isaacgymenvs_lite.learning.modules.running_mean_std import normalize_advantages
from isaacgymenvs_lite.learning.restoring import RestoringPlayer
from isaacgymenvs_lite.learning.safeguards import PPOSafeguards, leave_out_nccl
from isaacgymenvs_lite.utils.precision import resolve_mixed_precision
from isaacgymenvs_lite.utils.threads import one_torch_thread


class PPOAgent(PPOSafeguards):
    """The agent of `algo: name: a2c_continuous`, with rl_games' loops, losses and checkpoints.

    On a CPU, `ParallelNetwork` evaluates the networks, including an asymmetric critic. Transitions
    of diverged simulations are left out of the update; see `diverged`.
    """

    def __init__(self, base_name: str, params: dict[str, Any]) -> None:
        config = params["config"]
        device = torch.device(config.get("device", "cuda:0"))
        precision = config.get("mixed_precision", False)
        on_cpu = device.type == "cpu"
        # In rl_games this key selects CUDA autocast with a gradient scaler, which is not used here.
        config["mixed_precision"] = not on_cpu and resolve_mixed_precision(precision, device)
        leave_out_nccl(config)
        config["torch_compile"] = torch_compile_setting(
            config.get("torch_compile"), device.type, can_compile=True
        )
        with one_torch_thread():  # Orthogonal initialisers depend on the number of threads.
            super().__init__(base_name, params)
        self._mask = RolloutMask(self.horizon_length)
        self._meters = EpisodeMeters(self, ("game_rewards", "game_shaped_rewards", "game_lengths"))
        if self.normalize_advantage:
            self._check_batch_size()
        critic_has_rnn = self.has_central_value and self.central_value_net.is_rnn
        self._has_sequences = self.is_rnn or critic_has_rnn
        self._sliced = on_cpu and not self._has_sequences
        if on_cpu:
            take_models(self, device, precision)

    def env_reset(self) -> Any:
        """Reset the environment at the start of training.

        torch then uses one thread, because more threads slow down small operations, and recurrent
        networks with several threads give different results in each run.
        """
        if self._sliced or torch.are_deterministic_algorithms_enabled():
            torch.set_num_threads(1)
        return super().env_reset()

    def env_step(self, actions: Tensor) -> Any:
        """Step the task, and record which simulations diverged."""
        result: Any = super().env_step(actions)
        *_, dones, infos = result
        diverged = diverged_in(infos, self.ppo_device)
        self._mask.add(diverged)
        self._meters.leave_out(diverged, dones)
        return result

    def mean_policy(self, env: Env) -> Callable[[dict[str, Tensor]], Tensor]:
        """Return the policy without exploration noise for `env`, another task of the same kind."""
        self.set_eval()
        of_training: Any = self.rnn_states or []
        states: Any = [  # (layers, N, units)
            torch.zeros(len(state), env.num_envs, state.shape[2], device=self.ppo_device)
            for state in of_training
        ]

        def act(obs: dict[str, Tensor]) -> Tensor:
            nonlocal states
            tensors: Any = self.obs_to_tensors(obs)
            if states:  # New episodes start with zero states.
                lasting = (env.progress_buf > 0).to(self.ppo_device).view(1, -1, 1)
                states = [state * lasting for state in states]
            result = self.model(
                {
                    "is_train": False,
                    "prev_actions": None,
                    "obs": self._preproc_obs(tensors["obs"]),
                    "rnn_states": states,
                }
            )
            states = result["rnn_states"]
            actions: Any = self.preprocess_actions(result["mus"].float())
            return actions

        return act

    def discount_values(self, *rollout: Tensor) -> Any:
        """Return advantages (H, N, values), which are zero in steps where a simulation diverged."""
        kept = self._mask.kept
        if kept is None:
            return super().discount_values(*rollout)
        return self.discount_values_masks(*rollout, mb_masks=kept.float())

    def prepare_dataset(self, batch_dict: dict[str, Any]) -> None:
        """Fill the dataset with the transitions in which no simulation diverged."""
        kept = self._mask.kept
        if kept is not None:
            flat = swap_and_flatten01(kept)
            self._enough_rows(int(flat.sum()))
            if self._has_sequences:
                batch_dict["rnn_masks"] = flat.float()
            else:
                batch_dict = take_rows(batch_dict, flat)
        if not self._has_sequences:
            num_rows = current_group().smallest(len(batch_dict["returns"]))
            fit_datasets(self, num_rows)
        super().prepare_dataset(batch_dict)
        if self.normalize_advantage and current_group().size > 1:
            advantages = (batch_dict["returns"] - batch_dict["values"]).sum(dim=1)
            normalized = normalize_advantages(advantages, batch_dict.get("rnn_masks"))
            self.dataset.values_dict["advantages"] = normalized

    def train_actor_critic(self, input_dict: dict[str, Any]) -> Any:
        """Take a gradient step; for a recurrent policy, losses are means over unmasked rows."""
        masks = input_dict.get("rnn_masks")
        if masks is not None:
            input_dict["rnn_masks"] = masks / masks.mean().clamp(min=1.0 / len(masks))
        return super().train_actor_critic(input_dict)


class PPOPlayer(EpisodePlayer, RestoringPlayer, PpoPlayerContinuous):
    """The player of `a2c_continuous`, including recurrent policies."""

    def __init__(self, params: dict[str, Any]) -> None:
        super().__init__(params)
        self.batch_size = self.env.num_envs * self.num_agents
        self.init_rnn()

    def on_step(self, dones: Tensor, infos: dict[str, Any]) -> None:
        """Reset the recurrent states of environments whose episode ended, dones (N,)."""
        if self.is_rnn:
            ended = dones.nonzero().flatten()
            for state in self.states:  # (layers, N, units)
                state[:, ended] = 0.0
