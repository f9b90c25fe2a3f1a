"""Runs commands that take `key=value` words: isaacgymenvs-lite demo key=value ..."""

from __future__ import annotations

import argparse
import copy
import dataclasses
import logging
from collections.abc import Callable, Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING, TypeVar

from omegaconf import OmegaConf
from yaml import YAMLError

from isaacgymenvs_lite.errors import (
    EXIT_INTERRUPTED,
    EXIT_USER_ERROR,
    ConfigError,
    UserError,
    printable,
    unknown,
)
from isaacgymenvs_lite.schema import read_section

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")


class EscapingFormatter(logging.Formatter):
    """Escapes control characters in the texts and paths of a message.

    A stranger's run folder may have them in its name.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return the message."""
        if isinstance(record.args, tuple):
            record = copy.copy(record)
            record.args = tuple(
                printable(str(value)) if isinstance(value, (str, PurePath)) else value
                for value in record.args or ()
            )
        return super().format(record)


def log_messages() -> None:
    """Send the log to stderr, messages only."""
    handler = logging.StreamHandler()
    handler.setFormatter(EscapingFormatter())
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def run_command(
    parser: argparse.ArgumentParser,
    cls: type[T],
    action: Callable[[T], object],
    arguments: Sequence[str] | None = None,
    words: argparse.Namespace | None = None,
) -> int:
    """Read `key=value` words into settings and call `action` with them; return the exit code.

    The log goes to stderr, messages only. A user's mistake is one line and exit code 2; Ctrl-C
    ends with 130.

    Args:
        parser: may have options and words of its own; the settings are added to it.
        cls: a dataclass, see `schema.setting`.
        action: receives the settings.
        arguments: without the program's name; None = `sys.argv`.
        words: is filled with the parser's own options and words before the action runs.
    """
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("settings", nargs="*", default=[], metavar="key=value")
    given = parser.parse_args(arguments, words or argparse.Namespace()).settings
    log_messages()
    try:
        action(read_settings(cls, given))
    except UserError as error:
        parser.exit(EXIT_USER_ERROR, f"error: {error}\n")
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return 0


def read_settings(cls: type[T], words: Sequence[str]) -> T:
    """Read `["key=value", ...]`, values as in YAML, into a settings dataclass.

    Raises:
        ConfigError: a word without =, an unknown key, or a value that cannot be used.
    """
    known = [field.name for field in dataclasses.fields(cls)]
    for word in words:
        key, equals, _ = word.partition("=")
        if not equals:
            raise ConfigError(f"'{word}': expected key=value; keys: {', '.join(known)}")
        if key not in known:
            raise ConfigError(unknown("key", key, known))
    try:
        values = OmegaConf.from_dotlist(list(words))
    except YAMLError as error:
        raise ConfigError(f"{' '.join(words)}: a value is not valid YAML") from error
    return read_section(cls, values, where="", complete=True)
