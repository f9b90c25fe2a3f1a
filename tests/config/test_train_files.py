import pytest
from omegaconf import OmegaConf

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.train_files import load_train_file
from isaacgymenvs_lite.errors import ConfigError


def test_interpolations_into_the_tree_resolve(config_dir):
    params = load_train_file(config_dir / "train" / "Published.yaml", num_envs=5)["params"]
    config = params["config"]
    assert (params["seed"], params["load_checkpoint"]) == (42, False)
    assert (config["num_actors"], config["max_epochs"], config["name"]) == (5, 5000, "HumanoidAMP")
    assert config["full_experiment_name"] == "HumanoidAMP"
    assert config["learning_rate"] == 5e-5
    assert type(params["network"]["mlp"]["units"]) is list


def test_defaults_list(config_dir):
    file = config_dir / "train" / "Child.yaml"
    file.write_text("defaults: [Published, _self_]\nparams: {config: {gamma: 0.5}}\n")
    config = load_train_file(file)["params"]["config"]
    assert (config["gamma"], config["tau"]) == (0.5, 0.95)
    file.write_text("defaults: [_self_, Published]\nparams: {config: {gamma: 0.5}}\n")
    assert load_train_file(file)["params"]["config"]["gamma"] == 0.99


def test_bare_name_is_one_of_ours():
    params = load_train_file("HumanoidAMPPPOLowGP")["params"]
    assert params["config"]["disc_grad_penalty"] == 0.2
    on_gpu = load_train_file("HumanoidAMPPPO.yaml", rl_device="cuda:0")["params"]
    assert on_gpu["config"]["minibatch_size"] == 32768


def test_a_run_folder_stands_for_its_train_file(tmp_path):
    cfg = compose(["task=HumanoidASE", "train.params.config.latent_dim=8"])
    file = tmp_path / "config.yaml"
    OmegaConf.save(cfg, file)
    params = load_train_file(file)["params"]
    assert (params["config"]["latent_dim"], params["config"]["name"]) == (8, "HumanoidASE")
    assert load_train_file(file, num_envs=8)["params"]["config"]["num_actors"] == 8
    on_gpu = load_train_file(file, rl_device="cuda:0")["params"]
    assert on_gpu["config"]["minibatch_size"] == 16384 != params["config"]["minibatch_size"]


def test_folders_of_published_files_mean_ours(tmp_path, monkeypatch):
    for folder in ["isaacgymenvs/cfg/train", "ase/data/cfg/train/rlg"]:
        monkeypatch.chdir(tmp_path)
        found = load_train_file(f"{folder}/HumanoidASEPPO.yaml")
        assert found["params"]["config"]["latent_dim"] == 16
        with pytest.raises(ConfigError, match="does not exist"):
            load_train_file(f"other/{folder}/HumanoidASEPPO.yaml")


def test_wrong_paths(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"did you mean 'HumanoidAMPPPO'\?.*choices"):
        load_train_file("HumanoidAMPPO")
    with pytest.raises(ConfigError, match=r"'some/where\.yaml' does not exist \(looked in"):
        load_train_file("some/where.yaml")


def test_unusable_files(tmp_path):
    for text, message in [
        ("a: 1\n", "is not a train file"),
        ("", "is not a train file"),
        ("params: {config: {n: '${....nowhere}'}}\n", "nowhere"),
        ("defaults: [File]\nparams: {}\n", "run in a circle"),
        ("defaults: [{task: Ant}]\nparams: {}\n", "unknown train/task"),
        ("defaults: [Absent]\nparams: {}\n", "Could not load 'train/Absent'"),
    ]:
        file = tmp_path / "File.yaml"
        file.write_text(text)
        with pytest.raises(ConfigError, match=message):
            load_train_file(file)
