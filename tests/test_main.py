"""`python -m isaacgymenvs_lite` and `isaacgymenvs-lite`."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from isaacgymenvs_lite.__main__ import COMMANDS, DOORS, main, purpose, words_of_play


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
    assert {*COMMANDS.values(), *DOORS} == runnable() - {"__main__"}
    for name in COMMANDS:
        (line,) = (line for line in result.stdout.splitlines() if line.split()[:1] == [name])
        assert line.split(None, 1)[1] == purpose(name)
        assert "python" not in line


@pytest.fixture(params=[pytest.param("module", marks=pytest.mark.slow), "console script"])
def program(request: pytest.FixtureRequest, tmp_path: Path) -> list[str]:
    """The two ways to the commands; the script is what an installer writes."""
    if request.param == "module":
        return [sys.executable, "-m", "isaacgymenvs_lite"]
    script = tmp_path / "bin" / "isaacgymenvs-lite"
    script.parent.mkdir()
    script.write_text(
        f"#!{sys.executable}\nimport sys\nfrom isaacgymenvs_lite.__main__ import main\n"
        "sys.exit(main())\n"
    )
    script.chmod(0o755)
    return [str(script)]


def run(*command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    return subprocess.run(
        command, cwd=folder, env=env, capture_output=True, text=True, timeout=200, check=False
    )


@pytest.mark.slow
def test_it_trains_and_plays_in_another_folder(program, tmp_path):
    small = ("num_envs=16", "num_threads=1", "rl_device=cpu")
    trained = run(*program, "train", "task=Cartpole", *small, "max_iterations=1", folder=tmp_path)
    assert trained.returncode == 0, trained.stderr
    # What it says comes next is the program that was typed.
    typed = " ".join([*program[1:], "train"]) if len(program) > 1 else f"{program[0]} train"
    assert f"{typed} task=Cartpole" in trained.stdout + trained.stderr
    played = run(*program, "play", "task=Cartpole", *small, folder=tmp_path)
    assert played.returncode == 0, played.stderr
    assert "/nn/last_Cartpole_ep_1_rew_" in played.stdout + played.stderr


def test_a_command_exits_with_the_code_of_its_module(program, tmp_path):
    wrong = run(*program, "check", "Cartpol", folder=tmp_path)
    assert wrong.returncode == 2
    assert "did you mean 'Cartpole'" in wrong.stderr


def test_play_takes_the_newest_policy_unless_one_is_named():
    for words, expected in [
        ([], ["test=True", "checkpoint=last"]),
        (["task=Ant"], ["test=True", "checkpoint=last", "task=Ant"]),
        (["checkpoint=walk"], ["test=True", "checkpoint=walk"]),
        (["--help"], ["test=True", "--help"]),
    ]:
        assert words_of_play(words) == expected


def test_a_wrong_word_is_a_mistake_in_one_line(capsys):
    assert main(["dmo"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: unknown command 'dmo' (did you mean 'demo'?)")
