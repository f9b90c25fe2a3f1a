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
    """Escapes control characters in messages; the name of a stranger's folder may contain them."""

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
    """Send the messages of the log to stderr."""
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
    """Read `key=value` arguments into settings, call `action(settings)` and return the exit code.

    The messages of the log go to stderr. The exit code is 2 after a user's mistake and 130 after
    Ctrl-C.

    Args:
        parser: a parser that may have other options and arguments; `key=value` arguments are added
            to it.
        cls: a dataclass, see `schema.setting`.
        action: receives the settings.
        arguments: the arguments after the program's name; None means those in `sys.argv`.
        words: receives the parser's other options and arguments before the action runs.
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
    """Read `["key=value", ...]` with YAML's values into a settings dataclass.

    Raises:
        ConfigError: an argument lacks =, a key is unknown, or a value cannot be used.
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
