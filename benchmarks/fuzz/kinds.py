"""The kinds of files that `benchmarks.fuzz` breaks, and where they are listed.

A kind is an entry in `KINDS` of one of the modules in `_MODULES`.
"""

from __future__ import annotations

import importlib
import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.fuzz.mutators import mutate_bytes

_MODULES = (
    "benchmarks.fuzz.clips",
    "benchmarks.fuzz.robots",
    "benchmarks.fuzz.trees",
    "benchmarks.fuzz.checkpoints",
)

Mutator = Callable[[bytes, random.Random, Sequence[bytes]], bytes]
"""Gets a valid file, a generator, and all valid files of the kind; returns a broken one."""


def _nothing(_canary: Path) -> Iterable[tuple[str, bytes]]:
    return ()


@dataclass(frozen=True)
class Kind:
    """A kind of files, how valid ones are made, and which reader reads them.

    Attributes:
        name: on the command line and in the table.
        suffix: of the files, with its dot.
        originals: writes valid files, and what they refer to, into a folder; returns those that
            are to be broken. A broken file lies in the same folder.
        load: the public reader; it returns, or raises a UserError that names the file.
        mutate: breaks a file.
        hostile: yields names and contents of files made by hand; gets the path of a canary, a file
            that code in them has to create.
        command: returns the words behind `python -m` that read a file: a module with `main()`,
            then its arguments. None: the kind is read by no command of its own.
        names_file: errors name the file; False where they name a setting.
    """

    name: str
    suffix: str
    originals: Callable[[Path], Sequence[Path]]
    load: Callable[[Path], object]
    mutate: Mutator = mutate_bytes
    hostile: Callable[[Path], Iterable[tuple[str, bytes]]] = _nothing
    command: Callable[[Path], list[str]] | None = None
    names_file: bool = True


def all_kinds() -> dict[str, Kind]:
    """Return all kinds by name."""
    kinds = [kind for module in _MODULES for kind in importlib.import_module(module).KINDS]
    return {kind.name: kind for kind in kinds}
