"""Modules whose names can be imported; using such a name raises an error that names a replacement.

Scripts import names that they do not always use, for example names of the simulator in signatures
of functions. The import of such a name succeeds; calling the name, or reading an attribute of the
name, raises an `UnavailableError`.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, ClassVar, NoReturn

from isaacgymenvs_lite.errors import UnavailableError


class StandInModule(ModuleType):
    """A module from which every name can be imported; see the module docstring.

    Errors contain `reason`, which says what to use instead.
    """

    # Python treats a module with a path as a package, whose submodules can be imported.
    __path__: ClassVar[list[str]] = []

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(name)
        self.__reason = reason

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _StandIn(name, (), {"_path": f"{self.__name__}.{name}", "_reason": self.__reason})


class _StandIn(type):
    """Metaclass of the imported names, which are classes so that scripts can inherit from them."""

    _path: str
    _reason: str

    def __call__(cls, *args: Any, **kwargs: Any) -> NoReturn:
        raise UnavailableError(f"{cls._path}: {cls._reason}")

    def __getattr__(cls, name: str) -> NoReturn:
        if name.startswith("__"):
            raise AttributeError(name)
        raise UnavailableError(f"{cls._path}.{name}: {cls._reason}")
