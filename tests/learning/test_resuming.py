"""A training that was stopped and resumed is the training that was never stopped, bit by bit."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from isaacgymenvs_lite import train as train_py
from isaacgymenvs_lite.checkpoints import files, training_state
from isaacgymenvs_lite.checkpoints.archive import read_archive
from isaacgymenvs_lite.checkpoints.files import write_atomically
from isaacgymenvs_lite.checkpoints.run_config import resumed_tree
from isaacgymenvs_lite.checkpoints.training_state import read_training_state
from isaacgymenvs_lite.config.launch import LaunchSettings, check_config
from isaacgymenvs_lite.errors import CheckpointError, ConfigError, UserError
from isaacgymenvs_lite.report.scalars import read_scalars
from isaacgymenvs_lite.runner import run
from tests.tiny import (
    CONFIG,
    ONE_THREAD,
    TINY_AMP,
    TINY_LSTM,
    TINY_PPO,
    TINY_SAC,
    TINY_STYLE,
    fast_and_slow,
)
from tests.tiny import train_in as train

SHORT_EPISODES = "task.env.episodeLength=6"
# A linear schedule, some agents' default, depends on how many epochs a run has in all.
CONSTANT_RATE = f"{CONFIG}.lr_schedule=constant"
AGENTS = {
    "ppo": ("task=Ant", *TINY_PPO, SHORT_EPISODES, f"{CONFIG}.lr_schedule=adaptive"),
    "ppo_randomized": ("task=Ant", *TINY_PPO, SHORT_EPISODES, "task.task.randomize=True"),
    "asymmetric": ("task=AnymalTerrain", "train=AnymalTerrainPPO", *TINY_PPO),
    "amp": ("task=HumanoidAMP", *TINY_AMP, SHORT_EPISODES, f"{CONFIG}.lr_schedule=adaptive"),
    "amp_adaptive": (
        *("task=HumanoidAMP", *TINY_AMP, SHORT_EPISODES, "task.env.adaptiveStarts=0.5"),
        *("task.env.demoMotionShare=0.5", f"{CONFIG}.disc_grad_penalty_final=0.2", CONSTANT_RATE),
    ),
    "robot_amp": (
        *("task=RobotAMP", *TINY_AMP, SHORT_EPISODES, "task.task.randomize=True"),
        *("task.env.observations=deployable", "task.env.historySteps=2"),
        *("task.env.observationNoise.dof_vel=1.5", "task.env.actionDelay=[0,2]"),
        *("task.env.pushRobots=True", "task.env.pushInterval_s=0.1", CONSTANT_RATE),
    ),
    "gen_amp": ("task=HumanoidASE", *TINY_AMP, *TINY_STYLE, SHORT_EPISODES, CONSTANT_RATE),
    "lstm": (*TINY_LSTM, *ONE_THREAD, f"{CONFIG}.seq_length=4"),
    "sac": (*TINY_SAC, *ONE_THREAD, SHORT_EPISODES),
}


def state_of(run_folder: Path, epoch: int) -> dict[str, Any]:
    state = read_training_state(run_folder / "resume" / f"{epoch}.pth")
    assert state.memory is not None
    return {"checkpoint": state.checkpoint, "memory": state.memory, "buffers": state.buffers}


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_same(one: Any, other: Any, where: str = "") -> None:
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key in one:
            assert_same(one[key], other[key], f"{where}.{key}")
    elif isinstance(one, list):
        assert len(one) == len(other), where
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{where}.{i}")
    elif isinstance(one, torch.Tensor):
        assert torch.equal(one.nan_to_num(), other.nan_to_num()), where
    else:
        assert one == other or one != one, where


def check_resuming(folder: Path, words: Sequence[str]) -> Path:
    """Train four epochs at once, and two and two; return the folder of the resumed run."""
    folders = [folder / name for name in ("whole", "stopped")]
    for each in folders:
        each.mkdir()
    whole = train(folders[0], [*words, "max_iterations=4"])
    stopped = train(folders[1], [*words, "max_iterations=2"])
    run(resumed_tree([f"resume={stopped}", "max_iterations=4"]))
    assert [path.name for path in stopped.parent.iterdir()] == [stopped.name]
    assert_same(state_of(stopped, 4), state_of(whole, 4))
    return stopped


@pytest.mark.parametrize("words", fast_and_slow(AGENTS, "ppo", "amp", "sac", "lstm"))
def test_resumed_run_is_the_run_that_never_stopped(words, tmp_path):
    check_resuming(tmp_path, words)


@pytest.mark.slow
def test_hierarchy_resumes_exactly(tmp_path):
    low = train(tmp_path, ["task=HumanoidASE", *TINY_AMP, *TINY_STYLE, "max_iterations=1"])
    high = (
        *("task=HumanoidHeading", "task.env.motion_file=stand", *TINY_PPO, SHORT_EPISODES),
        f"{CONFIG}.llc_config={low / 'config.yaml'}",
        f"{CONFIG}.llc_checkpoint={next(low.glob('nn/*.pth'))}",
        f"{CONFIG}.exploration_correlation=0.5",
    )
    check_resuming(tmp_path, high)


MEASUREMENT = "isaacgymenvs_lite.utils.precision.measure_bfloat16_speedup"


@pytest.mark.parametrize(("speedup", "chosen"), [(5.0, True), (0.5, False)])
def test_the_precision_that_auto_chose_is_kept(speedup, chosen, tmp_path, monkeypatch):
    monkeypatch.setattr(MEASUREMENT, lambda: speedup)
    words = ["task=Ant", *TINY_PPO, f"{CONFIG}.mixed_precision=auto", "max_iterations=1"]
    stopped = train(tmp_path, words)
    monkeypatch.setattr(MEASUREMENT, lambda: pytest.fail("measured again"))
    run(resumed_tree([f"resume={stopped}", "max_iterations=2"]))
    stored = OmegaConf.load(stopped / "config.yaml")
    assert OmegaConf.select(stored, f"{CONFIG}.mixed_precision") is chosen


@pytest.fixture(scope="module")
def short_run(tmp_path_factory) -> Path:
    """Return the folder of an AMP run of two epochs, to be copied."""
    words = ["task=HumanoidAMP", *TINY_AMP, f"{CONFIG}.save_frequency=1"]
    run_folder = train(tmp_path_factory.mktemp("run"), words)
    time.sleep(1.0)  # TensorBoard's files have names of whole seconds, and of the process
    return run_folder


@pytest.fixture
def stopped(short_run, tmp_path, monkeypatch) -> Path:
    """Return a copy of that run, below runs/ of the working folder."""
    copy = tmp_path / "runs" / short_run.name
    shutil.copytree(short_run, copy)
    monkeypatch.chdir(tmp_path)
    return copy


def go_on(*words: str) -> None:
    run(resumed_tree([*words, "max_iterations=3"]))


def test_last_is_the_newest_run(stopped, caplog):
    caplog.set_level(logging.INFO)
    go_on("resume=last", "task=HumanoidAMP")
    assert "resumed after epoch 2" in caplog.text
    assert "not as if it had never stopped" not in caplog.text
    assert {file.name for file in (stopped / "resume").iterdir()} == {"3.pth", "3_buffers.pth"}
    assert "resume: ''" in (stopped / "config.yaml").read_text()


def test_scalars_go_on_in_the_same_log(stopped):
    go_on("resume=last")
    series = read_scalars(stopped / "summaries")["losses/a_loss"]
    assert list(series.frames) == [0, 16, 32]
    assert series.resumed_at == (32.0,)


def without_buffers(run: Path) -> None:
    (run / "resume/2_buffers.pth").unlink()


def without_state(run: Path) -> None:
    shutil.rmtree(run / "resume")


def of_another_state(run: Path) -> None:
    (run / "resume/2_buffers.pth").write_bytes((run / "resume/2_buffers.pth").read_bytes())
    buffers = read_archive(run / "resume/2_buffers.pth")
    torch.save({**buffers, "token": "of another state"}, run / "resume/2_buffers.pth")


@pytest.mark.parametrize(
    ("change", "words", "line"),
    [
        (without_buffers, (), "the replay buffers start empty because their file is missing"),
        (of_another_state, (), "the replay buffers start empty because their file is missing"),
        (
            without_state,
            (),
            "a checkpoint has no training state, therefore episodes",
        ),
        (None, ("num_envs=8",), "or horizon_length changed, therefore episodes"),
        (None, (f"{CONFIG}.learning_rate=1e-5",), "learning rates start at the new setting"),
    ],
)
def test_one_line_says_what_starts_again(change, words, line, stopped, caplog):
    if change is not None:
        change(stopped)
    go_on("resume=last", *words)
    (warning,) = [r.getMessage() for r in caplog.records if "never stopped" in r.getMessage()]
    assert line in warning
    assert (stopped / "resume/3.pth").is_file()


def test_a_full_disk_does_not_set_the_run_back(stopped, tmp_path, monkeypatch, caplog):
    """Checkpoints of the third epoch were rescued; its training state could not be written."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))

    def full(path: Path, state: dict[str, Any]) -> None:
        if path.is_relative_to(stopped):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write_atomically(path, state)

    with monkeypatch.context() as patch:
        for module in (files, training_state):
            patch.setattr(module, "write_atomically", full)
        go_on("resume=last")
    rescued = files.resolve_checkpoint("last", tmp_path / "runs", "HumanoidAMP")
    assert rescued.startswith(str(tmp_path / "tmp"))
    caplog.clear()
    run(resumed_tree([f"resume={stopped}", "max_iterations=4"]))
    assert f"resume={stopped} uses the rescued checkpoint " in caplog.text
    assert [file.name for file in stopped.glob("resume/*_buffers.pth")] == ["4_buffers.pth"]


