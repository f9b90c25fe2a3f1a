"""The keys of a train file that rl_games 1.6.5 reads, with their types and limits.

`train.params.config` has those of every run and those of PPO or of soft actor-critic;
`train.params.network` says how the networks are built.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.schema import check_unknown_keys, keys_of, missing_key, read_section, setting

_log = logging.getLogger(__name__)

ENV_NAME = "rlgpu"
"""The name of the environment in train files: the task that is made for them."""


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """How long a training is, what it stores and prints."""

    name: str = setting()
    """Experiment and checkpoint name."""
    env_name: str = setting(ENV_NAME)
    train_dir: str = setting("runs")
    """Folder of the run folders."""
    max_epochs: int = setting(-1, minimum=-1)
    """-1 for no limit."""
    max_frames: int = setting(-1, minimum=-1)
    score_to_win: float = setting(float("inf"))
    """Mean episode reward at which training ends."""
    save_best_after: int = setting(100, minimum=0)
    save_frequency: int = setting(0, minimum=0)
    keep_checkpoints: int = setting(0, minimum=0)
    """Newest checkpoints of save_frequency that stay, beside the best; 0: all."""
    print_stats: bool = setting(True)
    games_to_track: int = setting(100, minimum=1)
    reward_shaper: Mapping[str, Any] = setting({})


@dataclass(frozen=True, kw_only=True)
class PPOSettings(RunSettings):
    """The keys that every agent of the PPO family reads; rl_games requires the required ones."""

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


# PPO's further keys: read by rl_games in special set-ups, written by the launcher, or found in
# published files and read by nothing; none of them is a slip of the finger.
PPO_OTHER_KEYS = frozenset(
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


@dataclass(frozen=True, kw_only=True)
class SACSettings(RunSettings):
    """The keys that rl_games' SAC agent reads; it requires the required ones."""

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


# SAC's further keys: written by the launcher, or found in published files and read by nothing.
SAC_OTHER_KEYS = frozenset(
    (
        *("actor_betas", "critic_betas", "alphas_betas", "weight_decay", "is_train", "player"),
        *("device", "device_name", "env_config", "env_info", "features", "full_experiment_name"),
        *("multi_gpu", "network", "num_actors", "pbt_idx", "population_based_training"),
        "save_buffers",
        # published files only
        *("num_seed_steps", "max_env_steps", "use_diagnostics", "torch_compile", "log_path"),
        *("normalize_value", "normalize_advantage"),
    )
)


# The names in the factories of rl_games' network builder.
ACTIVATIONS = ("relu", "tanh", "sigmoid", "elu", "selu", "swish", "gelu", "softplus", "None")
INITIALIZERS = (
    "default",
    "const_initializer",
    "orthogonal_initializer",
    "orthogonal",
    "glorot_normal_initializer",
    "glorot_uniform_initializer",
    "variance_scaling_initializer",
    "random_uniform_initializer",
    "kaiming_normal",
)

# Networks made of an `mlp` section, and the sections of hidden layers that they may have.
_MLP_NETWORKS = frozenset(("actor_critic", "amp", "gen_amp", "ase", "hrl"))
_SAC_NETWORK = "soft_actor_critic"
_LATENT_NETWORKS = ("gen_amp", "ase")
_LAYER_SECTIONS = ("mlp", "disc", "enc")
_NETWORK_KEYS = frozenset(
    (
        *_LAYER_SECTIONS,
        *("name", "separate", "space", "rnn", "cnn", "inputs", "normalization", "value_shape"),
        *("value_activation", "central_value", "joint_obs_actions", "permute_input"),
        *("use_hidden_latents", "latent_dim", "latent_scale", "style"),
        *("log_std_bounds", "layer_norm"),
    )
)


