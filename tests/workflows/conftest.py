"""The libraries that are installed, and their command lines."""

from __future__ import annotations

import importlib.util
import logging
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from isaacgymenvs_lite.workflows.library import Library
from isaacgymenvs_lite.workflows.playing import play
from isaacgymenvs_lite.workflows.rsl_rl import LIBRARY as RSL_RL
from isaacgymenvs_lite.workflows.sb3 import LIBRARY as SB3
from isaacgymenvs_lite.workflows.skrl import LIBRARY as SKRL
from isaacgymenvs_lite.workflows.training import train

LIBRARIES = {library.name: library for library in (SB3, SKRL, RSL_RL)}


@pytest.fixture(params=sorted(LIBRARIES))
def library(request: pytest.FixtureRequest) -> Library:
    """Each library that is installed."""
    found = LIBRARIES[request.param]
    if importlib.util.find_spec(found.package) is None:
        pytest.skip(f"{found.package} is not installed")
    return found


Command = Callable[..., str]


def _commanding(
    verb: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Command:
    def run(library: Library, *words: str) -> str:
        capsys.readouterr()
        assert verb(library, ["--task", "Cartpole", "--logs", str(tmp_path / "logs"), *words]) == 0
        return capsys.readouterr().out

    return run


@pytest.fixture
def run_train(tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog) -> Command:
    """Return `run_train(library, *words)`, which trains Cartpole below tmp_path/logs."""
    caplog.set_level(logging.INFO)
    return _commanding(train, tmp_path, capsys)


@pytest.fixture
def run_play(tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog) -> Command:
    """Return `run_play(library, *words)`, which returns what it says of the episodes."""
    caplog.set_level(logging.INFO)
    return _commanding(play, tmp_path, capsys)


@pytest.fixture
def fails(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Return `fails(run, library, *words)`, which returns the one line of a user's mistake."""

    def run_wrong(run: Command, library: Library, *words: str) -> str:
        with pytest.raises(SystemExit) as stopped:
            run(library, *words)
        assert stopped.value.code == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert re.match("error: ", lines[-1])
        return lines[-1]

    return run_wrong
