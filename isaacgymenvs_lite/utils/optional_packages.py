"""Optional packages, which an extra installs, and the error for a missing one."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from isaacgymenvs_lite.errors import MissingPackageError

# Module -> extra of this package that installs it.
EXTRAS = {
    "PIL": "video",
    "av": "video",
    "matplotlib": "report",
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
# Module -> name of the package, where they differ.
_PACKAGE_NAMES = {"PIL": "Pillow", "av": "av (PyAV)"}


def require(module: str, wanted_by: str, otherwise: str = "") -> None:
    """Check that a package is installed, without importing it.

    Args:
        module: name that it is imported by, of `EXTRAS`.
        wanted_by: what needs it, for the message.
        otherwise: what to do without it, for the message.

    Raises:
        MissingPackageError: it is not installed; the message names the extra.
    """
    if importlib.util.find_spec(module) is None:
        package = _PACKAGE_NAMES.get(module, module)
        message = (
            f"{wanted_by} needs the package {package}, which is not installed;"
            f' pip install "isaacgymenvs-lite[{EXTRAS[module]}]"'
        )
        raise MissingPackageError(f"{message} or {otherwise}" if otherwise else message)


def import_package(module: str, wanted_by: str) -> Any:
    """Return a module of an optional package, such as `PIL.Image`.

    Args:
        module: its dotted name; the first part is one of `EXTRAS`.
        wanted_by: see `require`.

    Raises:
        MissingPackageError: the package is not installed.
    """
    require(module.partition(".")[0], wanted_by)
    return importlib.import_module(module)
