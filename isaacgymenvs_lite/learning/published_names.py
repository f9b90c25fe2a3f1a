"""Lists where the methods and attributes of the agents of IsaacGymEnvs and ASE are here.

`SURFACES` has every name that their learning packages define. A subclass that overrides a method
which nothing calls here would silently train without it: its definition raises an error.
`as_markdown` returns the tables of docs/migration.md.
"""

from __future__ import annotations

import inspect
import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import CodeType
from typing import Any

from isaacgymenvs_lite.errors import OverrideError

_PACKAGE = __name__.partition(".")[0]
_LEARNING = f"{_PACKAGE}.learning"
_NOT_OWN = frozenset((_PACKAGE, "rl_games", "torch", "builtins", "typing", "abc"))


@dataclass(frozen=True)
class Surface:
    """The names of a published class; a method's ends in `()`.

    `name(argument)` is the method `name` of a subclass that takes this argument.

    Attributes:
        published: the class, below `isaacgymenvs/learning` or `ase/learning`.
        ours: the class in its place, below `isaacgymenvs_lite.learning`.
        same: names that exist here, and are called, with their meaning and arguments.
        other: name -> its replacement here.
        absent: name -> why there is none, or what to do instead.
    """

    published: str
    ours: str
    same: str = ""
    other: dict[str, str] = field(default_factory=dict)
    absent: dict[str, str] = field(default_factory=dict)

    @property
    def replaced(self) -> dict[str, str]:
        """Names that do not exist here -> what to do instead."""
        return self.other | self.absent


_LOOP = "the play loop is evaluation.evaluate's: act(obs), _post_step(info) or run() of your own"
_CALLED_BY_LOOP = frozenset(("_env_reset_done", "env_step", "env_reset"))
_NO_DEBUG = "_record_step(n, infos) gets infos['amp_obs'] of each step"
_NO_COLOUR = "viewers here do not colour characters by their latents"

