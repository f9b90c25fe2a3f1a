"""The commands that a run prints for what may come next."""

from __future__ import annotations

import dataclasses
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from isaacgymenvs_lite import typed_command
from isaacgymenvs_lite.paths import cfg_dir
from isaacgymenvs_lite.typed_command import TypedCommand, package_command, words_of_job

REPOSITORY = Path(__file__).resolve().parents[1]
PLAYED = "test=True checkpoint=last num_envs=16"


def command(*words: str) -> TypedCommand:
    return TypedCommand(("python", "train.py"), words)


def test_playing() -> None:
    for words, expected in [
        ([], "task=Default"),
        (["num_envs=64", "max_iterations=3", "experiment=x"], "task=Default"),
        (["task=Ant", "seed=3"], "task=Ant"),
        (["task=Ant", "train=AntPPO"], "task=Ant"),
        (["train=AntSAC", "task=Ant"], "task=Ant train=AntSAC"),
        # What the network and the run's folder depend on stays, what this start was for goes.
        (
            ["train.params.network.mlp.units=[8,8]", "task=Ant", "checkpoint=a.pth", "test=False"],
            "task=Ant 'train.params.network.mlp.units=[8,8]'",
        ),
        (
            ["task=Ant", "+train.params.config.train_dir=my runs", "rl_device=cpu"],
            "task=Ant '+train.params.config.train_dir=my runs' rl_device=cpu",
        ),
        (["task=/a fork/Ant.yaml"], "'task=/a fork/Ant.yaml'"),
        (
            ["--config-dir", "mine", "task=Own", "train=AntPPO"],
            "task=Own train=AntPPO --config-dir mine",
        ),
        (["--config-dir=mine", "task=Own"], "task=Own --config-dir=mine"),
    ]:
        played = command(*words).play("Default", Path("runs/a/nn/a.pth"))
        assert played == f"python train.py {expected} {PLAYED}"


def test_playing_a_job_of_a_sweep() -> None:
    job = dataclasses.replace(command("task=Ant"), is_job=True)
    played = "test=True checkpoint=runs/a/nn/a.pth num_envs=16"
    assert job.play("Ant", Path("runs/a/nn/a.pth")) == f"python train.py task=Ant {played}"


def test_going_on() -> None:
    typed = command("num_envs=64", "task=Ant", "checkpoint=runs/a/nn/a.pth", "max_iterations=9")
    assert typed.resume(Path("runs/my ant")) == "python train.py 'resume=runs/my ant'"


def test_a_command_of_the_package_runs_in_any_shell(tmp_path, monkeypatch) -> None:
    """Its short name is for a shell that finds this environment's program by it."""
    monkeypatch.chdir(tmp_path)
    own = Path(sys.executable).parent
    for path, program in (
        (own, "isaacgymenvs-lite"),
        (tmp_path, f"{shlex.quote(sys.executable)} -m isaacgymenvs_lite"),
    ):
        monkeypatch.setenv("PATH", str(path))
        assert package_command("replay", "my run/1.npz") == f"{program} replay 'my run/1.npz'"


def test_a_job_of_a_sweep() -> None:
    """Hydra's names of files are the typed paths again, and values are the job's."""
    typed = ["-m", "--config-dir", "mine", "task=/a/b-c.yaml", "train=AntPPO", "seed=1,2"]
    job = ["task=b-c", "++task_checkout='/a'", "train=AntPPO", "seed=1"]
    expected = ["--config-dir", "mine", "task=/a/b-c.yaml", "train=AntPPO", "seed=1"]
    assert words_of_job(typed, job) == expected


def test_the_interpreter_that_a_shell_finds(monkeypatch, tmp_path: Path) -> None:
    environment = tmp_path / "venv" / "bin"
    environment.mkdir(parents=True)
    for name in ("python", "python3"):
        (environment / name).write_text("#!/bin/sh\n")
        (environment / name).chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(environment / "python3"))
    monkeypatch.setenv("PATH", str(environment))
    assert typed_command._python() == "python"
    # not active: by its path, from the working folder if it is below that
    monkeypatch.setenv("PATH", "/usr/bin")
    monkeypatch.chdir(tmp_path)
    assert typed_command._python() == "venv/bin/python3"
    monkeypatch.chdir("/")
    monkeypatch.setattr(sys, "executable", str(environment / "python3"))
    assert typed_command._python() in (
        str(environment / "python3"),
        str(environment / "python3")[1:],
    )


def _run(line: str, folder: Path) -> str:
    result = subprocess.run(
        line,
        shell=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout + result.stderr


@pytest.mark.slow
def test_what_a_training_prints_works_as_typed(tmp_path: Path) -> None:
    """Of files by their paths, with blanks in them, and with a network of its own."""
    folder = tmp_path / "my fork"
    folder.mkdir()
    shutil.copy(cfg_dir() / "task" / "Cartpole.yaml", folder / "Own Cartpole.yaml")
    shutil.copy(cfg_dir() / "train" / "CartpolePPO.yaml", folder / "Own train.yaml")
    words = "num_envs=16 num_threads=1 rl_device=cpu max_iterations=2 experiment=first"
    said = _run(
        f"'{sys.executable}' -m isaacgymenvs_lite.train 'task=my fork/Own Cartpole.yaml'"
        f" 'train=my fork/Own train.yaml' {words} train.params.network.mlp.units=[8]",
        tmp_path,
    )
    (saved, play) = re.search(r"^saved (\S+); play it: (.*)$", said, re.M).groups()  # type: ignore[union-attr]
    assert "epoch 2/2" in said
    resumed = _run(
        f"'{sys.executable}' -m isaacgymenvs_lite.train resume=last max_iterations=3", tmp_path
    )
    (saved,) = re.search(r"^saved (\S+); play it: add test=True ", resumed, re.M).groups()  # type: ignore[union-attr]
    said = _run(play, tmp_path)
    assert f"checkpoint: {tmp_path / saved}\n" in said
    assert "played " in said
