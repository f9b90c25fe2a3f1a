"""Turns a section of a YAML file into a typed, checked, frozen dataclass.

A component declares its settings once:

    @dataclass(frozen=True, kw_only=True)
    class PlaneSettings:
        static_friction: float = setting(1.0, key="staticFriction", minimum=0)
        restitution: float = setting(0.0, minimum=0, maximum=1)

    plane = read_section(PlaneSettings, cfg.task.env.plane, where="task.env.plane")

The values have the declared types. A wrong value raises a one-line `ConfigError` with the key, the
value and what was expected. Field types may be bool, int, float, str, Any, a mapping, another
settings dataclass, `tuple[T, ...]`, `list[T]`, and any of these or None.
"""

from __future__ import annotations

import dataclasses
import difflib
import logging
import math
import reprlib
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING
from typing import TYPE_CHECKING, Any, TypeVar

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from isaacgymenvs_lite.errors import ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_log = logging.getLogger(__name__)

T = TypeVar("T", bound="DataclassInstance")
Field = dataclasses.Field[Any]

# A key is called misspelt if its similarity to a known key (difflib's ratio) is at least this value
# and the lengths are nearly equal. The length distinguishes `disc_weight_decay` from
# `weight_decay`.
_MISSPELT_RATIO = 0.8
_MISSPELT_LENGTH = 3
# A hint about a missing key may name a key with at least this lower similarity.
_SIMILAR_RATIO = 0.6

_GIVEN = reprlib.Repr()  # shortens values in messages
_GIVEN.maxstring = _GIVEN.maxother = 120
LOGGED_KEYS: set[str] = set()
"""Keys without effect that this process has logged; each key is logged once."""


