"""Loads one broken file and judges what happened; makes the broken files of a kind."""

from __future__ import annotations

import contextlib
import enum
import gc
import importlib
import io
import os
import random
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.fuzz.kinds import Kind
from benchmarks.fuzz.mutators import mutate_bytes
from isaacgymenvs_lite.errors import MAX_MESSAGE, UserError

_EXIT_USER_ERROR = 2
_CANARY = "canary"
_PREFIX = "error: "


class Verdict(enum.Enum):
    """What became of a file; everything but the first two is a defect."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    OTHER = "other"
    HANG = "hang"
    MEMORY = "memory"
    CODE = "code"


@dataclass(frozen=True)
class Limits:
    """What reading one file may take.

    Attributes:
        time_s: of the processor.
        memory_bytes: by which the process may grow.
    """

    time_s: float = 5.0
    memory_bytes: int = 2**30


@dataclass(frozen=True)
class Outcome:
    """What became of one file.

    Attributes:
        number: of the file within its kind.
        verdict: see there.
        message: the error, or what is wrong.
        time_s: of the processor.
        memory_bytes: by which the process grew.
    """

    number: int
    verdict: Verdict
    message: str = ""
    time_s: float = 0.0
    memory_bytes: int = 0

    @property
    def is_defect(self) -> bool:
        """Whether the reader neither returned nor raised a fitting error."""
        return self.verdict not in (Verdict.ACCEPTED, Verdict.REFUSED)


class _TooSlow(BaseException):
    """No reader catches it."""


class Examiner:
    """Writes the broken files of a kind into a folder of its own and has them read.

    Args:
        kind: of files.
        folder: empty.
        seed: of the changes.
        limits: of each file.

    Raises:
        UserError: a valid file of the kind is refused.
    """

    def __init__(self, kind: Kind, folder: Path, seed: int, limits: Limits) -> None:
        self._kind, self._seed, self._limits = kind, seed, limits
        folder.mkdir(parents=True, exist_ok=True)
        originals = list(kind.originals(folder))
        self._contents = [path.read_bytes() for path in originals]
        self._canary = folder / _CANARY
        self._hostile = _written_hostile(kind, self._canary)
        self._file = folder / f"input{kind.suffix}"
        self._base_bytes = 0
        for path in originals:  # imports what the reader needs, and proves that the files are valid
            kind.load(path)
        self._files = {*os.listdir(folder), self._file.name}

    @property
    def file(self) -> Path:
        """The file that is read."""
        return self._file

    @property
    def num_hostile(self) -> int:
        """The number of files made by hand; they have the first numbers."""
        return len(self._hostile)

    def name(self, number: int) -> str:
        """Return what a file made by hand is called; "" for the others."""
        return self._hostile[number].name if number < len(self._hostile) else ""

    def content(self, number: int) -> bytes:
        """Return the broken file of a number; the same for the same seed."""
        if number < len(self._hostile):
            return self._hostile[number].read_bytes()
        rng = random.Random(f"{self._seed}/{self._kind.name}/{number}")
        valid = rng.choice(self._contents)
        try:
            return self._kind.mutate(valid, rng, self._contents)
        except RecursionError:  # some files are too deep for the writers of others
            return mutate_bytes(valid, rng, self._contents)

    def load(self, number: int) -> Outcome:
        """Have the public reader read the file of a number, in this process."""
        return self._judged(number, lambda: self._load(number))

    def command(self, number: int) -> Outcome:
        """Have the kind's command read the file of a number, in this process."""
        return self._judged(number, self._command)

    def _load(self, number: int) -> tuple[Verdict, str]:
        try:
            self._kind.load(self._file)
        except UserError as error:
            message = str(error)
            return self._fitting(message)
        return Verdict.ACCEPTED, ""

    def _fitting(self, message: str) -> tuple[Verdict, str]:
        """Judge the text of an error."""
        if len(message) > MAX_MESSAGE:
            return Verdict.OTHER, f"an error of {len(message)} characters: {message}"
        if not message.isprintable():
            return Verdict.OTHER, f"an error of several lines or with control characters: {message}"
        if self._kind.names_file and self._file.name not in message:
            return Verdict.OTHER, f"an error that does not name the file: {message}"
        return Verdict.REFUSED, message

    def _command(self) -> tuple[Verdict, str]:
        assert self._kind.command is not None
        return self.judge_command(*_run_in_process(self._kind.command(self._file)))

    def judge_command(self, code: int, stderr: str) -> tuple[Verdict, str]:
        """Judge the exit code of a command and what it wrote to stderr."""
        if code == 0:
            return Verdict.ACCEPTED, ""
        errors = [line for line in stderr.splitlines() if line.startswith(_PREFIX)]
        if code != _EXIT_USER_ERROR or len(errors) != 1 or "Traceback" in stderr:
            return Verdict.OTHER, f"exit code {code}: {stderr}"
        return self._fitting(errors[0].removeprefix(_PREFIX))

    def _judged(self, number: int, read: Any) -> Outcome:
        self._file.write_bytes(self.content(number))
        if not self._base_bytes:
            gc.collect()
            self._base_bytes = _resident_bytes("VmRSS")
        _reset_peak()
        # The process may have given memory back since the first file.
        base_bytes = min(self._base_bytes, _resident_bytes("VmRSS"))
        start_s = time.process_time()
        try:
            with _time_limit(self._limits.time_s), _recorded_warnings() as recorded:
                verdict, message = read()
            if recorded:
                verdict, message = Verdict.OTHER, f"a warning: {recorded[0].message}"
        except _TooSlow:
            where = traceback.format_exc().strip().splitlines()
            verdict, message = Verdict.HANG, "; ".join(line.strip() for line in where[-6:-1])
        except Exception:
            verdict, message = Verdict.OTHER, traceback.format_exc()
        spent_s = time.process_time() - start_s
        grown = max(0, _resident_bytes("VmHWM") - base_bytes)
        if grown > self._limits.memory_bytes:
            verdict, message = Verdict.MEMORY, f"{grown / 2**20:.0f} MiB; {message}"
        if self._canary.exists():
            self._canary.unlink()
            verdict, message = Verdict.CODE, "code of the file was run"
        if extra := set(os.listdir(self._file.parent)) - self._files:
            verdict, message = Verdict.OTHER, f"wrote {', '.join(sorted(extra))}"
            self._files |= extra
        return Outcome(number, verdict, message, spent_s, grown)


