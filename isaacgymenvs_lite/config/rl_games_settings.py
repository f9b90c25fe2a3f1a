"""The keys of a train file that rl_games 1.6.5 reads, with their types and limits.

`train.params.config` has the keys of every run and the keys of PPO or soft actor-critic.
`train.params.network` describes the networks.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.config.run_names import DEFAULT_TRAIN_DIR
from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.schema import convert_section, missing_key, select, setting

_log = logging.getLogger(__name__)

ENV_NAME = "rlgpu"
"""The environment's name in train files."""


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """The length of a training, and what it stores and prints."""

    name: str = setting()
    """Experiment and checkpoint name."""
    env_name: str = setting(ENV_NAME)
    train_dir: str = setting(DEFAULT_TRAIN_DIR)
    """Folder of the run folders."""
    max_epochs: int = setting(-1, minimum=-1)
    """-1 for no limit."""
    max_frames: int = setting(-1, minimum=-1)
    score_to_win: float = setting(float("inf"))
    """Mean episode reward at which training ends."""
    save_best_after: int = setting(100, minimum=0)
    save_frequency: int = setting(0, minimum=0)
    keep_checkpoints: int = setting(0, minimum=0)
    """How many checkpoints written at `save_frequency` are kept; 0 keeps all."""
    save_buffers: bool = setting(True)
    """Whether checkpoints include the replay buffers, for resume=."""
    imitation_frequency: int = setting(50, minimum=0)
    """Epochs between measurements of the mean policy; 0 for no measurements."""
    print_stats: bool = setting(True)
    games_to_track: int = setting(100, minimum=1)
    reward_shaper: Mapping[str, Any] = setting({})


@dataclass(frozen=True, kw_only=True)
class PPOSettings(RunSettings):
    """The keys that every agent of the PPO family reads; rl_games needs those without a default."""

    use_diagnostics: bool = setting(False)
    mixed_precision: Any = setting(False, choices=(True, False, "auto"))
    """Whether to use bfloat16; auto measures whether bfloat16 is faster on this CPU."""
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
    normalize_rms_advantage: bool = setting(False, choices=(False,))
    """True fails in rl_games 1.6.5."""
    use_action_masks: bool = setting(False, choices=(False,))
    """Masks exist only for discrete actions."""
    clip_actions: bool = setting(True)

    # Optimiser
    learning_rate: float = setting(above=0)
    lr_schedule: str | None = setting()
    """`adaptive` or `linear`; any other text keeps the learning rate constant."""
    schedule_type: str = setting("legacy", choices=("legacy", "standard", "standard_epoch"))
    kl_threshold: float | None = setting(None, above=0)
    """Required by the adaptive schedule."""
    weight_decay: float = setting(0.0, minimum=0)
    grad_norm: float = setting(above=0)
    """Used with truncate_grads."""
    truncate_grads: bool = setting(False)


@dataclass(frozen=True, kw_only=True)
class CentralValueSettings:
    """The section central_value_config: an asymmetric critic with a separate optimiser."""

    network: dict[str, Any] = setting()
    minibatch_size: int | None = setting(None, minimum=1)
    minibatch_size_per_env: int | None = setting(None, minimum=1)
    """Used if minibatch_size is absent."""
    mini_epochs: int = setting(minimum=1)
    learning_rate: float = setting(above=0)
    lr_schedule: str | None = setting(None)
    kl_threshold: float | None = setting(None, above=0)
    clip_value: bool = setting()
    e_clip: float = setting(0.2, above=0)
    normalize_input: bool = setting()
    truncate_grads: bool = setting(False)
    grad_norm: float = setting(1.0, above=0)
    weight_decay: float = setting(0.0, minimum=0)
    mixed_precision: bool = setting(False)
    freeze_critic: bool = setting(False)


@dataclass(frozen=True, kw_only=True)
class RewardShaperSettings:
    """The section reward_shaper, which scales and limits the task's rewards."""

    scale_value: float = setting(1.0)
    shift_value: float = setting(0.0)
    min_val: float = setting(float("-inf"))
    max_val: float = setting(float("inf"))
    log_val: bool = setting(False)
    is_torch: bool = setting(True)


