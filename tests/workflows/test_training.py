from __future__ import annotations

import importlib.util
import os
import re
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch
import yaml

from isaacgymenvs_lite.workflows.__main__ import main
from isaacgymenvs_lite.workflows.library import LIBRARIES
from isaacgymenvs_lite.workflows.training import play_episodes
from isaacgymenvs_lite.wrappers.autoreset import AutoresetTask

# rsl_rl normalises no returns, and takes longer.
ITERATIONS = {"sb3": "30", "skrl": "30", "rsl_rl": "70"}
SMALL = ("--num_envs", "4", "--headless", "num_threads=1")


def folder_of(tmp_path: Path, library) -> Path:
    (folder,) = (tmp_path / "logs" / library / "Cartpole").iterdir()
    return folder


def checkpoints_in(folder: Path) -> list[Path]:
    return [file for file in folder.rglob("*") if file.suffix in (".zip", ".pt")]


@pytest.mark.slow
def test_the_pole_stands_after_training(library, run_train, run_play):
    run_train(library, "num_envs=64", f"max_iterations={ITERATIONS[library]}", "num_threads=1")
    printed = run_play(library, "--num_envs", "32", "--use_last_checkpoint", "num_threads=1")
    assert "episodes: 32" in printed
    (mean,) = re.findall(r"length: mean ([\d.]+)", printed)
    assert float(mean) > 400.0  # of 499


def test_a_training_leaves_what_it_was_made_of(library, run_train, tmp_path):
    words = ("task.env.maxEffort=300", "agent.checkpoint_interval=1")
    run_train(library, *SMALL, "--max_iterations", "2", "--seed", "5", *words)
    folder = folder_of(tmp_path, library)
    env = yaml.safe_load((folder / "params" / "env.yaml").read_text())
    assert env["task"]["env"]["maxEffort"] == 300
    assert env["task"]["env"]["numEnvs"] == 4
    assert env["seed"] == 5
    agent = yaml.safe_load((folder / "params" / "agent.yaml").read_text())
    assert (agent["max_iterations"], agent["checkpoint_interval"]) == (2, 1)
    assert len(checkpoints_in(folder)) >= 2
    assert list(folder.glob("events.out.tfevents.*"))


def test_an_interrupted_training_is_saved(library, run_play, tmp_path, monkeypatch):
    step, made = AutoresetTask.step, []

    def interrupted(self, actions):
        made.append(1)
        if len(made) == 40:  # of the second rollout or later, before any checkpoint is due
            raise KeyboardInterrupt
        return step(self, actions)

    monkeypatch.setattr(AutoresetTask, "step", interrupted)
    words = ["--task", "Cartpole", "--logs", str(tmp_path / "logs"), *SMALL]
    assert main([library, "train", *words]) == 130
    assert "episodes: 4, " in run_play(library, *SMALL, "--use_last_checkpoint")


def test_a_checkpoint_is_gone_on_from_and_played_and_others_are_one_line(
    library, run_train, run_play, fails, tmp_path, monkeypatch
):
    words = ("--max_iterations", "1", "viewer=web", "viewer_port=0")
    run_train(library, *SMALL, *words)
    file = max(checkpoints_in(folder_of(tmp_path, library)))
    run_train(library, *SMALL, *words, "--checkpoint", "last")
    assert "episodes: 4, " in run_play(library, *SMALL)

    def line(*words: str) -> str:
        return fails(run_play, library, *SMALL, "--checkpoint", *words)

    assert "for this task and agent file" in line(str(file), "--task", "Ant")
    assert "no such file" in line(str(tmp_path / "none.pt"))
    damaged, harmful = tmp_path / "damaged.pt", tmp_path / "harmful.pt"
    damaged.write_bytes(b"no checkpoint")
    assert f"no checkpoint of {library}" in line(str(damaged))
    monkeypatch.setenv("HARM", str(tmp_path / "harm"))
    torch.save({"policy": Harmful(), "value": {}, "optimizer": {}}, harmful)
    assert "nothing of it was run" in line(str(harmful))
    assert not (tmp_path / "harm").exists()
    words = ("--use_last_checkpoint", "--logs", str(tmp_path / "none"))
    assert "no checkpoint below" in fails(run_play, library, *SMALL, *words)


