from __future__ import annotations

from typing import Any

import pytest
import yaml

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import cfg_dir
from isaacgymenvs_lite.schema import read_section
from isaacgymenvs_lite.tasks.amp.humanoid_amp_base import HumanoidAMPConfig
from isaacgymenvs_lite.tasks.base.task_config import UNREAD_ENV_KEYS, read_sim_config


def read_env_config(env: dict[str, Any]) -> HumanoidAMPConfig:
    return read_section(HumanoidAMPConfig, env, "task.env", ignored=UNREAD_ENV_KEYS)


def test_published_numbers_are_the_defaults_and_those_of_the_task_file() -> None:
    file = yaml.safe_load((cfg_dir() / "task" / "HumanoidAMP.yaml").read_text())
    from_file = {**file["env"]}
    for env in ({}, from_file):
        config = read_env_config(env)
        assert config.episode_length == 300
        assert config.pd_control is True
        assert config.power_scale == 1.0
        assert config.control_freq_inv == 2
        assert config.state_init == "Random"
        assert config.hybrid_init_prob == 0.5
        assert config.num_amp_obs_steps == 2
        assert config.local_root_obs is False
        # A published file without the key has the feet; ours adds what the clips show.
        assert config.contact_bodies == (None if env else ("right_foot", "left_foot"))
        assert config.termination_height == 0.5
        assert config.enable_early_termination is True
        assert config.asset.asset_file_name == "mjcf/amp_humanoid.xml"
        assert config.plane.dynamic_friction == 1.0
    for sim in ({}, {**file["sim"], "use_gpu_pipeline": False}):
        config = read_sim_config(sim)
        assert (config.dt, config.substeps) == (0.0166, 2)
        assert config.gravity == (0.0, 0.0, -9.81)


def test_a_wrong_value_is_named_with_what_is_expected() -> None:
    for key, value, expectation in [
        ("stateInit", "Standing", "Default"),
        ("numAMPObsSteps", 1, "2"),
        ("hybridInitProb", 1.5, "1"),
        ("clipActions", 0.0, "0"),
        ("pdControl", "perhaps", "True or False"),
        ("contactBodies", 5, "list"),
    ]:
        with pytest.raises(ConfigError, match=rf"task\.env\.{key}") as error:
            read_env_config({key: value})
        message = str(error.value)
        assert str(value) in message
        assert expectation in message.split(str(value), 1)[1]
        assert "\n" not in message


def test_a_misspelt_key_is_an_error() -> None:
    with pytest.raises(ConfigError, match=r"task\.env\.terminationHight.*terminationHeight"):
        read_env_config({"terminationHight": 0.3})
    with pytest.raises(ConfigError, match=r"task\.env\.asset\.assetFilename.*assetFileName"):
        read_env_config({"asset": {"assetFilename": "x.xml"}})
