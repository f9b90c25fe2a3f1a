"""XML files of strangers: limited in size and depth, without entities, confined to folders."""

from __future__ import annotations

import xml.etree.ElementTree as ET  # the parser below refuses what makes it unsafe
from collections.abc import Iterable
from pathlib import Path

from isaacgymenvs_lite.errors import ConfigError, one_line

MAX_TEXT_BYTES = 2**23
"""Of one XML file; the largest robots of public collections have 1 MiB."""
MAX_ELEMENTS = 50_000
MAX_DEPTH = 120
# The folder of such a name is a part of the robot's folder, as in ROS packages.
_PARTS_OF_A_ROBOT = ("urdf", "urdfs", "xml", "mjcf", "xacro")
_MAX_LEVELS = 6


class _Builder(ET.TreeBuilder):
    """Builds the tree and refuses document types, which may define entities, and endless nests."""

    def __init__(self) -> None:
        super().__init__()
        self.depth = self.elements = 0

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse any document type: the parser calls this before it reads the entities."""
        raise ValueError("it has a document type (<!DOCTYPE>), which no robot needs: remove it")

    def start(self, tag: str, attrs: dict[str, str]) -> ET.Element:
        """Count elements and depth."""
        self.depth += 1
        self.elements += 1
        if self.depth > MAX_DEPTH:
            raise ValueError(f"elements are nested more than {MAX_DEPTH} deep")
        if self.elements > MAX_ELEMENTS:
            raise ValueError(f"it has more than {MAX_ELEMENTS} elements")
        return super().start(tag, attrs)

    def end(self, tag: str) -> ET.Element:
        """Count depth."""
        self.depth -= 1
        return super().end(tag)


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Return the content of a file.

    Raises:
        ConfigError: it is missing, no ordinary file, cannot be read or is longer than `max_bytes`.
    """
    try:
        if not path.is_file():
            raise ConfigError(f"{path}: no such file")
        with path.open("rb") as stream:
            content = stream.read(max_bytes + 1)
    except (OSError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{path}: cannot be read ({one_line(error)})") from error
    if len(content) > max_bytes:
        raise ConfigError(
            f"{path}: is longer than {max_bytes / 2**20:g} MiB, too large for a robot"
        )
    return content


def read_xml(path: Path) -> ET.Element:
    """Return the root element of an XML file.

    Raises:
        ConfigError: the file is missing, too long, too deep, has a document type or is no XML.
    """
    content = read_bytes(path, MAX_TEXT_BYTES)
    parser = ET.XMLParser(target=_Builder())
    try:
        parser.feed(content.strip(b" \t\r\n\0"))  # some tools end a text with a zero
        return parser.close()
    except (ET.ParseError, ValueError, LookupError) as error:
        raise ConfigError(f"{path}: is no XML of a robot ({one_line(error)})") from error


def robot_folders(path: Path) -> tuple[Path, ...]:
    """Return the folders that files of a robot may be in: its own, and its package's.

    Args:
        path: of the robot's main file.
    """
    folder = path.resolve().parent
    found = [folder]
    if folder.name.lower() in _PARTS_OF_A_ROBOT and folder.parent != folder.parent.parent:
        found.append(folder.parent)
    found += [up for up in _upwards(folder) if (up / "package.xml").is_file()][:1]
    return tuple(found)


def find_below(folders: Iterable[Path], tried: Iterable[Path], what: str) -> Path:
    """Return the first of the paths `tried` that is a file below one of the folders.

    Links are followed before the check.

    Args:
        folders: resolved ones, in which files may be.
        tried: where the file may be.
        what: "mesh 'foot.stl' of robot.urdf", for messages.

    Raises:
        ConfigError: there is no such file, or it is elsewhere.
    """
    folders, looked = tuple(folders), []
    for path in tried:
        try:
            real = path.resolve()
            if real.is_file():
                if any(real.is_relative_to(folder) for folder in folders):
                    return real
                raise ConfigError(
                    f"{what} is outside of the robot's folder, {folders[-1]}: copy it there"
                )
        except (OSError, ValueError, RuntimeError) as error:  # a name too long, a circle of links
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"{what}: no path of a file ({one_line(error)})") from error
        looked.append(str(path))
    raise ConfigError(f"{what} is missing; looked for {', '.join(dict.fromkeys(looked))}")


def package_paths(uri: str, path: Path) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Return where a file of `package://name/rest` may be, and the folders that it may be below.

    The package is a folder of that name above the robot's file or beside one above it; files that
    were copied without their package are looked for as `rest` in the folders above.

    Args:
        uri: `name/rest`, also with a slash before it.
        path: of the robot's main file.
    """
    name, _, rest = uri.lstrip("/").partition("/")
    ups = _upwards(path.resolve().parent)
    packages = [up for up in ups if up.name == name]
    packages += [up / name for up in ups if name not in ("", ".", "..") and (up / name).is_dir()]
    packages = [package.resolve() for package in packages]
    bases = [*packages, *ups[:3]]
    return tuple(base / rest for base in bases), tuple(bases)


def _upwards(folder: Path) -> list[Path]:
    """Return a folder and those above it, some levels and never the whole disk."""
    return [up for up in (folder, *folder.parents)[:_MAX_LEVELS] if up != up.parent]
