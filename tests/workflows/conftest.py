"""The libraries that are installed, and their command line."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Callable
from pathlib import Path

import pytest

from isaacgymenvs_lite.workflows.__main__ import main
from isaacgymenvs_lite.workflows.library import LIBRARIES
from tests.tiny import fast_and_slow

Command = Callable[..., str]


@pytest.fixture(params=fast_and_slow({name: name for name in LIBRARIES}, "sb3"))
def library(request: pytest.FixtureRequest) -> str:
    """Each library that is installed."""
    if importlib.util.find_spec(LIBRARIES[request.param]) is None:
        pytest.skip(f"{request.param} is not installed")
    return request.param


def _commanding(verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Command:
    """Return a runner of a verb that adds task and logs, unless the words have them."""
    defaults = {"task": "Cartpole", "logs": str(tmp_path / "logs")}

    def run(library: str, *words: str) -> str:
        given = {word.lstrip("-").partition("=")[0] for word in words}
        added = [f"{key}={value}" for key, value in defaults.items() if key not in given]
        capsys.readouterr()
        assert main([library, verb, *added, *words]) == 0
        return capsys.readouterr().out

    return run


@pytest.fixture
def run_train(tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog) -> Command:
    """Return `run_train(library, *words)`, which trains Cartpole below tmp_path/logs."""
    caplog.set_level(logging.INFO)
    return _commanding("train", tmp_path, capsys)


@pytest.fixture
def run_play(tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog) -> Command:
    """Return `run_play(library, *words)`, which returns what it prints about the episodes."""
    caplog.set_level(logging.INFO)
    return _commanding("play", tmp_path, capsys)


@pytest.fixture
def fails(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Return `fails(run, library, *words)`, which returns the one line of a user's mistake."""

    def run_wrong(run: Command, library: str, *words: str) -> str:
        with pytest.raises(SystemExit) as stopped:
            run(library, *words)
        assert stopped.value.code == 2
        line = capsys.readouterr().err.strip().splitlines()[-1]
        assert line.startswith("error: ")
        return line

    return run_wrong
