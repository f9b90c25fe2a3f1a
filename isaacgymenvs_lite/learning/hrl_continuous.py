"""HRLAgent: a high-level policy whose actions are the latents of a frozen low-level controller.

Peng et al. 2022, "ASE: Large-Scale Reusable Adversarial Skill Embeddings" (arXiv 2205.01906).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from omegaconf import OmegaConf
from rl_games.common import env_configurations, tr_helpers
from rl_games.common.algo_observer import DefaultAlgoObserver
from torch import Tensor

from isaacgymenvs_lite.checkpoints.llc_reference import (
    LLC_KEY,
    llc_checkpoint_for,
    warn_of_another_llc,
)
from isaacgymenvs_lite.config.train_files import read_train_file
from isaacgymenvs_lite.config.train_params import KnownNames, prepare_train_params
from isaacgymenvs_lite.env_interface import (
    Env,
    HierarchyEnv,
    TrackingDemo,
    diverged_in,
    failures,
    goal_size,
    require,
)
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_config import AGENT_KEYS, HRLParams, read_agent_params
from isaacgymenvs_lite.learning.common_agent import CommonAgent, given_params
from isaacgymenvs_lite.learning.published_names import ReadOnly, accepts
from isaacgymenvs_lite.learning.skills.latents import latent_space
from isaacgymenvs_lite.learning.skills.low_level_policy import (
    LowLevelPolicy,
    LowLevelSizes,
    latents_of_actions,
)
from isaacgymenvs_lite.learning.warm_start import NUM_SAMPLES, clone_actions
from isaacgymenvs_lite.utils.state import Stateful

log = logging.getLogger(__name__)

# A flat configuration takes omitted keys from this train file.
_DEFAULTS = "HumanoidASEHRLPPO"
# Values of these types in a flat configuration are settings; other values are Python objects.
_PLAIN = (str, int, float, bool, dict, list, tuple, type(None))
_ENV_NAME = "rlgpu"
_NUM_ACTORS = 64
# After a warm start only the critic learns in so many epochs; noise on the observations of clips.
_FROZEN_EPOCHS, _CLIP_NOISE = 4, 0.1


class OverLowLevel:
    """Mixin of the agent and the player whose actions are latents of a low-level controller.

    Attributes:
        llc: the low-level controller.
    """

    llc: LowLevelPolicy
    _hrl: HRLParams
    _section: dict[str, Any]
    _env: Any
    _llc_device: Any
    _precision: Any

    _latent_dim = ReadOnly("llc.latent_dim", "the low-level controller")
    _task_size = ReadOnly("llc.num_task_obs", "the task")
    _llc_steps = ReadOnly("_hrl.llc_steps")
    _llc_agent = ReadOnly("llc", "_build_llc, which returns it")

    def _build_llc(self, params: HRLParams) -> LowLevelPolicy:
        """Load and return the low-level controller that the keys in `params` name."""
        return LowLevelPolicy(
            params.llc_config,
            llc_checkpoint_for(params.llc_checkpoint, self._section),
            self._build_llc_agent_config(),
            self._llc_device,
            self._precision,
        )

    def _build_llc_agent_config(self) -> LowLevelSizes:
        """Return sizes of the low-level controller's observations and actions in this task."""
        return LowLevelSizes.from_task(
            require(self._env, HierarchyEnv, "train.params.algo: a hierarchy")
        )

    def _extract_llc_obs(self, obs: Tensor) -> Tensor:
        """Remove the task features from observations (N, O)."""
        return self.llc.extract_obs(obs)

    def _compute_llc_action(self, obs: Any, actions: Tensor) -> Tensor:
        """Return the task's actions (N, A), given high-level actions (N, Z)."""
        rows = obs["obs"] if isinstance(obs, dict) else obs
        return self.llc.actions(self._extract_llc_obs(rows), latents_of_actions(actions))


