"""Mapping files, which assign joints of a source skeleton to bodies of the humanoid.

docs/motion_formats.md describes mapping files; the shipped files are in assets/retargeting.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from isaacgymenvs_lite import paths
from isaacgymenvs_lite.errors import ConfigError, unknown
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.motion.kinematics import FloatArray
from isaacgymenvs_lite.motion.skeleton import skeleton_for_num_dofs
from isaacgymenvs_lite.schema import read_section, setting
from isaacgymenvs_lite.utils import rotations
from isaacgymenvs_lite.utils.yaml_file import load_yaml

AXES = tuple(f"{sign}{axis}" for sign in "+-" for axis in "xyz")
# Bodies whose rotation is the rotation of their joint; joint positions determine the rotations of
# all other bodies.
WITH_ATTITUDE = ("pelvis", "torso", "head", "right_foot", "left_foot")


@dataclass(frozen=True, kw_only=True)
class _BodySettings:
    """An entry of the key `bodies`."""

    joint: str = setting()
    x: str | None = setting(None, choices=AXES)
    z: str | None = setting(None, choices=AXES)
    turn_deg: tuple[float, ...] = setting((0.0, 0.0, 0.0), length=3, minimum=-360, maximum=360)
    level: bool = setting(False)


@dataclass(frozen=True, kw_only=True)
class _MappingSettings:
    """The content of a mapping file."""

    up: str = setting(choices=AXES)
    unit_m: float = setting(minimum=1e-6, maximum=1e3)
    bodies: Mapping[str, Any] = setting()


@dataclass(frozen=True, eq=False)
class BodySource:
    """The source joint of a body's motion."""

    joint: str  # name of a joint of the source skeleton
    # (4,) xyzw, rotation of the body's frame relative to the joint's frame, or None if the body's
    # rotation does not come from the joint.
    frame: FloatArray | None
    level: bool  # whether the foot's sole becomes parallel to the ground in contacts


@dataclass(frozen=True, eq=False)
class SkeletonMapping:
    """A mapping from the joints of a source skeleton to the humanoid's bodies."""

    name: str  # path of the mapping file, or the name of a shipped mapping
    up: str  # up axis of the BVH file, one of `AXES`
    unit_m: float  # unit of length of the BVH file in m
    sources: Mapping[str, BodySource]  # from body names of the humanoid with 28 DOFs

    @property
    def to_z_up(self) -> FloatArray:
        """Rotation (4,) xyzw of `up` to z, and of the next axis in the cycle x, y, z to x."""
        z = axis_vector(self.up)
        x = np.roll(np.abs(z), 1)
        return _quaternion(np.stack((x, np.cross(z, x), z)))


def shipped_mappings() -> dict[str, Path]:
    """Return a dictionary from the names of the shipped mappings to the files."""
    return {path.stem: path for path in sorted((paths.assets_dir() / "retargeting").glob("*.yaml"))}


def load_mapping(mapping: str | Path) -> SkeletonMapping:
    """Read a mapping, whose file or shipped name is given, or raise a ConfigError."""
    with reading(mapping, "mapping file"):
        path, content = read_mapping_keys(mapping, shipped_mappings(), "up, unit_m and bodies")
        settings = read_section(_MappingSettings, content, where=str(path), complete=True)
        bodies, known = settings.bodies, skeleton_for_num_dofs(28).body_names
        for body in bodies:
            if body not in known:
                raise ConfigError(f"{path}: {unknown('body', str(body), known)}")
        missing = [body for body in known if body not in bodies]
        if missing:
            raise ConfigError(f"{path}: bodies lacks {', '.join(missing)}")
        sources = {body: _source(body, bodies[body], f"{path}: bodies.{body}") for body in known}
        return SkeletonMapping(str(mapping), settings.up, settings.unit_m, sources)


def read_mapping_keys(
    mapping: str | Path, shipped: Mapping[str, Path], expected: str
) -> tuple[Path, dict[Any, Any]]:
    """Return the path and the content of a mapping file, whose path or shipped name is given.

    `expected` is the part of the error message that lists the keys.
    """
    path = shipped.get(str(mapping)) or Path(mapping)
    if not path.is_file():
        raise ConfigError(
            f"mapping={mapping}: no such file; give a YAML file or a shipped mapping: "
            f"{', '.join(shipped)}"
        )
    content = load_yaml(path)
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected the keys {expected}")
    return path, content


def _source(body: str, entry: Any, where: str) -> BodySource:
    if isinstance(entry, str):
        entry = {"joint": entry}
    settings = read_section(_BodySettings, entry, where=where, complete=True)
    if settings.x is None and settings.z is None and body not in WITH_ATTITUDE:
        return BodySource(settings.joint, None, False)
    if settings.x is None or settings.z is None:
        raise ConfigError(
            f"{where}: expected x and z, the axes of the joint '{settings.joint}' that point "
            "forward and up in the humanoid's zero pose"
        )
    if settings.x[1] == settings.z[1]:
        raise ConfigError(f"{where}: x is {settings.x} and z {settings.z}, expected two axes")
    frame = body_frame(settings.x, settings.z, settings.turn_deg)
    return BodySource(settings.joint, frame, settings.level)


def body_frame(x: str, z: str, turn_deg: Sequence[float] = (0.0, 0.0, 0.0)) -> FloatArray:
    """Return the rotation (4,) xyzw of a body's frame relative to its joint's frame.

    `x` and `z` are the joint's axes that point forward and up. `turn_deg` (3,) is the vector of an
    additional rotation in the axes x, left and z, in degrees.
    """
    forward, up = axis_vector(x), axis_vector(z)
    axes = torch.from_numpy(_quaternion(np.stack((forward, np.cross(up, forward), up), axis=1)))
    extra = rotations.exp_map_to_quat(torch.from_numpy(np.radians(np.array(turn_deg))))
    return rotations.quat_mul(axes, extra).numpy()


def axis_vector(name: str) -> FloatArray:
    """Return the unit vector (3,) of an axis, which is one of `AXES`."""
    axis = np.zeros(3)
    axis["xyz".index(name[1])] = 1.0 if name[0] == "+" else -1.0
    return axis


def _quaternion(matrix: FloatArray) -> FloatArray:
    """Return the quaternion (4,) xyzw of a rotation matrix (3, 3)."""
    wxyz = np.zeros(4)
    mujoco.mju_mat2Quat(wxyz, matrix.ravel())
    return rotations.xyzw_from_wxyz(torch.from_numpy(wxyz)).numpy()
