"""Runs an unchanged script that imports isaacgymenvs.

    isaacgymenvs-lite alias SCRIPT [its arguments]

In this process the imports of `isaacgymenvs` and its modules load this package; no package
`isaacgymenvs` is installed. `gym` means gymnasium if gym is not installed. Names of `isaacgym` can
be imported, and `isaacgym.torch_utils` works; any other use of `isaacgym` raises an error that
names the replacement. A script that names a GPU runs on the CPU if the machine has no GPU.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import logging
import runpy
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType
from typing import Any

from isaacgymenvs_lite.config.launch import allow_cpu_fallback
from isaacgymenvs_lite.config.resolvers import register_for
from isaacgymenvs_lite.errors import EXIT_USER_ERROR
from isaacgymenvs_lite.isaacgymenvs_compat.module_names import (
    RENAMED,
    absent_because,
    stand_in_because,
)
from isaacgymenvs_lite.isaacgymenvs_compat.stand_ins import StandInModule
from isaacgymenvs_lite.train import message_handler

_OLD, _NEW = "isaacgymenvs", "isaacgymenvs_lite"
_SIMULATOR = "isaacgym"
_NO_SIMULATOR = (
    "Isaac Gym's tensor API does not exist here; docs/migration.md lists the replacement of each"
    " call"
)
_GYM = "gym"
# Maps modules of other packages to our modules that replace them.
_OTHERS = {
    f"{_SIMULATOR}.torch_utils": f"{_NEW}.isaacgymenvs_compat.torch_jit_utils",
    _GYM: f"{_NEW}.isaacgymenvs_compat.gym",
    f"{_GYM}.wrappers": f"{_NEW}.isaacgymenvs_compat.gym_wrappers",
    "rl_games.torch_runner": f"{_NEW}.isaacgymenvs_compat.runner",
}


class AliasFinder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds the module of this package that replaces a module `isaacgymenvs...`."""

    def find_spec(
        self, fullname: str, path: Any = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return a spec if the name means one of our modules, otherwise None."""
        root = fullname.partition(".")[0]
        if root not in (_OLD, _SIMULATOR, _GYM) and fullname not in _OTHERS:
            return None
        if root == "rl_games" and _OTHERS[fullname] in sys.modules:
            return None  # Our module imports the module that it replaces.
        if root == _GYM and importlib.machinery.PathFinder.find_spec(_GYM) is not None:
            return None
        return importlib.machinery.ModuleSpec(fullname, self, is_package=True)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        """Return the module that the name means."""
        root, _, rest = spec.name.partition(".")
        if spec.name in _OTHERS:
            name = _OTHERS[spec.name]
        elif root == _SIMULATOR:
            return StandInModule(spec.name, _NO_SIMULATOR)
        elif root == _GYM:
            name = f"gymnasium.{rest}"
        elif (reason := stand_in_because(rest)) is not None:
            return StandInModule(spec.name, reason)
        else:
            name = ".".join(part for part in (_NEW, RENAMED.get(rest, rest)) if part)
        module = _import(name, spec.name, absent_because(rest))
        if spec.name == f"{_OLD}.utils.rlgames_utils":  # Scripts import this, then register names.
            from isaacgymenvs_lite.registration import register_networks

            register_networks()
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Restore the spec of a module that has already been executed."""
        alias = module.__spec__
        if alias is not None and alias.loader_state is not None:
            module.__spec__ = alias.loader_state


def _import(name: str, alias: str, reason: str | None) -> ModuleType:
    """Return the module `name`; the error for a missing module contains `reason`."""
    if reason is None:
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name != name:
                raise
            reason = f"{_NEW} has no module of this name"
    raise ModuleNotFoundError(
        f"{alias}: {reason}; docs/migration.md lists the replacements of IsaacGymEnvs' modules",
        name=alias,
    ) from None


def install() -> None:
    """Make IsaacGymEnvs' names importable in this process; a second call does nothing."""
    if not any(isinstance(finder, AliasFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, AliasFinder())


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the script that the command line names."""
    parser = argparse.ArgumentParser(
        prog="isaacgymenvs-lite alias", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("script", type=Path, help="a Python file that imports isaacgymenvs")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="the script's own")
    args = parser.parse_args(arguments)
    if not args.script.is_file():
        parser.exit(EXIT_USER_ERROR, f"error: {args.script}: no such file; give a Python script\n")
    install()
    sys.argv = [str(args.script), *args.arguments]
    # Python adds the script's folder to the import path when it runs a script.
    sys.path.insert(0, str(args.script.resolve().parent))
    # If the script does not configure logging, the log of this package is printed.
    logging.getLogger(_NEW).setLevel(logging.INFO)
    logging.lastResort = message_handler()
    register_for(args.script.read_text(encoding="utf-8"))
    import torch  # This import takes seconds.

    from isaacgymenvs_lite.isaacgymenvs_compat.cuda import CudaIsCpu

    devices = nullcontext()
    if not torch.cuda.is_available():
        allow_cpu_fallback()
        devices = CudaIsCpu()
    with devices:
        runpy.run_path(str(args.script), run_name="__main__")


if __name__ == "__main__":
    main()