SURFACES = (
    Surface(
        "common_agent.CommonAgent (both)",
        "common_agent.CommonAgent",
        same="""init_tensors() train() save() train_epoch() play_steps() prepare_dataset()
            calc_gradients() discount_values() bound_loss() set_full_state_weights() env_reset()
            _load_config_params() _build_net_config() _setup_action_space() _init_train()
            _env_reset_done() _eval_critic() _actor_loss() _critic_loss() _calc_advs()
            _record_train_batch_info() _log_train_info() is_discrete bounds_loss_coef clip_actions
            model states last_lr optimizer dataset actions_num actions_low actions_high
            network_path train_result obs dones frame curr_frames epoch_num last_mean_rewards""",
        other={
            "central_value_net": "a train file with a central_value_config makes one in agents of"
            " AMP, not of ASE and hierarchies",
            "use_experimental_cv": "has_value_loss, by the key use_experimental_cv",
            "env_reset(env_ids)": "_env_reset_done() resets, _after_reset(env_ids) gets them",
            "running_mean_std": "model.running_mean_std",
        },
        absent={
            "_get_mean_rewards()": "_track_episodes(rewards, shaped_rewards, infos) fills the"
            " meters that rl_games logs and saves by",
            "model_output_file": "rl_games names the files in nn_dir",
            "_save_intermediate": "every file of save_frequency has its epoch in its name",
        },
    ),
    Surface(
        "amp_continuous.AMPAgent, amp_agent.AMPAgent",
        "amp_continuous.AMPAgent",
        same="""init_tensors() set_eval() set_train() get_stats_weights() set_stats_weights()
            play_steps() get_action_values() prepare_dataset() train_epoch() calc_gradients()
            _load_config_params() _build_net_config() _init_train() _disc_loss() _disc_loss_neg()
            _disc_loss_pos() _compute_disc_acc() _fetch_amp_obs_demo() _build_amp_buffers()
            _build_rand_action_probs() _init_amp_demo_buf() _update_amp_demos() _preproc_amp_obs()
            _combine_rewards() _eval_disc() _calc_advs() _calc_amp_rewards() _calc_disc_rewards()
            _store_replay_amp_obs() _record_train_batch_info() _log_train_info()
            _normalize_amp_input _amp_input_mean_std _task_reward_w _disc_reward_w
            _amp_observation_space _amp_batch_size _amp_minibatch_size _disc_coef _disc_logit_reg
            _disc_grad_penalty _disc_weight_decay _disc_reward_scale _amp_obs_demo_buffer
            _amp_replay_buffer _amp_replay_keep_prob _enable_eps_greedy _rand_action_probs""",
        other={
            "get_action_values(rand_action_probs)": "get_action_values(obs) reads"
            " self._rand_action_probs",
        },
        absent={"_amp_debug()": _NO_DEBUG},
    ),
    Surface(
        "ase_agent.ASEAgent",
        "gen_amp.GenAMPAgent",
        same="""init_tensors() play_steps() get_action_values() prepare_dataset() calc_gradients()
            env_reset() _load_config_params() _build_net_config() _sample_latents()
            _update_latents() _eval_actor() _eval_critic() _calc_amp_rewards() _calc_enc_rewards()
            _diversity_loss() _enable_enc_grad_penalty() _enable_amp_diversity_bonus() _eval_enc()
            _combine_rewards() _record_train_batch_info() _log_train_info() _latent_dim
            _latent_steps_min _latent_steps_max _amp_diversity_bonus _amp_diversity_tar _enc_coef
            _enc_weight_decay _enc_reward_scale _enc_grad_penalty _enc_reward_w _ase_latents
            _latent_reset_steps""",
        other={
            "get_action_values(ase_latents)": "_policy_inputs() returns the latents",
            "_eval_critic(ase_latents)": "obs_dict['amp_latents'] are the latents",
            "_reset_latents()": "_sample_latents(n) draws them, _after_reset(env_ids) gets"
            " those that start",
            "_reset_latent_step_count()": "schedule.restart(env_ids); keys latent_steps_min, _max",
            "_enc_loss()": "_extra_losses(result, batch, input_dict), with result['enc_pred']",
            "_calc_enc_error()": "_calc_enc_rewards(amp_obs, ase_latents) and _extra_losses(...)",
        },
        absent={"_change_char_color()": _NO_COLOUR, "_amp_debug()": _NO_DEBUG},
    ),
    Surface(
        "hrl_continuous.HRLAgent, hrl_agent.HRLAgent",
        "hrl_continuous.HRLAgent",
        same="""init_tensors() env_step() cast_obs() preprocess_actions() play_steps()
            _load_config_params() _setup_action_space() _build_llc() _build_llc_agent_config()
            _compute_llc_action() _extract_llc_obs() _calc_disc_reward() _combine_rewards()
            _record_train_batch_info() _log_train_info() _latent_dim _task_size _llc_steps
            _llc_agent _task_reward_w _disc_reward_w""",
        other={
            "_build_llc(config_params)": "_build_llc(params) returns the LowLevelPolicy of the"
            " keys llc_config and llc_checkpoint",
            "_build_llc_agent_config(config_params)": "_build_llc_agent_config() returns the"
            " LowLevelSizes of the task",
            "_get_mean_rewards()": "_track_episodes(rewards, shaped_rewards, infos), which counts"
            " control steps",
        },
    ),
    Surface(
        "common_player.CommonPlayer (both)",
        "common_player.CommonPlayer",
        same="""run() obs_to_torch() get_action() _build_net() _build_net_config() _post_step()
            _setup_action_space() network normalize_input normalize_value model is_rnn actions_num
            actions_low actions_high""",
        other={"running_mean_std": "model.running_mean_std"},
        absent={
            "_env_reset_done()": _LOOP,
            "env_step()": _LOOP,
            "env_reset()": _LOOP,
            "mask": "there are no action masks",
        },
    ),
    Surface(
        "amp_players.AMPPlayerContinuous (both)",
        "amp_players.AMPPlayerContinuous",
        same="""restore() _build_net() _post_step() _build_net_config() _amp_debug()
            _preproc_amp_obs() _eval_disc() _calc_amp_rewards() _calc_disc_rewards()
            _normalize_amp_input _disc_reward_scale _print_disc_prediction _amp_input_mean_std""",
    ),
    Surface(
        "ase_players.ASEPlayer",
        "gen_amp_players.GenAMPPlayerContinuous",
        same="""run() get_action() _build_net_config() _calc_amp_rewards() _calc_enc_rewards()
            _eval_enc() _amp_debug() _latent_dim _latent_steps_min _latent_steps_max
            _enc_reward_scale _ase_latents""",
        other={
            "_reset_latents()": "_latents_of(latent) returns what gives the latents of each step",
            "_update_latents()": "_latents_of(latent) returns what gives the latents of each step",
            "_reset_latent_step_count()": "keys latent_steps_min, latent_steps_max",
            "_calc_enc_error()": "_calc_enc_rewards(amp_obs, ase_latents)",
        },
        absent={
            "env_reset()": _LOOP,
            "_change_char_color()": _NO_COLOUR,
            "_latent_step_count": "every environment has a schedule of its own, as in training",
        },
    ),
    Surface(
        "hrl_players.HRLPlayer",
        "hrl_players.HRLPlayer",
        same="""run() get_action() _setup_action_space() _build_llc() _build_llc_agent_config()
            _compute_llc_action() _extract_llc_obs() _latent_dim _task_size _llc_steps
            _llc_agent""",
        other={
            "_build_llc(config_params)": "_build_llc(params) returns the LowLevelPolicy of the"
            " keys llc_config and llc_checkpoint",
            "_build_llc_agent_config(config_params)": "_build_llc_agent_config() returns the"
            " LowLevelSizes of the task",
        },
        absent={
            "env_step()": "the loop makes control steps; act(obs) has a new latent every llc_steps",
            "_calc_disc_reward()": "the reward that is reported is the task's",
        },
    ),
    Surface(
        "amp_datasets.AMPDataset (both)",
        "amp_datasets.AMPDataset",
        same="update_mu_sigma() _get_item() _shuffle_idx_buf() _idx_buf",
    ),
    Surface(
        "replay_buffer.ReplayBuffer (both)",
        "replay_buffer.ReplayBuffer",
        same="""reset() get_buffer_size() get_total_count() store() sample() _reset_sample_idx()
            _init_data_buf() _head _total_count _buffer_size _device _data_buf _sample_idx
            _sample_head""",
    ),
    Surface(
        "amp_models.ModelAMPContinuous (both)",
        "amp_models.ModelAMPContinuous",
        same="build() Network.forward()",
    ),
    Surface(
        "ase_models.ModelASEContinuous",
        "gen_amp_models.ModelGenAMPContinuous",
        same="build() Network.forward()",
    ),
    Surface(
        "hrl_models.ModelHRLContinuous (both)",
        "hrl_models.ModelHRLContinuous",
        same="build() Network",
    ),
    Surface(
        "amp_network_builder.AMPBuilder (both)",
        "amp_network_builder.AMPBuilder",
        same="build()",
    ),
    Surface(
        "amp_network_builder.AMPBuilder.Network (both)",
        "amp_network_builder.AMPBuilder.Network",
        same="""load() forward() eval_actor() eval_critic() eval_disc() get_disc_logit_weights()
            get_disc_weights() _build_disc() _disc_units _disc_activation _disc_initializer
            _disc_mlp _disc_logits sigma""",
    ),
    Surface(
        "ase_network_builder.ASEBuilder",
        "gen_amp_network_builder.GenAMPBuilder",
        same="build()",
    ),
    Surface(
        "ase_network_builder.ASEBuilder.Network",
        "gen_amp_network_builder.GenAMPBuilder.Network",
        same="""load() forward() eval_actor() eval_critic() eval_enc() get_enc_weights()
            sample_latents() _build_enc() _ase_latent_shape _enc_units _enc_activation
            _enc_initializer _enc_separate _enc_mlp _enc""",
        other={"_build_actor_critic_net()": "_build_trunks(params, obs_size) sets both trunks"},
    ),
    Surface(
        "ase_network_builder.AMPStyleCatNet1",
        "gen_amp_network_builder.StyleMLP",
        same="forward() eval_style() _activation _style_mlp _style_dense _dense_layers",
        absent={
            "init_params()": "GenAMPBuilder.Network._build_trunks initialises the layers",
            "get_out_size()": "the network keeps its own units",
            "_build_style_mlp()": "GenAMPBuilder.Network._build_trunks builds the layers",
            "_initializer": "GenAMPBuilder.Network._build_trunks initialises the layers",
            "_units": "the network keeps its own units",
            "_style_dim": "as wide as the latent",
            "_style_activation": "always tanh",
        },
    ),
    Surface(
        "ase_network_builder.AMPMLPNet",
        "gen_amp_network_builder.LatentMLP",
        same="forward() _mlp",
        absent={
            "init_params()": "GenAMPBuilder.Network._build_trunks initialises the layers",
            "get_out_size()": "the network keeps its own units",
            "_initializer": "GenAMPBuilder.Network._build_trunks initialises the layers",
            "_units": "the network keeps its own units",
        },
    ),
    Surface(
        "hrl_network_builder.HRLBuilder",
        "hrl_network_builder.HRLBuilder",
        same="build()",
    ),
    Surface(
        "hrl_network_builder.HRLBuilder.Network",
        "hrl_network_builder.HRLBuilder.Network",
        same="forward() eval_critic()",
    ),
)
CONSTANTS = {
    "amp_network_builder.DISC_LOGIT_INIT_SCALE": "amp_network_builder.DISC_LOGIT_INIT_SCALE",
    "ase_network_builder.ENC_LOGIT_INIT_SCALE": "gen_amp_network_builder.ENC_LOGIT_INIT_SCALE",
}
"""Module constants -> where they are here."""
ABSENT_MODULE_NAMES = {"ase_network_builder.LatentType": "nothing reads it"}


