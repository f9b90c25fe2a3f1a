"""Meshes and textures that a robot's file names, read into memory within limits.

MuJoCo gets them by new names, from memory alone: it opens no file of the disk.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from isaacgymenvs_lite.errors import ConfigError, printable
from isaacgymenvs_lite.robots.xml_files import find_below, package_paths, read_bytes, robot_folders

MESH_SUFFIXES = (".stl", ".obj", ".msh")
"""Formats that MuJoCo reads."""
MAX_MESH_BYTES = 2**26
MAX_ALL_BYTES = 2**29
MAX_TEXELS = 2**24
"""Of one texture, 4096 x 4096."""
MAX_ALL_TEXELS = 2**25


_MAX_FACES = 200_000  # MuJoCo reads no more of an STL file


@dataclass
class AssetFiles:
    """Files beside a robot's main file.

    Attributes:
        path: of the main file.
        contents: bytes of the files that were read, by the names that MuJoCo gets.
    """

    path: Path
    contents: dict[str, bytes] = field(default_factory=dict)
    _names: dict[Path, str] = field(default_factory=dict)
    _bytes: int = 0
    _texels: float = 0.0

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
        folders = robot_folders(self.path)
        name = name.replace("\\", "/")
        scheme, separator, rest = name.partition("://")
        if separator and scheme in ("package", "model"):
            tried, bases = package_paths(rest, self.path)
            return find_below((*bases, *folders), tried, what)
        if separator:
            raise ConfigError(f"{what}: expected a relative path or package://")
        return find_below(folders, [folders[0] / folder / name], what)

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

    def read(self, path: Path) -> str:
        """Read a file and return the name that MuJoCo gets for it.

        A file that is named again counts again: MuJoCo makes a mesh of it each time.

        Raises:
            ConfigError: it is too long, or all files together are.
        """
        if path not in self._names:
            content = _as_binary_stl(read_bytes(path, MAX_MESH_BYTES), path)
            # Meshes without a name are called after their file; two folders may have the same.
            name = f"{len(self._names)}_{PurePosixPath(path.name).stem}{path.suffix.lower()}"
            self._names[path], self.contents[name] = name, content
        name = self._names[path]
        self._bytes += len(self.contents[name])
        if self._bytes > MAX_ALL_BYTES:
            raise ConfigError(
                f"{self.path}: its meshes have more than {MAX_ALL_BYTES // 2**20} MiB together"
            )
        return name

    def has_room_for(self, texels: float) -> bool:
        """Return whether a texture is small enough, also with the others so far, and count it."""
        fits = 0 < texels <= MAX_TEXELS and self._texels + texels <= MAX_ALL_TEXELS
        self._texels += texels if fits else 0.0
        return fits


def _as_binary_stl(content: bytes, path: Path) -> bytes:
    """Return the content of a mesh file; of an STL file in ASCII the binary one that MuJoCo reads.

    Raises:
        ConfigError: a corner in ASCII is not three numbers.
    """
    # Some binary files begin with `solid`, too, but have no `vertex` so early.
    is_text = content[:5].lower() == b"solid" and b"vertex" in content[:1000]
    if path.suffix.lower() != ".stl" or not is_text:
        return content
    if content.count(b"vertex") > 3 * _MAX_FACES:
        raise ConfigError(f"{path}: has more than {_MAX_FACES} triangles")
    corners = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", content)
    try:
        triangles = np.array(corners, dtype="S32").astype("<f4").reshape(-1, 9)
    except ValueError as error:
        raise ConfigError(f"{path}: not an STL file: {printable(str(error))}") from error
    # A facet is its normal, which MuJoCo computes itself, three corners and two unused bytes.
    facets = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", 9), ("_", "<u2")])
    facets["corners"] = triangles
    return bytes(80) + struct.pack("<I", len(facets)) + facets.tobytes()


def png_texels(content: bytes) -> int:
    """Return width times height of a PNG picture; 0 if bytes do not begin as one."""
    if content[:8] != b"\x89PNG\r\n\x1a\n" or len(content) < 24:
        return 0
    width, height = struct.unpack(">II", content[16:24])
    return width * height
