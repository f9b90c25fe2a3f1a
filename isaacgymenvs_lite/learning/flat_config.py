"""Agents that are constructed by hand, from a flat configuration instead of a train file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from omegaconf import OmegaConf
from rl_games.common import env_configurations, tr_helpers
from rl_games.common.algo_observer import DefaultAlgoObserver

from isaacgymenvs_lite.config.train_files import load_train_file
from isaacgymenvs_lite.config.train_params import KnownNames, prepare_train_params
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_config import UNREAD_KEYS, GenAMPParams
from isaacgymenvs_lite.learning.hrl_config import HRLParams
from isaacgymenvs_lite.schema import keys_of

_PLAIN = (str, int, float, bool, dict, list, tuple, type(None))
_ENV_NAME = "rlgpu"
_NUM_ACTORS = 64


# What agents read beyond PPO's keys.
AGENT_KEYS = frozenset((*keys_of(GenAMPParams), *keys_of(HRLParams), *UNREAD_KEYS))


def given_params(params: dict[str, Any] | None, config: dict[str, Any] | None) -> dict[str, Any]:
    """Return what an agent's constructor was given, as `params` or under the published name.

    Raises:
        ConfigError: neither, or both.
    """
    if (params is None) == (config is None):
        raise ConfigError(
            "an agent is made with base_name and the section params of a train file, given as"
            " params= or config=, one of both"
        )
    return params if config is None else config  # type: ignore[return-value]


def given_section(params: dict[str, Any] | None, config: dict[str, Any] | None) -> dict[str, Any]:
    """As `given_params`, for agents that want the whole section.

    Raises:
        ConfigError: also for a flat configuration.
    """
    section = given_params(params, config)
    if not isinstance(section.get("config"), Mapping):
        raise ConfigError(
            "an agent's params have no section 'config': expected the section params of a train"
            " file (algo, model, network, config), as rl_games' Runner hands it over"
        )
    return section


def complete_params(params: Mapping[str, Any], train_file: str) -> dict[str, Any]:
    """Return the section `params` of a train file, as rl_games' Runner hands it to an agent.

    Args:
        params: such a section, which is returned as it is, or a flat configuration: keys of its
            `config`, which replace those of `train_file`. `network` may be a section of its own or
            a model of rl_games that is not built yet; `vec_env` and `env_info` an environment that
            exists; without them `env_config` holds arguments of `isaacgymenvs_lite.make`.
        train_file: name of the train file whose values count where nothing is given.

    Raises:
        ConfigError: a value that cannot be used, or no environment to make.
    """
    if isinstance(params.get("config"), Mapping):
        return dict(params)
    given = dict(params)
    objects = {key: given.pop(key) for key in list(given) if not isinstance(given[key], _PLAIN)}
    vec_env = objects.get("vec_env")
    if vec_env is not None:
        given.setdefault("num_actors", vec_env.env.num_envs)
        # Spaces are no values of a configuration.
        objects["env_info"] = given.pop("env_info", None) or vec_env.get_env_info()
    num_actors = int(given.setdefault("num_actors", _NUM_ACTORS))
    device = str(given.setdefault("device", "cpu"))
    _check_env(given, vec_env, num_actors)
    observer = given.pop("features", {}).get("observer") or DefaultAlgoObserver()
    shaper = objects.pop("reward_shaper", None)

    section = load_train_file(train_file, num_actors, device)["params"]
    if "network" in given:
        section["network"] = given.pop("network")
    section["config"] |= given
    tree = OmegaConf.create({"train": {"params": section}, "pbt": {}, "rl_device": device})
    names = KnownNames(config_keys=AGENT_KEYS)
    complete = prepare_train_params(tree, num_envs=num_actors, seed=0, names=names)
    config = complete["config"]
    config["reward_shaper"] = shaper or tr_helpers.DefaultRewardsShaper(**config["reward_shaper"])
    config["features"] = {"observer": observer}
    config |= objects
    return complete


def _check_env(given: dict[str, Any], vec_env: Any, num_actors: int) -> None:
    if vec_env is not None:
        return
    name = given.setdefault("env_name", _ENV_NAME)
    if name not in env_configurations.configurations:
        raise ConfigError(
            f"env_name={name} is not known to rl_games: call"
            " isaacgymenvs_lite.registration.build_runner() first, or give vec_env"
        )
    # A copy: the caller's own stays as it is.
    env_config = given["env_config"] = dict(given.get("env_config") or {})
    if name == _ENV_NAME and "task" not in env_config:
        raise ConfigError(
            "config: which task? expected vec_env, or env_config with the arguments of"
            " isaacgymenvs_lite.make, such as {'task': 'HumanoidHeading'}"
        )
    env_config.setdefault("num_envs", num_actors)
