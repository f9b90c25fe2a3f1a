"""Turns the train section of a composed tree into the dictionary that rl_games' Runner loads."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from isaacgymenvs_lite.config.rl_games_settings import (
    ENV_NAME,
    OTHER_KEYS,
    PlayerSettings,
    PPOSettings,
    RewardShaperSettings,
    SACSettings,
    check_central_value,
    check_network,
    scale_units,
)
from isaacgymenvs_lite.config.run_names import read_run_name
from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.schema import (
    check_unknown_keys,
    convert_section,
    keys_of,
    missing_key,
    plain,
    select,
)

_log = logging.getLogger(__name__)

_WHERE = "train.params"
_CONFIG = f"{_WHERE}.config"
# Isaac Lab's train files have the limits of its wrapper in this section; here task.env has them.
_ISAAC_LAB_SECTION = "env"
_LIMITS = {"clip_observations": "clipObservations", "clip_actions": "clipActions"}
ISAAC_LAB_ACTIONS = f"{_WHERE}.{_ISAAC_LAB_SECTION}.clip_actions"
"""Path of the key for the limit of actions; without the key the limit is 1."""
_PARAMS_KEYS = (
    *("seed", "algo", "model", "network", "config", "load_checkpoint", "load_path"),
    *("torch_threads", _ISAAC_LAB_SECTION),
)
# Maps each algorithm to the registered models and networks with which it runs; the usual name is
# the first. Names that a fork has registered are not checked.
_AMP = (("continuous_amp", "amp"), ("amp",))
_HRL = (("hrl", "continuous_hrl"), ("hrl",))
_GOES_WITH: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "a2c_continuous": (
        ("continuous_a2c_logstd", "continuous_a2c_tanh"),
        ("actor_critic", "simplenet"),
    ),
    "sac": (("soft_actor_critic",), ("soft_actor_critic",)),
    **dict.fromkeys(("amp", "amp_agent", "amp_continuous"), _AMP),
    "gen_amp": (("continuous_gen_amp", "gen_amp", "ase"), ("gen_amp", "ase")),
    "ase": (("ase", "continuous_gen_amp", "gen_amp"), ("ase", "gen_amp")),
    **dict.fromkeys(("hrl", "hrl_continuous"), _HRL),
    # No algorithm of this project runs with these models and networks of rl_games.
    "": (
        ("central_value", "continuous_a2c"),
        ("resnet_actor_critic", "rnd_curiosity", "testnet", "testnet_aux_loss"),
    ),
}
_MAX_SAMPLES = 2**31 - 1  # largest number of samples in an epoch


@dataclass(frozen=True)
class KnownNames:
    """Names that are registered with rl_games, and keys of the agents in addition to PPO's keys.

    An empty collection allows all names.
    """

    algos: Collection[str] = ()
    models: Collection[str] = ()
    networks: Collection[str] = ()
    config_keys: Collection[str] = ()


def prepare_train_params(
    cfg: Mapping[Any, Any],
    *,
    num_envs: int,
    seed: int,
    run_name: str | None = None,
    rl_device: str | None = None,
    num_agents: int = 1,
    num_states: int | None = None,
    names: KnownNames | None = None,
) -> dict[str, Any]:
    """Return the complete and checked section `train.params` for `Runner.load`.

    The function adds the keys that published files lack (device, num_actors, reward_shaper,
    player), translates former names (seq_len, max_steps), and fits the minibatches to the number
    of environments.

    Args:
        cfg: the tree, resolved or as it was composed; it is not changed.
        num_envs: environments of the task.
        seed: the resolved seed, see `resolve_seed`.
        run_name: exact name of the run folder; None lets rl_games add a time stamp to the name.
        rl_device: device of the agent; None means `rl_device` of the tree.
        num_agents: agents in each environment.
        num_states: dimension of the task's privileged observation, or None if the dimension is
            unknown.
        names: registered names; None allows all names.

    Raises:
        ConfigError: a key is missing, misspelt, or has a wrong value.
    """
    names = names or KnownNames()
    tree = plain(cfg)
    params = copy.deepcopy(tree["train"]["params"])
    _check_names(params, names)
    check_network(params["network"], f"{_WHERE}.network")
    scale_units(params["network"])
    config = params.get("config")
    if not isinstance(config, dict):
        raise missing_key("config", params, _PARAMS_KEYS, _WHERE, "expected the agent's settings")
    _check_sections(config, num_states)
    # IsaacGymEnvs' files interpolate these two keys; ASE's files have plain values.
    for key, launch_key in (("max_epochs", "max_iterations"), ("name", "experiment")):
        if (given := tree.get(launch_key)) not in ("", None):
            config[key] = given
    if "name" in config:  # the last part of this name names the checkpoints
        config["name"] = read_run_name(config["name"], f"{_CONFIG}.name").name
    if config.get("multi_gpu") and not tree.get("multi_gpu"):
        raise ConfigError(
            f"{_CONFIG}.multi_gpu={config['multi_gpu']}: several processes are started with"
            " torchrun and multi_gpu=True (docs/distributed.md); set it to False here"
        )
    params["seed"] = seed
    pbt = tree.get("pbt") or {}
    has_population = bool(pbt.get("enabled", False))
    device = str(rl_device or tree["rl_device"])
    config |= {
        "device": device,  # agents read this key
        "device_name": device,  # players read this key
        "num_actors": num_envs,
        "population_based_training": has_population,
        "pbt_idx": pbt.get("policy_idx", 0) if has_population else None,
        "full_experiment_name": run_name,
        "env_name": config.get("env_name", ENV_NAME),
        # The agents connect their processes without rl_games, which would start NCCL in the
        # constructor.
        "multi_gpu": False,
    }
    if params["algo"]["name"] != "sac":
        complete_ppo(params, num_envs, num_agents, names.config_keys)
        return params
    if tree.get("multi_gpu"):
        raise ConfigError("multi_gpu=True: SAC trains in one process; remove multi_gpu")
    convert_section(SACSettings, config, _CONFIG, OTHER_KEYS)
    return params


def _check_names(params: dict[str, Any], names: KnownNames) -> None:
    """Check the names of the algorithm, the model and the network, and their combination."""
    check_unknown_keys(params, _PARAMS_KEYS, _WHERE)
    sections = {"algo": names.algos, "model": names.models, "network": names.networks}
    for section, choices in sections.items():
        where = f"{_WHERE}.{section}"
        value = params.get(section)
        if not isinstance(value, dict) or "name" not in value:
            keys = value if isinstance(value, dict) else {}
            hint = f"choices: {', '.join(sorted(choices))}" if choices else "expected a name"
            raise missing_key("name", keys, ["name"], where, hint)
        name = str(value["name"])
        if choices and name not in choices:
            raise ConfigError(f"{where}.name: {unknown(section, name, choices)}")
        if section != "network":
            check_unknown_keys(value, ("name",), where)
    algo = str(params["algo"]["name"])
    space = params["network"].get("space") or {}
    if "discrete" in f"{algo} {params['model']['name']} {' '.join(map(str, space))}":
        raise ConfigError(
            f"{_WHERE}: got discrete actions, but the tasks' actions are continuous; expected algo"
            " a2c_continuous, model continuous_a2c_logstd and network.space.continuous"
        )
    for place, section in enumerate(("model", "network")):
        name, fitting = str(params[section]["name"]), _GOES_WITH.get(algo, _GOES_WITH[""])[place]
        ours = {other for family in _GOES_WITH.values() for other in family[place]}
        if algo in _GOES_WITH and name in ours.difference(fitting):
            raise ConfigError(
                f"{_WHERE}.{section}.name={name}: algo {algo} does not run with this {section};"
                f" choices: {', '.join(fitting)}"
            )


def _check_sections(config: dict[str, Any], num_states: int | None) -> None:
    """Check and complete the sections of `train.params.config`, in place."""
    if critic := config.get("central_value_config"):
        if num_states == 0:
            raise ConfigError(
                f"{_CONFIG}.central_value_config: a central critic needs privileged observations"
                " (states), which this task lacks; add task.env.asymmetric_observations=True if"
                " the task has this key, or remove the section"
            )
        check_central_value(critic, f"{_CONFIG}.central_value_config")
    shaper, where = config.get("reward_shaper") or {}, f"{_CONFIG}.reward_shaper"
    convert_section(RewardShaperSettings, shaper, where)
    for key in shaper.keys() - keys_of(RewardShaperSettings):  # rl_games would raise a TypeError
        raise ConfigError(f"{where}: {unknown('key', key, keys_of(RewardShaperSettings))}")
    player = config.get("player") or {}
    convert_section(PlayerSettings, player, f"{_CONFIG}.player", ("class_name",))
    if note := player_class_note(player):
        _log.info("%s", note)
    config |= {"reward_shaper": shaper, "player": {"deterministic": True} | player}


def complete_ppo(
    params: dict[str, Any],
    num_envs: int,
    num_agents: int = 1,
    agent_keys: Iterable[str] | None = None,
) -> None:
    """Translate and check the keys of PPO and fit its minibatches, in place.

    Args:
        params: the section `params` of a train file.
        num_envs: environments of the task.
        num_agents: agents in each environment.
        agent_keys: additional keys that the agents read; None allows all other keys.
    """
    config = params["config"]
    critic = config.get("central_value_config") or {}
    has_rnn = ("rnn" in params.get("network", {}), "rnn" in critic.get("network", {}))
    if "seq_len" in config:  # the names of rl_games before 1.6.5
        config.setdefault("seq_length", config.pop("seq_len"))
        if any(has_rnn):
            _log.warning("seq_len is called seq_length now: using %s", config["seq_length"])
    if not any(has_rnn):
        # rl_games requires that seq_length divides the batch, even if the network is not recurrent.
        config["seq_length"] = 1
    if config.get("schedule_type") == "per_minibatch":  # rl_games 2's name
        config["schedule_type"] = "legacy"
    if "max_steps" in config:
        # rl_games would use max_steps as an array axis.
        config.setdefault("max_frames", config.pop("max_steps"))
    if config.get("bounds_loss_coef") is None:
        config["bounds_loss_coef"] = 0.0  # rl_games 1.6.5 fails with None
    others = None if agent_keys is None else {*OTHER_KEYS, *agent_keys}
    settings = convert_section(PPOSettings, config, _CONFIG, others)
    config.setdefault("seq_length", settings.seq_length)
    if settings.minibatch_size is None and settings.minibatch_size_per_env is None:
        hint = "expected the samples of one gradient step, or minibatch_size_per_env"
        raise missing_key("minibatch_size", config, keys_of(PPOSettings), _CONFIG, hint)
    if settings.lr_schedule == "adaptive" and settings.kl_threshold is None:
        hint = "lr_schedule adaptive needs it, for example 0.008"
        raise missing_key("kl_threshold", config, keys_of(PPOSettings), _CONFIG, hint)
    _fit_minibatches(config, num_envs, num_agents, *has_rnn)


def _fit_minibatches(
    config: dict[str, Any],
    num_envs: int,
    num_agents: int,
    policy_has_rnn: bool,
    critic_has_rnn: bool,
) -> None:
    """Change minibatch sizes, in place, so that they divide the epoch's samples; log each change.

    A minibatch of a recurrent network consists of whole sequences.
    """
    horizon = config["horizon_length"]
    sequence = config["seq_length"]  # 1 without a recurrent network
    if horizon % sequence:
        raise ConfigError(
            f"{_CONFIG}: seq_length {sequence} does not divide horizon_length {horizon}; choose a"
            " divisor as seq_length"
        )
    batch = num_envs * num_agents * horizon
    if batch > _MAX_SAMPLES:
        raise ConfigError(
            f"{_CONFIG}.horizon_length={horizon} with num_envs={num_envs}: an epoch has"
            f" {batch:g} samples, expected at most {_MAX_SAMPLES}; lower one of the two"
        )
    # The central critic has one sample per environment, even if an environment has several agents.
    fitted = [("", config, batch, policy_has_rnn)]
    if isinstance(critic := config.get("central_value_config"), dict):
        fitted.append(("central_value_config.", critic, num_envs * horizon, critic_has_rnn))
    for label, section, samples, has_rnn in fitted:
        multiple, wish = sequence if has_rnn else 1, section.get("minibatch_size")
        if wish is None:
            if (per_env := section.get("minibatch_size_per_env")) is None:
                continue
            wish = num_envs * per_env
        section["minibatch_size"] = size = fit_minibatch(samples, wish, multiple_of=multiple)
        agents = f" x {num_agents} agents" if num_agents > 1 else ""
        reason = f"does not divide {batch} samples ({num_envs} envs x {horizon} steps{agents})"
        if samples % wish == 0:
            reason = f"is no multiple of seq_length {sequence}"
        if size != wish:
            _log.info("%sminibatch_size %d %s: using %d", label, wish, reason, size)
    limit = config["minibatch_size"]
    if isinstance(size := config.get("amp_minibatch_size"), int) and size > limit:
        _log.info("amp_minibatch_size %d exceeds the minibatch: using %d", size, limit)
        config["amp_minibatch_size"] = limit


def fit_minibatch(batch_size: int, minibatch_size: int, multiple_of: int = 1) -> int:
    """Return the divisor of `batch_size` that is nearest to `minibatch_size` in ratio.

    The result is a multiple of `multiple_of`, the sequence length of a recurrent network.

    >>> fit_minibatch(1024, 32768)
    1024
    >>> fit_minibatch(1000, 300)  # 250 is 1.2 times smaller, 500 is 1.67 times larger
    250
    """
    small = [each for each in range(1, math.isqrt(batch_size) + 1) if batch_size % each == 0]
    divisors = [*small, *(batch_size // each for each in small)]
    candidates = [divisor for divisor in divisors if divisor % multiple_of == 0]
    return min(candidates, key=lambda d: max(d, minibatch_size) / min(d, minibatch_size))


# --- keys that other modules read -------------------------------------------------------------


def apply_wrapper_limits(tree: dict[str, Any]) -> None:
    """Copy the limits in `train.params.env` into the task section of `tree`.

    rl_games scales actions to the copied limit, see `make_from_config`.
    """
    for key, task_key in _LIMITS.items():
        path = f"{_WHERE}.{_ISAAC_LAB_SECTION}.{key}"
        value = select(tree, path)
        if value is None:
            continue
        if not isinstance(value, (int, float)) or isinstance(value, bool) or value <= 0:
            raise ConfigError(f"{path}: got {value!r}, expected a number above 0")
        tree["task"]["env"][task_key] = float(value)


def checkpoint_in_file(tree: Mapping[str, Any]) -> str:
    """Return the checkpoint that the train file names, or '' if it names none.

    IsaacGymEnvs' files interpolate `checkpoint=`; other files have `load_checkpoint: True` and a
    path. The first versions of rl_games read the keys `load_checkpoint` and `load_path`; version
    1.6.5 ignores them.
    """
    params = tree["train"]["params"]
    if not params.get("load_checkpoint") or tree.get("checkpoint"):
        return ""
    if not params.get("load_path"):
        raise ConfigError(f"{_WHERE}.load_checkpoint=True: load_path is empty; give a .pth file")
    return str(params["load_path"])


def check_env_name(params: Mapping[str, Any]) -> None:
    """Refuse the environments of rl_games, because `task=` names the task.

    One of these environments imports code through Gymnasium by a name in `env_config`.
    """
    name = params["config"].get("env_name", ENV_NAME)
    if name != ENV_NAME:
        raise ConfigError(f"{_CONFIG}.env_name={name}: expected {ENV_NAME}; task= names the task")


def player_class_note(player: Mapping[str, Any]) -> str:
    """Return a note that a train file's player class has no effect, or '' if it names no class."""
    if "class_name" not in player:
        return ""
    return (
        f"{_CONFIG}.player.class_name={player['class_name']} has no effect: the player is the class"
        " that runner.player_factory has registered for algo.name"
    )


def torch_compile_setting(setting: Any, device: str, can_compile: bool) -> Any:
    """Return the value of `torch_compile` for rl_games' Runner, which compiles by default.

    Agents call this function in their constructors and store the result in the dictionary that the
    Runner reads afterwards. The function therefore also works in a user's Runner.

    Args:
        setting: the value of `train.params.config.torch_compile`, or None if the key is missing.
        device: device of the agent.
        can_compile: False for agents that differentiate twice (gradient penalties).
    """
    if not can_compile:
        if setting:
            _log.warning("torch_compile is off: it cannot differentiate a gradient penalty")
        return False
    return device.startswith("cuda") if setting is None else setting
