"""The AMP keys of `train.params.config`, with their checks (the PPO keys are rl_games')."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.schema import keys_of, read_section, setting

DISC_REWARDS = ("least_squares", "logistic")
DISC_LOSSES = ("bce", "least_squares")


@dataclass(frozen=True)
class AMPParams:
    """What an AMP agent reads beside PPO's keys; names and meanings as IsaacGymEnvs unless said."""

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
    disc_reward_scale: float = setting()
    """Factor of the style reward."""
    disc_weight_decay: float = setting(minimum=0)
    """Weight of all its squared weights."""
    normalize_amp_input: bool = setting(True)
    """Normalise AMP observations by running statistics."""
    amp_input_memory: int | None = setting(None, minimum=1)
    """This project's: rows that these statistics remember, older ones fade; None = all. The falls
    of the first epochs widen the statistics, and a wide scale hides small differences of pose."""
    disc_reward: str | None = setting(None, choices=DISC_REWARDS)
    """This project's: the style reward's formula; None = the agent's own."""
    disc_learning_rate: float | None = setting(None, above=0)
    """This project's: Adam's step size for the discriminator, which no schedule changes; None =
    learning_rate, with its schedule."""
    disc_loss: str = setting("bce", choices=DISC_LOSSES)
    """This project's: the prediction loss; least_squares is the AMP paper's."""


def read_amp_params(config: Mapping[str, Any]) -> AMPParams:
    """Check the AMP keys of `train.params.config`.

    Raises:
        ConfigError: a key is missing, ill-typed or out of range.
    """
    known = keys_of(AMPParams)
    section = {key: value for key, value in config.items() if key in known}
    return read_section(AMPParams, section, "train.params.config")
