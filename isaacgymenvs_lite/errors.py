"""Errors for users, one line each.

Every mistake that a user can make on the command line, in a YAML file or in an input file raises a
`UserError`. The command line shows its message as one line and exits with code 2; as a library
they are ordinary exceptions. A message has what was given, what was expected and what to do next.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

MAX_MESSAGE = 2000
"""Characters of a message. Of a longer one the middle is left out: the beginning has the file or
the key, the end what to do next."""
_KEPT_END = 160
EXIT_USER_ERROR = 2
"""Exit status of every command after a user's mistake."""
EXIT_INTERRUPTED = 130
"""Exit status of every command that Ctrl-C ends, as shells expect."""


class UserError(Exception):
    """Base of all errors that a user can cause and mend.

    The message may quote a stranger's file: it is shown on one line, without control characters
    (which could write to a terminal), and of at most `MAX_MESSAGE` characters.
    """

    def __str__(self) -> str:
        message = printable(" ".join(super().__str__().splitlines()))
        if len(message) <= MAX_MESSAGE:
            return message
        gap = " ... "
        kept = MAX_MESSAGE - _KEPT_END - len(gap)
        return f"{message[:kept]}{gap}{message[-_KEPT_END:]}"


class ConfigError(UserError, ValueError):
    """A key or a value of the configuration is unknown, missing or out of range."""


class DeviceError(UserError, ValueError):
    """A device is named that this machine does not have."""


class MotionFileError(UserError, ValueError):
    """A motion clip or a dataset of clips cannot be used."""


class CheckpointError(UserError, ValueError):
    """A checkpoint is missing, damaged, unsafe or of another network."""


class NotFiniteError(UserError, ArithmeticError):
    """Numbers of a training are nan or infinite; it cannot go on."""


class JobError(UserError):
    """A job of a sweep has failed; the message is the reason.

    It is made of its message alone, so that it can come from another process.
    """


class SweepError(JobError):
    """The settings of a sweep do not fit any of its jobs: the sweep ends."""


class StoppedAtOnceError(KeyboardInterrupt):
    """The user ended a training in the middle of an epoch, with a second Ctrl-C or SIGTERM.

    Attributes:
        exit_status: what the process ends with, as shells expect it after this signal.
    """

    def __init__(self, signal_number: int) -> None:
        super().__init__()
        self.exit_status = 128 + signal_number


class PeerError(UserError):
    """Another process of a data-parallel training has gone; its own error is the cause."""


class PeerMistakeError(PeerError):
    """Another process of a data-parallel training ends with an error, and all do."""


class WrapperError(UserError, TypeError):
    """An adapter got something else than a task."""


class OverrideError(UserError, AttributeError):
    """A subclass defines what nothing calls or reads here, or sets what is only read."""


class MissingPackageError(UserError, ImportError):
    """A package is missing that an extra of this package installs."""


class UnavailableError(UserError, NotImplementedError):
    """A published name can be imported, but what it does is not part of this version."""


def printable(text: str) -> str:
    """Return a text of a file without control characters: they are written as escapes."""
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in text)


def one_line(error: BaseException | str) -> str:
    """Return the message of an error on one line."""
    return " ".join(str(error).split())


def listed(names: Sequence[str], most: int = 8) -> str:
    """Return the first names, and how many more there are."""
    shown = ", ".join(names[:most]) or "none"
    return shown + (f" and {len(names) - most} more" if len(names) > most else "")


def suggest(given: str, choices: Iterable[str]) -> str:
    """Return " (did you mean 'x'?)" for the nearest of `choices`, or "" if none is near."""
    names = [str(choice) for choice in choices]
    near = [name for name in names if name.lower() == str(given).lower()]
    near = near or difflib.get_close_matches(str(given), names, n=1)
    return f" (did you mean '{near[0]}'?)" if near else ""


def unknown(what: str, given: str, choices: Iterable[str], next_step: str = "") -> str:
    """Return the message for a name that is none of `choices`.

    >>> unknown("task", "Humanoid", ["HumanoidAMP"])
    "unknown task 'Humanoid' (did you mean 'HumanoidAMP'?); choices: HumanoidAMP"
    """
    choices = sorted(str(choice) for choice in choices)
    listed = ", ".join(choices) or "none"
    message = f"unknown {what} '{given}'{suggest(given, choices)}; choices: {listed}"
    return f"{message}; {next_step}" if next_step else message
