"""Reads YAML text as plain values, with limits: anybody may have written it.

PyYAML's safe loader runs no code, but a small text can take all memory (aliases of aliases), end in
a RecursionError (deep nesting) or hold numbers that no other part of a program can use. Tags are
refused as well: no file here needs one.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import yaml

from isaacgymenvs_lite.errors import ConfigError, one_line

MAX_BYTES = 2**20
"""The longest published configuration file has 12 kB."""
MAX_DEPTH = 64
MAX_VALUES = 20_000
"""Keys, values, lists and mappings; an alias counts as often as it is used."""

_MAX_INT = 2**63 - 1
_MAX_INT_LENGTH = 32
_PREFIX = "tag:yaml.org,2002:"
# Numbers without a point, or without a sign of the exponent, are texts to PyYAML: 2e-5, 1.5e3.
_EXPONENT = re.compile(r"[-+]?[0-9]+(?:_[0-9]+)*(?:\.[0-9_]*)?[eE][-+]?[0-9]+\Z")
_TAGS = {f"{_PREFIX}{name}" for name in ("str", "int", "float", "bool", "null", "map", "seq")}
_TAGS.add(f"{_PREFIX}merge")


@dataclass(frozen=True)
class YamlText:
    """What a text holds.

    Attributes:
        content: plain dictionaries, lists, numbers and texts; None for an empty text.
        repeated: keys that are stated more than once in one mapping, of which the last counts.
    """

    content: Any
    repeated: list[str]


def read_text(path: Path, max_bytes: int = MAX_BYTES) -> str:
    """Return the text of a file.

    Raises:
        ConfigError: it is missing, no ordinary file, too long, or no UTF-8.
    """
    try:
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path} is no file; expected a YAML file")
        with path.open("rb") as file:
            content = file.read(max_bytes + 1)
        if len(content) > max_bytes:
            raise ConfigError(f"{path} is longer than {max_bytes // 1024} kB; no YAML file is")
        return content.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read the configuration file {path}: {error}") from error


def parse_yaml(text: str, where: str, max_values: int = MAX_VALUES) -> YamlText:
    """Return what a YAML text holds; numbers as OmegaConf reads them, 2e-5 among them.

    Args:
        text: one document.
        where: what the text is, for messages.
        max_values: keys and values that it may have.

    Raises:
        ConfigError: it is no YAML, or exceeds a limit.
    """
    try:
        loader = _Loader(text, max_values)
        content = loader.get_single_data()
    except _LimitError as error:
        raise ConfigError(f"{where}: {error}") from None
    except yaml.YAMLError as error:
        raise ConfigError(f"{where} is not valid YAML: {one_line(error)}") from error
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        # PyYAML's constructors take a scalar's text for granted: `!!bool maybe`.
        raise ConfigError(f"{where} is not valid YAML: a value cannot be read ({error})") from error
    return YamlText(content, loader.repeated)


class _LimitError(Exception):
    """A text exceeds a limit."""


class _Loader(yaml.SafeLoader):
    """Reads plain values as OmegaConf does; of equal keys the last one counts."""

    # OmegaConf has no dates: 2026-01-01 is a text.
    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {
        first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def __init__(self, text: str, max_values: int) -> None:
        super().__init__(text)
        self.repeated: list[str] = []
        self._max_values = max_values
        self._depth = self._count = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth += 1
        self._count += 1
        if (
            self._count > self._max_values
        ):  # PyYAML is slow: a long text must not be read to its end
            raise _too_many(self._max_values)
        if self._depth > MAX_DEPTH:
            raise _LimitError(f"nested more than {MAX_DEPTH} levels deep; no settings need that")
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def get_single_node(self) -> Any:
        node = super().get_single_node()
        if node is not None:
            _check_size(node, {}, self._max_values)
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> Any:
        last: dict[Any, Any] = {}
        for index, (key_node, _) in enumerate(node.value):
            if isinstance(key_node, yaml.ScalarNode) and key_node.tag.endswith(":str"):
                if key_node.value in last:
                    self.repeated.append(f"'{key_node.value}'")
                last[key_node.value] = index
            else:
                last[index] = index
        node.value = [node.value[index] for index in sorted(last.values())]
        return super().construct_mapping(node, deep=deep)

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        value = super().construct_yaml_int(node)
        if abs(value) > _MAX_INT:
            raise _LimitError(f"the number {node.value} has more than 64 bits")
        return value


_Loader.add_constructor(f"{_PREFIX}int", _Loader.construct_yaml_int)
_Loader.add_implicit_resolver(f"{_PREFIX}float", _EXPONENT, list("+-0123456789"))


def _check_size(node: yaml.Node, sizes: dict[int, int], max_values: int) -> int:
    """Return how many values a node has, aliases written out; the depth is limited already.

    Args:
        node: what was composed.
        sizes: of the nodes that were counted before, by `id`; 0 while one is being counted.
        max_values: the limit.

    Raises:
        _LimitError: too many, one that contains itself, or a value that cannot be used.
        YAMLError: a tag that names a type.
    """
    known = sizes.get(id(node))
    if known == 0:
        raise _LimitError("an alias is inside of what it is an alias of")
    if known is not None:
        return known
    sizes[id(node)] = 0
    if node.tag not in _TAGS:
        tag = node.tag.replace(_PREFIX, "!!")
        raise yaml.YAMLError(f"the tag {tag} is not allowed; expected plain values")
    children: list[yaml.Node] = []
    if isinstance(node, yaml.ScalarNode):
        _check_scalar(node)
    elif isinstance(node, yaml.MappingNode):
        children = [child for pair in node.value for child in pair]
    else:
        children = list(node.value)
    size = 1
    for child in children:
        size += _check_size(child, sizes, max_values)
        if size > max_values:
            raise _too_many(max_values)
    sizes[id(node)] = size
    return size


def _too_many(max_values: int) -> _LimitError:
    return _LimitError(f"more than {max_values:,} values, aliases included; expected fewer")


def _check_scalar(node: yaml.ScalarNode) -> None:
    if "\0" in node.value:
        raise _LimitError(f"the text {node.value[:40]!r} has a NUL character in it")
    if node.tag == f"{_PREFIX}int" and len(node.value) > _MAX_INT_LENGTH:
        raise _LimitError(f"the number {node.value[:40]}... has more than 64 bits")
