from __future__ import annotations

import warnings
from typing import Any

import pytest
from rl_games.common import env_configurations, vecenv
from rl_games.common.algo_observer import AlgoObserver
from rl_games.torch_runner import Runner

from isaacgymenvs_lite.learning.amp_continuous import AMPAgent
from isaacgymenvs_lite.registration import (
    build_runner,
    known_names,
    register,
    register_env,
)

# architecture.md, as far as these agents exist
AMP_ALGORITHMS = ("amp_agent", "amp_continuous", "amp", "gen_amp", "ase")
ALGORITHMS = (*AMP_ALGORITHMS, "hrl", "hrl_continuous")
MODELS = ("continuous_amp", "amp", "continuous_gen_amp", "gen_amp", "ase")
NETWORKS = ("amp", "gen_amp", "ase", "hrl")


@pytest.fixture
def runner() -> Runner:
    return build_runner()


def builders_of(factory) -> dict[str, Any]:
    """What rl_games' factory calls for each name."""
    return factory._builders


def test_names_of_train_files(runner):
    names = known_names(runner)
    assert set(ALGORITHMS) <= set(names.algos)
    assert set(MODELS) <= set(names.models)
    assert set(NETWORKS) <= set(names.networks)
    for values in (names.algos, names.models, names.networks):
        assert values == sorted(values)
    assert {"llc_steps", "amp_obs_steps", "imitation_frequency"} <= set(names.config_keys)


def test_rl_games_own_names_stay(runner):
    names = known_names(runner)
    assert {"a2c_continuous", "a2c_discrete", "sac"} <= set(names.algos)
    assert {"continuous_a2c_logstd", "discrete_a2c", "soft_actor_critic"} <= set(names.models)
    assert {"actor_critic", "resnet_actor_critic", "soft_actor_critic"} <= set(names.networks)
    plain = Runner()
    for factory in ("algo_factory", "player_factory"):
        for name, builder in builders_of(getattr(plain, factory)).items():
            if name in ("a2c_continuous", "sac"):  # ours, on top of rl_games'
                continue
            own = builders_of(getattr(runner, factory))[name]
            assert own.__code__ is builder.__code__, name


def test_every_algorithm_has_a_player(runner):
    for name in AMP_ALGORITHMS:
        agent = builders_of(runner.algo_factory)[name]
        player = builders_of(runner.player_factory)[name]
        assert issubclass(agent, AMPAgent)
        assert player.default_disc_reward == agent.default_disc_reward
        expected = "least_squares" if name == "amp_agent" else "logistic"
        assert agent.default_disc_reward == expected


def test_a_runner_that_the_caller_made():
    class MyObserver(AlgoObserver):
        pass

    observer = MyObserver()
    runner = Runner(observer)
    before = set(builders_of(runner.algo_factory))
    register(runner)
    assert set(builders_of(runner.algo_factory)) == before | set(ALGORITHMS)
    assert set(builders_of(runner.player_factory)) >= set(ALGORITHMS)
    assert runner.algo_observer is observer
    register(runner)  # twice is as good as once
    assert set(builders_of(runner.algo_factory)) == before | set(ALGORITHMS)


def test_users_do_not_read_that_rl_games_scripts_its_normalisers():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        register(Runner())
        warnings.warn("`torch.jit.script` is deprecated. Please", FutureWarning, stacklevel=1)
        warnings.warn("another of torch", FutureWarning, stacklevel=1)
    assert [str(warning.message) for warning in caught] == ["another of torch"]


def test_the_environment_of_train_files(monkeypatch):
    monkeypatch.setitem(env_configurations.configurations, "rlgpu", {})  # put back afterwards

    class Task:
        def __init__(self, **kwargs: object) -> None:
            self.kwargs = kwargs

    register_env(lambda **kwargs: Task(**kwargs))  # type: ignore[arg-type]
    env = vecenv.create_vec_env("rlgpu", 4, seed=7)
    assert isinstance(env.env, Task)
    assert env.env.kwargs == {"seed": 7}
    # the newest registration counts: a second run in the same process has its own task
    second = Task()
    register_env(lambda **kwargs: second)  # type: ignore[arg-type]
    assert vecenv.create_vec_env("rlgpu", 4).env is second


def test_a_runner_of_the_caller_finds_our_tasks(monkeypatch):
    monkeypatch.delitem(env_configurations.configurations, "rlgpu", raising=False)
    register(Runner())
    creator = env_configurations.configurations["rlgpu"]["env_creator"]
    env = creator(task="HumanoidAMP", num_envs=2)
    try:
        assert env.reset()["obs"].shape == (2, 105)
    finally:
        env.close()
