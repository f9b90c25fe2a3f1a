"""Reads a robot's MJCF or URDF, which a stranger wrote, into an MjSpec.

The text is read and checked here before MuJoCo gets it: includes are put in place, files are read
into memory from the robot's folder alone, and what could run code or take much memory is refused.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import mujoco
import numpy as np

from isaacgymenvs_lite.errors import ConfigError, listed, one_line, printable
from isaacgymenvs_lite.paths import user_path
from isaacgymenvs_lite.robots.mesh_files import AssetFiles, png_texels
from isaacgymenvs_lite.robots.xml_files import (
    MAX_DEPTH,
    MAX_ELEMENTS,
    find_below,
    read_xml,
    robot_folders,
)

MAX_BODIES = MAX_JOINTS = 500
MAX_GEOMS = 1000
# Elements by what they are. A text may have more of them than a robot: links that are fixed to
# others merge, shapes are left out. But MuJoCo takes time with the square of most of these numbers,
# so they are counted before it gets the text, too.
_KINDS = {
    **dict.fromkeys(("body", "link"), "bodies"),
    **dict.fromkeys(("joint", "freejoint"), "joints"),
    **dict.fromkeys(("geom", "collision", "visual"), "geoms"),
    **{"camera": "cameras", "light": "lights", "key": "keyframes", "default": "default classes"},
}
_MOST_WRITTEN = {
    "bodies": 4 * MAX_BODIES,
    "joints": 4 * MAX_JOINTS,
    "geoms": 4 * MAX_GEOMS,
    **dict.fromkeys(("actuators", "sensors", "cameras", "lights"), 2000),
    **dict.fromkeys(("keyframes", "default classes"), 2000),
    "built-in meshes": 20,
    "elements": MAX_ELEMENTS,
}
_MAX_INCLUDES = 50
_MAX_TEXTURE_SIDE = 4096
_MAX_MESH_PARAMETER = 200
# States and samples of an actuator or a sensor, numbers of a user's sensor.
_SIZES, _MAX_SIZE = ("actdim", "nsample", "dim"), 1000
_LEAST_INERTIA = 1e-9  # kg m^2
# Elements that load libraries or other models, or that describe no rigid robot.
_REFUSED = {
    **dict.fromkeys(("extension", "plugin"), "engine plugins are not loaded"),
    **dict.fromkeys(("composite", "flexcomp", "flex"), "soft bodies are no part of a robot"),
    **dict.fromkeys(("model", "attach"), "models within models are not read: save it as one"),
}
# Elements that a robot does not need: pictures, buffers, what tasks add themselves.
_LEFT_OUT = ("custom", "size", "visual", "statistic", "skin", "sensor", "hfield")


@dataclass(frozen=True)
class RobotFile:
    """A robot as its file describes it.

    Attributes:
        path: of the file.
        spec: its content, without sensors unless they were asked for.
        notes: what was left out, in words.
    """

    path: Path
    spec: mujoco.MjSpec
    notes: tuple[str, ...]


def read_robot(path: str | Path) -> mujoco.MjSpec:
    """Return the content of a robot's file; see `read_robot_file`."""
    return read_robot_file(path).spec


def read_robot_file(path: str | Path, with_sensors: bool = False) -> RobotFile:
    """Read a robot's MJCF or URDF.

    Meshes are read from the robot's folder: the file's own, the one above if the file's is called
    urdf, xml or the like, and the ROS package that holds it. `package://name/` is the folder of
    this name above the file or beside one above it.

    Args:
        path: of the file; its content decides between the formats.
        with_sensors: leave the sensors of an MJCF in, for a task that reads them.

    Raises:
        ConfigError: the file or one that it names is missing, too large or elsewhere, has elements
            that a robot does not need, or MuJoCo refuses it. The message names the file.
    """
    path = user_path(path)
    root = read_xml(path)
    files, notes = AssetFiles(path), []
    if root.tag == "mujoco":
        _put_includes(root, path)
        _leave_out(root, notes, with_sensors)
        _check_elements(root, path)
        _take_mjcf_files(root, files, notes)
    elif root.tag == "robot":
        _keep_urdf_elements(root)
        _check_elements(root, path)
        _take_urdf_files(root, files, notes)
    else:
        tag = printable(root.tag[:40])
        raise ConfigError(
            f"{path}: begins with <{tag}>; expected a robot as MJCF (<mujoco>) or URDF (<robot>)"
        )
    try:
        text = ET.tostring(root, encoding="unicode")
        spec = mujoco.MjSpec.from_string(text, assets=files.contents)
    except (ValueError, mujoco.FatalError) as error:
        raise ConfigError(f"{path}: MuJoCo cannot read it: {one_line(error)}") from error
    _check_counts(spec, path)
    _allow_open_meshes(spec)
    if root.tag == "robot":
        notes += _repair_inertias(spec)
    return RobotFile(path, spec, tuple(notes))


