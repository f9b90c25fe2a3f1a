"""`python -m isaacgymenvs_lite`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from isaacgymenvs_lite.__main__ import COMMANDS, DOORS, main, purpose


def runnable() -> set[str]:
    """Modules below the package that `python -m` runs."""
    package = Path(sys.modules[main.__module__].__file__ or "").parent
    return {
        ".".join(file.relative_to(package).with_suffix("").parts).removesuffix(".__main__")
        for file in package.rglob("*.py")
        if '\nif __name__ == "__main__"' in file.read_text(encoding="utf-8")
    }


def test_every_command_is_listed_with_what_it_does():
    command = [sys.executable, "-m", "isaacgymenvs_lite"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert {*COMMANDS, *DOORS} == runnable() - {"__main__"}
    for name in COMMANDS:
        (line,) = (line for line in result.stdout.splitlines() if line.split()[:1] == [name])
        assert line.split(None, 1)[1] == purpose(name)
        assert "python" not in line


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("dmo", "unknown command 'dmo' (did you mean 'demo'?)"),
        ("demo", "'demo' is a module: python -m isaacgymenvs_lite.demo"),
        (
            "workflows.sb3.train",
            "'workflows.sb3.train' is a module: python -m isaacgymenvs_lite.workflows.sb3.train",
        ),
    ],
)
def test_a_word_is_a_mistake_in_one_line(word, message, capsys):
    with pytest.raises(SystemExit) as caught:
        main([word])
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {message}")