def test_one_line_names_a_checkpoint_that_is_newer_than_the_state(stopped, tmp_path, caplog):
    states = shutil.copytree(stopped / "resume", tmp_path / "states")
    go_on("resume=last")
    shutil.rmtree(stopped / "resume")
    states.rename(stopped / "resume")
    caplog.set_level(logging.INFO)
    caplog.clear()
    go_on("resume=last")
    assert "resumed after epoch 2" in caplog.text
    assert caplog.text.count("(epoch 3) has only networks and optimisers") == 1


def test_names_of_folders_are_printed_without_control_characters(stopped, monkeypatch, capsys):
    """On a command line of its own, whose log goes to stderr."""
    renamed = stopped.rename(stopped.with_name("a\nb\x1b[31m\udcff"))
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    monkeypatch.setattr(sys, "argv", ["train.py", f"resume={renamed}", "max_iterations=3"])
    train_py.main()
    shown = capsys.readouterr().err
    assert r"runs/a\nb\x1b[31m\udcff/nn/" in shown
    assert "\x1b[31m" not in shown
    assert (renamed / "resume/3.pth").is_file()


def test_buffers_can_be_left_out(stopped, caplog):
    go_on("resume=last", f"+{CONFIG}.save_buffers=False")
    assert [file.name for file in (stopped / "resume").iterdir()] == ["3.pth"]