class ReadOnly:
    """A published attribute whose value is stored elsewhere here.

    Args:
        path: where, relative to the object: `_amp.disc_coef`.
        set_by: what sets the value; by default the key of this name.
    """

    def __init__(self, path: str, set_by: str = "") -> None:
        self._read = operator.attrgetter(path)
        self.set_by = set_by or f"train.params.config.{path.rpartition('.')[2]}"

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        return self if instance is None else self._read(instance)

    def __set__(self, instance: Any, value: Any) -> None:
        raise OverrideError(self.refusal(type(instance)))

    def refusal(self, cls: type) -> str:
        """Return the message for an attempt to set it in a class or an object."""
        return f"{cls.__name__}.{self._name} can only be read; its value comes from {self.set_by}"


def is_overridden(instance: Any, method: Callable[..., Any]) -> bool:
    """Return whether the class of `instance` has another method of this name."""
    return getattr(type(instance), method.__name__) is not method


def accepts(function: Callable[..., Any], num_arguments: int) -> bool:
    """Return whether a function may be called with so many positional arguments."""
    try:
        inspect.signature(function).bind(*range(num_arguments))
    except TypeError:
        return False
    return True


def _surfaces_of(cls: type) -> Iterator[Surface]:
    """Yield the surfaces of a class and its bases, its own first."""
    by_name = {f"{_LEARNING}.{surface.ours}": surface for surface in SURFACES}
    for base in cls.__mro__:
        if surface := by_name.get(f"{base.__module__}.{base.__qualname__}"):
            yield surface


