"""The keys of `train.params.config` that AMP, GenAMP and HRL agents read in addition to PPO's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from isaacgymenvs_lite.schema import keys_of, read_keys, setting

DISC_REWARDS = ("least_squares", "logistic")
DISC_LOSSES = ("bce", "least_squares")
UNREAD_KEYS = ("amp_latent_grad_bonus", "amp_latent_grad_bonus_max")
"""Keys of ASE's files that no code reads."""


@dataclass(frozen=True, kw_only=True)
class AMPParams:
    """The keys of AMP. Names and meanings are IsaacGymEnvs', except for keys marked as new."""

    task_reward_w: float = setting()
    """Weight of the task's reward."""
    disc_reward_w: float = setting()
    """Weight of the style reward."""
    disc_reward_w_final: float | None = setting(None)
    """New here: weight of the style reward in the last epoch; the weight changes linearly. None
    keeps `disc_reward_w`."""
    amp_obs_demo_buffer_size: int = setting(minimum=1)
    """Number of AMP observations of the clips that the demonstration buffer holds."""
    amp_replay_buffer_size: int = setting(minimum=1)
    """Number of earlier AMP observations of the policy that the replay buffer holds."""
    amp_replay_keep_prob: float = setting(minimum=0, maximum=1)
    """Probability that a new AMP observation is stored in a full replay buffer."""
    amp_batch_size: int = setting(minimum=1)
    """Number of AMP observations of the clips that are drawn in each epoch."""
    amp_minibatch_size: int = setting(minimum=1)
    """Number of AMP observations that a discriminator minibatch takes from each of three sources:
    the rollout, the replay buffer and the clips."""
    disc_coef: float = setting(minimum=0)
    """Weight of the discriminator's loss."""
    disc_logit_reg: float = setting(minimum=0)
    """Weight decay of the discriminator's last layer."""
    disc_grad_penalty: float = setting(minimum=0)
    """Weight of the gradient penalty: the discriminator's squared gradient on AMP observations of
    clips."""
    disc_grad_penalty_final: float | None = setting(None, minimum=0)
    """New here: final weight of the gradient penalty, reached when episodes are long; None keeps
    `disc_grad_penalty` constant. A large penalty leads to policies that do not fall; with a small
    penalty the discriminator judges motion in more detail."""
    disc_reward_scale: float = setting()
    """Scale of the style reward."""
    disc_weight_decay: float = setting(minimum=0)
    """Weight decay of all layers of the discriminator."""
    normalize_amp_input: bool = setting(True)
    """Whether running statistics normalise AMP observations."""
    amp_input_memory: int | None = setting(None, minimum=1)
    """New here: number of AMP observations that the normaliser remembers; None remembers all. Falls
    in the first epochs enlarge the normaliser's scale, and a large scale hides small differences of
    pose."""
    amp_obs_steps: int | None = setting(None, minimum=1)
    """New here: number of control steps, from the newest one, of an AMP observation that
    discriminator and encoder see; None selects all. After an episode starts in a pose of a clip,
    the older control steps come from the clip and not from the policy."""
    disc_reward: str | None = setting(None, choices=DISC_REWARDS)
    """New here: formula of the style reward; None selects the agent's default."""
    disc_learning_rate: float | None = setting(None, above=0)
    """New here: constant learning rate of the discriminator; None selects `learning_rate`."""
    disc_loss: str = setting("bce", choices=DISC_LOSSES)
    """New here: prediction loss of the discriminator; the AMP paper uses least_squares."""
    disc_input_noise: float = setting(0.0, minimum=0)
    """New here: standard deviation of noise on the discriminator's normalised training inputs. The
    noise hides the jitter of exploration, by which the discriminator could recognise the policy
    (instance noise: Arjovsky and Bottou 2017, arXiv 1701.04862)."""
    warm_start_steps: int = setting(0, minimum=0, maximum=100_000)
    """New here: number of gradient steps before the first epoch that train the mean action to
    follow the reference motions; see `warm_start`."""
    warm_start_noise: float = setting(0.1, minimum=0)
    """New here: noise on observations in `warm_start`, as a multiple of each dimension's standard
    deviation."""
    warm_start_frozen_epochs: int = setting(6, minimum=0)
    """New here: number of epochs after `warm_start` in which only critic and discriminator learn.
    An untrained critic or discriminator would spoil the policy."""
    enable_eps_greedy: bool = setting(False)
    """ASE's key: if it is True, some environments act without exploration noise, and the
    discriminator sees their motion. The steps of these environments do not train the policy."""


