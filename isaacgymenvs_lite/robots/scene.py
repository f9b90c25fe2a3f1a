"""What a robot is simulated with and moves on: the project's stage, put into the robot's model."""

from __future__ import annotations

import warnings
from typing import Any

import mujoco

from isaacgymenvs_lite.paths import assets_dir

_STAGE = "mjcf/parts/stage.xml"
_PREFIX = "stage/"
_MAX_ITERATIONS = 100
_ITERATIONS = ("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations")
_COPIED_OF_FLOOR = ("pos", "quat", "size", "condim", "friction", "material", "group", "rgba")


def add_stage(spec: mujoco.MjSpec) -> None:
    """Add floor, light and solver settings of the project's models; a floor of the file is reused.

    The robot's own cone, impratio and contact parameters stay. The floor is called `floor`, is at
    z = 0 and collides with every geom of the robot that can collide.

    Args:
        spec: changed; of a robot, whose world has no geoms but the file's own floor.
    """
    stage = mujoco.MjSpec.from_string(
        '<mujoco model="stage"><include file="stage.xml"/></mujoco>',
        include={"stage.xml": (assets_dir() / _STAGE).read_bytes()},
    )
    _take_options(spec, stage)
    _copy_fields(stage.visual, spec.visual)
    own = next(iter(spec.worldbody.geoms), None)
    bits = [(geom.contype, geom.conaffinity) for geom in spec.geoms]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of files of meshes, which the stage does not have
        spec.attach(stage, frame=spec.worldbody.add_frame(), prefix=_PREFIX)
    floor = spec.geom(f"{_PREFIX}floor")
    if own is not None:
        for name in _COPIED_OF_FLOOR:
            setattr(own, name, getattr(floor, name))
        spec.delete(floor)
        for pair in spec.pairs:  # before the rename: they name the floor
            pair.geomname1 = "floor" if pair.geomname1 == own.name else pair.geomname1
            pair.geomname2 = "floor" if pair.geomname2 == own.name else pair.geomname2
        floor = own
    floor.name = "floor"
    for contype, conaffinity in bits:
        floor.contype |= conaffinity
        floor.conaffinity |= contype


def _take_options(spec: mujoco.MjSpec, stage: mujoco.MjSpec) -> None:
    option = spec.option
    option.timestep, option.integrator = stage.option.timestep, stage.option.integrator
    option.solver = stage.option.solver
    option.disableflags, option.enableflags = stage.option.disableflags, stage.option.enableflags
    for name in _ITERATIONS:
        setattr(option, name, min(getattr(option, name), _MAX_ITERATIONS))


def _copy_fields(source: Any, target: Any) -> None:
    """Copy all numbers of a nested MuJoCo structure."""
    for name in (name for name in dir(source) if not name.startswith("_")):
        value = getattr(source, name)
        if isinstance(value, (int, float)):
            setattr(target, name, value)
        elif hasattr(value, "__len__"):
            getattr(target, name)[:] = value
        elif not callable(value):
            _copy_fields(value, getattr(target, name))
