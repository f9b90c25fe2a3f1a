"""The command line in this process with a stand-in for the runner, and twice in its own."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from omegaconf import DictConfig

from isaacgymenvs_lite import train
from isaacgymenvs_lite.__main__ import main
from isaacgymenvs_lite.errors import StoppedAtOnceError
from isaacgymenvs_lite.typed_command import TypedCommand
from tests.train_command import make_train_command

REPOSITORY = Path(__file__).resolve().parents[1]
Call = Callable[..., int]


class Runner:
    """Stores what it should run, in place of isaacgymenvs_lite.runner."""

    def __init__(self) -> None:
        self.runs: list[DictConfig] = []
        self.commands: list[TypedCommand] = []
        self.error: BaseException | None = None

    def run(self, cfg: DictConfig, command: TypedCommand, **_: object) -> None:
        self.runs.append(cfg)
        self.commands.append(command)
        logging.getLogger("isaacgymenvs_lite.some").info("running")
        logging.getLogger("isaacgymenvs_lite.some").warning("careful")
        if self.error is not None:
            raise self.error


@pytest.fixture
def runner() -> Runner:
    return Runner()


@pytest.fixture
def call(monkeypatch, tmp_path, runner) -> Call:
    """Run the command line in an empty folder; returns the exit code."""
    return make_train_command(monkeypatch, tmp_path, runner.run)


def test_runs_with_the_composed_tree(call: Call, runner, capsys):
    assert call("task=HumanoidAMP", "num_envs=7", "seed=3") == 0
    (cfg,) = runner.runs
    assert (cfg.task.env.numEnvs, cfg.seed, cfg.task_name) == (7, 3, "HumanoidAMP")
    assert "hydra" not in cfg


def test_the_runner_is_given_what_was_typed(call: Call, runner, tmp_path):
    """Not what it is made into: names of files are paths, a shipped policy is its name."""
    file = tmp_path / "own-ant.yaml"
    file.write_text("defaults: [Ant, _self_]\n")
    words = [f"task={file}", "train=AntPPO", "seed=3"]
    assert call(*words) == 0
    assert runner.commands[-1].words == tuple(words)
    assert call("-m", *words[:2], "seed=1,2") == 0
    assert [command.words[-1] for command in runner.commands[1:]] == ["seed=1", "seed=2"]
    assert all(set(words[:2]) <= set(command.words) for command in runner.commands)


def test_log_shows_messages_and_the_level_of_warnings(call: Call, runner, capsys):
    call()
    output = capsys.readouterr()
    assert output.err.splitlines() == ["running", "warning: careful"]
    assert output.out == ""


def test_nothing_is_written_and_the_working_directory_stays(call: Call, runner, tmp_path):
    runner.error = None
    call("checkpoint=some/file.pth")
    assert list(tmp_path.iterdir()) == []
    assert Path.cwd() == tmp_path


def test_mistakes_end_in_one_line_and_exit_code_2(call: Call, runner, capsys):
    for arguments, expected in [
        (
            ["task=Humanoids"],
            "error: unknown task 'Humanoids' (did you mean 'Humanoid'",
        ),
        (["num_env=3"], "error: unknown key 'num_env' (did you mean 'num_envs'?)"),
        (["num_envs=1,2"], "error: 'num_envs=1,2' gives several values"),
        (["rl_device=cuda:0"], "error: rl_device=cuda:0: torch sees no GPU"),
        (["--num_envs", "64"], "error: unknown option '--num_envs': settings are written without"),
        (["--config-dir", "absent"], "error: the configuration folder 'absent' does not exist"),
        (["--cfg", "job", "num_env=1"], "error: unknown key 'num_env'"),
        (
            ["train=~nosuchuser/x.yaml"],
            "error: ~nosuchuser/x.yaml: the home folder of '~nosuchuser'",
        ),
    ]:
        assert call(*arguments) == train.EXIT_USER_ERROR
        output = capsys.readouterr()
        assert output.err.startswith(expected)
        assert len(output.err.splitlines()) == 1
        assert output.out == ""
        assert runner.runs == []


def test_a_working_folder_that_was_removed(call: Call, runner, capsys, tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    for command in (lambda: call("task=Ant"), lambda: main(["check", "Ant"])):
        assert command() == train.EXIT_USER_ERROR
        assert capsys.readouterr().err.startswith("error: the working folder was removed")
    assert runner.runs == []


def test_bugs_keep_their_traceback(call: Call, runner):
    for error in [ValueError("a bug"), RuntimeError("a bug"), KeyError("x")]:
        runner.error = error
        with pytest.raises(type(error)) as raised:
            call()
        assert raised.value is error


def test_interrupt_ends_without_a_traceback(call: Call, runner, capsys):
    for error, status in [
        (KeyboardInterrupt(), 130),
        (StoppedAtOnceError(signal.SIGINT), 130),
        (StoppedAtOnceError(signal.SIGTERM), 143),
    ]:
        runner.error = error
        assert call() == status
        shown = capsys.readouterr().err
        assert shown.splitlines()[-1] == f"warning: ended by the user: exit status {status}"
        assert "Traceback" not in shown


def test_config_can_be_shown_without_running(call: Call, runner, capsys):
    assert call("--cfg", "job", "num_envs=5", "--package", "task.env", "--resolve") == 0
    assert "numEnvs: 5" in capsys.readouterr().out
    assert runner.runs == []


def test_help_is_a_screen_with_examples(call: Call, runner, capsys):
    assert call("--help") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 40
    assert sum("python train.py task=" in line or "train.py resume=" in line for line in lines) >= 5


def test_options_may_stand_between_settings(call: Call, runner, capsys):
    assert call("task=Cartpole", "-m", "seed=1,2") == 0
    assert [cfg.seed for cfg in runner.runs] == [1, 2]
    assert call("task=Cartpole", "--cfg", "job", "--package", "task.env", "num_envs=5") == 0


def test_choices_are_whole_and_tasks_only(call: Call, runner, capsys):
    assert call("task=HumanoidAmp") == 2
    said = capsys.readouterr().err
    assert "(did you mean 'HumanoidAMP'?)" in said
    # Without Classic, a YAML file that tasks include.
    assert "Cartpole, FrankaCabinet, FrankaCubeStack, Humanoid, " in said
    assert call("train.params.config.foo=1") == 2
    assert " ... " not in capsys.readouterr().err


def test_a_shipped_policy_brings_its_settings_along(call: Call, runner, monkeypatch):
    """They come before what was typed."""
    monkeypatch.setattr(train, "complete_arguments", lambda words: ["seed=7", "num_envs=5", *words])
    assert call("num_envs=3") == 0
    assert (runner.runs[0].seed, runner.runs[0].num_envs) == (7, 3)


@pytest.mark.parametrize("command", [["train.py"], ["-m", "isaacgymenvs_lite.train"]])
def test_both_ways_to_start_and_no_heavy_import_for_a_mistake(tmp_path, command):
    if command == ["train.py"]:
        command = [str(REPOSITORY / "train.py")]
    result = subprocess.run(
        [sys.executable, "-X", "importtime", *command, "num_env=3"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == train.EXIT_USER_ERROR
    *imports, message = result.stderr.splitlines()
    assert message.startswith("error: unknown key 'num_env'")
    imported = {line.rpartition("|")[2].strip() for line in imports}
    assert "hydra" in imported
    assert not imported & {"torch", "mujoco", "rl_games", "numpy"}
    assert list(tmp_path.iterdir()) == []
