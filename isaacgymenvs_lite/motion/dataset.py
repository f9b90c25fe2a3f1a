"""Data sets of clips: a YAML file that lists motion files and how often to sample each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from isaacgymenvs_lite.errors import ConfigError, MotionFileError, suggest
from isaacgymenvs_lite.motion.formats.files import reading
from isaacgymenvs_lite.utils.yaml_file import load_yaml

_ENTRY_KEYS = ("file", "weight")
# Sums of weights in this range are exact enough, also of many.
_MIN_WEIGHT, _MAX_WEIGHT = 1e-12, 1e12
_EXAMPLE = 'expected `motions:` with a list of `- {file: "clip.npz", weight: 0.5}`'


@dataclass(frozen=True)
class DatasetEntry:
    """One clip of a data set: its file as written there, and its weight >= 0 (not normalised)."""

    file: str
    weight: float


def read_dataset(path: str | Path) -> list[DatasetEntry]:
    """Read the entries of the data set at `path`, in the order of the file.

    Raises:
        MotionFileError: the file is no readable YAML, has no list `motions`, an entry has unknown
            or missing keys or a weight that is not a number >= 0, or all weights are 0.
    """
    with reading(path, "data set of clips"):
        return _entries(path)


def _entries(path: str | Path) -> list[DatasetEntry]:
    try:
        data = load_yaml(Path(path))
    except ConfigError as error:
        raise MotionFileError(f"{error}; {_EXAMPLE}") from error
    motions = data.get("motions") if isinstance(data, dict) else None
    if not isinstance(motions, list) or not motions:
        found = list(data) if isinstance(data, dict) else type(data).__name__
        raise MotionFileError(f"{path}: has no list of motions (found {found}); {_EXAMPLE}")
    _refuse_unknown(data, ("motions",), str(path))
    entries = [_entry(item, f"{path}: motions[{i}]") for i, item in enumerate(motions)]
    if sum(entry.weight for entry in entries) <= 0.0:
        raise MotionFileError(f"{path}: all {len(entries)} weights are 0, expected one above 0")
    return entries


def _entry(item: Any, where: str) -> DatasetEntry:
    if not isinstance(item, dict):
        raise MotionFileError(f"{where} is {item!r}, expected the keys file and weight")
    _refuse_unknown(item, _ENTRY_KEYS, where)
    for key in _ENTRY_KEYS:
        if key not in item:
            raise MotionFileError(f"{where} lacks the key '{key}', found {sorted(item)}")
    if not isinstance(item["file"], str) or not item["file"]:
        raise MotionFileError(f"{where}: file is {item['file']!r}, expected the name of a file")
    return DatasetEntry(item["file"], _weight(item["weight"], f"{where} ('{item['file']}')"))


def _weight(value: Any, where: str) -> float:
    try:
        # YAML 1.1 reads 2e-5 (no dot) as text: accept it.
        weight = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        weight = math.nan
    if weight != 0.0 and not _MIN_WEIGHT <= weight <= _MAX_WEIGHT:
        raise MotionFileError(
            f"{where}: weight is {value!r}, expected a number: 0, or {_MIN_WEIGHT:g} to "
            f"{_MAX_WEIGHT:g}"
        )
    return weight


def _refuse_unknown(data: dict[Any, Any], known: tuple[str, ...], where: str) -> None:
    for key in data:
        if key not in known:
            raise MotionFileError(
                f"{where}: unknown key '{key}'{suggest(str(key), known)}; "
                f"expected {' and '.join(known)}"
            )