@dataclass(frozen=True, kw_only=True)
class GenAMPParams(AMPParams):
    """The keys of GenAMP. Names and meanings are ASE's, except for keys marked as new."""

    latent_dim: int = setting(minimum=2)
    """Dimension of a latent."""
    latent_steps_min: int = setting(minimum=1)
    """Least number of control steps under one latent."""
    latent_steps_max: int = setting(minimum=2)
    """Exclusive upper limit of the number of control steps under one latent."""
    amp_diversity_bonus: float = setting(minimum=0)
    """Weight of the diversity loss: different latents must lead to different actions."""
    amp_diversity_tar: float = setting()
    """Ratio of action distance to latent distance (both squared) that the diversity loss aims
    at."""
    enc_coef: float = setting(minimum=0)
    """Weight of the encoder's loss."""
    enc_weight_decay: float = setting(minimum=0)
    """Weight decay of all layers of the encoder."""
    enc_reward_scale: float = setting()
    """Scale of the encoder's reward."""
    enc_grad_penalty: float = setting(minimum=0)
    """Weight of the squared gradient of the encoder's error with respect to the AMP
    observations."""
    enc_reward_w: float = setting()
    """Weight of the encoder's reward."""
    clip_latents: float = setting(0.0, minimum=0, maximum=1)
    """New here: share of latents that the encoder infers from clips instead of random latents; see
    `latents.ClipLatents`."""
    latent_sharpness: float = setting(0.0, minimum=0)
    """New here: how closely a clip's latent must match the random latent that the clip is paired
    with, for a conditional discriminator; 0 forms no pairs."""
    disc_mismatched_demos: float = setting(0.0, minimum=0, maximum=1)
    """New here: share of a conditional discriminator's replayed AMP observations that are replaced
    by AMP observations of clips with wrong latents. They count as fake."""
    enc_alignment_coef: float = setting(0.0, minimum=0)
    """New here: weight of the loss that makes the latents of two nearby times of a clip similar."""
    enc_uniformity_coef: float = setting(0.0, minimum=0)
    """New here: weight of the loss that spreads the latents of the clips over the sphere."""
    enc_command_coef: float = setting(0.0, minimum=0)
    """New here: weight of the loss that makes the first entries of the latents of clips commands:
    velocities and turn rate. It needs `task.env.goal=skill`."""

    @property
    def encodes_clips(self) -> bool:
        """Whether one of the encoder's losses uses the clips."""
        coefs = (self.enc_alignment_coef, self.enc_uniformity_coef, self.enc_command_coef)
        return any(coef != 0.0 for coef in coefs)


@dataclass(frozen=True, kw_only=True)
class HRLParams:
    """The keys of HRL. Names and meanings are ASE's, except for keys marked as new."""

    llc_config: str = setting()
    """Train file of the low-level controller."""
    llc_checkpoint: str | None = setting("")
    """Checkpoint of the low-level controller, or the name of a shipped policy."""
    llc_steps: int = setting(minimum=1)
    """Number of control steps under one latent."""
    task_reward_w: float = setting(1.0)
    """Weight of the task's reward."""
    disc_reward_w: float = setting(0.0)
    """Weight of the low-level controller's style reward."""
    exploration_correlation: float = setting(0.0, minimum=0, maximum=0.99)
    """New here: correlation between the exploration noises of consecutive high-level steps."""
    warm_start_steps: int = setting(0, minimum=0, maximum=100_000)
    """New here: number of gradient steps before the first epoch that teach the mean action the
    latents of clips, for goals that the clips reach."""


AGENT_KEYS = frozenset((*keys_of(GenAMPParams), *keys_of(HRLParams), *UNREAD_KEYS))
"""All keys that this project's agents accept in addition to PPO's."""

P = TypeVar("P", bound=AMPParams | HRLParams)


def read_agent_params(config: Mapping[str, Any], cls: type[P]) -> P:
    """Return those keys of `train.params.config` that the dataclass `cls` has.

    Raises ConfigError for an invalid value.
    """
    return read_keys(cls, config, "train.params.config")