def _check_counts(spec: mujoco.MjSpec, path: Path) -> None:
    for what, found, most in (
        ("bodies", len(spec.bodies) - 1, MAX_BODIES),
        ("joints", len(spec.joints), MAX_JOINTS),
        ("geoms", len(spec.geoms), MAX_GEOMS),
    ):
        if found > most:
            raise ConfigError(f"{path}: has {found} {what}; expected a robot of at most {most}")


def _allow_open_meshes(spec: mujoco.MjSpec) -> None:
    """Let meshes without volume be, where no inertia comes from them: MuJoCo refuses them."""
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


def _put_includes(root: ET.Element, path: Path) -> None:
    """Replace every <include> by the content of its file.

    As MuJoCo does, look beside the main file first, then beside the file that includes.
    """
    folders, seen = robot_folders(path), {path.resolve()}
    todo, elements = [(root, folders[0])], 0
    while todo:
        parent, folder = todo.pop()
        children: list[tuple[ET.Element, Path]] = []
        waiting = [(child, folder) for child in reversed(parent)]
        while waiting:
            child, folder = waiting.pop()
            if child.tag != "include":
                children.append((child, folder))
                continue
            name = child.get("file", "")
            what = f'{path}: <include file="{name}">'
            file = find_below(folders, [folders[0] / name, folder / name], what)
            if file in seen or len(seen) > _MAX_INCLUDES:
                raise ConfigError(f"{what} is included twice; expected every file once")
            seen.add(file)
            waiting += [(inner, file.parent) for inner in reversed(read_xml(file))]
            elements += len(waiting)
        if elements > MAX_ELEMENTS:
            raise ConfigError(f"{path}: has more than {MAX_ELEMENTS} elements")
        parent[:] = [child for child, _ in children]
        todo += children


def _check_elements(root: ET.Element, path: Path) -> None:
    """Refuse what a robot does not need and what could take much memory or time."""
    written = dict.fromkeys(_MOST_WRITTEN, 0.0)
    for element, copies, depth in _walk(root):
        if depth > MAX_DEPTH:
            raise ConfigError(f"{path}: elements are nested more than {MAX_DEPTH} deep")
        if element.tag in _REFUSED:
            raise ConfigError(f"{path}: has <{element.tag}>: {_REFUSED[element.tag]}")
        if any(abs(value) > _MAX_MESH_PARAMETER for value in _numbers(element, "params")):
            raise ConfigError(f"{path}: a <mesh> has params above {_MAX_MESH_PARAMETER}")
        for key in _SIZES:
            if any(size > _MAX_SIZE for size in _numbers(element, key)):
                raise ConfigError(f"{path}: <{element.tag}> has {key} above {_MAX_SIZE}")
        if element.tag == "texture":
            sides = [*_numbers(element, "width"), *_numbers(element, "height")]
            if any(side > _MAX_TEXTURE_SIDE for side in sides):
                raise ConfigError(f"{path}: a <texture> is larger than {_MAX_TEXTURE_SIDE} pixels")
        kind, number = _kind_of(element)
        written["elements"] += copies
        written[kind] += copies * number
        for what in ("elements", kind):
            if written[what] > _MOST_WRITTEN[what]:
                raise ConfigError(
                    f"{path}: describes more than {_MOST_WRITTEN[what]} {what}, with the copies of"
                    " <replicate>; expected one robot"
                )


