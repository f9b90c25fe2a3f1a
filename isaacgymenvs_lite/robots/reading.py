"""Reads a robot's MJCF or URDF into an MjSpec; the file may come from a stranger.

One pass over an MJCF and its included files refuses plugins and includes from other folders; then
MuJoCo reads the files. Meshes and textures are read only from the robot's folder.
"""

from __future__ import annotations

import re
import struct
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import mujoco
import numpy as np

from isaacgymenvs_lite.errors import ConfigError, UserError, listed, one_line, printable
from isaacgymenvs_lite.paths import user_path

MESH_SUFFIXES = (".stl", ".obj", ".msh")
"""Mesh formats that MuJoCo reads."""
# If the file's folder has one of these names, the robot's folder is the folder above, as in ROS
# packages.
_PARTS_OF_A_ROBOT = ("urdf", "urdfs", "xml", "mjcf", "xacro")
_MAX_LEVELS = 6


class RobotFiles:
    """Finds the files of a robot in the folder of its main file and in its ROS package."""

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()
        folder = self.path.parent
        self._folders = [folder]
        if folder.name.lower() in _PARTS_OF_A_ROBOT and folder.parent != folder.parent.parent:
            self._folders.append(folder.parent)
        self._folders += [up for up in _upwards(folder) if (up / "package.xml").is_file()][:1]

    def find(self, name: str, folder: str = "", kind: str = "mesh") -> Path:
        """Return the path of a file of the robot; `name` is a path or a package:// URI.

        `folder` is for example `meshdir`, relative to the main file.

        Raises:
            ConfigError: the file is missing or outside of the robot's folder.
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
        """Return the path of a mesh in a format that MuJoCo reads.

        `foot.stl` or `foot.obj` in the same folder replaces `foot.dae`, which MuJoCo does not read.
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
        """Return the path of an included file in the main file's folder or in that of `of`."""
        what = f'{self.path}: <include file="{name}">'
        return _find_below(self._folders, [self.path.parent / name, of.parent / name], what)

    def _in_packages(self, uri: str) -> tuple[list[Path], list[Path]]:
        """Return possible paths of `package://name/rest`, and the folders that may contain them.

        Because files may have been copied without their package, `rest` is also searched in the
        folders above the main file.
        """
        name, _, rest = uri.lstrip("/").partition("/")
        ups = _upwards(self.path.parent)
        packages = [up for up in ups if up.name == name]
        if name not in ("", ".", ".."):
            packages += [up / name for up in ups if (up / name).is_dir()]
        folders = [*(package.resolve() for package in packages), *ups[:3]]
        return [folder / rest for folder in folders], folders


def _upwards(folder: Path) -> list[Path]:
    """Return a folder and a few folders above it, but not the root of the file system."""
    return [up for up in (folder, *folder.parents)[:_MAX_LEVELS] if up != up.parent]


def _find_below(folders: Iterable[Path], tried: Iterable[Path], what: str) -> Path:
    """Return the first path of `tried` that leads, through any links, to a file below a folder."""
    folders, tried = list(folders), list(dict.fromkeys(tried))
    try:
        found = next((real for path in tried if (real := path.resolve()).is_file()), None)
    except (OSError, ValueError, RuntimeError) as error:  # too long a name, or a circle of links
        raise ConfigError(f"{what}: this is not a path ({one_line(error)})") from error
    if found is None:
        raise ConfigError(f"{what} is missing; looked for {', '.join(map(str, tried))}")
    if not any(found.is_relative_to(folder) for folder in folders):
        raise ConfigError(f"{what} is outside of the robot's folder, {folders[-1]}: copy it there")
    return found


def read_xml(path: Path) -> ET.Element:
    """Return the root element of an XML file."""
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    try:
        return ET.fromstring(path.read_bytes().strip(b" \t\r\n\0"))  # some tools end with a zero
    except (ET.ParseError, OSError, ValueError, LookupError) as error:
        raise ConfigError(f"{path} is not valid XML ({one_line(error)})") from error


def mesh_content(path: Path) -> bytes:
    """Return the content of a mesh file; MuJoCo needs STL in ASCII to be converted to binary."""
    content = path.read_bytes()
    # Some binary files also begin with `solid`, but only a text file soon contains `vertex`.
    is_text = content[:5].lower() == b"solid" and b"vertex" in content[:1000]
    if path.suffix.lower() != ".stl" or not is_text:
        return content
    corners = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", content)
    try:
        triangles = np.array(corners, dtype="S32").astype("<f4").reshape(-1, 9)
    except ValueError as error:
        raise ConfigError(f"{path}: not an STL file: {printable(str(error))}") from error
    # A facet consists of a normal (zeros, because MuJoCo computes it), three corners and two unused
    # bytes.
    facets = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", 9), ("_", "<u2")])
    facets["corners"] = triangles
    return bytes(80) + struct.pack("<I", len(facets)) + facets.tobytes()


