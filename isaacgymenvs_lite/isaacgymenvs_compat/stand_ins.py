"""Modules whose names can be imported; using one raises an error that names the replacement.

Scripts import names that they do not use on every run, such as those of launchers of processes;
and names of the simulator are in signatures of functions that are never called. An import of such a
name succeeds; calling it, or reading anything of it, raises an `UnavailableError`.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, ClassVar, NoReturn

from isaacgymenvs_lite.errors import UnavailableError


class StandInModule(ModuleType):
    """A module that has every name; see the module docstring.

    The reason, in errors, says why its names do nothing and what to use instead.
    """

    # What has a path is a package: modules below it are imported in the same way.
    __path__: ClassVar[list[str]] = []

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(name)
        self.__reason = reason

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _StandIn(name, (), {"_path": f"{self.__name__}.{name}", "_reason": self.__reason})


class _StandIn(type):
    """The class of stand-ins: classes, so that a script can inherit from them and annotate."""

    _path: str
    _reason: str

    def __call__(cls, *args: Any, **kwargs: Any) -> NoReturn:
        raise UnavailableError(f"{cls._path}: {cls._reason}")

    def __getattr__(cls, name: str) -> NoReturn:
        if name.startswith("__"):
            raise AttributeError(name)
        raise UnavailableError(f"{cls._path}.{name}: {cls._reason}")
