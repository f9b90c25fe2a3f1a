"""Checks how large a configuration becomes when resolved, without resolving it.

`a: ${b}${b}`, `b: ${c}${c}`, ...: thirty lines of that kind take more memory than there is.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from isaacgymenvs_lite.config.hydra_bridge import parse_interpolations
from isaacgymenvs_lite.errors import ConfigError

MAX_VALUES = 1_000_000
_KEY = re.compile(r"\[([^\]]*)\]|([^.\[\]]+)")


def check_expansion(cfg: DictConfig | ListConfig) -> None:
    """Check that resolving a tree ends, and takes a reasonable amount of memory.

    Raises:
        ConfigError: an interpolation leads back to itself, or too much is repeated.
    """
    try:
        _Expansion(OmegaConf.to_container(cfg, resolve=False)).size(())
    except RecursionError:
        raise ConfigError("interpolations lead through too many others; write values out") from None


class _Expansion:
    """Sizes of the values of a tree, interpolations resolved; each is worked out once."""

    def __init__(self, tree: Any) -> None:
        self._tree = tree
        self._sizes: dict[tuple[str, ...], int] = {}

    def size(self, path: tuple[str, ...]) -> int:
        """Return the number of values below a path, or of the parts that a text is made of."""
        known = self._sizes.get(path)
        where = ".".join(path)
        if known == 0:
            raise ConfigError(f"{where}: the interpolation leads back to itself; correct its path")
        if known is not None:
            return known
        self._sizes[path] = 0
        value = _select(self._tree, path)
        size = 1
        for target in self._parts(path, value):
            size += self.size(target)
            if size > MAX_VALUES:
                raise ConfigError(
                    f"{where}: interpolations repeat more than {MAX_VALUES:,} values; write fewer"
                )
        self._sizes[path] = size
        return size

    def _parts(self, path: tuple[str, ...], value: Any) -> Iterator[tuple[str, ...]]:
        if isinstance(value, dict):
            yield from ((*path, str(key)) for key in value)
        elif isinstance(value, list):
            yield from ((*path, str(index)) for index in range(len(value)))
        elif isinstance(value, str) and "${" in value:
            for target in _targets(value, path):
                yield self._existing(target)

    def _existing(self, path: tuple[str, ...]) -> tuple[str, ...]:
        """Return the longest part of a path that there is: what follows is in an interpolation."""
        while path and _select(self._tree, path) is _ABSENT:
            path = path[:-1]
            if isinstance(_select(self._tree, path), dict | list):
                return _NOWHERE  # a key that does not exist: resolving says so
        return path


_ABSENT = object()
_NOWHERE = ("\0",)


def _select(tree: Any, path: tuple[str, ...]) -> Any:
    for key in path:
        if isinstance(tree, dict):
            named = {str(name): name for name in tree} if key not in tree else {key: key}
            tree = tree[named[key]] if key in named else _ABSENT
        elif isinstance(tree, list) and key.isdecimal() and int(key) < len(tree):
            tree = tree[int(key)]
        else:
            return _ABSENT
    return tree


def _targets(text: str, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield the paths that the interpolations in the text at `path` lead to."""
    for written in parse_interpolations(text).paths:
        dots = len(written) - len(written.lstrip("."))
        keys = tuple(bracket or name for bracket, name in _KEY.findall(written[dots:]))
        yield (*(path[: max(len(path) - dots, 0)] if dots else ()), *keys)
