"""Explains which names replace those names of IsaacGymEnvs' and ASE's agents that are missing here.

A user's subclass may override a published method that this project never calls. The class statement
of such a subclass raises an error that names the replacement.
"""

from __future__ import annotations

import inspect
import operator
from collections.abc import Callable
from typing import Any, ClassVar

from isaacgymenvs_lite.errors import OverrideError

_PACKAGE = __name__.partition(".")[0]
_NOT_OWN = frozenset((_PACKAGE, "rl_games", "torch", "builtins", "typing", "abc"))
_LOOP = "evaluation.evaluate has the play loop; override act(obs), _post_step(info) or run()"
_BUILD_LLC = "_build_llc(params) returns the LowLevelPolicy of the keys llc_config, llc_checkpoint"
_LLC_SIZES = "_build_llc_agent_config() returns the LowLevelSizes of the task"
_NO_COLOUR = "viewers here do not colour characters by their latents"

# Keys are published names (`name(argument)` is a method with this argument); values are their
# replacements.
AGENT_NAMES = {
    "_amp_debug()": "_record_step(n, infos) gets infos['amp_obs'] of each step",
    "_build_llc(config_params)": _BUILD_LLC,
    "_build_llc_agent_config(config_params)": _LLC_SIZES,
    "_calc_enc_error()": "_calc_enc_rewards(amp_obs, ase_latents) and _extra_losses(...)",
    "_change_char_color()": _NO_COLOUR,
    "_enc_loss()": "_extra_losses(result, batch, input_dict), with result['enc_pred']",
    "_eval_critic(ase_latents)": "obs_dict['amp_latents'] are the latents",
    "_get_mean_rewards()": "_track_episodes(rewards, shaped_rewards, infos) updates the meters of"
    " rl_games' log and best checkpoint",
    "_reset_latent_step_count()": "schedule.restart(env_ids); keys latent_steps_min, _max",
    "_reset_latents()": "_sample_latents(n) draws latents, _after_reset(env_ids) gets the"
    " environments with new episodes",
    "_save_intermediate": "every file of save_frequency has its epoch in its name",
    "central_value_net": "agents of AMP make one if the train file has a central_value_config;"
    " agents of ASE and hierarchies refuse the key",
    "env_reset(env_ids)": "_env_reset_done() resets, _after_reset(env_ids) gets them",
    "get_action_values(ase_latents)": "_policy_inputs() returns the latents",
    "get_action_values(rand_action_probs)": "get_action_values(obs) reads self._rand_action_probs",
    "model_output_file": "rl_games names the files in nn_dir",
    "running_mean_std": "model.running_mean_std",
    "use_experimental_cv": "has_value_loss, by the key use_experimental_cv",
}
PLAYER_NAMES = {
    "_build_llc(config_params)": _BUILD_LLC,
    "_build_llc_agent_config(config_params)": _LLC_SIZES,
    "_calc_disc_reward()": "the reward that is reported is the task's",
    "_calc_enc_error()": "_calc_enc_rewards(amp_obs, ase_latents)",
    "_change_char_color()": _NO_COLOUR,
    "_env_reset_done()": _LOOP,
    "_latent_step_count": "every environment has a schedule of its own, as in training",
    "_reset_latent_step_count()": "keys latent_steps_min, latent_steps_max",
    "_reset_latents()": "_latents_of(latent) returns a function that computes each step's latents",
    "_update_latents()": "_latents_of(latent) returns a function that computes each step's latents",
    "env_reset()": _LOOP,
    "env_step()": _LOOP,
    "mask": "there are no action masks",
    "running_mean_std": "model.running_mean_std",
}
NETWORK_NAMES = {
    "_build_actor_critic_net()": "_build_trunks(params, obs_size) sets both trunks",
    "_build_style_mlp()": "GenAMPBuilder.Network._build_trunks builds the layers",
    "get_out_size()": "the network keeps its own units",
    "init_params()": "GenAMPBuilder.Network._build_trunks initialises the layers",
}


class PublishedNames:
    """Mixin that raises an error if a user's subclass overrides a method that nothing calls."""

    replaced: ClassVar[dict[str, str]] = {}

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if cls.__module__.partition(".")[0] == _PACKAGE:
            return
        own = [cls, *(b for b in cls.__mro__[1:] if b.__module__.partition(".")[0] not in _NOT_OWN)]
        defined = {name: value for base in reversed(own) for name, value in vars(base).items()}
        called = {
            used
            for name, value in defined.items()
            if inspect.isfunction(value)
            for used in value.__code__.co_names
            if used != name
        }
        for published, instead in cls.replaced.items():
            name, _, argument = published.removesuffix(")").partition("(")
            method = defined.get(name)
            # A subclass that overrides `run` may call any method itself.
            if not inspect.isfunction(method) or name in called or "run" in defined:
                continue
            if not argument or argument in inspect.signature(method).parameters:
                raise OverrideError(f"{cls.__name__}.{published}: nothing calls it here; {instead}")
        for name in defined:
            for base in cls.__mro__:
                if isinstance(constant := vars(base).get(name), ReadOnly):
                    raise OverrideError(constant.refusal(cls))


class ExplainedNames(PublishedNames):
    """Mixin of agents and players: AttributeErrors name the replacement of a published method."""

    def __getattr__(self, name: str) -> Any:
        instead = self.replaced.get(name) or self.replaced.get(f"{name}()")
        if instead:
            raise OverrideError(f"{type(self).__name__} has no {name}: {instead}")
        raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")


class ReadOnly:
    """A published attribute whose value is stored under another name.

    Args:
        path: path of the value from the object, for example `_amp.disc_coef`.
        set_by: setting that determines the value; by default it is the key with the attribute's
            name.
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
        """Return the error message for an attempt to set the attribute."""
        return f"{cls.__name__}.{self._name} can only be read; its value comes from {self.set_by}"


def accepts(function: Callable[..., Any], num_arguments: int) -> bool:
    """Return whether a function accepts `num_arguments` positional arguments."""
    try:
        inspect.signature(function).bind(*range(num_arguments))
    except TypeError:
        return False
    return True