class HRLAgent(OverLowLevel, CommonAgent):
    """The agent of `algo: name: hrl` or `hrl_continuous`.

    A high-level step consists of `llc_steps` control steps under one latent, and its reward is the
    mean of their rewards. If an episode ends during a high-level step, the remaining control steps
    of the high-level step get no reward, and the environment is reset after the last control step.
    The task is a `HierarchyEnv`.

    Attributes:
        style_rewards: (N, 1) style rewards of the low-level controller in the last high-level step.

    `params` may be a flat configuration; see `complete_params`.

    Raises:
        ConfigError: a value cannot be used, or the train file names no low-level controller.
        CheckpointError: the low-level controller is missing, or does not fit its file or the task.
    """

    scalars: ClassVar[dict[str, str]] = {
        **CommonAgent.scalars,
        "disc_reward_mean": "info/disc_reward_mean",
        "disc_reward_std": "info/disc_reward_std",
    }

    stored = ("frozen_until",)
    stored_episodes = ("_noise",)
    unsupported_keys = (*CommonAgent.unsupported_keys, "central_value_config")
    _task_reward_w = ReadOnly("_hrl.task_reward_w")
    _disc_reward_w = ReadOnly("_hrl.disc_reward_w")

    # --- constructor -----------------------------------------------------------------------

    def __init__(
        self,
        base_name: str,
        params: dict[str, Any] | None = None,
        config: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(base_name, complete_params(given_params(params, config), _DEFAULTS))

    def load_networks(self, params: dict[str, Any]) -> None:
        """Build the network of the section, unless the configuration contains a network object."""
        if "network" not in self.config:
            super().load_networks(params)

    def _load_config_params(self, config: dict[str, Any]) -> None:
        super()._load_config_params(config)
        self._hrl = read_agent_params(config, HRLParams)
        self._env, self._llc_device = self.vec_env.env, self.ppo_device
        self._noise = CorrelatedNoise(self._hrl.exploration_correlation)
        self.llc = self._build_llc(self._hrl)
        self.control_steps_per_action = self._hrl.llc_steps
        self.style_rewards = torch.zeros(self.num_actors, 1, device=self.ppo_device)
        # A subclass may have the published `_calc_disc_reward`, which gets AMP observations only.
        self._disc_reward_takes_latents = accepts(self._calc_disc_reward, 2)

    def _setup_action_space(self) -> None:
        """Replace the task's action space by a space of latents."""
        self.env_info = {**self.env_info, "action_space": latent_space(self.llc.latent_dim)}
        super()._setup_action_space()

    def init_tensors(self) -> None:
        """Allocate the rollout, including style rewards."""
        super().init_tensors()
        buffer = self.experience_buffer.tensor_dict
        buffer["disc_rewards"] = torch.zeros_like(buffer["rewards"])

    # --- checkpoint ------------------------------------------------------------------------

    def get_full_state_weights(self) -> dict[str, Any]:
        """Return the checkpoint, including a reference to the low-level controller."""
        return {**super().get_full_state_weights(), LLC_KEY: self.llc.reference}

    def set_full_state_weights(self, weights: dict[str, Any], set_epoch: bool = True) -> None:
        """Load a checkpoint, and warn if it was trained with another low-level controller."""
        super().set_full_state_weights(weights, set_epoch)
        warn_of_another_llc(weights, self.llc.reference, self._restored_from)

    # --- warm start ------------------------------------------------------------------------

    def _init_train(self) -> None:
        super()._init_train()
        if self._hrl.warm_start_steps > 0 and not self.has_restored:
            self._warm_start()

    def _warm_start(self) -> None:
        """Teach the mean action to choose the latents of clips that reach the goal.

        A goal is observed relative to the character. Therefore the goals and latents of clips also
        go with the poses of other clips.
        """
        fetch = getattr(self._env, "fetch_tracking_demo", None)
        demo = None if fetch is None else fetch(NUM_SAMPLES)
        if demo is None or not demo.reaches_goal or not self.model.a2c_network.separate:
            log.info("no warm start: the clips do not show which motion reaches the goal")
            return
        obs, amp_obs = demo.obs.to(self.ppo_device), demo.amp_obs.to(self.ppo_device)
        latents = self.llc.encoder.read(self.llc.discriminator.truncate(amp_obs))
        others = torch.randperm(len(obs), device=obs.device)
        goal_obs = obs[others, obs.shape[1] - goal_size(self._env) :]
        mixed = torch.cat((obs[:, : obs.shape[1] - goal_obs.shape[1]], goal_obs), dim=-1)
        demo = TrackingDemo(
            torch.cat((obs, mixed)), torch.cat((latents, latents[others])), torch.empty(0)
        )
        normalizer = self.model.running_mean_std if self.normalize_input else None
        steps = self._hrl.warm_start_steps
        error = clone_actions(self.model, normalizer, demo, steps, _CLIP_NOISE)
        self.frozen_until = _FROZEN_EPOCHS
        log.info("warm start: %d steps on the latents of clips, error %.3f", steps, error)

    # --- rollout ---------------------------------------------------------------------------

    def get_action_values(self, obs: dict[str, Tensor]) -> dict[str, Tensor]:
        """Sample latents whose exploration noise is correlated in time."""
        result = super().get_action_values(obs)
        if self._hrl.exploration_correlation != 0.0:
            given = (result[name] for name in ("actions", "mus", "sigmas"))
            result["actions"], result["neglogpacs"] = self._noise.apply(*given)
        return result

    def preprocess_actions(self, actions: Tensor) -> Tensor:
        """Return actions (N, Z) clamped to +-1."""
        return actions.clamp(-1.0, 1.0)

    def _obs_tensor(self, obs: Any) -> Tensor:
        """Return the environment's observations as a tensor (N, O)."""
        tensors: Any = self.obs_to_tensors(obs)
        return tensors["obs"] if isinstance(tensors, dict) else tensors

    def env_step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        """Make `llc_steps` control steps under the latents `actions` (N, Z).

        Returns:
            Observations (N, O), which for an ended episode are its last ones; mean rewards (N, 1);
            dones (N,), which are 1.0 where an episode ended in any control step; and the infos of
            the last control step. `terminate` in the infos is 1 where an episode ended in failure,
            and `diverged` is True where the simulation diverged before the episode ended.
        """
        actions = self.preprocess_actions(actions)
        obs = self._obs_tensor(self.obs)
        going_on = torch.ones(len(actions), device=self.ppo_device)
        terminate = torch.zeros_like(going_on)
        diverged = torch.zeros_like(going_on, dtype=torch.bool)
        rewards = torch.zeros(len(actions), 1, device=self.ppo_device)
        self.style_rewards = torch.zeros_like(rewards)
        infos: dict[str, Any] = {}
        reset_buf = self._env.reset_buf
        for _ in range(self._hrl.llc_steps):
            reset_buf.zero_()  # An ended episode goes on until the last step.
            raw_obs, step_rewards, dones, infos = self.vec_env.step(
                self._compute_llc_action(obs, actions)
            )
            playing = going_on.unsqueeze(1)
            obs = torch.where(playing.bool(), self._obs_tensor(raw_obs), obs)
            rewards += playing * step_rewards.to(self.ppo_device).view_as(rewards)
            if self._hrl.disc_reward_w != 0.0:
                amp_obs = infos["amp_obs"].to(self.ppo_device)
                given = (latents_of_actions(actions),) if self._disc_reward_takes_latents else ()
                self.style_rewards += playing * self._calc_disc_reward(amp_obs, *given)
            dones = dones.to(self.ppo_device)
            terminate += going_on * failures(dones, infos).float()
            if (in_step := diverged_in(infos, self.ppo_device)) is not None:
                diverged |= in_step & going_on.bool()
            going_on *= 1.0 - dones.float()
        self.style_rewards /= self._hrl.llc_steps
        # The flag is set again, because control steps after the end of an episode may have cleared
        # it.
        reset_buf.masked_fill_((going_on == 0.0).to(reset_buf.device), 1)
        infos = {**infos, "terminate": terminate, "diverged": diverged}
        return {"obs": obs}, rewards / self._hrl.llc_steps, 1.0 - going_on, infos

    def _calc_disc_reward(self, amp_obs: Tensor, latents: Tensor | None = None) -> Tensor:
        """Return the low-level controller's style rewards (N, 1) of AMP observations (N, F)."""
        return self.llc.style_reward(amp_obs, latents)

    def _record_step(self, n: int, infos: dict[str, Any]) -> None:
        super()._record_step(n, infos)
        self.experience_buffer.update_data("disc_rewards", n, self.style_rewards)

    def _total_rewards(self, task_rewards: Tensor) -> Tensor:
        style = self.experience_buffer.tensor_dict["disc_rewards"]
        self._rollout_rewards = {"task_rewards": task_rewards, "disc_rewards": style}
        return self._combine_rewards(task_rewards, style)

    def _combine_rewards(self, task_rewards: Tensor, disc_rewards: Tensor) -> Tensor:
        """Return the total rewards task_reward_w * task + disc_reward_w * style, (..., 1)."""
        return self._hrl.task_reward_w * task_rewards + self._hrl.disc_reward_w * disc_rewards

    def _track_episodes(
        self, rewards: Tensor, shaped_rewards: Tensor, infos: dict[str, Any]
    ) -> None:
        """Update episode statistics, which count control steps and sum their rewards."""
        steps = self._hrl.llc_steps
        super()._track_episodes(steps * rewards, steps * shaped_rewards, infos)

    def mean_policy(self, env: Env) -> Callable[[dict[str, Tensor]], Tensor]:
        """Return the policy without exploration noise, which is called once per control step."""

        def choose(obs: Tensor) -> Tensor:
            means = self._evaluate_policy({"obs": obs}, {})["mus"].float()
            return self.preprocess_actions(means)

        act = self.llc.policy_under(choose, self._hrl.llc_steps, self._compute_llc_action)
        return lambda obs: act(self._obs_tensor(obs))


class CorrelatedNoise(Stateful):
    """Makes exploration noise correlated in time; each sample is still standard normal.

    With independent noise, the latent selects another skill six times a second. Hollenstein et al.
    2024, "Colored Noise in PPO" (arXiv 2312.11091) use coloured noise; this class uses a
    first-order autoregressive process. Like in the paper, PPO computes action probabilities as if
    the noise were independent.

    Args:
        correlation: correlation between the noises of consecutive steps, 0 <= correlation < 1.
    """

    stored = ("_last",)

    def __init__(self, correlation: float) -> None:
        self._correlation = correlation
        self._last: Tensor | None = None

    def apply(self, actions: Tensor, mus: Tensor, sigmas: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions (N, A) with correlated noise and their negative log probabilities (N,).

        The argument `actions` is `mus` + `sigmas` * independent standard normal noise, (N, A) each.
        """
        noise = (actions - mus) / sigmas
        if self._last is not None:
            rho = self._correlation
            noise = rho * self._last + math.sqrt(1.0 - rho * rho) * noise
        self._last = noise
        constant = 0.5 * math.log(2.0 * math.pi) * noise.shape[-1]
        neglogp = 0.5 * noise.square().sum(dim=-1) + torch.log(sigmas).sum(dim=-1) + constant
        return mus + sigmas * noise, neglogp


def complete_params(params: Mapping[str, Any], train_file: str) -> dict[str, Any]:
    """Return a complete section `params`, which rl_games' Runner passes to an agent.

    Users of the published HRLAgent call its constructor with a flat configuration.

    Args:
        params: a complete section, which is returned unchanged, or a flat configuration. A flat
            configuration has keys of the section's `config`, which replace the values in
            `train_file`. `network` may be a section or a model of rl_games whose network is not
            built yet. `vec_env` and `env_info` may be those of an existing environment; otherwise
            `env_config` holds arguments of `isaacgymenvs_lite.make`.
        train_file: name of the train file that contains all other keys.

    Raises:
        ConfigError: a value cannot be used, or an environment is neither given nor described.
    """
    if isinstance(params.get("config"), Mapping):
        return dict(params)
    given = dict(params)
    objects = {key: given.pop(key) for key in list(given) if not isinstance(given[key], _PLAIN)}
    vec_env = objects.get("vec_env")
    if vec_env is not None:
        given.setdefault("num_actors", vec_env.env.num_envs)
        # `env_info` contains spaces, which are objects and no settings.
        objects["env_info"] = given.pop("env_info", None) or vec_env.get_env_info()
    num_actors = int(given.setdefault("num_actors", _NUM_ACTORS))
    device = str(given.setdefault("device", "cpu"))
    _check_env(given, vec_env, num_actors)
    observer = given.pop("features", {}).get("observer") or DefaultAlgoObserver()
    shaper = objects.pop("reward_shaper", None)

    section = read_train_file(train_file, num_actors, device)["params"]
    if "network" in given:
        section["network"] = given.pop("network")
    section["config"] |= given
    tree = OmegaConf.create({"train": {"params": section}, "pbt": {}, "rl_device": device})
    names = KnownNames(config_keys=AGENT_KEYS)
    complete = prepare_train_params(tree, num_envs=num_actors, seed=0, names=names)
    config = complete["config"]
    config["reward_shaper"] = shaper or tr_helpers.DefaultRewardsShaper(**config["reward_shaper"])
    config["features"] = {"observer": observer}
    config |= objects
    return complete


def _check_env(given: dict[str, Any], vec_env: Any, num_actors: int) -> None:
    if vec_env is not None:
        return
    name = given.setdefault("env_name", _ENV_NAME)
    if name not in env_configurations.configurations:
        raise ConfigError(
            f"env_name={name} is not registered with rl_games: call"
            " isaacgymenvs_lite.registration.build_runner() first, or give vec_env"
        )
    # A copy is made, so that the caller's dictionary does not change.
    env_config = given["env_config"] = dict(given.get("env_config") or {})
    if name == _ENV_NAME and "task" not in env_config:
        raise ConfigError(
            "config: which task? expected vec_env, or env_config with the arguments of"
            " isaacgymenvs_lite.make, such as {'task': 'HumanoidHeading'}"
        )
    env_config.setdefault("num_envs", num_actors)
