"""The keys of `train.params.config` that soft actor-critic reads in rl_games 1.6.5, with limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.config.run_settings import RunSettings
from isaacgymenvs_lite.schema import setting


@dataclass(frozen=True, kw_only=True)
class SACSettings(RunSettings):
    """What rl_games' SAC agent reads. Required keys are those that it requires."""

    save_best_after: int = setting(500, minimum=0)

    # Samples
    num_steps_per_episode: int = setting(1, minimum=1)
    """Steps of each environment in an epoch."""
    num_updates_per_step: int = setting(1, minimum=1)
    """Gradient steps after each of them."""
    num_warmup_steps: int = setting(1000, minimum=0)
    """Epochs of random actions."""
    num_warmup_frames: int | None = setting(None, minimum=0)
    """Frames of random actions, in place of num_warmup_steps."""
    replay_buffer_size: int = setting(minimum=1)
    batch_size: int = setting(minimum=1)

    # Objective
    gamma: float = setting(0.99, minimum=0, maximum=1)
    """Discount of one step."""
    critic_tau: float = setting(0.005, above=0, maximum=1)
    """Share of the critic that its target takes over in a gradient step."""
    init_alpha: float = setting(above=0)
    """Weight of the entropy at the start."""
    learnable_temperature: bool = setting()
    target_entropy_coef: float = setting(1.0)
    """Wanted entropy, in minus the number of actions."""
    value_bootstrap: bool = setting(True)
    """An episode cut by its length is worth what would have come."""
    normalize_input: bool = setting(False)

    # Optimisers
    actor_lr: float = setting(above=0)
    critic_lr: float = setting(above=0)
    alpha_lr: float = setting(above=0)
    policy_frequency: int = setting(2, minimum=1)
    """Critic updates for each update of the actor."""
    critic_grad_clip: float = setting(5.0, minimum=0)
    """0 for none."""
    mixed_precision: Any = setting(False, choices=(True, False, "auto"))
    """bfloat16, on a CPU in the hidden layers; auto measures whether it is faster there."""


# Written by the launcher, or found in published files and read by nothing.
OTHER_KEYS = frozenset(
    (
        *("actor_betas", "critic_betas", "alphas_betas", "weight_decay", "is_train", "player"),
        *("device", "device_name", "env_config", "env_info", "features", "full_experiment_name"),
        *("multi_gpu", "network", "num_actors", "pbt_idx", "population_based_training"),
        # published files only
        *("num_seed_steps", "max_env_steps", "use_diagnostics", "torch_compile", "log_path"),
        *("normalize_value", "normalize_advantage"),
    )
)
