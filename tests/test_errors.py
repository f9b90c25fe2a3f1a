"""Messages for users: one line without control characters, of a bounded length."""

from __future__ import annotations

import pytest

from isaacgymenvs_lite.errors import MAX_MESSAGE, ConfigError, MissingPackageError


@pytest.mark.parametrize("kind", [ConfigError, MissingPackageError])
def test_a_long_message_keeps_its_beginning_and_its_end(kind: type[Exception]) -> None:
    text = str(kind(f"file.yaml: got {'x' * 5000}, expected a number"))
    assert len(text) == MAX_MESSAGE
    assert text.startswith("file.yaml: got x")
    assert text.endswith("x, expected a number")


def test_a_message_is_one_line_that_controls_no_terminal() -> None:
    assert str(ConfigError("a\n\x1b[31mb\u202ec")) == "a \\x1b[31mb\\u202ec"
