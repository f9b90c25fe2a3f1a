"""Keys, and the options of Isaac Lab's scripts as their synonyms."""

from __future__ import annotations

import runpy
import sys
import time

import pytest
import torch
import yaml

from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.workflows.__main__ import LIBRARIES, VERBS, main
from isaacgymenvs_lite.workflows.command import (
    Command,
    PlaySettings,
    TrainSettings,
    make_parser,
    read_command,
)
from isaacgymenvs_lite.workflows.sb3 import LIBRARY as SB3
from isaacgymenvs_lite.workflows.training import in_real_time

SMALL = ("--num_envs", "4", "--headless", "num_threads=1")


def read(verb: str, *words: str) -> Command:
    settings = {"train": TrainSettings, "play": PlaySettings}[verb]
    return read_command(settings, make_parser(SB3, verb).parse_intermixed_args(words))


@pytest.mark.parametrize(
    ("verb", "options", "keys"),
    [
        ("train", "--task Ant --num_envs 4 --headless", "task=Ant num_envs=4"),
        ("train", "--task=Ant --seed 3 --cpu", "task=Ant seed=3 rl_device=cpu"),
        (
            "train",
            "--task Ant --device cpu --agent my.yaml",
            "task=Ant agent=my.yaml rl_device=cpu",
        ),
        (
            "train",
            "--task Ant --max_iterations 3 --log_interval 64 --checkpoint a.zip --logs here",
            "task=Ant max_iterations=3 log_interval=64 checkpoint=a.zip logs=here",
        ),
        (
            "train",
            "--video_length 6 --task Ant --video --video_interval 20",
            "task=Ant capture_video=True capture_video_len=6 capture_video_freq=20",
        ),
        ("play", "--task Ant --use_last_checkpoint", "task=Ant checkpoint=last"),
        ("play", "--task Ant --real-time --livestream 1", "task=Ant real_time=True viewer=web"),
        (
            "play",
            "--task IsaacGymEnvsLite/Ant-v0 agent.ppo.gamma=0.9 task.env.x=1",
            "task=IsaacGymEnvsLite/Ant-v0 agent.ppo.gamma=0.9 task.env.x=1",
        ),
    ],
)
def test_options_are_synonyms_of_keys(verb, options, keys):
    assert read(verb, *options.split()) == read(verb, *keys.split())


def test_a_key_belongs_to_the_command_the_agent_or_the_task():
    words = ("task=IsaacGymEnvsLite/Ant-v0", "max_iterations=3", "logs=2026", "agent=my.yaml")
    command = read("train", *words, "agent.ppo.gamma=0.9", "+task.env.x=1", "num_envs=8", "seed=2")
    assert command.settings == TrainSettings(
        task="Ant", max_iterations=3, logs="2026", agent="my.yaml"
    )
    assert command.agent_words == ("agent.ppo.gamma=0.9",)
    assert command.task_words == ("+task.env.x=1", "num_envs=8", "seed=2")


def test_keys_come_after_options():
    assert read("train", "--task", "Ant", "--seed", "1", "seed=2").task_words == (
        "seed=1",
        "seed=2",
    )


def test_a_play_is_recorded_once():
    assert "capture_video_freq=9007199254740992" in read("play", "task=Ant", "--video").task_words


