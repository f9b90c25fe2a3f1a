"""One value of a YAML file as the declared type of a setting, or an error that says what was meant.

The inner part of `isaacgymenvs_lite.schema`.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from isaacgymenvs_lite.errors import ConfigError

Field = dataclasses.Field[Any]
# Fills a nested settings dataclass: class, mapping, path.
ReadNested = Callable[[Any, Mapping[Any, Any], str], Any]

# Whole numbers up to here are exact as floats, too; nothing here counts further.
_MAX_WHOLE = 2**53


def read_value(value: Any, kind: Any, field: Field, path: str, read_nested: ReadNested) -> Any:
    """Return the plain `value` as the type `kind`, within the limits of `field`.

    Raises:
        ConfigError: it cannot be; the message names `path`, the value and what was expected.
    """
    try:
        return _convert(value, kind, field, path, read_nested)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(error, ConfigError):
            raise
        expected = expectation(kind, field)
        if isinstance(error, OverflowError):
            expected += f" and of at most {_MAX_WHOLE}"
        raise ConfigError(f"{path}: got {value!r}, expected {expected}") from None


def _convert(value: Any, kind: Any, field: Field, path: str, read_nested: ReadNested) -> Any:
    """Return `value` as `kind`; a ValueError means "not what was expected"."""
    optional, kind = _split_optional(kind)
    if value is None or (value == "" and field.metadata.get("blank")):
        if optional:
            return None
        raise ValueError
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        if not isinstance(value, Mapping):
            raise ValueError
        return read_nested(kind, value, path)
    origin = typing.get_origin(kind) or kind
    if origin in (tuple, list):
        return origin(_convert_entries(value, kind, field, path, read_nested))
    if origin in (dict, Mapping):
        if not isinstance(value, Mapping):
            raise ValueError
        return dict(value)
    result = _convert_scalar(value, kind)
    _check_limits(result, field)
    return result


def _convert_entries(
    value: Any, kind: Any, field: Field, path: str, read_nested: ReadNested
) -> Iterable[Any]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise ValueError
    if len(value) < field.metadata.get("min_length", 0):
        raise ValueError
    entry_kind = (typing.get_args(kind) or (Any,))[0]
    return [
        _convert(entry, entry_kind, field, f"{path}[{index}]", read_nested)
        for index, entry in enumerate(value)
    ]


def _convert_scalar(value: Any, kind: Any) -> Any:
    if kind is Any:
        return value
    if kind is bool:
        if not isinstance(value, bool):
            raise ValueError
        return value
    if kind is str and not isinstance(value, bool):
        if not isinstance(value, (str, int, float)):
            raise ValueError
        return str(value)  # YAML takes a name such as 2026 for a number
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError
    number = float(value)
    if math.isnan(number):
        raise ValueError
    if kind is float:
        return number
    if kind is int:
        if abs(number) > _MAX_WHOLE:
            raise OverflowError
        if isinstance(value, int):
            return value  # float() would round whole numbers beyond 2^53
        if not number.is_integer():
            raise ValueError
        return int(number)
    raise NotImplementedError(f"settings of type {kind} are not supported")


def _check_limits(value: Any, field: Field) -> None:
    limits = field.metadata
    choices = limits.get("choices")
    if choices is not None and value not in choices:
        raise ValueError
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return
    if (
        (limits.get("minimum") is not None and value < limits["minimum"])
        or (limits.get("maximum") is not None and value > limits["maximum"])
        or (limits.get("above") is not None and value <= limits["above"])
        or (limits.get("below") is not None and value >= limits["below"])
    ):
        raise ValueError


def _split_optional(kind: Any) -> tuple[bool, Any]:
    """Split `X | None` into (True, X); any other kind is (False, kind)."""
    if typing.get_origin(kind) not in (typing.Union, types.UnionType):
        return kind is Any, kind
    members = [member for member in typing.get_args(kind) if member is not type(None)]
    if len(members) != 1:
        raise NotImplementedError(f"settings of type {kind} are not supported")
    return True, members[0]


_NOUNS = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "text",
    Any: "a value",
}
_PLURALS = {bool: "True or False", int: "whole numbers", float: "numbers", str: "names"}


def expectation(kind: Any, field: Field) -> str:
    """Describe in words what a field takes."""
    optional, kind = _split_optional(kind)
    origin = typing.get_origin(kind) or kind
    choices = field.metadata.get("choices")
    if origin in (tuple, list):
        entry = (typing.get_args(kind) or (Any,))[0]
        noun = f"a list of {_PLURALS.get(entry, 'values')}"
        if choices is not None:
            noun = f"a list out of {', '.join(_word(choice) for choice in choices)}"
        if field.metadata.get("min_length"):
            noun += f" with at least {field.metadata['min_length']} entries"
    elif choices is not None:
        noun = f"one of {', '.join(_word(choice) for choice in choices)}"
    else:
        noun = _NOUNS.get(kind, "a mapping of keys to values")
    noun += _limits_in_words(field)
    if field.metadata.get("blank"):
        return f"{noun}, or ''"
    return f"{noun}, or null" if optional and kind is not Any else noun


def _limits_in_words(field: Field) -> str:
    limits = field.metadata
    words = [
        f"{word} {limits[name]}"
        for name, word in (
            ("minimum", "of at least"),
            ("above", "above"),
            ("maximum", "of at most"),
            ("below", "below"),
        )
        if limits.get(name) is not None
    ]
    return " " + " and ".join(words) if words else ""


def _word(choice: Any) -> str:
    """Return a choice as one types it; nothing at all needs its quotes."""
    return str(choice) or "''"
