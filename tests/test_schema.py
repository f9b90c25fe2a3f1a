from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import FrozenInstanceError, dataclass
from typing import Any

import pytest
from omegaconf import OmegaConf

from isaacgymenvs_lite import schema
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.schema import check_unknown_keys, keys_of, read_section, setting


@pytest.fixture(autouse=True)
def _no_key_logged():
    """The log names an unread key once in a process; here each test is a process of its own."""
    schema.LOGGED_KEYS.clear()


@dataclass(frozen=True, kw_only=True)
class Inner:
    mass: float = setting(1.0, above=0)


@dataclass(frozen=True, kw_only=True)
class Example:
    steps: int = setting(minimum=1)
    rate: float = setting(0.5, minimum=0, maximum=1)
    flag: bool = setting(False)
    name: str = setting("x")
    mode: str = setting("a", choices=("a", "b"))
    units: tuple[int, ...] = setting((8,), minimum=1, min_length=1)
    up: tuple[float, ...] = setting((0.0, 0.0, 1.0), length=3)
    names: list[str] = setting([])
    limit: int | None = setting(None, minimum=1, blank=True)
    extra: Mapping[str, Any] = setting({})
    anything: Any = setting(None)
    inner: Inner = setting(Inner())
    camel: int = setting(3, key="camelCase")


def read(**values: Any) -> Example:
    return read_section(Example, {"steps": 4, **values}, where="here")


def test_defaults_and_required():
    assert read() == Example(steps=4)
    with pytest.raises(ConfigError, match=r"'here\.steps' is missing; expected a whole number of"):
        read_section(Example, {}, where="here")
    with pytest.raises(ConfigError, match=r"'here\.steps' is missing"):
        read_section(Example, None, where="here")


def test_result_is_frozen_and_defaults_are_not_shared():
    with pytest.raises(FrozenInstanceError):
        read().steps = 5  # type: ignore[misc]
    read().names.append("changed")
    assert read().names == []


def test_values_become_the_declared_type():
    for key, value, expected in [
        ("rate", 1, 1.0),
        ("rate", "2e-5", 2e-5),
        ("steps", 64.0, 64),
        ("steps", 2**53 + 1, 2**53 + 1),
        ("name", 2026, "2026"),
        ("units", [1024, 512.0], (1024, 512)),
        ("names", ["a", "b"], ["a", "b"]),
        ("limit", "", None),
        ("extra", {"a": 1}, {"a": 1}),
        ("anything", [1, {"b": 2}], [1, {"b": 2}]),
        ("inner", {"mass": 2}, Inner(mass=2.0)),
    ]:
        result = getattr(read(**{key: value}), key)
        assert result == expected
        assert type(result) is type(expected)


def test_omegaconf_containers_become_plain():
    tree = OmegaConf.create(
        {"n": 5, "s": {"steps": "${n}", "units": [1, "${n}"], "extra": {"a": 1}}}
    )
    result = read_section(Example, tree.s, where="s")
    assert (result.steps, result.units) == (5, (1, 5))
    assert type(result.extra) is dict


def test_dangling_interpolation_names_its_place():
    tree = OmegaConf.create({"s": {"steps": "${nowhere}"}})
    with pytest.raises(ConfigError, match=r"^s\.steps: .*nowhere"):
        read_section(Example, tree.s, where="s")


def test_wrong_values_are_named_with_what_was_expected():
    for key, value, message in [
        ("steps", 0, r"here\.steps: got 0, expected a whole number of at least 1"),
        ("steps", True, "got True, expected a whole number"),
        ("steps", "many", "got 'many', expected a whole number"),
        ("rate", 1.01, r"expected a number of at least 0 and of at most 1"),
        ("rate", float("nan"), "got nan, expected a number"),
        ("rate", 10**400, "expected a number"),
        ("flag", "False", "got 'False', expected True or False"),
        ("name", True, "got True, expected text"),
        ("mode", "c", "got 'c', expected one of a, b"),
        ("units", [4, 0], r"got \[4, 0\], expected a list of whole numbers.* of at least 1"),
        ("units", [], "with at least 1 entries"),
        ("up", [0, 1], "a list of numbers with 3 entries"),
        ("names", "ab", "got 'ab', expected a list of names"),
        ("limit", 0, "expected a whole number of at least 1, or ''"),
        ("inner", {"mass": 0}, r"here\.inner\.mass: got 0, expected a number above 0"),
    ]:
        with pytest.raises(ConfigError, match=message) as error:
            read(**{key: value})
        assert "\n" not in str(error.value)


def test_key_is_the_name_in_the_file():
    assert read(camelCase=7).camel == 7
    assert "camelCase" in keys_of(Example)
    assert "camel" not in keys_of(Example)
    with pytest.raises(ConfigError, match=r"here\.camelCase: got 'x'"):
        read(camelCase="x")


def test_misspelt_keys_are_refused():
    for misspelt in ["stpes", "step", "Steps", "st_eps"]:
        with pytest.raises(ConfigError, match=rf"'here\.{misspelt}' \(did you mean 'steps'\?\)"):
            read_section(Example, {misspelt: 4}, where="here")


def test_keys_that_nothing_reads_are_named_once(caplog):
    with caplog.at_level(logging.WARNING):
        read(unheard_of=1, strange=2)
        read(unheard_of=1)
    assert [record.message for record in caplog.records] == [
        "nothing reads here.unheard_of, here.strange"
    ]


def test_near_miss_beside_its_correct_form_is_another_key(caplog):
    # Published files have lr_threshold beside kl_threshold: alike, and both meant.
    values = {"lr_threshold": 1, "kl_threshold": 0.008}
    check_unknown_keys(values, ["kl_threshold"], "c")
    assert "nothing reads c.lr_threshold" in caplog.text
    with pytest.raises(ConfigError, match="did you mean 'kl_threshold'"):
        check_unknown_keys(values, ["kl_threshold"], "c", complete=True)