@pytest.mark.parametrize(
    ("verb", "words", "message"),
    [
        ("train", "num_envs=3", "task= is missing, for example task=Cartpole"),
        ("train", "task=Ant --task Cartpole", "task=Ant: given as an option as well"),
        ("train", "task=Ant max_iterations=0", "max_iterations: got 0, expected a whole number"),
        ("train", "task=Ant max_iteration=3", "(did you mean 'max_iterations'?)"),
        ("train", "task=Ant real_time=True", "real_time=True: is no setting of another library's"),
        ("play", "task=Ant max_iterations=3", "max_iterations=3: is no setting of another"),
        ("train", "task=Ant Cartpole", "Cartpole: is no setting of another library's agent"),
        ("train", "task=Ant test=True", "test=True: is no setting of another library's agent; use"),
        ("train", "task=Ant experiment=mine", "use logs=FOLDER"),
        ("train", "task=Ant logs={", "logs={: a value is not valid YAML"),
    ],
)
def test_a_wrong_key_is_one_line(verb, words, message):
    with pytest.raises(UserError) as caught:
        read(verb, *words.split())
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", sorted(LIBRARIES))
@pytest.mark.parametrize("verb", sorted(VERBS))
def test_the_published_modules_are_the_same_command(name, verb, monkeypatch, capsys):
    with pytest.raises(SystemExit) as ended:
        main([name, verb, "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: isaacgymenvs-lite workflows {name} {verb} task=<name>" in text
    module = f"isaacgymenvs_lite.workflows.{name}.{verb}"
    monkeypatch.setattr(sys, "argv", [module, "--help"])
    with pytest.raises(SystemExit):
        runpy.run_module(module, run_name="__main__")
    assert capsys.readouterr().out == text


def test_one_command_trains_and_plays(library, tmp_path, capsys):
    words = ["task=Cartpole", "num_envs=4", "num_threads=1", f"logs={tmp_path}"]
    assert main([library.name, "train", *words, "max_iterations=1"]) == 0
    assert main([library.name, "train", *words, "max_iterations=1", "checkpoint=last"]) == 0
    assert len(list((tmp_path / library.name / "Cartpole").iterdir())) == 2
    capsys.readouterr()
    assert main([library.name, "play", *words, "checkpoint=last"]) == 0
    assert "episodes: 4, " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("sbb train", "unknown library 'sbb' (did you mean 'sb3'?); choices: rsl_rl, sb3, skrl"),
        ("sb3 trian task=Ant", "unknown verb 'trian' (did you mean 'train'?); choices: play"),
        ("sb3", "unknown verb ''; choices: play, train"),
    ],
)
def test_a_library_or_a_verb_that_does_not_exist_is_one_line(words, message, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {message}")


def test_without_words_the_usage_is_shown(capsys):
    assert main([]) == 0
    usage = "usage: isaacgymenvs-lite workflows sb3|skrl|rsl_rl train|play"
    assert usage in capsys.readouterr().out


def test_the_tutorials_options_are_accepted(library, run_train, run_play, tmp_path, caplog):
    words = ("--enable_cameras", "--device", "cpu", "--livestream", "0", "--keep_all_info")
    more = ("--log_interval", "64", "--agent", f"{library.name}_cfg_entry_point")
    task = ("--task", "IsaacGymEnvsLite/Cartpole-v0", "--kit_args", "--a=1")
    run_train(library, *SMALL, "--max_iterations", "1", *words, *more, *task[:2])
    assert "--enable_cameras, --keep_all_info: nothing to do for it here" in caplog.text
    (folder,) = (tmp_path / "logs" / library.name / "Cartpole").iterdir()
    assert yaml.safe_load((folder / "params/env.yaml").read_text())["rl_device"] == "cpu"
    printed = run_play(library, *SMALL, *task[:2], "--enable_cameras", "--ml_framework", "torch")
    assert "episodes: 4, " in printed  # with the newest checkpoint by default


def test_livestream_serves_the_page(library, run_train, caplog):
    words = ("--livestream", "2", "viewer_port=0")
    run_train(library, *SMALL, "--max_iterations", "1", *words)
    assert "watch it at http://localhost:" in caplog.text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--distributed",), "--distributed: a training is one process"),
        (("--xr",), "use viewer=web"),
        (("--visualizer", "kit"), "--visualizer: use headless=False"),
        (("--resume",), "--resume: use --checkpoint FILE"),
        (("--load_run", "x"), "--load_run: use --checkpoint FILE"),
        (("--livestream", "7"), "--livestream: invalid choice"),
        (
            ("--max_iteratons", "3"),
            "unrecognized arguments: --max_iteratons 3 (did you mean '--max_i",
        ),
        (("--num_envs", "0"), "expected a whole number >= 1"),
        (("--device", "gpu"), "--device=gpu: expected cpu, cuda or cuda:N"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_other_options_are_refused_in_one_line(run_train, fails, words, message):
    pytest.importorskip("stable_baselines3")
    assert message in fails(run_train, SB3, *SMALL, *words)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_device_that_is_not_there_is_one_line(library, run_train, fails):
    line = fails(run_train, library, *SMALL, "--device", "cuda:0")
    assert "--device=cuda:0: torch sees no GPU on this machine; use --device=cpu" in line


def test_the_log_can_be_written_less_often(run_train, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    pytest.importorskip("stable_baselines3")
    steps = []
    for interval in ("128", "512"):  # a rollout is 32 x 4 frames
        logs = tmp_path / interval
        words = ("--max_iterations", "8", "--log_interval", interval)
        run_train(SB3, *SMALL, *words, "--logs", str(logs))
        (folder,) = (logs / "sb3" / "Cartpole").iterdir()
        events = EventAccumulator(str(folder))
        events.Reload()
        steps.append(len(events.Scalars("time/fps")))
    assert steps[0] > 2 * steps[1] > 0


def test_real_time_waits():
    starts_s: list[float] = []
    step = in_real_time(lambda: starts_s.append(time.monotonic()), dt_s=0.02)
    for _ in range(4):
        step()
    assert starts_s[-1] - starts_s[0] >= 0.055