def _kind_of(element: ET.Element) -> tuple[str, int]:
    """Return what an element is, of `_MOST_WRITTEN`, and how many of them."""
    if element.tag in ("actuator", "sensor"):
        return f"{element.tag}s", len(element)
    if element.tag == "mesh" and "builtin" in element.attrib:
        return "built-in meshes", 1
    kind = _KINDS.get(element.tag)
    return ("elements", 0) if kind is None else (kind, 1)


def _walk(root: ET.Element) -> Iterator[tuple[ET.Element, float, int]]:
    """Yield all elements, how often <replicate> makes each of them appear, and their depth."""
    waiting = [(root, 1.0, 1)]
    while waiting:
        element, copies, depth = waiting.pop()
        yield element, copies, depth
        if element.tag == "replicate":
            copies *= max([1.0, *_numbers(element, "count")])
        waiting += [(child, copies, depth + 1) for child in element]


def _numbers(element: ET.Element, key: str) -> Iterator[float]:
    """Yield the numbers of an attribute; MuJoCo complains of others."""
    for word in element.get(key, "").split():
        try:
            yield float(word)
        except ValueError:
            continue


# --- MJCF ----------------------------------------------------------------------------------------


def _take_mjcf_files(root: ET.Element, files: AssetFiles, notes: list[str]) -> None:
    """Read meshes and textures into `files`; leave out what a robot does not need."""
    folders = {"mesh": "", "texture": ""}
    strip = False
    for compiler in root.iter("compiler"):
        both = compiler.attrib.pop("assetdir", None)
        for kind, key in (("mesh", "meshdir"), ("texture", "texturedir")):
            folders[kind] = compiler.attrib.pop(key, both if both is not None else folders[kind])
        strip = compiler.attrib.pop("strippath", "false") == "true" or strip
    dropped: set[str] = set()
    for parent in list(root.iter()):
        for element in list(parent):
            if element.tag == "mesh" and "file" in element.attrib:
                name = element.attrib["file"]
                _take_mesh(element, "file", _stripped(name, strip), folders["mesh"], files)
                element.attrib.setdefault("name", PurePosixPath(name.replace("\\", "/")).stem)
            elif element.tag == "texture" and not _take_texture(
                element, folders["texture"], strip, files
            ):
                dropped.add(_texture_name(element))
                parent.remove(element)
    if dropped:
        notes.append(
            "left out textures that are no PNG files of the robot or too large:"
            f" {', '.join(sorted(dropped))}"
        )
        for material in root.iter("material"):
            if material.get("texture") in dropped:
                del material.attrib["texture"]
            for layer in [one for one in material if one.get("texture") in dropped]:
                material.remove(layer)
    _drop_unknown_materials(root, notes)


def _drop_unknown_materials(root: ET.Element, notes: list[str]) -> None:
    """Remove the names of materials that the file does not define: colours only."""
    known = {asset.get("name") for asset in root.findall("asset/material")}
    unknown = [
        element
        for element in root.iter()
        if element.tag in ("geom", "site", "spatial") and "material" in element.attrib
        if element.get("material") not in known
    ]
    names = sorted({element.attrib.pop("material") for element in unknown})
    if names:
        notes.append(f"left out materials that the file does not define: {listed(names)}")


def _leave_out(root: ET.Element, notes: list[str], with_sensors: bool) -> None:
    """Remove the sections that a robot does not need; sensors and skins with a note."""
    counts = {"sensor": 0, "skin": 0, "hfield": 0}
    for parent in list(root.iter()):
        for element in [child for child in parent if _is_left_out(child, with_sensors)]:
            parent.remove(element)
            if element.tag in counts:
                counts[element.tag] += len(element) if element.tag == "sensor" else 1
    notes += [f"left out of the file: {n} {tag}s" for tag, n in counts.items() if n]


def _is_left_out(element: ET.Element, with_sensors: bool) -> bool:
    if element.tag == "sensor" and with_sensors:
        return False
    is_terrain = element.tag == "geom" and "hfield" in (element.get("type"), *element.attrib)
    return element.tag in _LEFT_OUT or is_terrain


