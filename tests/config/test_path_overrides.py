"""`train=` and `task=` with the path of a file."""

from __future__ import annotations

from pathlib import Path

import pytest

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import cfg_dir


@pytest.fixture
def published(tmp_path: Path) -> Path:
    """A train file of the project's name with another learning rate, elsewhere."""
    text = (cfg_dir() / "train" / "ClassicPPO.yaml").read_text()
    file = tmp_path / "AntPPO.yaml"
    file.write_text(text.replace("learning_rate: 3e-4", "name: Mine\n    learning_rate: 7e-3"))
    return file


def test_a_train_file_is_taken_from_its_path(published: Path) -> None:
    cfg = compose(["task=Ant", f"train={published}", "num_envs=7"])
    assert cfg.train.params.config.learning_rate == 7e-3
    assert cfg.train.params.config.num_actors == 7  # interpolations lead into the composed tree
    # Only this once: the name alone means the project's file.
    assert compose(["task=Ant", "train=AntPPO"]).train.params.config.learning_rate == 3e-4


def test_names_that_look_like_other_values_are_names(published: Path) -> None:
    for name in ["2024", "77_903", "1e5", "true", "null"]:
        file = published.with_name(f"{name}.yaml")
        file.write_text(published.read_text())
        cfg = compose(["task=Ant", f"train={file}"])
        assert cfg.train.params.config.learning_rate == 7e-3


def test_paths_may_be_relative_and_go_without_suffix(published: Path, monkeypatch) -> None:
    monkeypatch.chdir(published.parent)
    for named in ("./AntPPO", "AntPPO.yaml", "./AntPPO.yaml"):
        cfg = compose(["task=Ant", f"train={named}"])
        assert cfg.train.params.config.name == "Mine", named


def test_a_defaults_list_finds_neighbours_first_and_the_project_next(published: Path) -> None:
    (published.parent / "Low.yaml").write_text(
        "defaults:\n  - AntPPO\n  - _self_\nparams:\n  config:\n    e_clip: 0.3\n"
    )
    config = compose(["task=Ant", f"train={published.parent / 'Low.yaml'}"]).train.params.config
    assert (config.learning_rate, config.e_clip) == (7e-3, 0.3)
    (published.parent / "Other.yaml").write_text(
        "defaults:\n  - CartpolePPO\n  - _self_\nparams:\n  config:\n    e_clip: 0.3\n"
    )
    config = compose(["task=Ant", f"train={published.parent / 'Other.yaml'}"]).train.params.config
    assert (config.minibatch_size, config.e_clip) == (8192, 0.3)


def test_a_defaults_list_finds_files_in_a_folder_below(tmp_path: Path) -> None:
    (tmp_path / "env").mkdir()
    (tmp_path / "env" / "short.yaml").write_text("episodeLength: 77\n")
    file = tmp_path / "Mine.yaml"
    file.write_text("defaults: [Ant, _self_, {env: short}]\n")
    for words in ([f"task={file}"], [f"task={file}", "task/env=short"]):
        cfg = compose([*words, "train=AntPPO"])
        assert (cfg.task.name, cfg.task.env.episodeLength) == ("Ant", 77)
    with pytest.raises(ConfigError, match="task/env"):
        compose([f"task={file}", "task/env=long", "train=AntPPO"])


def test_a_task_file_is_taken_from_its_path(tmp_path: Path) -> None:
    file = tmp_path / "short-ant.v2.yaml"  # no name in Hydra's grammar
    file.write_text("defaults: [Ant, _self_]\nenv:\n  episodeLength: 77\n")
    cfg = compose([f"task={file}", "train=AntPPO"])
    assert (cfg.task.name, cfg.task.env.episodeLength) == ("Ant", 77)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    for group in ["task", "train"]:
        with pytest.raises(
            ConfigError, match=rf"{group}={tmp_path}/Lost.yaml: no file .*Lost.yaml"
        ):
            compose(["task=Ant", f"{group}={tmp_path}/Lost.yaml"])


def _fork(tmp_path: Path, **train: str) -> Path:
    """Return the task file of a fork of IsaacGymEnvs, with train files beside it."""
    root = tmp_path / "fork"
    for folder in ("assets/amp/motions", "isaacgymenvs/cfg/task", "isaacgymenvs/cfg/train"):
        (root / folder).mkdir(parents=True)
    for name, text in train.items():
        (root / "isaacgymenvs/cfg/train" / f"{name}.yaml").write_text(text)
    task = root / "isaacgymenvs/cfg/task/Walker.yaml"
    task.write_text("defaults: [HumanoidAMP, _self_]\nenv:\n  motion_file: theirs.npz\n")
    return task


_THEIRS = "defaults: [HumanoidAMPPPO, _self_]\nparams:\n  config:\n    learning_rate: 7e-3\n"


def test_the_train_file_beside_a_task_file_is_its_default(tmp_path: Path, caplog) -> None:
    task = _fork(tmp_path, WalkerPPO=_THEIRS)
    with caplog.at_level("INFO"):
        cfg = compose([f"task={task}"])
    assert cfg.train.params.config.learning_rate == 7e-3
    assert f"train file: {task.parents[1]}/train/WalkerPPO.yaml (next to" in caplog.text
    # What is typed counts.
    assert compose([f"task={task}", "train=HumanoidAMPPPO"]).train.params.config.minibatch_size
    cfg = compose([f"task={task}", "train=HumanoidAMPPPO"])
    assert cfg.train.params.config.learning_rate != 7e-3


def test_without_one_the_projects_of_that_name_is(tmp_path: Path) -> None:
    task = _fork(tmp_path)
    with pytest.raises(ConfigError, match=r"no default train file 'WalkerPPO'.*train="):
        compose([f"task={task}"])
    task = task.rename(task.with_name("Ant.yaml"))
    assert compose([f"task={task}"]).train.params.config.name == "Ant"


def test_a_task_file_of_ase_is_completed(tmp_path: Path) -> None:
    file = tmp_path / "ase/data/cfg/humanoid_sword_shield.yaml"
    file.parent.mkdir(parents=True)
    file.write_text("env:\n  numEnvs: 4096\n  terminationHeight: 0.2\nsim:\n  substeps: 3\n")
    cfg = compose([f"task={file}", "train=HumanoidASEPPO", "num_envs=8"])
    assert (cfg.task.name, cfg.task_checkout) == ("HumanoidASE", str(tmp_path))
    assert (cfg.task.env.numEnvs, cfg.task.env.terminationHeight) == (8, 0.2)
    assert (cfg.task.sim.substeps, cfg.task.sim.dt) == (3, pytest.approx(1 / 60))
    assert compose([f"task={file}", "train=HumanoidASEPPO"]).task.env.numEnvs == 4096
