"""The functions of IsaacGymEnvs' train.py."""

from __future__ import annotations

import sys

import pytest
from omegaconf import OmegaConf, open_dict

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.isaacgymenvs_compat.reformat import omegaconf_to_dict
from isaacgymenvs_lite.isaacgymenvs_compat.train import launch_rlg_hydra, preprocess_train_config


def test_a_train_section_is_completed() -> None:
    cfg = compose(["task=Cartpole", "rl_device=cpu"])
    section = omegaconf_to_dict(cfg.train)
    section["params"]["network"]["mlp"]["model_size_multiplier"] = 2
    done = preprocess_train_config(cfg, section)
    assert done is section
    config = done["params"]["config"]
    assert done["params"]["network"]["mlp"]["units"] == [64, 64]
    assert (config["device"], config["full_experiment_name"]) == ("cpu", None)
    assert (config["population_based_training"], config["pbt_idx"]) == (False, None)
    with open_dict(cfg):
        cfg.pbt = OmegaConf.create({"enabled": True, "policy_idx": 3})
        cfg.full_experiment_name = "one"
    config = preprocess_train_config(cfg, section)["params"]["config"]
    assert (config["population_based_training"], config["pbt_idx"]) == (True, 3)
    assert config["full_experiment_name"] == "one"


def test_the_command_line_is_train_py_s(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["train.py", "num_env=4"])
    with pytest.raises(SystemExit) as end:
        launch_rlg_hydra()
    assert end.value.code == 2
    assert "did you mean 'num_envs'" in capsys.readouterr().err