@dataclass(frozen=True, kw_only=True)
class PlayerSettings:
    """Those keys of the section player that have an effect."""

    games_num: int = setting(32, minimum=1)
    """Episodes."""
    deterministic: bool = setting(True)
    n_game_life: int = setting(1, choices=(1,))
    """Number of lives in a game; a game of this project's tasks has one life."""
    record: str | None = setting(None)
    """File for a recording of environment 0."""
    latent: str | None = setting(None)


# Nothing reads these keys of published files; `check` names them.
UNREAD_KEYS = frozenset(
    (
        *("defer_summaries_sec", "lr_threshold", "max_env_steps", "num_envs", "num_seed_steps"),
        *("summaries_interval_sec_max", "summaries_interval_sec_min", "use_others_experience"),
    )
)
# Allowed keys in addition to the dataclasses. rl_games reads some of these keys in special set-ups,
# and the launcher writes some. The remaining keys are former names, which are translated before the
# check.
OTHER_KEYS = UNREAD_KEYS | frozenset(
    (
        *("actor_betas", "adv_rms_momentum", "alphas_betas", "bound_loss_type", "bptt_length"),
        *("central_value_config", "check_scores", "critic_betas", "device", "device_name"),
        *("env_args", "env_config", "env_info", "epochs_between_resets", "features"),
        *("freeze_critic", "full_experiment_name", "is_train", "log_path", "max_steps"),
        *("multi_gpu", "network", "network_path", "normalize_advantage", "normalize_value"),
        *("num_actors", "pbt_idx", "player", "population_based_training"),
        *("schedule_entropy", "self_play", "self_play_config", "seq_len", "torch_compile"),
        *("use_diagnostics", "use_experimental_cv", "use_smooth_clamp", "value_size", "vec_env"),
        *("weight_decay", "zero_rnn_on_done"),
    )
)


@dataclass(frozen=True, kw_only=True)
class SACSettings(RunSettings):
    """The keys that rl_games' SAC agent reads; it needs those without a default."""

    save_best_after: int = setting(500, minimum=0)

    # Samples
    num_steps_per_episode: int = setting(1, minimum=1)
    """Steps of each environment in an epoch."""
    num_updates_per_step: int = setting(1, minimum=1)
    """Gradient steps after each step."""
    num_warmup_steps: int = setting(1000, minimum=0)
    """Epochs of random actions."""
    num_warmup_frames: int | None = setting(None, minimum=0)
    """Frames of random actions; this key replaces num_warmup_steps."""
    replay_buffer_size: int = setting(minimum=1)
    batch_size: int = setting(minimum=1)

    # Objective
    gamma: float = setting(0.99, minimum=0, maximum=1)
    """Discount of one step."""
    critic_tau: float = setting(0.005, above=0, maximum=1)
    """Weight of the critic in the update of its target network."""
    init_alpha: float = setting(above=0)
    """Initial weight of the entropy."""
    learnable_temperature: bool = setting()
    target_entropy_coef: float = setting(1.0)
    """The target entropy is minus this factor times the number of actions."""
    value_bootstrap: bool = setting(True)
    """Whether the target bootstraps at the end of an episode that reached its time limit."""
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
    """Whether to use bfloat16 (on a CPU: in the hidden layers); auto measures what is faster."""


# rl_games' network builder registers these names.
ACTIVATIONS = ("relu", "tanh", "sigmoid", "elu", "selu", "swish", "gelu", "softplus", "None")


# Maps each initialiser to its arguments. `default` ignores the arguments that it has in published
# files.
INITIALIZERS: dict[str, tuple[str, ...] | None] = {
    "default": None,
    "const_initializer": ("val",),
    "orthogonal_initializer": ("gain",),
    "orthogonal": ("gain",),
    "glorot_normal_initializer": ("gain",),
    "glorot_uniform_initializer": ("gain",),
    "variance_scaling_initializer": ("mode", "scale"),
    "random_uniform_initializer": ("a", "b"),
    "kaiming_normal": ("a", "mode", "nonlinearity"),
}
# Initialisers of a fixed sigma, which is a vector. All other initialisers need matrices.
_VECTOR_INITIALIZERS = ("default", "const_initializer", "random_uniform_initializer")


