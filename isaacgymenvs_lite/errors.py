"""Errors for users, one line each.

A mistake on the command line, in a YAML file or in an input file raises a `UserError`. Commands
print the message of the error on one line and exit with code 2; a program can catch the error like
any exception. A message says what was given, what was expected and what to do next.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

MAX_MESSAGE = 2000
"""Largest number of characters of a message. The middle of a longer message is cut out, because its
beginning names the file or the key and its end names what to do next."""
_KEPT_END = 160
EXIT_USER_ERROR = 2
"""Exit status of every command after a user's mistake."""
EXIT_INTERRUPTED = 130
"""Exit status of every command after Ctrl-C, as shells expect."""


class UserError(Exception):
    """Base of all errors that a user can cause and mend.

    The message may quote a stranger's file. Therefore the printed message is one line of at most
    `MAX_MESSAGE` characters without control characters, which could change the state of a terminal.
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
    """A setting names a device that this machine lacks."""


class MotionFileError(UserError, ValueError):
    """A motion clip or a dataset of clips cannot be used."""


class CheckpointError(UserError, ValueError):
    """A checkpoint is missing, damaged, unsafe or belongs to another network."""


class NotFiniteError(UserError, ArithmeticError):
    """Values of a training are NaN or infinite, so that the training cannot continue."""


class JobError(UserError):
    """A job of a sweep has failed; the message gives the reason.

    The message is the only argument, so that the error can be pickled.
    """


class SweepError(JobError):
    """The settings of a sweep are wrong for all of its jobs, so that the sweep ends."""


class StoppedAtOnceError(KeyboardInterrupt):
    """The user ended a training in the middle of an epoch, with a second Ctrl-C or SIGTERM.

    Attributes:
        exit_status: the exit status of the process that shells expect after this signal.
    """

    def __init__(self, signal_number: int) -> None:
        super().__init__()
        self.exit_status = 128 + signal_number


class PeerError(UserError):
    """Another process of a data-parallel training has ended because of its own error."""


class PeerMistakeError(PeerError):
    """Another process of a data-parallel training has reported a mistake; all processes end."""


class WrapperError(UserError, TypeError):
    """A wrapper received an object that is not a task."""


class OverrideError(UserError, AttributeError):
    """A subclass defines a member that this project never uses, or sets a read-only member."""


class MissingPackageError(UserError, ImportError):
    """An optional package is not installed; an extra of this project installs it."""


class UnavailableError(UserError, NotImplementedError):
    """A published name can be imported, but this version does not implement it."""


def printable(text: str) -> str:
    """Return a text with its control characters written as escapes."""
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in text)


def one_line(error: BaseException | str) -> str:
    """Return the message of an error on one line."""
    return " ".join(str(error).split())


def listed(names: Sequence[str], most: int = 8) -> str:
    """Return a text with the first `most` names and the number of further names."""
    shown = ", ".join(names[:most]) or "none"
    return shown + (f" and {len(names) - most} more" if len(names) > most else "")


def suggest(given: str, choices: Iterable[str]) -> str:
    """Return " (did you mean 'x'?)" for the most similar of `choices`, or "" if none is similar."""
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
