"""HRLAgent: a high-level policy whose actions are the latents of a frozen low-level controller.

Peng et al. 2022, "ASE: Large-Scale Reusable Adversarial Skill Embeddings" (arXiv 2205.01906).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor

from isaacgymenvs_lite.checkpoints.llc_reference import (
    LLC_KEY,
    llc_checkpoint_for,
    warn_of_another_llc,
)
from isaacgymenvs_lite.learning.common_agent import CommonAgent
from isaacgymenvs_lite.learning.flat_config import complete_params, given_params
from isaacgymenvs_lite.learning.hrl_config import HRLParams, read_hrl_params
from isaacgymenvs_lite.learning.published_names import ReadOnly, accepts
from isaacgymenvs_lite.learning.skills.correlated_noise import CorrelatedNoise
from isaacgymenvs_lite.learning.skills.latents import latent_space
from isaacgymenvs_lite.learning.skills.low_level_policy import (
    LowLevelPolicy,
    LowLevelSizes,
    latents_of_actions,
)

# The train file whose values a flat configuration leaves out.
_DEFAULTS = "HumanoidASEHRLPPO"


class HRLAgent(CommonAgent):
    """The agent of `algo: name: hrl` or `hrl_continuous`.

    A step of the high level is `llc_steps` control steps under one latent: rewards are averaged
    over them, an episode that ends on the way earns nothing more, and is reset after the last one.

    Needs of the environment beside CommonAgent's: `get_task_obs_size()`, the number of trailing
    observation entries that the low-level controller does not see, and `infos["amp_obs"]` (N, F).

    Attributes:
        llc: the low-level controller.

    Args:
        base_name: name for rl_games' bookkeeping.
        params: the section `params` of a train file, as the Runner hands it over, or a flat
            configuration; see `flat_config.complete_params`.
        config: the same under the name that the published agents have for it.

    Raises:
        ConfigError: a value that cannot be used, or a train file of no low-level controller.
        CheckpointError: no low-level controller, or one that fits neither its file nor the task.
    """

    scalars: ClassVar[dict[str, str]] = {
        **CommonAgent.scalars,
        "disc_reward_mean": "info/disc_reward_mean",
        "disc_reward_std": "info/disc_reward_std",
    }

    _latent_dim = ReadOnly("llc.latent_dim", "the low-level controller")
    _task_size = ReadOnly("llc.num_task_obs", "the task")
    _llc_steps = ReadOnly("_hrl.llc_steps")
    _llc_agent = ReadOnly("llc", "_build_llc, which returns it")
    _task_reward_w = ReadOnly("_hrl.task_reward_w")
    _disc_reward_w = ReadOnly("_hrl.disc_reward_w")

    def __init__(
        self,
        base_name: str,
        params: dict[str, Any] | None = None,
        config: dict[str, Any] | None = None,
    ) -> None:
        self._params = complete_params(given_params(params, config), _DEFAULTS)
        super().__init__(base_name, self._params)

    def load_networks(self, params: dict[str, Any]) -> None:
        """Build the network that the section names, unless the configuration holds one."""
        if "network" not in self.config:
            super().load_networks(params)

    def _load_config_params(self, config: dict[str, Any]) -> None:
        super()._load_config_params(config)
        self._hrl: HRLParams = read_hrl_params(config)
        self._noise = CorrelatedNoise(self._hrl.exploration_correlation)
        self.llc = self._build_llc(self._hrl)
        self.control_steps_per_action = self._hrl.llc_steps
        self._disc_rewards = torch.zeros(self.num_actors, 1, device=self.ppo_device)
        # A subclass' reward as published depends on the motion alone.
        self._disc_reward_takes_latents = accepts(self._calc_disc_reward, 2)

    def _build_llc(self, params: HRLParams) -> LowLevelPolicy:
        """Return the low-level controller that the keys name."""
        return LowLevelPolicy(
            params.llc_config,
            llc_checkpoint_for(params.llc_checkpoint, self._params),
            self._build_llc_agent_config(),
            self.ppo_device,
        )

    def _build_llc_agent_config(self) -> LowLevelSizes:
        """Return what the task tells the low-level controller; see `LowLevelSizes.from_task`."""
        return LowLevelSizes.from_task(self.vec_env.env)

    def _setup_action_space(self) -> None:
        """Make the latent the agent's action; rl_games sized everything by the task's actions."""
        self.env_info = {**self.env_info, "action_space": latent_space(self.llc.latent_dim)}
        super()._setup_action_space()

    def init_tensors(self) -> None:
        """Allocate the rollout of style rewards, too."""
        super().init_tensors()
        buffer = self.experience_buffer.tensor_dict
        buffer["disc_rewards"] = torch.zeros_like(buffer["rewards"])

    # --- checkpoint ------------------------------------------------------------------------

    def get_full_state_weights(self) -> dict[str, Any]:
        """Return what a checkpoint holds, and over which low level it was trained."""
        return {**super().get_full_state_weights(), LLC_KEY: self.llc.reference}

    def set_full_state_weights(self, weights: dict[str, Any], set_epoch: bool = True) -> None:
        """Take over a checkpoint; as CommonAgent."""
        super().set_full_state_weights(weights, set_epoch)
        warn_of_another_llc(weights, self.llc.reference, self._restored_from)

    # --- rollout ---------------------------------------------------------------------------

    def get_action_values(self, obs: dict[str, Tensor]) -> dict[str, Tensor]:
        """As CommonAgent; with `exploration_correlation` the noise lasts over several steps."""
        result = super().get_action_values(obs)
        if self._hrl.exploration_correlation != 0.0:
            given = (result[name] for name in ("actions", "mus", "sigmas"))
            result["actions"], result["neglogpacs"] = self._noise.apply(*given)
        return result

    def preprocess_actions(self, actions: Tensor) -> Tensor:
        """Return actions (N, Z) clamped to +-1."""
        return actions.clamp(-1.0, 1.0)

    def _obs_tensor(self, obs: Any) -> Tensor:
        """Return the observation tensor (N, O) of what the environment gives."""
        tensors: Any = self.obs_to_tensors(obs)
        return tensors["obs"] if isinstance(tensors, dict) else tensors

    def _extract_llc_obs(self, obs: Tensor) -> Tensor:
        """Return observations (N, O) without the task's features."""
        return self.llc.extract_obs(obs)

    def _compute_llc_action(self, obs: Any, actions: Tensor) -> Tensor:
        """Return the task's actions (N, A) under the latents that `actions` (N, Z) point to."""
        llc_obs = self._extract_llc_obs(self._obs_tensor(obs))
        return self.llc.actions(llc_obs, latents_of_actions(actions))

    def env_step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        """Make `llc_steps` control steps under one latent.

        Args:
            actions: (N, Z).

        Returns:
            The observation after the last step, of an episode that ended before: the one at its
            end; mean rewards (N, 1); dones (N,), 1.0 where any step ended the episode; the infos of
            the last step, with `terminate` 1 where the episode's end was a failure.
        """
        actions = self.preprocess_actions(actions)
        obs = self._obs_tensor(self.obs)
        going_on = torch.ones(len(actions), device=self.ppo_device)
        terminate = torch.zeros_like(going_on)
        rewards = torch.zeros(len(actions), 1, device=self.ppo_device)
        self._disc_rewards = torch.zeros_like(rewards)
        infos: dict[str, Any] = {}
        for _ in range(self._hrl.llc_steps):
            raw_obs, step_rewards, dones, infos = self.vec_env.step(
                self._compute_llc_action(obs, actions)
            )
            playing = going_on.unsqueeze(1)
            obs = torch.where(playing.bool(), self._obs_tensor(raw_obs), obs)
            rewards += playing * step_rewards.to(self.ppo_device).view_as(rewards)
            if self._hrl.disc_reward_w != 0.0:
                amp_obs = infos["amp_obs"].to(self.ppo_device)
                given = (latents_of_actions(actions),) if self._disc_reward_takes_latents else ()
                self._disc_rewards += playing * self._calc_disc_reward(amp_obs, *given)
            terminate += going_on * self._step_terminated(dones, infos)
            going_on *= 1.0 - dones.to(self.ppo_device).float()
        self._disc_rewards /= self._hrl.llc_steps
        # A task may have forgotten an end that lies some steps back.
        env = self.vec_env.env
        env.reset_buf.masked_fill_((going_on == 0.0).to(env.device), 1)
        infos = {**infos, "terminate": terminate}
        return {"obs": obs}, rewards / self._hrl.llc_steps, 1.0 - going_on, infos

    def _calc_disc_reward(self, amp_obs: Tensor, latents: Tensor | None = None) -> Tensor:
        """Return the low level's style rewards (N, 1); see `LowLevelPolicy.style_reward`.

        Asked for only if disc_reward_w is not 0.
        """
        return self.llc.style_reward(amp_obs, latents)

    def _step_terminated(self, dones: Tensor, infos: dict[str, Any]) -> Tensor:
        self.dones = dones.to(self.ppo_device)
        return self._terminated(infos).float()

    def _record_step(self, n: int, infos: dict[str, Any]) -> None:
        super()._record_step(n, infos)
        self.experience_buffer.update_data("disc_rewards", n, self._disc_rewards)

    def _total_rewards(self, task_rewards: Tensor) -> Tensor:
        style = self.experience_buffer.tensor_dict["disc_rewards"]
        self._rollout_rewards = {"task_rewards": task_rewards, "disc_rewards": style}
        return self._combine_rewards(task_rewards, style)

    def _combine_rewards(self, task_rewards: Tensor, disc_rewards: Tensor) -> Tensor:
        """Return task_reward_w * task + disc_reward_w * style, (..., 1)."""
        return self._hrl.task_reward_w * task_rewards + self._hrl.disc_reward_w * disc_rewards

    def _track_episodes(
        self, rewards: Tensor, shaped_rewards: Tensor, infos: dict[str, Any]
    ) -> None:
        """As CommonAgent, in control steps and their rewards."""
        steps = self._hrl.llc_steps
        super()._track_episodes(steps * rewards, steps * shaped_rewards, infos)

    def mean_policy(self, env: Any) -> Callable[[dict[str, Tensor]], Tensor]:
        """Return what plays `env` one control step after another; see CommonAgent."""
        del env

        def choose(obs: Tensor) -> Tensor:
            means = self._evaluate_policy({"obs": obs}, {})["mus"].float()
            return self.preprocess_actions(means)

        act = self.llc.policy_under(choose, self._hrl.llc_steps, self._compute_llc_action)
        return lambda obs: act(self._obs_tensor(obs))

    def _before_update(self, batch_dict: dict[str, Any]) -> None:
        super()._before_update(batch_dict)
        style = self.experience_buffer.tensor_dict["disc_rewards"]
        self._collect({"disc_reward_mean": style.mean(), "disc_reward_std": style.std()})

    def _record_train_batch_info(
        self, batch_dict: dict[str, Any], train_info: dict[str, Any]
    ) -> None:
        super()._record_train_batch_info(batch_dict, train_info)
        train_info["disc_rewards"] = batch_dict["disc_rewards"]
