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
    amp_obs_demo_buffer_size: int = setting(minimum=1)
    """Capacity of the buffer of reference observations, in rows."""
    amp_replay_buffer_size: int = setting(minimum=1)
    """Capacity of the replay buffer of the policy's observations, in rows."""
    amp_replay_keep_prob: float = setting(minimum=0, maximum=1)
    """Probability that a new row enters a full replay buffer."""
    amp_batch_size: int = setting(minimum=1)
    """Number of reference rows that are fetched per epoch."""
    amp_minibatch_size: int = setting(minimum=1)
    """Number of the policy's, of replayed and of reference rows in a discriminator minibatch."""
    disc_coef: float = setting(minimum=0)
    """Weight of the discriminator's loss."""
    disc_logit_reg: float = setting(minimum=0)
    """Weight decay of the discriminator's last layer."""
    disc_grad_penalty: float = setting(minimum=0)
    """Weight of the discriminator's squared gradient on reference rows."""
    disc_grad_penalty_final: float | None = setting(None, minimum=0)
    """New here: final value of `disc_grad_penalty` for long episodes; None keeps it constant. A
    large penalty leads to policies that stay up; a small one judges motion in more detail."""
    disc_reward_scale: float = setting()
    """Scale of the style reward."""
    disc_weight_decay: float = setting(minimum=0)
    """Weight decay of all of the discriminator's layers."""
    normalize_amp_input: bool = setting(True)
    """Whether running statistics normalise AMP observations."""
    amp_input_memory: int | None = setting(None, minimum=1)
    """New here: number of rows that these statistics remember, or None for all rows. The falls of
    the first epochs widen the statistics, and a wide scale hides small differences of pose."""
    amp_obs_steps: int | None = setting(None, minimum=1)
    """New here: number of newest control steps of the AMP observation that discriminator and
    encoder see, or None for all. After a start in a clip the older control steps show the clip, not
    the policy."""
    disc_reward: str | None = setting(None, choices=DISC_REWARDS)
    """New here: formula of the style reward, or None for the agent's default."""
    disc_learning_rate: float | None = setting(None, above=0)
    """New here: constant learning rate of the discriminator, or None for `learning_rate`."""
    disc_loss: str = setting("bce", choices=DISC_LOSSES)
    """New here: prediction loss of the discriminator; least_squares is the AMP paper's."""
    disc_input_noise: float = setting(0.0, minimum=0)
    """New here: standard deviation of noise on the discriminator's normalised training inputs. It
    hides the jitter of exploration, which would tell the policy from the clips (instance noise:
    Arjovsky and Bottou 2017, arXiv 1701.04862)."""
    warm_start_steps: int = setting(0, minimum=0, maximum=100_000)
    """New here: number of gradient steps before the first epoch that train the mean action to
    follow the reference motions; see `warm_start`."""
    warm_start_noise: float = setting(0.1, minimum=0)
    """New here: noise on a warm start's observations, in standard deviations of each dimension."""
    warm_start_frozen_epochs: int = setting(6, minimum=0)
    """New here: number of epochs after a warm start in which only critic and discriminator learn.
    Untrained ones would spoil the policy."""
    enable_eps_greedy: bool = setting(False)
    """ASE's: some environments act without exploration noise, to show their motion to the
    discriminator. Their steps do not train the policy."""


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
    """Target of the diversity loss: squared distance of actions per squared distance of latents."""
    enc_coef: float = setting(minimum=0)
    """Weight of the encoder's loss."""
    enc_weight_decay: float = setting(minimum=0)
    """Weight decay of all of the encoder's layers."""
    enc_reward_scale: float = setting()
    """Scale of the encoder's reward."""
    enc_grad_penalty: float = setting(minimum=0)
    """Weight of the squared gradient of the encoder's error by the AMP observations."""
    enc_reward_w: float = setting()
    """Weight of the encoder's reward."""
    clip_latents: float = setting(0.0, minimum=0, maximum=1)
    """New here: share of latents that the encoder infers from clips; see `latents.ClipLatents`."""
    latent_sharpness: float = setting(0.0, minimum=0)
    """New here: sharpness of the match between random latents and motions of the clips, for a
    conditional discriminator; 0 does not match them."""
    disc_mismatched_demos: float = setting(0.0, minimum=0, maximum=1)
    """New here: share of a conditional discriminator's replayed rows that are replaced by
    demonstrations under wrong latents, which count as fake."""
    enc_alignment_coef: float = setting(0.0, minimum=0)
    """New here: weight of the loss that brings the latents of near moments of a clip together."""
    enc_uniformity_coef: float = setting(0.0, minimum=0)
    """New here: weight of the loss that spreads the latents of all moments."""

    @property
    def encodes_clips(self) -> bool:
        """Whether the encoder also learns from the clips."""
        return self.enc_alignment_coef != 0.0 or self.enc_uniformity_coef != 0.0


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
    """New here: correlation of the exploration noise of consecutive steps."""


AGENT_KEYS = frozenset((*keys_of(GenAMPParams), *keys_of(HRLParams), *UNREAD_KEYS))
"""All keys that this project's agents accept in addition to PPO's."""

P = TypeVar("P", bound=AMPParams | HRLParams)


def read_agent_params(config: Mapping[str, Any], cls: type[P]) -> P:
    """Return the keys of `train.params.config` that the dataclass `cls` has, if they are valid."""
    return read_keys(cls, config, "train.params.config")
