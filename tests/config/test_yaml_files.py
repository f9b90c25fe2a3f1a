import logging

import pytest
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins

from isaacgymenvs_lite.config import yaml_files
from isaacgymenvs_lite.config.yaml_files import read_yaml, tolerant_hydra
from isaacgymenvs_lite.errors import ConfigError


@pytest.fixture(autouse=True)
def _no_file_warned_about(monkeypatch):
    monkeypatch.setattr(yaml_files, "_warned_files", set())


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


def test_hydras_reader_is_replaced_only_inside_the_context():
    def reader():
        return SourcesRegistry.instance().types["file"]

    Plugins.instance()  # registers Hydra's own
    own = reader()
    with tolerant_hydra():
        assert reader() is not own
        with tolerant_hydra():
            pass
        assert reader() is not own
    assert reader() is own
    with pytest.raises(KeyError), tolerant_hydra():
        raise KeyError
    assert reader() is own
