"""Files that a robot's MJCF or URDF names: where they may be, and in what formats."""

from __future__ import annotations

import re
import struct
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

import numpy as np

from isaacgymenvs_lite.errors import ConfigError, one_line, printable

MESH_SUFFIXES = (".stl", ".obj", ".msh")
"""Formats that MuJoCo reads."""
# The folder of such a name is a part of the robot's folder, as in ROS packages.
_PARTS_OF_A_ROBOT = ("urdf", "urdfs", "xml", "mjcf", "xacro")
_MAX_LEVELS = 6


class RobotFiles:
    """Finds the files of a robot in its own folder and in its ROS package.

    Args:
        path: of the robot's main file.

    Attributes:
        path: of the main file, absolute, without links.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()
        folder = self.path.parent
        self._folders = [folder]
        if folder.name.lower() in _PARTS_OF_A_ROBOT and folder.parent != folder.parent.parent:
            self._folders.append(folder.parent)
        self._folders += [up for up in _upwards(folder) if (up / "package.xml").is_file()][:1]

    def find(self, name: str, folder: str = "", kind: str = "mesh") -> Path:
        """Return the path of a file that the robot names.

        Args:
            name: relative, absolute, or a `package://` or `model://` URI.
            folder: `meshdir` and the like, relative to the main file.
            kind: what it is, for messages.

        Raises:
            ConfigError: it is missing or outside of the robot's folder.
        """
        what = f"{self.path}: {kind} '{name}'"
        scheme, separator, rest = name.replace("\\", "/").partition("://")
        if separator and scheme in ("package", "model"):
            tried, packages = self._in_packages(rest)
            return _find_below((*packages, *self._folders), tried, what)
        if separator:
            raise ConfigError(f"{what}: expected a relative path or package://")
        return _find_below(self._folders, [self.path.parent / folder / scheme], what)

    def find_mesh(self, name: str, folder: str = "") -> Path:
        """Return the path of a mesh, or of a file beside it that has it in another format.

        Args:
            name: as in `find`; of a format that MuJoCo does not read, `foot.dae`, the file may be
                `foot.stl` or `foot.obj`.
            folder: as in `find`.

        Raises:
            ConfigError: there is none in a format that MuJoCo reads.
        """
        suffix = PurePosixPath(name).suffix
        stem = name.removesuffix(suffix)
        if suffix.lower() in MESH_SUFFIXES:
            return self.find(name, folder)
        for other in MESH_SUFFIXES:
            try:
                return self.find(f"{stem}{other}", folder)
            except ConfigError:
                continue
        raise ConfigError(
            f"{self.path}: mesh '{name}' has a format that MuJoCo does not read; expected"
            f" {', '.join(MESH_SUFFIXES)}: convert it, with Blender or trimesh for example, to"
            f" '{PurePosixPath(stem).name}.stl' beside it"
        )

    def find_include(self, name: str, of: Path) -> Path:
        """Return the path of an included file: beside the main file, else beside `of`.

        Raises:
            ConfigError: it is missing or outside of the robot's folder.
        """
        what = f'{self.path}: <include file="{name}">'
        return _find_below(self._folders, [self.path.parent / name, of.parent / name], what)

    def _in_packages(self, uri: str) -> tuple[list[Path], list[Path]]:
        """Return where a file of `package://name/rest` may be, and the folders it may be below.

        The package is a folder of that name above the robot's file or beside one above it; files
        that were copied without their package are looked for as `rest` in the folders above.
        """
        name, _, rest = uri.lstrip("/").partition("/")
        ups = _upwards(self.path.parent)
        packages = [up for up in ups if up.name == name]
        if name not in ("", ".", ".."):
            packages += [up / name for up in ups if (up / name).is_dir()]
        folders = [*(package.resolve() for package in packages), *ups[:3]]
        return [folder / rest for folder in folders], folders


def _upwards(folder: Path) -> list[Path]:
    """Return a folder and those above it, some levels and never the whole disk."""
    return [up for up in (folder, *folder.parents)[:_MAX_LEVELS] if up != up.parent]


def _find_below(folders: Iterable[Path], tried: Iterable[Path], what: str) -> Path:
    """Return the first of the paths `tried` that is a file below one of the folders.

    Links are followed before the check.
    """
    folders, tried = list(folders), list(dict.fromkeys(tried))
    try:
        found = next((real for path in tried if (real := path.resolve()).is_file()), None)
    except (OSError, ValueError, RuntimeError) as error:  # a name too long, a circle of links
        raise ConfigError(f"{what}: no path of a file ({one_line(error)})") from error
    if found is None:
        raise ConfigError(f"{what} is missing; looked for {', '.join(map(str, tried))}")
    if not any(found.is_relative_to(folder) for folder in folders):
        raise ConfigError(f"{what} is outside of the robot's folder, {folders[-1]}: copy it there")
    return found


def read_xml(path: Path) -> ET.Element:
    """Return the root element of an XML file.

    Raises:
        ConfigError: the file is missing or is no XML.
    """
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    try:
        return ET.fromstring(path.read_bytes().strip(b" \t\r\n\0"))  # some tools end with a zero
    except (ET.ParseError, OSError, ValueError, LookupError) as error:
        raise ConfigError(f"{path}: is no XML of a robot ({one_line(error)})") from error


def mesh_content(path: Path) -> bytes:
    """Return the content of a mesh file; of an STL file in ASCII the binary one that MuJoCo reads.

    Raises:
        ConfigError: a corner in ASCII is not three numbers.
    """
    content = path.read_bytes()
    # Some binary files begin with `solid`, too, but have no `vertex` so early.
    is_text = content[:5].lower() == b"solid" and b"vertex" in content[:1000]
    if path.suffix.lower() != ".stl" or not is_text:
        return content
    corners = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", content)
    try:
        triangles = np.array(corners, dtype="S32").astype("<f4").reshape(-1, 9)
    except ValueError as error:
        raise ConfigError(f"{path}: not an STL file: {printable(str(error))}") from error
    # A facet is its normal, which MuJoCo computes itself, three corners and two unused bytes.
    facets = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", 9), ("_", "<u2")])
    facets["corners"] = triangles
    return bytes(80) + struct.pack("<I", len(facets)) + facets.tobytes()