# These networks have a section `mlp`; the networks that a fork has registered may have any keys.
_MLP_NETWORKS = frozenset(("actor_critic", "amp", "gen_amp", "ase", "hrl"))
_SAC_NETWORK = "soft_actor_critic"
_LATENT_NETWORKS = ("gen_amp", "ase")
_MAX_UNITS = 2**20
_OTHER_NETWORK_KEYS = (
    *("name", "mlp", "disc", "enc", "style", "rnn", "inputs", "value_shape", "central_value"),
    *("joint_obs_actions", "permute_input", "use_hidden_latents", "latent_dim", "layer_norm"),
)


@dataclass(frozen=True, kw_only=True)
class UnitsSettings:
    """The sizes of hidden layers."""

    units: list[int] = setting(minimum=1, maximum=_MAX_UNITS)
    model_size_multiplier: float = setting(1, above=0, maximum=1000)
    """Factor by which all units are multiplied."""


@dataclass(frozen=True, kw_only=True)
class LayerSettings(UnitsSettings):
    """Hidden layers: the sections mlp, disc and enc."""

    activation: str = setting(choices=ACTIVATIONS)
    initializer: dict[str, Any] = setting({"name": "default"})
    regularizer: Mapping[str, Any] | None = setting(None)
    d2rl: bool = setting(False)
    norm_only_first_layer: bool = setting(False)
    separate: bool = setting(False)
    """Whether the encoder has separate layers instead of the discriminator's layers."""
    conditional: bool = setting(False)
    """Whether the discriminator also receives the latent."""


@dataclass(frozen=True, kw_only=True)
class StyleSettings:
    """The section style: layers between the latent and the actor."""

    units: list[int] = setting(minimum=1, maximum=_MAX_UNITS)


@dataclass(frozen=True, kw_only=True)
class RecurrentSettings:
    """The section rnn."""

    name: str = setting(choices=("lstm", "gru"))
    units: int = setting(minimum=1, maximum=_MAX_UNITS)
    layers: int = setting(minimum=1)
    layer_norm: bool = setting(False)
    before_mlp: bool = setting(False)
    concat_input: bool = setting(False)
    concat_output: bool = setting(False)


@dataclass(frozen=True, kw_only=True)
class NetworkSettings:
    """The keys at the top of the network section."""

    separate: bool = setting(False)
    """Whether actor and critic have separate layers."""
    normalization: str | None = setting(None, choices=("layer_norm", "batch_norm", "None"))
    value_activation: str = setting("None", choices=ACTIVATIONS)
    latent_scale: float = setting(1.0, above=0)
    """Norm of the latents that the network receives."""
    log_std_bounds: list[float] | None = setting(None, length=2)
    space: Mapping[str, Any] | None = setting(None)


@dataclass(frozen=True, kw_only=True)
class GaussianSettings:
    """The section space.continuous: the distribution of the actions."""

    mu_activation: str = setting(choices=ACTIVATIONS)
    sigma_activation: str = setting(choices=ACTIVATIONS)
    mu_init: dict[str, Any] = setting()
    sigma_init: dict[str, Any] = setting()
    fixed_sigma: Any = setting()
    learn_sigma: bool = setting(True)


_SECTIONS: dict[str, type[Any]] = {
    **dict.fromkeys(("mlp", "disc", "enc"), LayerSettings),
    "style": StyleSettings,
    "rnn": RecurrentSettings,
}