def _stripped(name: str, strip: bool) -> str:
    return PurePosixPath(name.replace("\\", "/")).name if strip else name


def _take_mesh(element: ET.Element, key: str, name: str, folder: str, files: AssetFiles) -> None:
    element.attrib.pop("content_type", None)
    element.set(key, files.read(files.find_mesh(name, folder)))


def _texture_name(element: ET.Element) -> str:
    files = (value for key, value in element.attrib.items() if key.startswith("file"))
    return element.get("name") or PurePosixPath(next(files, "")).stem


def _take_texture(element: ET.Element, folder: str, strip: bool, files: AssetFiles) -> bool:
    """Read a texture's picture; return whether MuJoCo gets the texture."""
    keys = [key for key in element.attrib if key.startswith("file")]
    element.attrib.pop("content_type", None)
    if not keys:
        return files.has_room_for(_builtin_texels(element))
    if keys != ["file"] or not element.attrib["file"].lower().endswith(".png"):
        return False
    name = element.attrib["file"]
    try:
        key = files.read(files.find(_stripped(name, strip), folder, "texture"))
    except ConfigError:
        return False
    if not files.has_room_for(png_texels(files.contents[key])):
        return False
    element.attrib.setdefault("name", _texture_name(element))
    element.set("file", key)
    return True


def _builtin_texels(element: ET.Element) -> float:
    width, height = (sum(_numbers(element, side)) for side in ("width", "height"))
    if element.get("type") == "2d":
        return width * height
    return 6.0 * width * width  # the sides of a cube, which MuJoCo makes of its width


# --- URDF ----------------------------------------------------------------------------------------


def _keep_urdf_elements(root: ET.Element) -> None:
    """Remove what other programs read (<gazebo>, <transmission>) and shapes without size."""
    root[:] = [child for child in root if child.tag in ("link", "joint", "material")]
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            sphere = shape.find("geometry/sphere")
            if sphere is not None and not any(_numbers(sphere, "radius")):
                link.remove(shape)


def _take_urdf_files(root: ET.Element, files: AssetFiles, notes: list[str]) -> None:
    """Read meshes into `files`, leave out visual ones that cannot be read, set the compiler."""
    hidden = []
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            mesh = shape.find("geometry/mesh")
            if mesh is None:
                continue
            name = mesh.get("filename", "")
            try:
                _take_mesh(mesh, "filename", name, "", files)
            except ConfigError:
                if shape.tag == "collision":
                    raise
                link.remove(shape)
                hidden.append(name)
    if hidden:
        notes.append(
            f"left out {len(hidden)} visual meshes that are missing or have a format that MuJoCo"
            f" does not read, the first '{printable(hidden[0])}'"
        )
    if root.find("link/collision") is None:
        notes.append("no collision shapes in the file: what it shows collides")
        for visual in root.iter("visual"):
            visual.tag = "collision"
    extension = ET.Element("mujoco")
    # Links on fixed joints stay bodies: feet and hands of many robots are such.
    settings = {"fusestatic": "false", "discardvisual": "false", "strippath": "false"}
    # Links without mass are common in URDF, and inertias that no solid has.
    least = {"boundmass": "1e-6", "boundinertia": f"{_LEAST_INERTIA:g}"}
    settings |= {"balanceinertia": "true", **least}
    ET.SubElement(extension, "compiler", settings)
    root.insert(0, extension)


def _repair_inertias(spec: mujoco.MjSpec) -> list[str]:
    """Make inertias positive that MuJoCo refuses, for it to balance; return a note on them."""
    repaired = []
    for body in spec.bodies:
        xx, yy, zz, xy, xz, yz = body.fullinertia
        if not np.isfinite(body.fullinertia).all():  # MuJoCo's mark of a body without one
            continue
        moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if moments.min() > 0:
            continue
        full = (axes * moments.clip(min=_LEAST_INERTIA)) @ axes.T
        body.fullinertia = [*full.diagonal(), full[0, 1], full[0, 2], full[1, 2]]
        repaired.append(body.name)
    return [f"repaired inertias that are not positive: {listed(repaired)}"] if repaired else []
