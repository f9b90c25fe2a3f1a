"""The section pbt: what is refused, and what published files may hold."""

from __future__ import annotations

import pytest

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.config.pbt_settings import mutable_values, read_pbt_settings
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.schema import plain

ON = ("task=Ant", "pbt=pbt_default", "rl_device=cpu")


def test_one_line_for_a_wrong_value():
    for words, expected in [
        (["pbt.policy_idx=8"], "pbt.policy_idx=8: expected a number from 0 to 7; each of the"),
        (["pbt.num_policies=1"], "pbt.num_policies=1: a single policy cannot be compared"),
        (["pbt.workspace=''"], "pbt.workspace='' cannot be the name"),
        (["pbt.workspace=../x"], "pbt.workspace='../x' leads out of the folder of the runs"),
        (["pbt.change_min=0.5"], "pbt.change_min: got 0.5, expected a number of at least 1"),
        (["pbt.change_min=2"], "pbt.change_min=2 is above pbt.change_max=1.5"),
        (["+pbt.polcy_idx=1"], "unknown key 'pbt.polcy_idx' (did you mean 'policy_idx'?)"),
        (["train.params.config.gamma=high"], "train.params.config.gamma='high' cannot be mutated"),
    ]:
        with pytest.raises(ConfigError) as error:
            check_config(compose([*ON, *words]))
        assert expected in str(error.value)


def test_files_of_mutations(tmp_path):
    for mutation, expected in [
        (
            "task.env.upWeight: mutate_flaot",
            "pbt.mutation: task.env.upWeight: unknown function 'mutate_flaot' (did you mean"
            " 'mutate_float'?); choices: mutate_discount, mutate_eps_clip, mutate_float,"
            " mutate_float_min_1, mutate_mini_epochs",
        ),
        (
            "task.env.upWeigth: mutate_float",
            "pbt.mutation: unknown key 'task.env.upWeigth' (did you mean 'upWeight'?)",
        ),
        ("task.env.asset.assetFileName: mutate_float", "cannot be mutated; expected a number"),
        ("train.params.network.rnn.units: mutate_float", "pbt.mutation names no setting of this"),
        ("{}", "pbt.mutation names no setting of this"),
    ]:
        folder = tmp_path / "pbt" / "mutation"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "mine.yaml").write_text(mutation)
        with pytest.raises(ConfigError) as error:
            check_config(compose([*ON, "pbt/mutation=mine"], tmp_path))
        assert expected in str(error.value)


def test_a_published_file_with_mutations_of_its_own(tmp_path):
    """In one file, quoted, beside settings that this train file does not have."""
    (tmp_path / "pbt").mkdir()
    (tmp_path / "pbt" / "theirs.yaml").write_text(
        "enabled: True\npolicy_idx: 0\nnum_policies: 4\nworkspace: 'ws'\ndbg_mode: False\n"
        "interval_steps: 5000000\nstart_after: 10000000\ninitial_delay: 20000000\n"
        "replace_fraction_worst: 0.125\nreplace_fraction_best: 0.3\n"
        "replace_threshold_frac_std: 0.5\nreplace_threshold_frac_absolute: 0.05\n"
        "mutation_rate: 0.15\nchange_min: 1.1\nchange_max: 1.5\n"
        "mutation:\n"
        '  task.env.fingertipDeltaRewScale: "mutate_float"\n'
        '  task.env.headingWeight: "mutate_float"\n'
        '  train.params.config.learning_rate: "mutate_float"\n'
        '  train.params.config.mini_epochs: "mutate_mini_epochs"\n'
    )
    words = ["task=Ant", "pbt=theirs", "train.params.config.learning_rate='5e-4'"]
    cfg = compose([*words, "rl_device=cpu", "pbt.policy_idx=3"], tmp_path)
    check_config(cfg)
    tree = plain(cfg)
    settings = read_pbt_settings(tree)
    assert settings is not None and (settings.policy_idx, settings.workspace) == (3, "ws")
    assert mutable_values(tree, settings) == {
        "task.env.headingWeight": 0.5,
        "train.params.config.learning_rate": 5e-4,
        "train.params.config.mini_epochs": 4,
    }


def test_our_files_name_settings_of_ant():
    for name in ["default_mutation", "ant_mutation"]:
        tree = plain(compose([*ON, f"pbt/mutation={name}"]))
        settings = read_pbt_settings(tree)
        assert settings is not None
        assert mutable_values(tree, settings).keys() == settings.mutation.keys()


def test_off_without_a_section_of_its_own():
    assert read_pbt_settings(plain(compose(["task=Ant"]))) is None
    with pytest.raises(ConfigError, match=r"pbt\.mutation names no setting"):
        check_config(compose(["task=Ant", "pbt.enabled=True", "rl_device=cpu"]))
