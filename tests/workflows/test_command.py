"""Keys, and the options of Isaac Lab's scripts as their synonyms."""

from __future__ import annotations

import runpy
import sys

import pytest

from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.workflows.__main__ import VERBS, main, make_parser, read_command
from isaacgymenvs_lite.workflows.library import LIBRARIES
from isaacgymenvs_lite.workflows.training import PlaySettings, TrainSettings


def read(verb: str, *words: str) -> tuple:
    settings = {"train": TrainSettings, "play": PlaySettings}[verb]
    return read_command(settings, make_parser("sb3", verb).parse_intermixed_args(words))


def test_options_are_synonyms_of_keys():
    for verb, options, keys in [
        ("train", "--task Ant --num_envs 4 --headless", "task=Ant num_envs=4 headless=True"),
        ("train", "--task=Ant --seed 3 --cpu", "task=Ant seed=3 rl_device=cpu"),
        ("train", "--task Ant --device cpu --agent a.yaml", "task=Ant rl_device=cpu agent=a.yaml"),
        (
            "train",
            "--task Ant --max_iterations 3 --log_interval 64 --checkpoint a.zip --logs here",
            "task=Ant max_iterations=3 log_interval=64 checkpoint=a.zip logs=here",
        ),
        ("play", "--task Ant --use_last_checkpoint", "task=Ant checkpoint=last"),
        ("play", "--task Ant --real-time --livestream 1", "task=Ant real_time=True viewer=web"),
        ("train", "--task Ant --livestream 0 --enable_cameras --kit_args x", "task=Ant viewer="),
        (
            "play",
            "--task IsaacGymEnvsLite/Ant-v0 agent.ppo.gamma=0.9 task.env.x=1",
            "task=IsaacGymEnvsLite/Ant-v0 agent.ppo.gamma=0.9 task.env.x=1",
        ),
    ]:
        assert read(verb, *options.split()) == read(verb, *keys.split())


def test_a_key_belongs_to_the_command_the_agent_or_the_task():
    words = ("task=IsaacGymEnvsLite/Ant-v0", "max_iterations=3", "logs=2026", "agent=my.yaml")
    settings, task_words, agent_words = read(
        "train", *words, "agent.ppo.gamma=0.9", "+task.env.x=1", "num_envs=8", "seed=2"
    )
    assert settings == TrainSettings(task="Ant", max_iterations=3, logs="2026", agent="my.yaml")
    assert agent_words == ["agent.ppo.gamma=0.9"]
    assert task_words == ["+task.env.x=1", "num_envs=8", "seed=2"]


def test_the_last_word_of_a_key_wins():
    for verb, words, expected in [
        ("train", "--seed 1 seed=2", ("seed=1", "seed=2")),
        (
            "train",
            "--video_length 6 --video",
            (
                *("capture_video=True", "capture_video_len=200", "capture_video_freq=2000"),
                "capture_video_len=6",
            ),
        ),
        (
            "play",
            "--video",
            ("capture_video=True", "capture_video_len=200", f"capture_video_freq={2**53}"),
        ),
    ]:
        assert read(verb, "task=Ant", *words.split())[1] == list(expected)


def test_a_wrong_key_is_one_line():
    for verb, words, message in [
        ("train", "num_envs=3", "task= is missing, for example task=Cartpole"),
        ("train", "task=Ant max_iteration=3", "(did you mean 'max_iterations'?)"),
        (
            "train",
            "task=Ant real_time=True",
            "real_time=True: this setting does not apply to another library's",
        ),
        (
            "train",
            "task=Ant Cartpole",
            "Cartpole: this setting does not apply to another library's agent",
        ),
        ("train", "task=Ant experiment=mine", "expected agent, checkpoint, log_interval, logs,"),
        ("train", "task=Ant logs={", "logs={: a value is not valid YAML"),
    ]:
        with pytest.raises(UserError) as caught:
            read(verb, *words.split())
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)


def test_other_options_are_refused_in_one_line(capsys):
    for words, message in [
        ("--distributed", "unrecognized arguments: --distributed"),
        ("--livestream 7", "--livestream: invalid choice"),
        ("--max_iteratons 3", "--max_iteratons 3 (did you mean '--max_i"),
    ]:
        with pytest.raises(SystemExit) as ended:
            main(["sb3", "train", "task=Ant", *words.split()])
        assert ended.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert message in line


def test_the_published_modules_are_the_same_command(monkeypatch, capsys):
    for name in sorted(LIBRARIES):
        for verb in sorted(VERBS):
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


def test_a_library_or_a_verb_that_does_not_exist_is_one_line(capsys):
    for words, message in [
        ("sbb train", "unknown library 'sbb' (did you mean 'sb3'?); choices: rsl_rl, sb3, skrl"),
        ("sb3 trian task=Ant", "unknown verb 'trian' (did you mean 'train'?); choices: play"),
        ("sb3", "unknown verb ''; choices: play, train"),
    ]:
        assert main(words.split()) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"error: {message}")
