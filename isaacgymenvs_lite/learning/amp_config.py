"""The keys of `train.params.config` that AMP, GenAMP and HRL agents read in addition to PPO's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from isaacgymenvs_lite.schema import keys_of, read_keys, setting

DISC_REWARDS = ("least_squares", "logistic")
DISC_LOSSES = ("bce", "least_squares")
UNREAD_KEYS = ("amp_latent_grad_bonus", "amp_latent_grad_bonus_max")
"""Keys of ASE's files that nothing has ever read."""


@dataclass(frozen=True, kw_only=True)
class AMPParams:
    """The keys of AMP; names and meanings as in IsaacGymEnvs unless they are marked as new here."""

    task_reward_w: float = setting()
    """Weight of the task's reward."""
    disc_reward_w: float = setting()
    """Weight of the style reward."""
    amp_obs_demo_buffer_size: int = setting(minimum=1)
    """Rows of reference observations kept."""
    amp_replay_buffer_size: int = setting(minimum=1)
    """Rows of the policy's own past observations kept."""
    amp_replay_keep_prob: float = setting(minimum=0, maximum=1)
    """Share of new rows that enter a full replay buffer."""
    amp_batch_size: int = setting(minimum=1)
    """Reference rows fetched per epoch."""
    amp_minibatch_size: int = setting(minimum=1)
    """Rows of each kind that the discriminator sees per minibatch."""
    disc_coef: float = setting(minimum=0)
    """Weight of the discriminator's loss."""
    disc_logit_reg: float = setting(minimum=0)
    """Weight of the squared weights of its last layer."""
    disc_grad_penalty: float = setting(minimum=0)
    """Weight of its squared gradient on reference rows."""
    disc_grad_penalty_final: float | None = setting(None, minimum=0)
    """New here: what that weight comes to when the policy stays up, see
    `AMPAgent._schedule_grad_penalty`; None = it is constant. A large one leads to policies
    that stay up, a small one sees whether they move."""
    disc_reward_scale: float = setting()
    """Factor of the style reward."""
    disc_weight_decay: float = setting(minimum=0)
    """Weight of all its squared weights."""
    normalize_amp_input: bool = setting(True)
    """Normalise AMP observations by running statistics."""
    amp_input_memory: int | None = setting(None, minimum=1)
    """New here: rows that these statistics remember, older ones fade; None = all. The falls of the
    first epochs widen the statistics, and a wide scale hides small differences of pose."""
    amp_obs_steps: int | None = setting(None, minimum=1)
    """New here: how many control steps of the AMP observation, the newest, discriminator and
    encoder see; None = all. After a start in a clip the older ones are the clip's for a while,
    whatever the policy does."""
    disc_reward: str | None = setting(None, choices=DISC_REWARDS)
    """New here: the style reward's formula; None = the agent's own."""
    disc_learning_rate: float | None = setting(None, above=0)
    """New here: Adam's step size for the discriminator, which no schedule changes; None =
    learning_rate, with its schedule."""
    disc_loss: str = setting("bce", choices=DISC_LOSSES)
    """New here: the prediction loss; least_squares is the AMP paper's."""
    disc_input_noise: float = setting(0.0, minimum=0)
    """New here: standard deviation of noise on the normalised AMP observations that the
    discriminator learns from. It hides the jitter of exploration, which separates the policy's
    motion from the clips' at once, so that the discriminator learns the motion (instance noise:
    Arjovsky and Bottou 2017, arXiv 1701.04862)."""
    warm_start_steps: int = setting(0, minimum=0, maximum=100_000)
    """New here: gradient steps before the first epoch that teach the mean action to follow the
    reference motions, see `warm_start`; 0 = none."""
    warm_start_noise: float = setting(0.1, minimum=0)
    """New here: noise on the observations meanwhile, in standard deviations of each."""
    warm_start_frozen_epochs: int = setting(6, minimum=0)
    """New here: epochs after a warm start in which only critic and discriminator learn: untrained
    they would lead the policy astray."""
    enable_eps_greedy: bool = setting(False)
    """ASE's: some environments act without exploration noise, so that the discriminator sees
    motion free of noise; their steps do not train the policy."""


