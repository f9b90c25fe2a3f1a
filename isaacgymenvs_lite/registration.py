"""Registers our agents, players, models, networks and tasks with rl_games.

    from rl_games.torch_runner import Runner
    from isaacgymenvs_lite.registration import register

    runner = Runner()
    register(runner)
    runner.load(yaml_config)    # config: env_name: rlgpu, env_config: {task: HumanoidAMP, ...}

`amp_agent` is then `LeastSquaresAMPAgent`. If the caller registers `AMPAgent` as `amp_agent`, the
style reward is logistic, as in IsaacGymEnvs.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

from rl_games.algos_torch import model_builder
from rl_games.common import env_configurations, vecenv
from rl_games.common.algo_observer import AlgoObserver
from rl_games.torch_runner import Runner

import isaacgymenvs_lite
from isaacgymenvs_lite.config.train_params import KnownNames
from isaacgymenvs_lite.learning.amp_config import AGENT_KEYS
from isaacgymenvs_lite.learning.amp_continuous import AMPAgent, LeastSquaresAMPAgent
from isaacgymenvs_lite.learning.amp_models import ModelAMPContinuous
from isaacgymenvs_lite.learning.amp_network_builder import AMPBuilder
from isaacgymenvs_lite.learning.amp_players import AMPPlayerContinuous, LeastSquaresAMPPlayer
from isaacgymenvs_lite.learning.gen_amp import GenAMPAgent
from isaacgymenvs_lite.learning.gen_amp_models import ModelGenAMPContinuous
from isaacgymenvs_lite.learning.gen_amp_network_builder import GenAMPBuilder
from isaacgymenvs_lite.learning.gen_amp_players import GenAMPPlayerContinuous
from isaacgymenvs_lite.learning.hrl_continuous import HRLAgent
from isaacgymenvs_lite.learning.hrl_models import ModelHRLContinuous
from isaacgymenvs_lite.learning.hrl_network_builder import HRLBuilder
from isaacgymenvs_lite.learning.hrl_players import HRLPlayer
from isaacgymenvs_lite.learning.ppo import PPOAgent, PPOPlayer
from isaacgymenvs_lite.learning.sac import SACAgent, SACPlayer
from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.wrappers.rl_games_env import RLGPUEnv

_ALGORITHMS: dict[str, tuple[type, type]] = {
    "a2c_continuous": (PPOAgent, PPOPlayer),
    "amp_agent": (LeastSquaresAMPAgent, LeastSquaresAMPPlayer),
    "amp_continuous": (AMPAgent, AMPPlayerContinuous),
    "amp": (AMPAgent, AMPPlayerContinuous),
    "gen_amp": (GenAMPAgent, GenAMPPlayerContinuous),
    "ase": (GenAMPAgent, GenAMPPlayerContinuous),
    "hrl": (HRLAgent, HRLPlayer),
    "hrl_continuous": (HRLAgent, HRLPlayer),
    "sac": (SACAgent, SACPlayer),
}
_MODELS: dict[str, type] = {
    "continuous_amp": ModelAMPContinuous,
    "amp": ModelAMPContinuous,
    "continuous_gen_amp": ModelGenAMPContinuous,
    "gen_amp": ModelGenAMPContinuous,
    "ase": ModelGenAMPContinuous,
    "continuous_hrl": ModelHRLContinuous,
    "hrl": ModelHRLContinuous,
}
_NETWORKS: dict[str, type] = {
    "amp": AMPBuilder,
    "gen_amp": GenAMPBuilder,
    "ase": GenAMPBuilder,
    "hrl": HRLBuilder,
}
_ENV_NAME = "rlgpu"
# These keys of train.params.config are read by `runner` and not by agents.
_RUNNER_KEYS = ("imitation_frequency", "print_disc_prediction", "save_buffers")


def register(runner: Runner) -> None:
    """Add all our algorithms, players, models, networks and tasks to rl_games' Runner."""
    register_networks()
    register_algorithms(runner)


def register_algorithms(runner: Runner) -> None:
    """Add our algorithms and players to rl_games' Runner; they replace entries of equal names."""
    for name, (agent, player) in _ALGORITHMS.items():
        runner.algo_factory.register_builder(name, agent)
        runner.player_factory.register_builder(name, player)


def register_networks() -> None:
    """Register our models, networks and tasks with rl_games, for all Runners."""
    # torch 2.14 warns because rl_games uses torch.jit.script, which no user can change.
    warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated", FutureWarning)
    # The first backward pass on a GPU prints this warning, although torch then makes the context.
    no_context = "Attempting to run cuBLAS, but there was no current CUDA context"
    warnings.filterwarnings("ignore", no_context, UserWarning)
    if _ENV_NAME not in env_configurations.configurations:
        register_env()
    for name, model in _MODELS.items():
        model_builder.register_model(name, model)
    for name, network in _NETWORKS.items():
        model_builder.register_network(name, network)


def build_runner(observer: AlgoObserver | None = None) -> Runner:
    """Return a Runner with our agents; the observer is called during a training."""
    runner = Runner(observer)
    register(runner)
    return runner


def register_env(creator: Callable[..., VecTask] | None = None) -> None:
    """Register `creator(**env_config)` as the task of `env_name: rlgpu` in train files.

    The default creator is `isaacgymenvs_lite.make`.
    """
    vecenv.register("RLGPU", RLGPUEnv)
    env_configurations.register(
        _ENV_NAME, {"vecenv_type": "RLGPU", "env_creator": creator or isaacgymenvs_lite.make}
    )


def known_names(runner: Runner) -> KnownNames:
    """Return the registered names that a train file may use, and the keys of our agents."""
    builder = model_builder.ModelBuilder()
    return KnownNames(
        algos=sorted(runner.algo_factory._builders),
        models=sorted(builder.model_factory._builders),
        networks=sorted(builder.network_builder.network_factory._builders),
        config_keys=AGENT_KEYS.union(_RUNNER_KEYS),
    )