def _written_hostile(kind: Kind, canary: Path) -> list[Path]:
    """Return the kind's hostile files, made once: some are large, and slow to make."""
    folder = canary.parent.with_name(f"{canary.parent.name}_hostile")
    if not folder.exists():
        folder.mkdir()
        for number, (name, content) in enumerate(kind.hostile(canary)):
            (folder / f"{number:03}_{name}").write_bytes(content)
    return sorted(folder.iterdir())


def _run_in_process(words: list[str]) -> tuple[int, str]:
    """Run `python -m WORDS` in this process; returns the exit code and what it wrote to stderr."""
    stderr = io.StringIO()
    argv, sys.argv = sys.argv, list(words)
    try:
        with contextlib.redirect_stderr(stderr), contextlib.redirect_stdout(io.StringIO()):
            return int(importlib.import_module(words[0]).main() or 0), stderr.getvalue()
    except SystemExit as end:
        if isinstance(end.code, str):
            return 1, end.code
        return int(end.code or 0), stderr.getvalue()
    finally:
        sys.argv = argv


@contextlib.contextmanager
def _time_limit(time_s: float) -> Iterator[None]:
    """Raise `_TooSlow` after so many seconds of the processor."""

    def stop(_signal: int, _frame: Any) -> None:
        raise _TooSlow

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, time_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


@contextlib.contextmanager
def _recorded_warnings() -> Iterator[list[warnings.WarningMessage]]:
    """Record Python's warnings: each would be two more lines than one."""
    with warnings.catch_warnings(record=True) as recorded:
        warnings.simplefilter("always")
        for hidden in (ResourceWarning, DeprecationWarning):  # Python shows neither
            warnings.simplefilter("ignore", hidden)
        yield recorded


def _reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _resident_bytes(field: str) -> int:
    status = Path("/proc/self/status").read_text()
    line = next(line for line in status.splitlines() if line.startswith(f"{field}:"))
    return int(line.split()[1]) * 1024


def limit_address_space(limits: Limits) -> None:
    """Keep this process from taking more than twice what a file may take."""
    allowed = _resident_bytes("VmSize") + 2 * limits.memory_bytes
    resource.setrlimit(resource.RLIMIT_AS, (allowed, allowed))