def setting(
    default: Any = MISSING,
    *,
    key: str | None = None,
    minimum: float | None = None,
    maximum: float | None = None,
    above: float | None = None,
    choices: Iterable[Any] | None = None,
    min_length: int = 0,
    length: int | None = None,
    blank: bool = False,
) -> Any:
    """Declare a field of a settings dataclass.

    Args:
        default: value when the key is absent; a setting without default is a required key.
        key: the key in the YAML file if it is not the field's name (`numEnvs` for `num_envs`).
        minimum: smallest allowed number, also for every entry of a list.
        maximum: largest allowed number.
        above: exclusive lower limit.
        choices: the allowed values; text is compared exactly.
        min_length: smallest number of entries of a list.
        length: exact number of entries of a list.
        blank: whether '' counts as None; in cfg/config.yaml '' means "not given".
    """
    metadata = {
        "key": key,
        "minimum": minimum,
        "maximum": maximum,
        "above": above,
        "choices": None if choices is None else tuple(choices),
        "min_length": min_length,
        "length": length,
        "blank": blank,
    }
    if isinstance(default, (list, dict)):
        return dataclasses.field(default_factory=lambda: default.copy(), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def read_section(
    cls: type[T],
    mapping: Mapping[Any, Any] | None,
    where: str,
    ignored: Iterable[str] | None = (),
    *,
    complete: bool = False,
) -> T:
    """Fill the settings dataclass `cls` from `mapping`.

    Values are converted to the declared types: an int to a float, a text such as "2e-5" (which YAML
    1.1 does not read as a number) to a number, a number to text, and OmegaConf containers to plain
    containers. Unknown keys that resemble no known key are only logged, because published files
    have keys that nothing reads.

    Args:
        cls: a dataclass whose fields are the keys; `setting` adds limits and choices.
        mapping: a plain or an OmegaConf mapping; None counts as empty.
        where: path of the section, for messages: "task.env"; "" for the root.
        ignored: keys that other code reads, or that no code is meant to read. None means that other
            code reads all keys that `cls` lacks.
        complete: whether the section has all its keys. An unknown key that resembles any known key
            is then misspelt.

    Raises:
        ConfigError: a value has a wrong type or is out of range, a required key is missing, or an
            unknown key looks misspelt.
    """
    values = as_mapping(mapping, where)
    by_key = {_key(field): field for field in dataclasses.fields(cls)}
    if ignored is not None:
        check_unknown_keys(values, by_key, where, ignored, complete=complete)
    kinds = typing.get_type_hints(cls)
    arguments: dict[str, Any] = {}
    for key, field in by_key.items():
        kind, path = kinds[field.name], _join(where, key)
        if key in values:
            value = plain(values[key])
            try:
                arguments[field.name] = _convert(value, kind, field, path)
            except ConfigError:
                raise
            except (TypeError, ValueError, OverflowError):
                expected = _expectation(kind, field)
                given = _GIVEN.repr(value)
                raise ConfigError(f"{path}: got {given}, expected {expected}") from None
        elif field.default is MISSING and field.default_factory is MISSING:
            hint = f"expected {_expectation(kind, field)}"
            raise missing_key(key, values, by_key, where, hint)
    return cls(**arguments)


def read_keys(cls: type[T], mapping: Mapping[Any, Any] | None, where: str) -> T:
    """Fill the settings dataclass `cls` from a section; other code reads keys that `cls` lacks.

    Raises:
        ConfigError: as in `read_section`.
    """
    return read_section(cls, mapping, where, ignored=None)


def convert_section(
    cls: type[T], section: Any, where: str, ignored: Iterable[str] | None = ()
) -> T:
    """Check a plain section like `read_section` and convert its values in place.

    This function is for sections that other packages read. The names of the fields of `cls` are the
    keys of the section.
    """
    settings = read_section(cls, section, where, ignored)
    for key in keys_of(cls) & set(section or ()):
        section[key] = getattr(settings, key)
    return settings


def keys_of(cls: type[DataclassInstance]) -> frozenset[str]:
    """Return the YAML keys that a settings dataclass reads."""
    return frozenset(_key(field) for field in dataclasses.fields(cls))


def check_unknown_keys(
    values: Mapping[str, Any],
    known: Iterable[str],
    where: str,
    ignored: Iterable[str] = (),
    *,
    complete: bool = False,
) -> None:
    """Refuse unknown keys of `values` that look misspelt, and log all further unknown keys.

    If `complete` is False, an unknown key does not look misspelt when `values` also has the known
    key that it resembles.

    Raises:
        ConfigError: an unknown key looks misspelt.
    """
    expected = {*known, *ignored}
    unread: list[str] = []
    for key in values:
        if key in expected:
            continue
        path, size = _join(where, str(key)), len(_fold(str(key)))
        alike = [other for other in expected if abs(len(_fold(other)) - size) <= _MISSPELT_LENGTH]
        near = nearest(str(key), sorted(alike), _MISSPELT_RATIO)
        if near is not None and (complete or near not in values):
            raise ConfigError(
                f"unknown key '{path}' (did you mean '{near}'?); correct or remove it"
            )
        if path not in LOGGED_KEYS:
            unread.append(path)
    if unread:
        LOGGED_KEYS.update(unread)
        _log.warning("nothing reads %s", ", ".join(unread))


def missing_key(
    key: str, values: Mapping[str, Any], known: Iterable[str], where: str, hint: str
) -> ConfigError:
    """Return the error for a missing required key; the error names a similar unknown key."""
    known = set(known)
    near = nearest(key, [str(other) for other in values if other not in known], _SIMILAR_RATIO)
    instead = f" (is '{near}' misspelt?)" if near is not None else ""
    return ConfigError(f"the key '{_join(where, key)}' is missing{instead}; {hint}")


def nearest(given: str, choices: Iterable[str], ratio: float) -> str | None:
    """Return the most similar of `choices`, ignoring case and underscores, or None."""
    folded = {_fold(choice): choice for choice in choices}
    near = difflib.get_close_matches(_fold(given), list(folded), n=1, cutoff=ratio)
    return folded[near[0]] if near else None


def select(tree: Any, path: str) -> Any:
    """Return the value at `path` in nested dictionaries, or None if there is no value."""
    for key in path.split("."):
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the path and the value of each leaf in nested mappings; an empty mapping is a leaf.

    Args:
        tree: the mappings.
        path: path of `tree`, with which all yielded paths begin.
    """
    if isinstance(tree, Mapping) and (tree or not path):
        for key, value in tree.items():
            yield from leaves(value, f"{path}.{key}" if path else str(key))
    else:
        yield path, tree


def plain(value: Any) -> Any:
    """Convert OmegaConf containers in `value` to dicts and lists with resolved interpolations.

    Raises:
        ConfigError: an interpolation leads nowhere.
    """
    if not isinstance(value, (DictConfig, ListConfig)):
        return value
    try:
        return OmegaConf.to_container(value, resolve=True)
    except OmegaConfBaseException as error:
        where = getattr(error, "full_key", None) or "the configuration"
        raise ConfigError(f"{where}: {str(error).splitlines()[0]}") from error


def as_mapping(section: Any, where: str) -> dict[str, Any]:
    """Return a section as a plain dictionary; None becomes an empty dictionary.

    Raises:
        ConfigError: the section is a list or a value.
    """
    values = plain(section)
    if not isinstance(values, Mapping | None):
        given = _GIVEN.repr(values)
        raise ConfigError(f"{where}: got {given}, expected a mapping of keys to values")
    return dict(values or {})


def _key(field: Field) -> str:
    return field.metadata.get("key") or field.name


def _join(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key


def _fold(key: str) -> str:
    return key.replace("_", "").lower()


# --- one value -----------------------------------------------------------------------------------


def _convert(value: Any, kind: Any, field: Field, path: str) -> Any:
    """Return a plain value converted to the type `kind`; check the limits of `field`.

    Raises:
        ValueError: the value has a wrong type or is out of range.
        ConfigError: an entry of the value is wrong; the message names the entry's path.
    """
    limits = field.metadata
    optional, kind = _split_optional(kind)
    if value is None or (value == "" and limits.get("blank")):
        if optional:
            return None
        raise ValueError
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        if not isinstance(value, Mapping):
            raise ValueError
        return read_section(kind, value, path)
    origin = typing.get_origin(kind) or kind
    if origin in (tuple, list):
        if isinstance(value, str) or not isinstance(value, Sequence):
            raise ValueError
        exact = limits.get("length")
        if len(value) < limits.get("min_length", 0) or exact not in (None, len(value)):
            raise ValueError
        entry = (typing.get_args(kind) or (Any,))[0]
        return origin(_convert(each, entry, field, f"{path}[{i}]") for i, each in enumerate(value))
    if origin in (dict, Mapping):
        if not isinstance(value, Mapping):
            raise ValueError
        return dict(value)
    result = _convert_scalar(value, kind)
    choices = limits.get("choices")
    if choices is not None and result not in choices:
        raise ValueError
    if isinstance(result, (int, float)) and not isinstance(result, bool):
        least, most, above = (limits.get(name) for name in ("minimum", "maximum", "above"))
        if (
            (least is not None and result < least)
            or (most is not None and result > most)
            or (above is not None and result <= above)
        ):
            raise ValueError
    return result


def _convert_scalar(value: Any, kind: Any) -> Any:
    if kind is Any or (kind is bool and isinstance(value, bool)):
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError
    if kind is str:
        return str(value)  # YAML reads the name 2026 as a number
    if kind is int and isinstance(value, int):
        return value
    if kind not in (int, float):
        raise ValueError
    number = float(value)
    if math.isnan(number) or (kind is int and not number.is_integer()):
        raise ValueError
    return kind(number)


def _split_optional(kind: Any) -> tuple[bool, Any]:
    """Split the type `X | None` into (True, X); return (False, kind) for any other type."""
    if typing.get_origin(kind) not in (typing.Union, types.UnionType):
        return kind is Any, kind
    (member,) = (member for member in typing.get_args(kind) if member is not types.NoneType)
    return True, member


_NOUNS = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "text",
    Any: "a value",
}
_PLURALS = {bool: "True or False", int: "whole numbers", float: "numbers", str: "names"}
_LIMITS = {"minimum": "of at least", "above": "above", "maximum": "of at most"}


def _expectation(kind: Any, field: Field) -> str:
    """Describe the values that a field accepts."""
    optional, kind = _split_optional(kind)
    limits = field.metadata
    choices = limits.get("choices")
    listed = ", ".join(str(choice) or "''" for choice in choices or ())
    if (typing.get_origin(kind) or kind) in (tuple, list):
        entry = (typing.get_args(kind) or (Any,))[0]
        noun = (
            f"a list out of {listed}" if choices else f"a list of {_PLURALS.get(entry, 'values')}"
        )
        if exact := limits.get("length"):
            noun += f" with {exact} entries"
        elif least := limits.get("min_length"):
            noun += f" with at least {least} entries"
    else:
        noun = f"one of {listed}" if choices else _NOUNS.get(kind, "a mapping of keys to values")
    given = [
        f"{word} {limits[name]}" for name, word in _LIMITS.items() if limits.get(name) is not None
    ]
    if given:
        noun += f" {' and '.join(given)}"
    if limits.get("blank"):
        return f"{noun}, or ''"
    return f"{noun}, or null" if optional and kind is not Any else noun