_LEAST_INERTIA = 1e-9  # kg m^2
# These elements load libraries or other models, or describe soft bodies.
_REFUSED = {
    **dict.fromkeys(("extension", "plugin"), "engine plugins are not loaded"),
    **dict.fromkeys(("composite", "flexcomp", "flex"), "soft bodies are no part of a robot"),
    **dict.fromkeys(("model", "attach"), "models within models are not read: save it as one"),
}


class RobotFile(NamedTuple):
    """A robot as described by its file, with notes on removed parts."""

    spec: mujoco.MjSpec
    notes: tuple[str, ...]


def read_robot_file(path: str | Path, with_sensors: bool = False) -> RobotFile:
    """Read a robot's MJCF or URDF; the content of the file decides between the formats.

    Meshes are read from the robot's folder: the folder of the file, the folder above it if the
    file's folder is called urdf, xml or the like, and the ROS package of the file.
    `package://name/` means a folder `name` above the file, or next to a folder above the file.
    `with_sensors` keeps the sensors of an MJCF for a task that reads them.

    Raises:
        ConfigError: the file or a file that it names is missing or in another folder, has elements
            that a robot does not need, or is refused by MuJoCo.
    """
    path = user_path(path)
    try:
        root, files = read_xml(path), RobotFiles(path)
        is_urdf = root.tag == "robot"
        if is_urdf:
            notes = _prepare_urdf(root)
            spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
        elif root.tag == "mujoco":
            _check_texts(root, files)
            spec = mujoco.MjSpec.from_file(str(files.path))
            notes = _leave_out(spec, with_sensors)
        else:
            raise ConfigError(
                f"{path} begins with <{root.tag[:40]}>; expected a robot as MJCF (<mujoco>) or URDF"
                " (<robot>)"
            )
        notes += _take_meshes(spec, files, is_urdf)
        notes += _take_textures(spec, files)
        spec.meshdir = spec.texturedir = ""
        _allow_open_meshes(spec)
        if is_urdf:
            notes += _repair_inertias(spec)
        return RobotFile(spec, tuple(notes))
    except UserError:
        raise
    except Exception as error:
        raise ConfigError(f"{path}: MuJoCo cannot read it: {one_line(error)}") from error


def _check_texts(root: ET.Element, files: RobotFiles) -> None:
    """Refuse plugins, nested models and includes from other folders in a file and its includes."""
    waiting, known = [(root, files.path)], {files.path}
    while waiting:
        root, file = waiting.pop()
        for element in root.iter():
            if element.tag in _REFUSED:
                raise ConfigError(f"{files.path}: has <{element.tag}>: {_REFUSED[element.tag]}")
            if element.tag == "include":
                included = files.find_include(element.get("file", ""), file)
                if included not in known:  # MuJoCo refuses a file that is included twice
                    known.add(included)
                    waiting.append((read_xml(included), included))


def _leave_out(spec: mujoco.MjSpec, with_sensors: bool) -> list[str]:
    """Remove elements that a robot does not need; return notes on sensors, skins and terrain."""
    of_terrain = [geom for geom in spec.geoms if geom.hfieldname]
    for thing in [*of_terrain, *spec.numerics, *spec.texts, *spec.tuples]:
        spec.delete(thing)
    left_out = {"skin": spec.skins, "hfield": spec.hfields}
    if not with_sensors:
        left_out["sensor"] = spec.sensors
    notes = [f"left out of the file: {len(o)} {kind}s" for kind, o in left_out.items() if o]
    for thing in [thing for things in left_out.values() for thing in things]:
        spec.delete(thing)
    defaults = mujoco.MjSpec()
    sizes = [name for name in dir(spec) if name.startswith("nuser")]
    for name in ("memory", "nkey", *sizes):  # <size>; the task adds sensors and has no keyframes
        setattr(spec, name, getattr(defaults, name))
    for name in ("meaninertia", "meanmass", "meansize", "extent", "center"):
        setattr(spec.stat, name, getattr(defaults.stat, name))
    materials = {material.name for material in spec.materials}
    unknown = set()
    for element in (*spec.geoms, *spec.sites, *spec.tendons):
        if element.material and element.material not in materials:
            unknown.add(element.material)
            element.material = ""
    if unknown:
        names = listed(sorted(unknown))
        notes.append(f"left out materials that the file does not define: {names}")
    return notes