def _check_overrides(cls: type) -> None:
    """Raise an error for names that a user's class defines without any effect.

    Raises:
        OverrideError: a method that only the published code calls, or a value that is not read.
    """
    if cls.__module__.partition(".")[0] == _PACKAGE:
        return
    # A class made by `type(...)` may have the module of its metaclass.
    others = (base for base in cls.__mro__[1:] if base.__module__.partition(".")[0] not in _NOT_OWN)
    own = [cls, *others]
    defined = {name: value for base in reversed(own) for name, value in vars(base).items()}
    called = {name for n, value in defined.items() for name in _names_used(value) if name != n}
    if "run" in defined:  # a player with a loop of its own
        called |= _CALLED_BY_LOOP
    for surface in _surfaces_of(cls):
        for published, instead in surface.replaced.items():
            name, _, argument = published.removesuffix(")").partition("(")
            function = defined.get(name)
            if not published.endswith(")") or not _is_function(function) or name in called:
                continue
            if argument and argument not in inspect.signature(_function_of(function)).parameters:
                continue
            raise OverrideError(
                f"{cls.__name__}.{published}: nothing calls it here; {instead} (docs/migration.md)"
            )
    for name in defined:
        for base in cls.__mro__:
            if isinstance(constant := vars(base).get(name), ReadOnly):
                raise OverrideError(constant.refusal(cls))


