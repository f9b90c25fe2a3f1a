"""The keys of `train.params.config` that PPO reads in rl_games 1.6.5, with their limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.config.run_settings import RunSettings
from isaacgymenvs_lite.schema import setting


@dataclass(frozen=True, kw_only=True)
class PPOSettings(RunSettings):
    """What every agent of the PPO family reads. Required keys are those that rl_games requires."""

    use_diagnostics: bool = setting(False)
    mixed_precision: Any = setting(False, choices=(True, False, "auto"))
    """bfloat16; auto measures whether it is faster on this CPU."""
    torch_compile: Any = setting(None)
    """True, False, a mode of torch.compile, or {mode, critic_mode}."""

    # Samples
    horizon_length: int = setting(minimum=1)
    """Steps of each environment in an epoch."""
    minibatch_size: int | None = setting(None, minimum=1)
    minibatch_size_per_env: int | None = setting(None, minimum=1)
    """Used if minibatch_size is absent."""
    mini_epochs: int = setting(minimum=1)
    seq_length: int = setting(4, minimum=1)
    """Recurrent networks only."""

    # Objective
    ppo: bool = setting(True)
    gamma: float = setting(minimum=0, maximum=1)
    """Discount of one step."""
    tau: float = setting(minimum=0, maximum=1)
    """Lambda of generalised advantage estimation."""
    e_clip: float = setting(above=0)
    clip_value: bool = setting()
    critic_coef: float = setting(minimum=0)
    entropy_coef: float = setting(minimum=0)
    bounds_loss_coef: float | None = setting(None, minimum=0)
    value_bootstrap: bool = setting(True)
    normalize_input: bool = setting()
    normalize_value: bool = setting(False)
    normalize_advantage: bool = setting()
    normalize_rms_advantage: bool = setting(False)
    clip_actions: bool = setting(True)

    # Optimiser
    learning_rate: float = setting(above=0)
    lr_schedule: str | None = setting()
    """adaptive or linear; any other word means constant."""
    schedule_type: str = setting("legacy", choices=("legacy", "standard", "standard_epoch"))
    kl_threshold: float | None = setting(None, above=0)
    """Required by the adaptive schedule."""
    weight_decay: float = setting(0.0, minimum=0)
    grad_norm: float = setting(above=0)
    """Used with truncate_grads."""
    truncate_grads: bool = setting(False)


# Read by rl_games in special set-ups, written by the launcher, or found in published files and read
# by nothing; none of them is a slip of the finger.
OTHER_KEYS = frozenset(
    (
        # rl_games
        "adv_rms_momentum",
        "bound_loss_type",
        "bptt_length",
        "central_value_config",
        "check_scores",
        "device",
        "device_name",
        "env_args",
        "env_config",
        "env_info",
        "epochs_between_resets",
        "features",
        "freeze_critic",
        "full_experiment_name",
        "is_train",
        "log_path",
        "multi_gpu",
        "network_path",
        "num_actors",
        "pbt_idx",
        "player",
        "population_based_training",
        "schedule_entropy",
        "self_play",
        "self_play_config",
        "use_action_masks",
        "use_experimental_cv",
        "use_smooth_clamp",
        "value_size",
        "vec_env",
        "zero_rnn_on_done",
        # former names, translated before the check
        "max_steps",
        "seq_len",
        # published files only
        "defer_summaries_sec",
        "lr_threshold",
        "num_envs",
        "summaries_interval_sec_min",
        "summaries_interval_sec_max",
        "use_others_experience",
    )
)