@dataclass(frozen=True, kw_only=True)
class GenAMPParams(AMPParams):
    """The keys that GenAMP adds to AMP's; names and meanings as in ASE unless they are marked."""

    latent_dim: int = setting(minimum=2)
    """Numbers in a latent."""
    latent_steps_min: int = setting(minimum=1)
    """Least number of control steps that a latent is kept."""
    latent_steps_max: int = setting(minimum=2)
    """Above the largest number."""
    amp_diversity_bonus: float = setting(minimum=0)
    """Weight of the loss that makes different latents act differently."""
    amp_diversity_tar: float = setting()
    """Its target: squared distance of actions over squared distance of latents."""
    enc_coef: float = setting(minimum=0)
    """Weight of the encoder's loss."""
    enc_weight_decay: float = setting(minimum=0)
    """Weight of all its squared weights."""
    enc_reward_scale: float = setting()
    """Factor of the encoder's reward."""
    enc_grad_penalty: float = setting(minimum=0)
    """Weight of the squared gradient of its error by the AMP observations."""
    enc_reward_w: float = setting()
    """Weight of the encoder's reward."""
    clip_latents: float = setting(0.0, minimum=0, maximum=1)
    """New here: share of the latents that the encoder reads from the clips; see
    `latents.ClipLatents`."""
    latent_sharpness: float = setting(0.0, minimum=0)
    """New here, for a conditional discriminator: above 0 random latents are paired with motions of
    the clips whose own latents are near, the more exclusively the larger it is."""
    disc_mismatched_demos: float = setting(0.0, minimum=0, maximum=1)
    """New here, for a conditional discriminator: share of the replayed rows in whose place it
    receives demonstrations under the latents of others, as fakes."""
    enc_alignment_coef: float = setting(0.0, minimum=0)
    """New here: weight of the loss that brings together what the encoder reads at moments of a
    clip that are near each other."""
    enc_uniformity_coef: float = setting(0.0, minimum=0)
    """New here: weight of the loss that spreads what it reads at all moments."""

    @property
    def encodes_clips(self) -> bool:
        """Whether the encoder also learns from the clips."""
        return self.enc_alignment_coef != 0.0 or self.enc_uniformity_coef != 0.0


@dataclass(frozen=True, kw_only=True)
class HRLParams:
    """The keys of HRL; names and meanings as in ASE unless they are marked as new here."""

    llc_config: str = setting()
    """Train file of the low-level controller."""
    llc_checkpoint: str | None = setting("")
    """Its checkpoint, or the name of a shipped policy; see `llc_reference.llc_checkpoint_for`."""
    llc_steps: int = setting(minimum=1)
    """Control steps that the low-level controller makes under one latent."""
    task_reward_w: float = setting(1.0)
    """Weight of the task's reward."""
    disc_reward_w: float = setting(0.0)
    """Weight of the low-level controller's style reward."""
    exploration_correlation: float = setting(0.0, minimum=0, maximum=0.99)
    """New here: correlation of the exploration noise of consecutive steps; see
    `CorrelatedNoise`."""


AGENT_KEYS = frozenset((*keys_of(GenAMPParams), *keys_of(HRLParams), *UNREAD_KEYS))
"""All keys that the agents of this project read or accept in addition to PPO's."""

P = TypeVar("P", bound=AMPParams | HRLParams)


def read_agent_params(config: Mapping[str, Any], cls: type[P]) -> P:
    """Check the keys of `train.params.config` that a class of this module has.

    Args:
        config: also with PPO's keys.
        cls: AMPParams, GenAMPParams or HRLParams.

    Raises:
        ConfigError: a key is missing, ill-typed or out of range.
    """
    return read_keys(cls, config, "train.params.config")