@pytest.mark.parametrize("place", ["task", "agent", "generators", "episodes"])
def test_a_state_that_does_not_fit_is_one_line(place, stopped):
    file = stopped / "resume/2.pth"
    content = read_archive(file)
    memory = content["training_state"]["memory"]
    memory[place] = {name: {"nonsense": torch.zeros(3)} for name in memory[place]}
    torch.save(content, file)
    with pytest.raises(CheckpointError, match=r"resume=.*2.pth: the training state does not fit"):
        go_on("resume=last")


def test_a_state_of_another_version_is_one_line(stopped):
    file = stopped / "resume/2.pth"
    content = read_archive(file)
    content["training_state"]["version"] = 1
    torch.save(content, file)
    with pytest.raises(CheckpointError, match=r"is of another version.*: checkpoint=.*2\.pth"):
        go_on("resume=last")


LOOKED_ON = {"viewer": "web", "headless": False, "capture_video": True}
SENT_AWAY = {"wandb_activate": True, "wandb_entity": "stranger", "wandb_logcode_dir": "/"}


@pytest.mark.slow
def test_a_run_does_not_decide_who_looks_on_and_what_is_sent_away(stopped, monkeypatch, caplog):
    monkeypatch.setattr("isaacgymenvs_lite.config.launch.require", lambda *_, **__: None)
    caplog.set_level(logging.INFO)
    file = stopped / "config.yaml"
    cfg = OmegaConf.load(file)
    cfg.update({**LOOKED_ON, **SENT_AWAY})
    file.write_text(f"# typed: task=Ant --config-dir=/stranger\n{OmegaConf.to_yaml(cfg)}")
    default = LaunchSettings(task_name="HumanoidAMP")
    settings = check_config(resumed_tree(["resume=last"]))
    for key in (*LOOKED_ON, *SENT_AWAY):
        assert getattr(settings, key) == getattr(default, key)
    assert "type again what you want: wandb_activate, viewer, capture_video" in caplog.text
    typed = ["viewer=web", "headless=False", "capture_video=True", "wandb_activate=True"]
    settings = check_config(resumed_tree(["resume=last", *typed, "wandb_tags=[a]"]))
    assert (settings.viewer, settings.headless, settings.capture_video) == ("web", False, True)
    assert (settings.wandb_activate, settings.wandb_entity, settings.wandb_tags) == (
        True,
        "",
        ["a"],
    )
    off = ["viewer=", "headless=True", "capture_video=False", "wandb_activate=False"]
    assert not check_config(resumed_tree(["resume=last", *off])).wandb_activate
    caplog.clear()
    go_on("resume=last")
    assert "stranger" not in caplog.text + file.read_text()


def test_a_checkpoint_after_the_last_epoch(stopped, tmp_path):
    file = next(stopped.glob("nn/last*_ep_2_*.pth"))
    words = ["task=HumanoidAMP", *TINY_AMP, f"checkpoint={file}", "max_iterations=1"]
    with pytest.raises(
        ConfigError, match=r"checkpoint=.*: its last epoch was 2, and max_epochs is 1"
    ):
        train(tmp_path, words)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["resume=missing"], "no such file or folder"),
        (["resume=."], "no run folder"),
        (["resume=last", "task=Ant"], "resume=last: no run with task.name=Ant"),
        (["resume=last", "task.env.num_legs=3"], r"task.env.num_legs.*settings of the run"),
        (["resume=last", "--multirun"], "only settings can be given"),
        (
            ["resume=last", "max_iterations=2"],
            "resume=.*: its last epoch was 2, and max_epochs is 2; to continue set",
        ),
        (["resume=last", "test=True"], "to play a policy give checkpoint="),
        (
            ["resume=last", "max_iterations=3", "train.params.network.mlp.units=[8]"],
            "resume=.*expected 8x",
        ),
    ],
)
def test_mistakes_are_one_line_and_change_nothing(words, message, stopped):
    before = contents(stopped)
    with pytest.raises(UserError, match=message):
        run(resumed_tree(words))
    assert contents(stopped) == before
