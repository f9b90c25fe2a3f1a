"""An HRLAgent that is constructed by hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from rl_games.algos_torch.model_builder import ModelBuilder

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.learning.amp_continuous import AMPAgent
from isaacgymenvs_lite.learning.hrl_continuous import HRLAgent, complete_params
from isaacgymenvs_lite.wrappers.rl_games_env import RLGPUEnv
from tests.learning.test_gen_amp import LATENT_DIM
from tests.learning.test_hrl import llc  # noqa: F401  a fixture

TRAIN_FILE = "HumanoidASEHRLPPO"


@pytest.fixture
def vec_env(make_runner: Callable[..., Any]) -> RLGPUEnv:
    make_runner()
    return RLGPUEnv("rlgpu", 8)


@pytest.fixture
def config(llc, vec_env, tmp_path: Path) -> dict[str, Any]:  # noqa: F811
    return {
        "llc_config": llc[1],
        "llc_checkpoint": llc[2],
        "llc_steps": 2,
        "vec_env": vec_env,
        "horizon_length": 4,
        "minibatch_size": 1000,
        "max_epochs": 1,
        "mixed_precision": False,
        "train_dir": str(tmp_path / "runs"),
    }


def test_a_flat_configuration_trains(config) -> None:
    agent = HRLAgent("hrl_humanoid", config)
    assert agent.actions_num == LATENT_DIM
    assert agent.num_actors == 8
    assert agent.minibatch_size == 32  # 8 environments x 4 steps
    before = [weights.clone() for weights in agent.model.parameters()]
    agent.train()
    agent.writer.close()
    assert agent.epoch_num == 1
    pairs = zip(before, agent.model.parameters(), strict=True)
    assert any(not torch.equal(old, new) for old, new in pairs)


def test_a_published_call_is_understood_without_complaints(config, caplog) -> None:
    agent = HRLAgent(base_name="hrl_humanoid", config=config)
    agent.writer.close()
    assert (agent._llc_steps, agent._latent_dim, agent._task_size) == (2, LATENT_DIM, 0)
    assert agent._llc_agent is agent.llc
    assert "nothing reads" not in caplog.text
    complete_params({**config, "llc_stepz": 3}, TRAIN_FILE)
    assert "nothing reads train.params.config.llc_stepz" in caplog.text


@pytest.mark.parametrize("given", [{}, {"params": {}, "config": {}}])
def test_an_agent_is_made_of_one_section(given) -> None:
    for cls in (HRLAgent, AMPAgent):
        with pytest.raises(ConfigError, match="either params= or config="):
            cls("run", **given)
    with pytest.raises(ConfigError, match="no section config"):
        AMPAgent(base_name="run", config={"horizon_length": 3})


def test_the_network_may_be_given(config) -> None:
    section = {
        "name": "hrl",
        "separate": True,
        "mlp": {"units": [24], "activation": "elu", "initializer": {"name": "default"}},
        "space": {
            "continuous": {
                "mu_activation": "None",
                "sigma_activation": "None",
                "mu_init": {"name": "default"},
                "sigma_init": {"name": "const_initializer", "val": -1.0},
                "fixed_sigma": True,
                "learn_sigma": False,
            }
        },
    }
    model = ModelBuilder().load({"model": {"name": "hrl"}, "network": section})
    for network in (section, model):
        agent = HRLAgent("hrl_humanoid", {**config, "network": network})
        agent.writer.close()
        assert agent.model.a2c_network.mu.in_features == 24


def test_what_is_not_given_is_the_train_file_s(config) -> None:
    found = complete_params(config, TRAIN_FILE)["config"]
    assert (found["llc_steps"], found["gamma"], found["task_reward_w"]) == (2, 0.99, 0.9)
    assert found["name"] == "HumanoidASEHRL"


def test_a_train_file_s_section_stays_as_it_is() -> None:
    params = {"algo": {"name": "hrl"}, "config": {"llc_steps": 3}}
    assert complete_params(params, TRAIN_FILE) == params


def test_without_an_environment_the_task_must_be_named(config) -> None:
    del config["vec_env"]
    with pytest.raises(ConfigError, match="which task"):
        complete_params(config, TRAIN_FILE)
    config["env_config"] = {"task": "HumanoidHeading"}
    config["num_actors"] = 6
    found = complete_params(config, TRAIN_FILE)["config"]
    assert found["env_config"] == {"task": "HumanoidHeading", "num_envs": 6}
    assert config["env_config"] == {"task": "HumanoidHeading"}


def test_an_environment_that_rl_games_does_not_know(config) -> None:
    del config["vec_env"]
    with pytest.raises(ConfigError, match=r"env_name=nobodys.*build_runner"):
        complete_params({**config, "env_name": "nobodys"}, TRAIN_FILE)


def test_values_are_checked(config) -> None:
    with pytest.raises(ConfigError, match="learning_rate"):
        complete_params({**config, "learning_rate": "fast"}, TRAIN_FILE)
