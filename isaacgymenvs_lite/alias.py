"""Runs a script that says `import isaacgymenvs`, unchanged.

    python -m isaacgymenvs_lite.alias SCRIPT [its arguments]

For this one process, `isaacgymenvs` and everything below it mean this package; nothing is
installed under that name. Scripts import `isaacgym` before torch, because Isaac Gym wanted that:
here it is an empty module, whose first use says what to do instead; `isaacgym.torch_utils` is not.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import runpy
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

_OLD, _NEW = "isaacgymenvs", "isaacgymenvs_lite"
_SIMULATOR = "isaacgym"
# Modules that are called otherwise here.
_RENAMED = {
    f"utils.{name}": f"published.{name}"
    for name in ("torch_jit_utils", "rlgames_utils", "reformat", "utils")
}
# The one module of the simulator's package that needs no simulator.
_ROTATIONS = f"{_SIMULATOR}.torch_utils", "utils.torch_jit_utils"
EXIT_USER_ERROR = 2


class AliasFinder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds `isaacgymenvs...` as the module of this package that stands for it."""

    def find_spec(
        self, fullname: str, path: Any = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a spec for names of the old package and of the simulator."""
        del path, target
        if fullname.partition(".")[0] not in (_OLD, _SIMULATOR):
            return None
        return importlib.machinery.ModuleSpec(fullname, self, is_package=True)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        """Return the module that the name stands for."""
        root, _, rest = spec.name.partition(".")
        if spec.name == _ROTATIONS[0]:
            root, rest = _OLD, _ROTATIONS[1]
        if root == _SIMULATOR:
            return _NoSimulator(spec.name)
        name = ".".join(part for part in (_NEW, _RENAMED.get(rest, rest)) if part)
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name != name:
                raise
            raise ModuleNotFoundError(
                f"{spec.name}: {_NEW} has no module {name}; docs/migration.md names what"
                " IsaacGymEnvs' modules became",
                name=spec.name,
            ) from None
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Give the module, which has been executed under its own name, its own spec back."""
        alias = module.__spec__
        if alias is not None and alias.loader_state is not None:
            module.__spec__ = alias.loader_state


class _NoSimulator(ModuleType):
    """Stands for Isaac Gym, as far as to be imported."""

    __path__: ClassVar[list[str]] = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise AttributeError(
            f"{self.__name__}.{name}: Isaac Gym's tensor API does not exist here; docs/migration.md"
            " says call by call what to use instead"
        )


def install() -> None:
    """Make the old names importable in this process; a second call does nothing."""
    if not any(isinstance(finder, AliasFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, AliasFinder())


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the script that the command line names."""
    parser = argparse.ArgumentParser(
        prog="python -m isaacgymenvs_lite.alias",
        description=(__doc__ or "").partition("\n")[0],
    )
    parser.add_argument("script", type=Path, help="a Python file that imports isaacgymenvs")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="the script's own")
    args = parser.parse_args(arguments)
    if not args.script.is_file():
        parser.exit(EXIT_USER_ERROR, f"error: {args.script}: no such file; give a Python script\n")
    install()
    sys.argv = [str(args.script), *args.arguments]
    # As python does for a script: its neighbours can be imported.
    sys.path.insert(0, str(args.script.resolve().parent))
    runpy.run_path(str(args.script), run_name="__main__")


if __name__ == "__main__":
    main()
