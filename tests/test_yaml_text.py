"""YAML text from anybody: limits of size, depth, sharing and values."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from isaacgymenvs_lite import yaml_text
from isaacgymenvs_lite.errors import ConfigError, MotionFileError
from isaacgymenvs_lite.motion.dataset import read_dataset
from isaacgymenvs_lite.motion.retargeting.mapping import load_mapping
from isaacgymenvs_lite.yaml_text import parse_yaml, read_text


def laughs(levels: int, of: str = "[{}, {}, {}, {}, {}]") -> str:
    """Return lists of lists: 5 ** levels values in a few hundred characters."""
    lines = ["a0: &a0 x"]
    for i in range(1, levels):
        aliases = of.format(*[f"*a{i - 1}"] * 5)
        lines.append(f"a{i}: &a{i} {aliases}")
    return "\n".join(lines) + "\n"


MERGES = "a0: &a0 {x: 1}\n" + "".join(
    f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 8)}]}}\n" for i in range(1, 12)
)
HOSTILE = {
    "aliases of aliases": (laughs(12), "more than 20,000 values, aliases included"),
    "aliases in mappings": (laughs(12, "{{a: {}, b: {}, c: {}, d: {}}}"), "more than 20,000"),
    "merged mappings": (MERGES, "more than 20,000 values"),
    "an alias of itself": ("a: &a [*a]\n", "inside of what it is an alias of"),
    "a merge of itself": ("a: &a {<<: *a}\n", "inside of what it is an alias of"),
    "deep lists": ("[" * 5000, "nested more than 64 levels deep"),
    "deep mappings": ("{a: " * 5000, "nested more than 64 levels deep"),
    "deep blocks": ("".join(" " * i + "-\n" for i in range(500)), "nested more than 64"),
    "deep keys": ("? " * 3000, "nested more than 64 levels deep"),
    "many values": ("- a\n" * 20_001, "more than 20,000 values"),
    "a long number": ("a: " + "9" * 5000, "has more than 64 bits"),
    "a large number": ("a: 9223372036854775808", "has more than 64 bits"),
    "a hexadecimal number": ("a: 0x" + "f" * 100_000, "has more than 64 bits"),
    "a number of minutes": ("a: 1" + ":59" * 5000, "has more than 64 bits"),
    "a NUL": ('a: "runs\\0x"', "NUL character"),
    "a call": ("a: !!python/object/apply:os.system [touch x]", r"tag .*apply:os\.system"),
    "a path": ("a: !!python/object/apply:pathlib.Path [x]", r"tag .*apply:pathlib\.Path"),
    "a name": ("a: !!python/name:os.system", "tag .*python/name"),
    "a tag of YAML": ("a: !!set {x}", "the tag !!set is not allowed"),
    "bytes": ("a: !!binary aGVsbG8=", "the tag !!binary is not allowed"),
    "a tag of somebody": ("a: !Ref x", "the tag !Ref is not allowed"),
    "no truth value": ("a: !!bool maybe", "a value cannot be read"),
    "no number": ("a: !!int x", "a value cannot be read"),
    "two documents": ("a: 1\n---\nb: 2\n", "is not valid YAML"),
    "no alias": ("a: *b", "is not valid YAML"),
    "an unhashable key": ("? [a]\n: b\n", "is not valid YAML"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_texts_are_one_line(kind: str) -> None:
    text, said = HOSTILE[kind]
    with pytest.raises(ConfigError, match=said) as refused:
        parse_yaml(text, "file.yaml")
    assert str(refused.value).startswith("file.yaml")
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 400


def test_what_files_of_this_family_hold_is_read() -> None:
    text = (
        "base: &base {a: 1, b: [1, 2]}\nother:\n  <<: *base\n  a: -2e-5\nsame: *base\n"
        "n: 9223372036854775807\nt: !!str 5\nd: 2026-01-01\nx: ~\ny: yes\ni: .inf\n"
    )
    read = parse_yaml(text, "file.yaml")
    assert read.content["other"] == {"a": -2e-5, "b": [1, 2]}
    assert read.content["same"] == {"a": 1, "b": [1, 2]}
    assert [read.content[key] for key in "ntdxyi"] == [
        *(2**63 - 1, "5", "2026-01-01", None, True, float("inf")),
    ]
    assert read.repeated == []


def test_an_empty_text_holds_nothing() -> None:
    assert parse_yaml("# nothing\n", "file.yaml").content is None


def test_files_are_read_up_to_a_length(tmp_path: Path) -> None:
    file = tmp_path / "long.yaml"
    file.write_text("#" * (yaml_text.MAX_BYTES + 1))
    with pytest.raises(ConfigError, match="is longer than 1024 kB"):
        read_text(file)
    file.write_text("#" * yaml_text.MAX_BYTES)
    assert len(read_text(file)) == yaml_text.MAX_BYTES


def test_only_ordinary_files_are_opened(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.yaml"
    os.mkfifo(pipe)  # opening it would wait for a writer
    for path in (pipe, tmp_path, Path("/dev/zero")):
        with pytest.raises(ConfigError, match="is no file"):
            read_text(path)


# --- the other doors -----------------------------------------------------------------------------


def test_data_sets_and_mappings_are_read_with_limits(tmp_path: Path) -> None:
    file = tmp_path / "file.yaml"
    for text in (laughs(14), "[" * 5000, "a: !!python/name:os.system", "a: " + "9" * 5000):
        file.write_text(text)
        with pytest.raises(MotionFileError, match=re.escape(str(file))):
            read_dataset(file)
        with pytest.raises(ConfigError, match=re.escape(str(file))):
            load_mapping(file)


def test_a_long_data_set_is_still_read(tmp_path: Path) -> None:
    file = tmp_path / "set.yaml"
    file.write_text("motions:\n" + "- {file: a.npz, weight: 1}\n" * 1000)
    assert len(read_dataset(file)) == 1000


@pytest.mark.parametrize(
    "value",
    [
        *("2e-5", "5e3", "1.e3", "-.5e-3", ".5e3", "1_0e3", "+1e+5", "1e", "e5", "1.5e3", "1e5.5"),
        *("12:30:45", "12:30.5", "0x1F", "0o17", "017", "0b11", "1_000.5", "1._5e3", "~"),
        *(".inf", "-.INF", ".nan", "2026-01-01", "2026-01-01 10:00:00", "on", "No", "null", "None"),
    ],
)
def test_values_are_what_omegaconf_reads(value):
    text = f"key: {value}"
    assert repr(parse_yaml(text, "a text").content) == repr(dict(OmegaConf.create(text)))
