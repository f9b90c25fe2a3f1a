"""Imports optional packages, or says which extra of this package would install them."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from isaacgymenvs_lite.errors import MissingPackageError

# Maps each module to the extra of this package that installs it.
EXTRAS = {
    "av": "video",
    "mink": "retarget",
    "onnx": "export",
    "onnxruntime": "export",
    "onnxscript": "export",
    "optuna": "sweep",
    "pybullet_data": "motions",
    "pybvh": "retarget",
    "rsl_rl": "rsl-rl",
    "skrl": "skrl",
    "stable_baselines3": "sb3",
    "wandb": "wandb",
}
# Maps a module to the name of its package if the names differ.
_PACKAGE_NAMES = {"av": "av (PyAV)"}


def require(module: str, wanted_by: str, otherwise: str = "") -> None:
    """Check that a package is installed, without importing it.

    Args:
        module: the name under which the package is imported, a key of `EXTRAS`.
        wanted_by: the feature that needs the package, for the message.
        otherwise: an alternative without the package, for the message.

    Raises:
        MissingPackageError: the package is not installed; the message names the extra.
    """
    if importlib.util.find_spec(module) is None:
        package = _PACKAGE_NAMES.get(module, module)
        message = (
            f"{wanted_by} needs the package {package}, which is not installed;"
            f' pip install "isaacgymenvs-lite[{EXTRAS[module]}]"'
        )
        raise MissingPackageError(f"{message} or {otherwise}" if otherwise else message)


def import_package(module: str, wanted_by: str) -> Any:
    """Return a module of an optional package, for example `stable_baselines3.common`.

    Args:
        module: dotted name of the module; the text before the first dot is a key of `EXTRAS`.
        wanted_by: see `require`.

    Raises:
        MissingPackageError: the package is not installed.
    """
    require(module.partition(".")[0], wanted_by)
    return importlib.import_module(module)
