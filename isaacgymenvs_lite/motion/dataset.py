"""Data sets of clips: a YAML file that lists motion files and how often to sample each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from isaacgymenvs_lite.errors import ConfigError, MotionFileError
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.schema import read_section, setting
from isaacgymenvs_lite.utils.yaml_file import load_yaml

_EXAMPLE = 'expected `motions:` with a list of `- {file: "clip.npz", weight: 0.5}`'


@dataclass(frozen=True)
class _Dataset:
    """The file."""

    motions: list[Any] = setting(min_length=1)


@dataclass(frozen=True)
class DatasetEntry:
    """One clip of a data set: its file as written there, and its weight (not normalised)."""

    file: str = setting()
    weight: float = setting(minimum=0, maximum=1e12)


def read_dataset(path: str | Path) -> list[DatasetEntry]:
    """Read the entries of the data set at `path`, in the order of the file.

    Raises:
        MotionFileError: the file is no readable YAML, has no list `motions`, an entry has unknown
            or missing keys or a weight that is not a number >= 0, or all weights are 0.
    """
    with reading(path, "data set of clips"):
        try:
            data = load_yaml(Path(path))
        except ConfigError as error:
            raise MotionFileError(f"{error}; {_EXAMPLE}") from error
        try:
            motions = read_section(_Dataset, data, "", complete=True).motions
            entries = [
                read_section(DatasetEntry, entry, f"motions[{i}]", complete=True)
                for i, entry in enumerate(motions)
            ]
        except ConfigError as error:
            raise MotionFileError(f"{path}: {error}; {_EXAMPLE}") from error
        if sum(entry.weight for entry in entries) <= 0.0:
            raise MotionFileError(f"{path}: all {len(entries)} weights are 0, expected one above 0")
        return entries
