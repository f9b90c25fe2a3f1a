"""Train files of Isaac Lab."""

from __future__ import annotations

import pytest

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import read_config
from isaacgymenvs_lite.config.train_params import prepare_train_params
from isaacgymenvs_lite.errors import ConfigError

# What those files have and IsaacGymEnvs' lack: no interpolations, a device, -1 environments.
LAB = (
    "+train.params.env={clip_observations: 5.0, clip_actions: 0.5}",
    "train.params.config.num_actors=-1",
    "train.params.config.device='cuda:0'",
    "train.params.config.device_name='cuda:0'",
    "train.params.seed=7",
)


def test_device_and_sizes_are_those_of_the_command_line() -> None:
    cfg = compose(["task=Ant", "rl_device=cpu", *LAB])
    config = prepare_train_params(cfg, num_envs=12, seed=1)["config"]
    assert (config["device"], config["device_name"], config["num_actors"]) == ("cpu", "cpu", 12)


def test_the_task_keeps_the_wrappers_limits() -> None:
    env = read_config(compose(["task=Ant", *LAB])).tree["task"]["env"]
    assert (env["clipObservations"], env["clipActions"]) == (5.0, 0.5)
    assert "clipObservations" not in read_config(compose(["task=Ant"])).tree["task"]["env"]


def test_a_limit_that_is_none_is_named() -> None:
    cfg = compose(["task=Ant", "+train.params.env={clip_actions: -1}"])
    with pytest.raises(ConfigError, match=r"train.params.env.clip_actions: got -1, expected"):
        read_config(cfg)