@dataclass(frozen=True, kw_only=True)
class LayerSettings:
    """Hidden layers: the sections mlp, disc and enc."""

    units: tuple[int, ...] = setting(minimum=1)
    """Width of each layer."""
    activation: str = setting(choices=ACTIVATIONS)
    initializer: Mapping[str, Any] = setting({"name": "default"})
    regularizer: Mapping[str, Any] | None = setting(None)
    d2rl: bool = setting(False)
    norm_only_first_layer: bool = setting(False)
    separate: bool = setting(False)
    """Encoder: False shares the discriminator's layers."""
    conditional: bool = setting(False)
    """Discriminator: the latent is an input, too."""
    model_size_multiplier: float = setting(1, above=0)
    """Factor on all units, applied before the network is built."""


@dataclass(frozen=True, kw_only=True)
class LatentSettings:
    """The keys of the network section itself that are about latents."""

    latent_scale: float = setting(1.0, above=0)
    """Length of the latents that the network gets."""


@dataclass(frozen=True, kw_only=True)
class GaussianSettings:
    """The section space.continuous: the distribution of the actions."""

    mu_activation: str = setting(choices=ACTIVATIONS)
    sigma_activation: str = setting(choices=ACTIVATIONS)
    mu_init: Mapping[str, Any] = setting()
    sigma_init: Mapping[str, Any] = setting()
    fixed_sigma: Any = setting()
    learn_sigma: bool = setting(True)


def check_network(network: Mapping[str, Any], where: str) -> None:
    """Check names, units and keys of a network section.

    Raises:
        ConfigError: a key is missing or misspelt, or a value is none of the choices.
    """
    if network["name"] in _MLP_NETWORKS:
        check_unknown_keys(network, _NETWORK_KEYS, where)
        if "mlp" not in network:
            raise missing_key(
                "mlp", network, _NETWORK_KEYS, where, "expected the hidden layers' section"
            )
        if network.get("inputs"):
            _log.warning(
                "%s.inputs: the tasks observe one vector, not named parts; no effect", where
            )
    own = {key: network[key] for key in keys_of(LatentSettings) if key in network}
    read_section(LatentSettings, own, where)
    for section in _LAYER_SECTIONS:
        if section in network:
            path = f"{where}.{section}"
            layers = read_section(LayerSettings, network[section], path)
            _check_initializer(layers.initializer, f"{path}.initializer")
    if network.get("disc", {}).get("conditional") and network["name"] not in _LATENT_NETWORKS:
        raise ConfigError(
            f"{where}.disc.conditional=True: the network {network['name']} has no latents that a"
            f" discriminator could receive; expected {where}.name: {' or '.join(_LATENT_NETWORKS)}"
        )
    space = network.get("space") or {}
    # Soft actor-critic's distribution has no settings: its files leave the section empty.
    if isinstance(space, Mapping) and "continuous" in space and network["name"] != _SAC_NETWORK:
        path = f"{where}.space.continuous"
        gaussian = read_section(GaussianSettings, space["continuous"], path)
        _check_initializer(gaussian.mu_init, f"{path}.mu_init")
        _check_initializer(gaussian.sigma_init, f"{path}.sigma_init")


def scale_units(network: dict[str, Any]) -> None:
    """Multiply the mlp's units by its model_size_multiplier, in place."""
    mlp = network.get("mlp")
    if not isinstance(mlp, dict):
        return
    factor = mlp.get("model_size_multiplier", 1)
    if factor != 1:
        mlp["units"] = [max(1, int(units * factor)) for units in mlp["units"]]
        mlp["model_size_multiplier"] = 1  # once is enough, should the section be read again


def _check_initializer(initializer: Mapping[str, Any], where: str) -> None:
    name = initializer.get("name")
    if name is None:
        raise ConfigError(f"{where}: the key 'name' is missing; choices: {', '.join(INITIALIZERS)}")
    if name not in INITIALIZERS:
        raise ConfigError(f"{where}.name: " + unknown("initializer", str(name), INITIALIZERS))
