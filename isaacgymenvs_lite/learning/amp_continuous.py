"""AMPAgent: PPO with a style reward from a discriminator that is trained together with the policy.

Peng et al. 2021, "AMP: Adversarial Motion Priors for Stylized Physics-Based Character Control"
(arXiv 2104.02180), in the version of IsaacGymEnvs; docs/amp.md lists the differences.

The methods are in the order of an epoch. The rollout stores the AMP observation `amp_obs` of each
step, and the discriminator computes a reward from it. AMP observations of the clips
(demonstrations) and of earlier rollouts (replay buffer) are drawn. Each minibatch trains policy and
discriminator together. After the last minibatch, the rollout's `amp_obs` are stored in the replay
buffer.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from isaacgymenvs_lite.distributed.group import current_group
from isaacgymenvs_lite.env_interface import AMPEnv, TrackingDemo, require
from isaacgymenvs_lite.learning.amp_config import AMPParams, read_agent_params
from isaacgymenvs_lite.learning.common_agent import CommonAgent, LossTerms
from isaacgymenvs_lite.learning.modules.discriminator import (
    AMPObsShape,
    StyleDiscriminator,
    StyleLosses,
    disc_obs_size,
)
from isaacgymenvs_lite.learning.published_names import ReadOnly, accepts
from isaacgymenvs_lite.learning.replay_buffer import ReplayBuffer
from isaacgymenvs_lite.learning.restoring import Parts
from isaacgymenvs_lite.learning.warm_start import NUM_SAMPLES, clone_actions

log = logging.getLogger(__name__)

# Smoothing factor of `AMPAgent.staying_up`, which follows half of a change within 14 epochs.
_PER_EPOCH = 0.05
# `staying_up` rises from 0 to 1 between these mean episode lengths (shares of the time limit). The
# upper length is below 1, because exploration noise shortens episodes in training.
_BEGINS_TO_STAY_UP, _STAYS_UP = 0.3, 0.6
_AMP_OBS_KINDS = ("amp_obs", "amp_obs_replay", "amp_obs_demo")


class AMPAgent(StyleLosses, CommonAgent):
    """The agent of `algo: name: amp_continuous` or `amp`, with the logistic style reward.

    The task is an `AMPEnv`.

    Attributes:
        default_disc_reward: formula of the style reward if the key `disc_reward` is absent.
        params_class: dataclass of the agent's keys in addition to PPO's.
        env_contract: typing.Protocol that the task must fulfil.
        discriminator: network, normaliser and style reward.
        staying_up: smoothed mean episode length, rescaled to 0..1.
    """

    staying_up = 0.0
    stored = ("frozen_until", "staying_up")
    stored_buffers = ("_amp_obs_demo_buffer", "_amp_replay_buffer")
    default_disc_reward = "logistic"
    params_class: ClassVar[type[AMPParams]] = AMPParams
    env_contract: ClassVar[Any] = AMPEnv
    _env: AMPEnv
    scalars: ClassVar[dict[str, str]] = {
        **CommonAgent.scalars,
        "disc_loss": "losses/disc_loss",
        "disc_agent_acc": "info/disc_agent_acc",
        "disc_demo_acc": "info/disc_demo_acc",
        "disc_agent_logit": "info/disc_agent_logit",
        "disc_demo_logit": "info/disc_demo_logit",
        "disc_grad_penalty": "info/disc_grad_penalty",
        "disc_grad_penalty_weight": "info/disc_grad_penalty_weight",
        "disc_logit_loss": "info/disc_logit_loss",
        "disc_reward_mean": "info/disc_reward_mean",
        "disc_reward_std": "info/disc_reward_std",
        "task_reward_mean": "info/task_reward_mean",
        "style_share": "info/style_reward_share",
    }

    _task_reward_w = ReadOnly("_amp.task_reward_w")
    _disc_reward_w = ReadOnly("style_weight", "train.params.config.disc_reward_w")
    _disc_reward_scale = ReadOnly("_amp.disc_reward_scale")
    _disc_coef = ReadOnly("_amp.disc_coef")
    _disc_logit_reg = ReadOnly("_amp.disc_logit_reg")
    _disc_grad_penalty = ReadOnly("_amp.disc_grad_penalty")
    _disc_weight_decay = ReadOnly("_amp.disc_weight_decay")
    _amp_batch_size = ReadOnly("_amp.amp_batch_size")
    _amp_replay_keep_prob = ReadOnly("_amp.amp_replay_keep_prob")
    _normalize_amp_input = ReadOnly("_amp.normalize_amp_input")
    _enable_eps_greedy = ReadOnly("_amp.enable_eps_greedy")
    _amp_input_mean_std = ReadOnly("discriminator.normalizer", "the agent's discriminator")
    _observes_goal = True
    _amp_observation_space = ReadOnly("_env.amp_observation_space", "the task")

    # --- constructor -----------------------------------------------------------------------

    def _load_config_params(self, config: dict[str, Any]) -> None:
        super()._load_config_params(config)
        self._amp = read_agent_params(config, self.params_class)
        self._env = require(self.vec_env.env, self.env_contract, "train.params.algo: AMP")
        self._max_episode_steps: int | None = getattr(self._env, "max_episode_length", None)
        if self._max_episode_steps is None and self._amp.disc_grad_penalty_final is not None:
            log.info("disc_grad_penalty is constant: the task has no max_episode_length")
        self._amp_obs_size = disc_obs_size(AMPObsShape.from_task(self._env), self._amp)
        # Some environments act without exploration noise if this attribute is True.
        self._masks_exploration = self._amp.enable_eps_greedy
        self._amp_minibatch_size = min(self._amp.amp_minibatch_size, self.minibatch_size)

    def _build_net_config(self) -> dict[str, Any]:
        return {**super()._build_net_config(), "amp_input_shape": (self._amp_obs_size,)}

    def _build_modules(self) -> None:
        super()._build_modules()
        self.discriminator = StyleDiscriminator(
            self.model.a2c_network,
            self._amp_obs_size,
            self._amp,
            self.default_disc_reward,
            self.ppo_device,
        )
        # A subclass may have the published `_disc_loss`, which has three arguments and computes the
        # gradient itself.
        self._disc_loss_takes_gradient = accepts(self._disc_loss, 4)

    def _parameter_groups(self) -> list[dict[str, Any]]:
        if self._amp.disc_learning_rate is None:
            return super()._parameter_groups()
        disc = self.model.a2c_network.disc_parameters()
        others = [p for p in self.model.parameters() if all(p is not d for d in disc)]
        return [{"params": others}, {"params": disc, "lr": self._amp.disc_learning_rate}]

    def init_tensors(self) -> None:
        """Allocate the rollout and the discriminator's buffers."""
        super().init_tensors()
        self._build_amp_buffers()

    def _build_amp_buffers(self) -> None:
        """Allocate the rollout's `amp_obs`, and the buffers of demonstrations and replayed rows."""
        self.experience_buffer.tensor_dict["amp_obs"] = torch.zeros(
            self.horizon_length, self.num_actors, self._amp_obs_size, device=self.ppo_device
        )
        self.tensor_list += ["amp_obs"]
        self._build_rand_action_probs()
        self._masks_exploration |= bool((self._rand_action_probs < 1.0).any())
        if self._masks_exploration:
            self.experience_buffer.tensor_dict["rand_action_mask"] = torch.zeros(
                self.horizon_length, self.num_actors, device=self.ppo_device
            )
            self.tensor_list += ["rand_action_mask"]
        # This buffer holds demonstrations (AMP observations of the clips).
        self._amp_obs_demo_buffer = ReplayBuffer(
            self._amp.amp_obs_demo_buffer_size, self.ppo_device
        )
        # This buffer holds AMP observations of earlier policies.
        self._amp_replay_buffer = ReplayBuffer(self._amp.amp_replay_buffer_size, self.ppo_device)

    def _build_rand_action_probs(self) -> None:
        """Set `_rand_action_probs` (N,), each environment's probability of exploration noise."""
        self._rand_action_probs = torch.ones(self.num_actors, device=self.ppo_device)
        if self._amp.enable_eps_greedy:
            self._rand_action_probs = exploration_probs(self.num_actors).to(self.ppo_device)

    def _init_train(self) -> None:
        super()._init_train()
        self._init_amp_demo_buf()
        if self._amp.warm_start_steps > 0 and not self.has_restored:
            self._warm_start()

    def _warm_start(self) -> None:
        """Train the mean action to follow the reference motions, if their actions are known."""
        start_s = time.monotonic()
        demo = self._fetch_tracking_demo()
        if demo is None or not self.model.a2c_network.separate:
            log.info("no warm start: the clips do not provide all observations of the policy")
            return
        log.info("warm start: %d steps on the clips", self._amp.warm_start_steps)
        normalizer = self.model.running_mean_std if self.normalize_input else None
        steps, noise = self._amp.warm_start_steps, self._amp.warm_start_noise
        latents = self._tracking_latents(demo)
        error = clone_actions(self.model, normalizer, demo, steps, noise, latents)
        self.frozen_until = self._amp.warm_start_frozen_epochs
        taken_s = time.monotonic() - start_s
        log.info("warm start: action error %.3f after %.1f s", error, taken_s)

    def _fetch_tracking_demo(self) -> TrackingDemo | None:
        """Return poses of clips with their actions; None if the task does not know the actions."""
        fetch = getattr(self._env, "fetch_tracking_demo", None)
        fetched = None if fetch is None else fetch(NUM_SAMPLES, self._observes_goal)
        if fetched is None:
            return None
        inputs: Any = self._preproc_obs(fetched.obs.to(self.ppo_device))
        actions, amp_obs = (rows.to(self.ppo_device) for rows in (fetched.actions, fetched.amp_obs))
        return TrackingDemo(inputs, actions, self.discriminator.truncate(amp_obs))

    def _tracking_latents(self, demo: TrackingDemo) -> Tensor | None:
        """Return latents (n, Z) for the poses in `demo`; None if the policy has no latents."""
        return None

    def _init_amp_demo_buf(self) -> None:
        """Fill the buffer of demonstrations."""
        size = self._amp_obs_demo_buffer.get_buffer_size()
        for _ in range(math.ceil(size / self._amp.amp_batch_size)):
            self._store_demos()

    def _update_amp_demos(self) -> None:
        """Add new demonstrations to the buffer once per epoch."""
        self._store_demos()

    def _store_demos(self) -> None:
        demos = self._fetch_amp_obs_demo(self._amp.amp_batch_size)
        self._amp_obs_demo_buffer.store({"amp_obs": self.discriminator.truncate(demos)})

    def _fetch_amp_obs_demo(self, num_samples: int) -> Tensor:
        """Return AMP observations (n, F) of the reference motions."""
        return self._env.fetch_amp_obs_demo(num_samples)

    # --- rollout ---------------------------------------------------------------------------

    def get_action_values(self, obs: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return sampled actions; environments drawn with `_rand_action_probs` act with noise."""
        result = super().get_action_values(obs)
        if self._masks_exploration:
            self._explored = torch.bernoulli(self._rand_action_probs)
            explored = self._explored.bool().unsqueeze(-1)
            result["actions"] = torch.where(explored, result["actions"], result["mus"])
        return result

    def _record_step(self, n: int, infos: dict[str, Any]) -> None:
        amp_obs = self.discriminator.truncate(infos["amp_obs"])
        self.experience_buffer.update_data("amp_obs", n, amp_obs)
        if self._masks_exploration:
            self.experience_buffer.update_data("rand_action_mask", n, self._explored)

    def _total_rewards(self, task_rewards: Tensor) -> Tensor:
        amp_obs = self.experience_buffer.tensor_dict["amp_obs"]
        amp_rewards = self._calc_amp_rewards(amp_obs, *self._reward_latents())
        self._rollout_rewards = {"task_rewards": task_rewards, **amp_rewards}
        return self._combine_rewards(task_rewards, amp_rewards)

    @property
    def style_weight(self) -> float:
        """The weight of the style reward in this epoch."""
        final = self._amp.disc_reward_w_final
        is_late = 0 < 2 * self.max_epochs < 3 * self.epoch_num
        return self._amp.disc_reward_w if final is None or not is_late else final

    def _combine_rewards(self, task_rewards: Tensor, amp_rewards: dict[str, Tensor]) -> Tensor:
        """Return the total rewards task_reward_w * task + style_weight * style, (..., 1)."""
        style_rewards = self.style_weight * amp_rewards["disc_rewards"]
        return self._amp.task_reward_w * task_rewards + style_rewards

    # --- training set ----------------------------------------------------------------------

    def prepare_dataset(self, batch_dict: dict[str, Any]) -> None:
        """Fill the dataset, including AMP observations of rollout, replay buffer and clips."""
        task, style = (self._rollout_rewards[name] for name in ("task_rewards", "disc_rewards"))
        of_task = (self._amp.task_reward_w * task.mean()).abs()
        of_style = (self.style_weight * style.mean()).abs()
        self.collect({"style_share": of_style / (of_task + of_style).clamp(min=1e-8)})
        self._schedule_grad_penalty()
        self._update_amp_demos()
        self._draw_disc_rows(batch_dict)
        super().prepare_dataset(batch_dict)
        for name in (*_AMP_OBS_KINDS, "rand_action_mask"):
            if name in batch_dict:
                self.dataset.values_dict[name] = batch_dict[name]

    def _schedule_grad_penalty(self) -> None:
        """Lower the gradient penalty towards its final weight as episodes become longer."""
        final, max_steps = self._amp.disc_grad_penalty_final, self._max_episode_steps
        if final is None or max_steps is None:
            return
        episodes = self.game_lengths.current_size
        # Episodes of all processes are summed, because one process alone may have no episode yet.
        sums = torch.tensor([episodes, episodes * self.game_lengths.get_mean().item()])
        episodes, steps = current_group().sum_(sums).tolist()
        if episodes > 0:
            share = steps / episodes / max_steps
            now = (share - _BEGINS_TO_STAY_UP) / (_STAYS_UP - _BEGINS_TO_STAY_UP)
            now = min(max(now, 0.0), 1.0)
            self.staying_up += _PER_EPOCH * (now - self.staying_up)
        first, progress = self._amp.disc_grad_penalty, self.staying_up
        weight = float(first ** (1.0 - progress) * min(first, final) ** progress)
        self.discriminator.grad_penalty = weight
        self.collect({"disc_grad_penalty_weight": torch.tensor(weight)})

    def _draw_disc_rows(self, batch_dict: dict[str, Any]) -> None:
        """Add AMP observations of the clips and of earlier rollouts to the batch."""
        fakes = batch_dict["amp_obs"]
        batch_dict["amp_obs_demo"] = self._amp_obs_demo_buffer.sample(len(fakes))["amp_obs"]
        if self._amp_replay_buffer.get_total_count() > 0:
            fakes = self._amp_replay_buffer.sample(len(fakes))["amp_obs"]
        batch_dict["amp_obs_replay"] = fakes

    def prepare_minibatch(self, minibatch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Add noise on AMP observations, and weights that are 0 for steps without exploration."""
        rows = super().prepare_minibatch(minibatch)
        if self._masks_exploration:
            mask = minibatch["rand_action_mask"]
            share = current_group().mean(mask.mean())
            rows["row_weights"] = mask / share.clamp(min=1.0 / len(mask))
        if self._amp.disc_input_noise > 0.0:
            for name in _AMP_OBS_KINDS:
                noise = torch.randn_like(minibatch[name])
                rows[f"{name}_noise"] = self._amp.disc_input_noise * noise
        return rows

    def _dataset_row_limits(self) -> dict[str, int]:
        return dict.fromkeys(_AMP_OBS_KINDS, self._amp_minibatch_size)

    def _training_inputs(self, input_dict: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return normalised AMP observations, and the noise that the model adds to them."""
        inputs = super()._training_inputs(input_dict)
        for name in _AMP_OBS_KINDS:
            inputs[name] = self._preproc_amp_obs(input_dict[name])
            if f"{name}_noise" in input_dict:
                inputs[f"{name}_noise"] = input_dict[f"{name}_noise"]
        if not self._disc_loss_takes_gradient:
            inputs["amp_obs_demo"].requires_grad_()
        return inputs

    def _normalizer_inputs(self, input_dict: dict[str, Tensor]) -> list[tuple[Any, ...]]:
        inputs = super()._normalizer_inputs(input_dict)
        if self.discriminator.normalizer is not None:
            kinds = map(input_dict.__getitem__, _AMP_OBS_KINDS)
            inputs.append((self.discriminator.normalizer, *kinds))
        return inputs

    def _extra_losses(
        self, result: dict[str, Tensor], batch: dict[str, Any], input_dict: dict[str, Tensor]
    ) -> LossTerms:
        terms = super()._extra_losses(result, batch, input_dict)
        agent_logit = torch.cat((result["disc_agent_logit"], result["disc_agent_replay_logit"]))
        gradient = (result["disc_demo_gradient"],) if self._disc_loss_takes_gradient else ()
        info = self._disc_loss(
            agent_logit, result["disc_demo_logit"], batch["amp_obs_demo"], *gradient
        )
        for name, value in info.items():
            terms[name] = (self._amp.disc_coef if name == "disc_loss" else 0.0, value.mean())
        return terms

    def _after_update(self, batch_dict: dict[str, Any]) -> None:
        self._store_replay_amp_obs(batch_dict["amp_obs"])

    def _store_replay_amp_obs(self, amp_obs: Tensor, **others: Tensor) -> None:
        """Store AMP observations (n, F) and other columns; a full buffer stores a random share."""
        rows = {"amp_obs": amp_obs, **others}
        self._amp_replay_buffer.store_some(rows, self._amp.amp_replay_keep_prob)

    # --- checkpoint ------------------------------------------------------------------------

    def _parts(self) -> Parts:
        parts = super()._parts()
        own = self.discriminator.checkpoint_modules
        return replace(parts, modules={**parts.modules, **own})

    def get_stats_weights(self, model_stats: bool = False) -> dict[str, Any]:
        """Return the normalisers' statistics, with IsaacGymEnvs' key for AMP observations."""
        own = self.discriminator.checkpoint_modules
        states = {key: module.state_dict() for key, module in own.items()}
        return {**super().get_stats_weights(model_stats), **states}

    def set_stats_weights(self, weights: dict[str, Any]) -> None:
        """Load normaliser statistics."""
        super().set_stats_weights(weights)
        for key, module in self.discriminator.checkpoint_modules.items():
            module.load_state_dict(weights[key])


def exploration_probs(num_envs: int) -> Tensor:
    """Return each environment's probability of exploration noise (N,), as in ASE.

    Environment i explores with probability 1 - exp(10 (i / (N - 1) - 1)); a single environment
    always explores.
    """
    if num_envs == 1:
        return torch.ones(1)
    probs = 1.0 - torch.exp(10.0 * (torch.linspace(0.0, 1.0, num_envs) - 1.0))
    probs[0], probs[-1] = 1.0, 0.0
    return probs


class LeastSquaresAMPAgent(AMPAgent):
    """The agent of `algo: name: amp_agent`; its default is the AMP paper's bounded style reward.

    In IsaacGymEnvs, scripts register AMPAgent under this name, and use the logistic reward.
    """

    default_disc_reward = "least_squares"