def _function_of(value: Any) -> Any:
    return inspect.unwrap(getattr(value, "__func__", value))


def _is_function(value: Any) -> bool:
    return inspect.isfunction(_function_of(value)) if value is not None else False


def _names_used(value: Any) -> set[str]:
    """Return the attributes that a function of a class body reads, by their names."""
    if not _is_function(value):
        return set()
    codes: list[CodeType] = [_function_of(value).__code__]
    names: set[str] = set()
    while codes:
        code = codes.pop()
        names.update(code.co_names)
        codes += [constant for constant in code.co_consts if isinstance(constant, CodeType)]
    return names


class PublishedNames:
    """Mixin for classes that people subclass: raises an error for overrides without effect."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        _check_overrides(cls)


class ExplainedNames(PublishedNames):
    """Mixin for agents and players: its AttributeError names where a published attribute is."""

    def __getattr__(self, name: str) -> Any:
        for surface in _surfaces_of(type(self)):
            for published in (name, f"{name}()"):
                if published in surface.replaced:
                    raise OverrideError(
                        f"{type(self).__name__} has no {published}: {surface.replaced[published]}"
                        " (docs/migration.md)"
                    )
        raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")


def counts() -> dict[str, int]:
    """Return how many published names are the same, are replaced, or are absent."""
    same = sum(len(surface.same.split()) for surface in SURFACES) + len(CONSTANTS)
    other = sum(len(surface.other) for surface in SURFACES)
    absent = sum(len(surface.absent) for surface in SURFACES) + len(ABSENT_MODULE_NAMES)
    return {"same": same, "other": other, "absent": absent}


def as_markdown() -> str:
    """Return the tables of docs/migration.md."""
    lines: list[str] = []
    for surface in SURFACES:
        same = ", ".join(f"`{name}`" for name in surface.same.split())
        lines += [f"**{surface.published}** is `{surface.ours}`. The same: {same}.", ""]
        if not surface.replaced:
            continue
        lines += ["| | not under this name |", "|---|---|"]
        lines += [f"| `{name}` | instead: {text} |" for name, text in surface.other.items()]
        lines += [f"| `{name}` | not here: {text} |" for name, text in surface.absent.items()]
        lines.append("")
    constants = (f"`{old}` is `{new}`" for old, new in CONSTANTS.items())
    missing = (f"`{name}` ({why})" for name, why in ABSENT_MODULE_NAMES.items())
    found = counts()
    lines += [
        f"Of the modules: {', '.join(constants)}; not here: {', '.join(missing)}.",
        "",
        f"{sum(found.values())} names: {found['same']} the same, {found['other']} elsewhere,"
        f" {found['absent']} not here.",
    ]
    return "\n".join(lines)
