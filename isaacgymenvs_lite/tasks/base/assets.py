"""Finds and compiles the MJCF file of a task."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.robots.reading import read_robot_file
from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.tasks.base.task_config import AssetConfig, SimConfig

log = logging.getLogger(__name__)

_ASSETS_OF_ASE = ("data", "assets")  # relative `assetRoot` in files of ASE and its forks


def asset_path(
    asset: AssetConfig,
    own: str,
    published: Collection[str] = (),
    key: str = "task.env.asset.assetFileName",
) -> Path:
    """Return the path of the MJCF file that `task.env.asset` names.

    Args:
        asset: the section.
        own: path of this project's file for the task, relative to assets/.
        published: file names in published task files. If such a file does not exist, `own` replaces
            it.
        key: key of the file name, which messages contain.

    Raises:
        ConfigError: the file does not exist.
    """
    name = asset.asset_file_name or own
    root = Path(asset.asset_root) if asset.asset_root else assets_dir()
    made_for_isaac_gym = not root.is_absolute() and root.parts[-2:] == _ASSETS_OF_ASE
    if (made_for_isaac_gym or not root.is_dir()) and (assets_dir() / name).is_file():
        reason = "has models for Isaac Gym" if root.is_dir() else "does not exist"
        log.info("task.env.asset.assetRoot=%s %s; using %s", root, reason, assets_dir())
        root = assets_dir()
    path = root / name
    if path.is_file():
        return path
    if name in published:
        log.info("%s: %s does not exist here; using %s", key, name, own)
        return assets_dir() / own
    raise ConfigError(f"{key}='{name}': no file {path}; shipped: {shipped_assets()}")


def shipped_assets() -> str:
    """Return the names of the project's MJCF files as text for messages."""
    return ", ".join(
        sorted(str(p.relative_to(assets_dir())) for p in assets_dir().glob("mjcf/*.xml"))
    )


def compile_model(
    path: Path,
    own: str,
    sim: SimConfig,
    dynamic_friction: float,
    change: Callable[[mujoco.MjSpec], None] = lambda spec: None,
) -> mujoco.MjModel:
    """Compile an MJCF file with the task's time step, gravity and friction (see `compile_spec`)."""
    return compile_spec(read_spec(path, own), path, sim, dynamic_friction, change)


def read_spec(path: Path, own: str) -> mujoco.MjSpec:
    """Read an MJCF or URDF file.

    A file is read as an untrusted robot file, unless it is in assets/ or is the task's file `own`.
    """
    file, ours = path.resolve(), assets_dir().resolve()
    if file.is_relative_to(ours) or file == (ours / own).resolve():
        with explained(path):
            return mujoco.MjSpec.from_file(str(path))
    model = read_robot_file(path, with_sensors=True)
    for note in model.notes:
        log.info("%s: %s", path, note)
    return model.spec


def compile_spec(
    spec: mujoco.MjSpec,
    path: Path,
    sim: SimConfig,
    dynamic_friction: float,
    change: Callable[[mujoco.MjSpec], None] = lambda spec: None,
) -> mujoco.MjModel:
    """Compile a specification with the task's time step, gravity and friction.

    `spec` holds the contents of the file at `path`, and the function `change` is applied to `spec`
    first. `dynamic_friction` is the coefficient of sliding friction with the geom `floor`.

    Raises:
        ConfigError: MuJoCo cannot compile the specification.
    """
    with explained(path):
        change(spec)
        model = spec.compile()
    model.opt.timestep = sim.dt / sim.substeps
    model.opt.gravity[:] = sim.gravity
    # MuJoCo uses the larger coefficient of two touching geoms, so all geoms get the same one.
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor") >= 0:
        model.geom_friction[:, 0] = dynamic_friction
    return model


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn MuJoCo's error about the file at `path` into a ConfigError."""
    try:
        yield
    except ConfigError:
        raise
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"task.env.asset: MuJoCo cannot load {path}: {reason}") from error


def hinge_limits(model: mujoco.MjModel, layout: ModelLayout) -> npt.NDArray[np.float64]:
    """Return the limits (D, 2) of hinges (rad) and slides (m). Limits of other joints are 0."""
    limits = np.zeros((layout.num_dofs, 2))
    for dof in layout.scalar_dofs:
        limits[dof] = model.joint(layout.dof_names[dof]).range
    return limits