class Harmful:
    def __reduce__(self) -> tuple:
        return os.mkdir, (os.environ["HARM"],)


def test_mistakes_are_one_line(library, run_train, fails, tmp_path):
    def line(*words: str) -> str:
        return fails(run_train, library, *SMALL, *words)

    section = {"sb3": "ppo", "skrl": "ppo", "rsl_rl": "algorithm"}[library]
    assert "Cartpole" in line("--task", "Cartpol")
    assert "'max_iteration' (did you mean 'max_iterations'" in line("agent.max_iteration=3")
    assert "unknown key of agent 'zzz'" in line("agent.zzz=1")
    wrong = f"unknown key of agent.{section} 'learning_rat' (did you mean 'learning_rate'?)"
    assert wrong in line(f"agent.{section}.learning_rat=1")
    assert "expected one of '', web" in line("viewer=webb")
    assert "unknown agent file 'Nobody'; choices: Cartpole, default" in line("--agent", "Nobody")
    assert "rl_device" in line("--device", "gpu")
    (tmp_path / "file").touch()
    assert "cannot write the log folder" in line("--logs", str(tmp_path / "file"))
    unknown = tmp_path / "agent.yaml"
    unknown.write_text("max_iterations: 1\n")
    assert "is missing" in line("--agent", str(unknown))


def test_videos_are_written(gl, library, run_train, tmp_path):
    words = ("--video", "--video_length", "6", "--video_interval", "20")
    run_train(library, *SMALL, "--max_iterations", "1", *words)
    videos = sorted((folder_of(tmp_path, library) / "videos").iterdir())
    assert [file.name for file in videos] == ["rl-video-step-0.mp4", "rl-video-step-20.mp4"]
    with av.open(str(videos[0])) as container:
        frames = [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    assert len(frames) == 6
    assert all(frame.std() > 5 for frame in frames)
    assert (np.abs(frames[5].astype(int) - frames[0]) > 30).any()


def test_a_library_that_is_not_installed_is_one_line(library, run_train, fails, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    line = fails(run_train, library, *SMALL)
    assert f"needs the package {LIBRARIES[library]}, which is not installed; pip install" in line


def test_the_last_model_of_sb3_is_where_isaac_lab_has_it(run_train, tmp_path):
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    sb3 = "sb3"
    run_train(sb3, *SMALL, "--max_iterations", "1")
    folder = folder_of(tmp_path, sb3)
    assert stable_baselines3.PPO.load(folder / "model").num_timesteps == 32 * 4
    assert not list(folder.rglob("*.pkl"))


def test_the_first_episode_of_each_environment_counts():
    """Episodes last 2, 3 and 7 steps."""
    lengths = torch.tensor([2, 3, 7])
    stepper = SimpleNamespace(num_envs=3, last_step=None, now=0)

    def step() -> None:
        stepper.now += 1
        ended = stepper.now % lengths == 0
        ids = ended.nonzero().flatten()
        # Later episodes have another return.
        episodes = SimpleNamespace(
            env_ids=ids,
            lengths=lengths[ids],
            returns=100.0 * (stepper.now // lengths[ids]).double(),
        )
        stepper.last_step = SimpleNamespace(episodes=episodes, truncated=ended & (lengths == 7))

    returns, lengths, truncated = play_episodes(stepper, step)
    assert stepper.now == 7
    assert lengths.tolist() == [2, 3, 7]
    assert returns.tolist() == [100.0, 100.0, 100.0]
    assert truncated.tolist() == [False, False, True]
