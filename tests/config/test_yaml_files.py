import logging
from pathlib import Path

import pytest
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from yaml import YAMLError

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.yaml_files import read_yaml
from isaacgymenvs_lite.errors import ConfigError


@pytest.fixture
def write(tmp_path):
    def write_file(text: str):
        path = tmp_path / "file.yaml"
        path.write_text(text)
        return path

    return write_file


def test_last_of_equal_keys_wins_with_one_warning(write, caplog):
    path = write("a: 1\nconfig:\n  ppo: True\n  lr: 1\n  ppo: False\nb: 2\n")
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            content = read_yaml(path)
    assert content == {"a": 1, "config": {"ppo": False, "lr": 1}, "b": 2}
    assert [record.message for record in caplog.records] == [
        f"{path} states 'ppo' more than once: the last one counts"
    ]


def test_equal_keys_in_different_sections_are_no_duplicates(write, caplog):
    assert read_yaml(write("a: {x: 1}\nb: {x: 2}\n")) == {"a": {"x": 1}, "b": {"x": 2}}
    assert not caplog.records


def test_numbers_are_read_as_omegaconf_does(write):
    content = read_yaml(write("a: 2e-5\nb: 5e3\nc: 1_000\nd: 2026-01-01\ne: None\nf: on\n"))
    assert content == {"a": 2e-5, "b": 5000.0, "c": 1000, "d": "2026-01-01", "e": "None", "f": True}


def test_anchors_and_merge_keys_still_work(write):
    assert read_yaml(write("x: &x {a: 1}\ny:\n  <<: *x\n  b: 2\n")).y == {"a": 1, "b": 2}


def test_empty_file_is_an_empty_mapping(write):
    assert read_yaml(write("")) == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1, 2", "is not valid YAML"),
        ("- 1\n- 2\n", "holds a list, expected a mapping"),
        ("just text", "holds a str, expected a mapping"),
        ("a: !!python/object/apply:os.system ['true']\n", "is not valid YAML"),
    ],
)
def test_unusable_files_are_named(write, text, message):
    path = write(text)
    with pytest.raises(ConfigError, match=message) as error:
        read_yaml(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(ConfigError, match=r"cannot read .*absent\.yaml"):
        read_yaml(tmp_path / "absent.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"cannot read .*binary\.yaml"):
        read_yaml(tmp_path / "binary.yaml")


def hydra_reads(folder: Path) -> object:
    """Return what Hydra itself makes of root.yaml in a folder."""
    with initialize_config_dir(str(folder), version_base="1.3"):
        return hydra_compose("root").a


def test_hydras_reader_is_replaced_only_while_a_tree_is_composed(tmp_path):
    (tmp_path / "root.yaml").write_text("a: 1\na: 2\n")
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "Mine.yaml").write_text("defaults: [CartpolePPO]\nx: 1\nx: 2\n")
    with pytest.raises(YAMLError, match="duplicate key a"):
        hydra_reads(tmp_path)
    assert compose(["task=Cartpole", "train=Mine"], tmp_path).train.x == 2
    with pytest.raises(YAMLError, match="duplicate key a"):
        hydra_reads(tmp_path)
    with pytest.raises(ConfigError):
        compose(["task=Nothing"], tmp_path)
    with pytest.raises(YAMLError, match="duplicate key a"):
        hydra_reads(tmp_path)