def check_network(network: dict[str, Any], where: str, *, is_critic: bool = False) -> None:
    """Check names, units and keys of the network section at path `where`; convert its numbers.

    Raises:
        ConfigError: a key is missing or misspelt, or a value is not among the choices.
    """
    name = network["name"]
    is_ours = name in _MLP_NETWORKS
    if is_ours and "mlp" not in network:
        raise missing_key("mlp", network, (), where, "expected the hidden layers' section")
    if is_ours and "cnn" in network:
        raise ConfigError(f"{where}.cnn: the tasks observe one vector, no pictures; remove it")
    if is_ours and network.get("inputs"):
        _log.warning("%s.inputs: the tasks observe one vector, not named parts; no effect", where)
    others = _OTHER_NETWORK_KEYS if is_ours else None
    space = convert_section(NetworkSettings, network, where, others).space or {}
    for section, settings in _SECTIONS.items():
        if section in network:
            layers = convert_section(settings, network[section], f"{where}.{section}", None)
            if isinstance(layers, LayerSettings):
                _check_initializer(layers.initializer, f"{where}.{section}.initializer")
    if name == _SAC_NETWORK and select(network, "mlp.units") == []:
        raise ConfigError(f"{where}.mlp.units: got [], expected at least one hidden layer in SAC")
    if "mlp" in network and "initializer" not in network["mlp"]:
        hint = "expected a mapping with its name, such as default"
        raise missing_key("initializer", network["mlp"], (), f"{where}.mlp", hint)
    if select(network, "disc.conditional") and is_ours and name not in _LATENT_NETWORKS:
        raise ConfigError(
            f"{where}.disc.conditional=True: the network {name} has no latents that a"
            f" discriminator could receive; expected {where}.name: {' or '.join(_LATENT_NETWORKS)}"
        )
    if is_ours and "continuous" not in space and not is_critic:
        hint = "expected the distribution of the actions"
        raise missing_key("continuous", space, (), f"{where}.space", hint)
    # Soft actor-critic's distribution has no settings, so its files leave the section empty.
    if "continuous" in space and name != _SAC_NETWORK:
        path = f"{where}.space.continuous"
        gaussian = convert_section(GaussianSettings, network["space"]["continuous"], path, None)
        _check_initializer(gaussian.mu_init, f"{path}.mu_init")
        is_vector = gaussian.fixed_sigma not in (False, "obs_cond")
        choices = _VECTOR_INITIALIZERS if is_vector else tuple(INITIALIZERS)
        _check_initializer(gaussian.sigma_init, f"{path}.sigma_init", choices)


def scale_units(network: dict[str, Any]) -> None:
    """Multiply the units of the section mlp by its model_size_multiplier, in place."""
    mlp = network.get("mlp")
    factor = mlp.get("model_size_multiplier", 1) if isinstance(mlp, dict) else 1
    if isinstance(mlp, dict) and factor != 1:
        mlp["units"] = [max(1, int(units * factor)) for units in mlp["units"]]
        mlp["model_size_multiplier"] = 1  # a second call changes nothing


def check_central_value(section: dict[str, Any], where: str) -> None:
    """Check the section of an asymmetric critic; convert numbers in place."""
    network = convert_section(CentralValueSettings, section, where, None).network
    if "name" not in network:
        raise missing_key("name", network, (), f"{where}.network", "expected actor_critic")
    # Without the key `central_value` rl_games' network returns the output of an actor.
    if section["network"].setdefault("central_value", True) is not True:
        raise ConfigError(f"{where}.network.central_value: expected True; remove the key")
    check_network(network, f"{where}.network", is_critic=True)


def _check_initializer(
    initializer: dict[str, Any], where: str, choices: Collection[str] = tuple(INITIALIZERS)
) -> None:
    """Check the name of an initialiser and its arguments, which rl_games passes on to torch."""
    if "name" not in initializer:
        raise ConfigError(f"{where}: the key 'name' is missing; choices: {', '.join(choices)}")
    name = str(initializer["name"])
    if name not in choices:
        reason = " for a fixed sigma, which is a vector" if name in INITIALIZERS else ""
        raise ConfigError(f"{where}.name{reason}: {unknown('initializer', name, choices)}")
    arguments = INITIALIZERS[name]
    if arguments is None:
        return
    for key in initializer.keys() - {"name"}:
        if key not in arguments:
            raise ConfigError(f"{where}: {unknown('key', str(key), arguments)}")
        if key not in ("mode", "nonlinearity"):
            initializer[key] = float(initializer[key])
