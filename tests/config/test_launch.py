import importlib.util

import pytest
import torch

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import LaunchSettings, check_config
from isaacgymenvs_lite.errors import ConfigError, DeviceError, UserError


@pytest.fixture
def no_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


def message(*overrides: str, config_dir=None) -> str:
    with pytest.raises(UserError) as error:
        check_config(compose(overrides, config_dir))
    assert "\n" not in str(error.value)
    return str(error.value)


def test_defaults(no_gpu):
    assert check_config(compose()) == LaunchSettings(
        task_name="HumanoidAMP", wandb_name="HumanoidAMP"
    )


def test_values_are_typed_and_blanks_are_none(no_gpu):
    settings = check_config(
        compose(["num_envs=64", "sigma=-1", "experiment=2026", "wandb_tags=[a,b]", "seed=-1"])
    )
    assert (settings.num_envs, settings.sigma, settings.max_iterations) == (64, -1.0, None)
    assert (settings.experiment, settings.wandb_tags, settings.seed) == ("2026", ["a", "b"], -1)
    added = check_config(compose(["+full_experiment_name=exact"]))
    assert added.full_experiment_name == "exact"


def test_files_of_a_user_pass(no_gpu, config_dir):
    for train in ("Published", "Ase", "OnlyDefaults"):
        check_config(compose(["task=Mine", f"train={train}"], config_dir))


def test_wrong_values(no_gpu):
    for override, expected in [
        ("num_envs=0", "num_envs: got 0, expected a whole number of at least 1, or ''"),
        ("num_envs=many", "num_envs: got 'many'"),
        ("seed=-2", "seed: got -2, expected a whole number of at least -1"),
        ("sigma=wide", "sigma: got 'wide', expected a number, or ''"),
        ("pipeline=fpga", "pipeline: got 'fpga', expected one of cpu, gpu"),
        ("test=maybe", "test: got 'maybe', expected True or False"),
        ("wandb_tags=a", "wandb_tags: got 'a', expected a list"),
        ("task.env.numEnvs=0", "task.env.numEnvs: got 0"),
        ("+num_emvs=3", "unknown key 'num_emvs' (did you mean 'num_envs'?)"),
        ("seed=${nowhere}", "seed: Interpolation key 'nowhere' not found"),
        ("train.params.config.gamma=${eq:1}", "train.params.config.gamma: "),
        ("~task.name", "the key 'task.name' is missing"),
        ("~task.sim", "the key 'task.sim' is missing; a task file has dt and gravity below sim:"),
        ("task.env.numEnvs=9999999999999", "of at most 16777216"),
        ("latent=random", "latent=random chooses what a trained policy shows: add test=True"),
        ("pbt.enabled=1", "pbt.enabled: got 1, expected True or False"),
    ]:
        assert expected in message(override)


def test_several_processes_train_and_do_not_play():
    with pytest.raises(ConfigError, match="multi_gpu=True trains in several processes; to play"):
        check_config(compose(["multi_gpu=True", "test=True"]))
    check_config(compose(["multi_gpu=True"]))


def test_mistakes_that_need_no_torch_are_found_before_it_is_asked(monkeypatch):
    for override in ["num_envs=0", "seed=abc", "rl_device=gpu"]:

        def asked() -> bool:
            raise AssertionError("torch was asked for a GPU")

        monkeypatch.setattr(torch.cuda, "is_available", asked)
        message(override)


def test_devices_of_a_machine_without_a_gpu(no_gpu):
    for key in ("sim_device", "rl_device"):
        assert f"{key}=gpu: expected cpu, cuda or cuda:N" in message(f"{key}=gpu")
    assert "torch sees no GPU" in message("rl_device=cuda:0")
    with pytest.raises(DeviceError):
        check_config(compose(["rl_device=cuda"]))


def test_default_rl_device_is_the_gpu_if_there_is_one(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    settings = check_config(compose())
    assert (settings.sim_device, settings.rl_device) == ("cpu", "cuda:0")


def test_wandb_must_be_installed(no_gpu, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert 'pip install "isaacgymenvs-lite[wandb]"' in message("wandb_activate=True")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    assert check_config(compose(["wandb_activate=True"])).wandb_activate