def _take_meshes(spec: mujoco.MjSpec, files: RobotFiles, is_urdf: bool) -> list[str]:
    """Read all meshes into `spec.assets`; return a note on missing visual meshes of a URDF."""
    assets, hidden = {}, list[str]()
    for mesh in [mesh for mesh in spec.meshes if mesh.file]:
        name = PurePosixPath(mesh.file.replace("\\", "/")).name if spec.strippath else mesh.file
        users = [geom for geom in spec.geoms if geom.meshname == mesh.name]
        try:
            path = files.find_mesh(name, spec.meshdir)
        except ConfigError:
            if not is_urdf or any(geom.contype for geom in users):
                raise
            hidden.append(name)
            for thing in [*users, mesh]:
                spec.delete(thing)
            continue
        mesh.file, mesh.content_type = f"{len(assets)}_{path.stem}{path.suffix.lower()}", ""
        assets[mesh.file] = mesh_content(path)
    spec.assets = assets
    if not hidden:
        return []
    return [
        f"left out {len(hidden)} visual meshes that are missing or have a format that MuJoCo does"
        f" not read, the first '{printable(hidden[0])}'"
    ]


def _take_textures(spec: mujoco.MjSpec, files: RobotFiles) -> list[str]:
    """Read images of textures into `spec.assets`; return a note on omitted textures."""
    assets, dropped = dict(spec.assets), []
    for texture in [one for one in spec.textures if one.file or any(one.cubefiles)]:
        name = texture.file.replace("\\", "/")
        try:
            if not name.lower().endswith(".png"):
                raise ConfigError("MuJoCo reads PNG files")
            name = PurePosixPath(name).name if spec.strippath else name
            path = files.find(name, spec.texturedir, "texture")
        except ConfigError:
            dropped.append(texture)
            continue
        texture.file, texture.content_type = f"{len(assets)}_{path.name}", ""
        assets[texture.file] = path.read_bytes()
    spec.assets = assets
    names = sorted(texture.name for texture in dropped)
    for material in spec.materials:
        material.textures = ["" if name in names else name for name in material.textures]
    for texture in dropped:
        spec.delete(texture)
    what = "left out textures that are not PNG files in the robot's folder"
    return [f"{what}: {', '.join(names)}"] if names else []


def _allow_open_meshes(spec: mujoco.MjSpec) -> None:
    """Allow meshes without volume, which MuJoCo refuses, if no inertia is computed from them."""
    always = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    inertial = {
        geom.meshname
        for body in spec.bodies
        if always or not body.explicitinertial
        for geom in body.geoms
    }
    for mesh in spec.meshes:
        if mesh.name not in inertial:
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def _prepare_urdf(root: ET.Element) -> list[str]:
    """Set options of MuJoCo's compiler; remove <gazebo> elements and spheres without a radius.

    If a robot has no collision shapes, its visual shapes collide, and the function returns a note.
    """
    root[:] = [child for child in root if child.tag in ("link", "joint", "material")]
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            sphere = shape.find("geometry/sphere")
            if sphere is not None and not float(sphere.get("radius", 0)):
                link.remove(shape)
    extension = ET.Element("mujoco")
    # Links on fixed joints remain separate bodies, because many robots have such feet and hands.
    settings = {"fusestatic": "false", "discardvisual": "false", "strippath": "false"}
    # URDF files often have links without mass or with impossible inertias.
    least = {"boundmass": "1e-6", "boundinertia": f"{_LEAST_INERTIA:g}"}
    settings |= {"balanceinertia": "true", **least}
    ET.SubElement(extension, "compiler", settings)
    root.insert(0, extension)
    if root.find("link/collision") is not None:
        return []
    for visual in root.iter("visual"):
        visual.tag = "collision"
    return ["the file has no collision shapes, so its visual shapes collide"]


def _repair_inertias(spec: mujoco.MjSpec) -> list[str]:
    """Replace inertias that MuJoCo would refuse by positive inertias; return a note on them."""
    repaired = []
    for body in spec.bodies:
        xx, yy, zz, xy, xz, yz = body.fullinertia
        if not np.isfinite(body.fullinertia).all():  # NaN marks a body without an inertia
            continue
        moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if moments.min() > 0:
            continue
        full = (axes * moments.clip(min=_LEAST_INERTIA)) @ axes.T
        body.fullinertia = [*full.diagonal(), full[0, 1], full[0, 2], full[1, 2]]
        repaired.append(body.name)
    return [f"repaired inertias that are not positive: {listed(repaired)}"] if repaired else []
