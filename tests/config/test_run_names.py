"""Names of runs: `experiment=`, `+full_experiment_name=`, `params.config.name` of a train file."""

from __future__ import annotations

import pytest

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import check_config, read_config
from isaacgymenvs_lite.config.run_names import read_run_name, run_name_of
from isaacgymenvs_lite.errors import ConfigError


def test_names_and_folders_below_the_runs() -> None:
    for given, name in [
        ("walk1", "walk1"),
        ("amp/walk1", "amp/walk1"),
        ("./amp//walk1/", "amp/walk1"),
        ("läuft_№1.2=x", "läuft_№1.2=x"),
        (7, "7"),
    ]:
        assert str(read_run_name(given, "experiment")) == name


def test_other_names_are_one_line() -> None:
    for given, problem in [
        ("", "cannot be the name"),
        ("..", "leads out of"),
        ("../../x", "leads out of"),
        ("a/../../x", "leads out of"),
        ("/tmp/x", "leads out of"),
        ("~/x", "leads out of"),
        ("a\\b", "leads out of"),
        ("a\nb", "cannot be the name"),
        ("a\udcffb", "cannot be the name"),
        ("a/b/c/d/e/f", "up to 5 levels"),
        ("a" * 161, "longer than 160 bytes"),
        ("ä" * 81, "longer than 160 bytes"),
    ]:
        with pytest.raises(
            ConfigError, match=rf"^experiment='.*{problem}.*expected a name"
        ) as refused:
            read_run_name(given, "experiment")
        assert "\n" not in str(refused.value)
        assert str(refused.value).isprintable()


def test_they_are_checked_at_the_start() -> None:
    for words, key in [
        (["experiment=../../x"], "experiment"),
        (["experiment='  '"], "experiment"),
        (["+full_experiment_name=/tmp/x"], "full_experiment_name"),
        (["train.params.config.name=../x"], "train.params.config.name"),
    ]:
        with pytest.raises(ConfigError, match=f"^{key}="):
            check_config(compose(["task=Cartpole", "rl_device=cpu", *words]))


def test_a_train_file_from_outside_stays_below_the_runs(tmp_path) -> None:
    file = tmp_path / "Mine.yaml"
    file.write_text("defaults: [CartpolePPO, _self_]\nparams: {config: {name: ../../x}}\n")
    words = ["task=Cartpole", "rl_device=cpu", f"train={file}"]
    with pytest.raises(ConfigError, match=r"^train\.params\.config\.name='\.\./\.\./x' leads out"):
        check_config(compose(words))
    config = read_config(compose([*words, "experiment=mine"]))  # replaces the file's name
    assert str(run_name_of(config.tree)) == "mine"
