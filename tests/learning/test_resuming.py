"""A training that was stopped and resumed is the training that was never stopped, bit by bit."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest
import torch

from isaacgymenvs_lite.checkpoints.run_config import resumed_tree
from isaacgymenvs_lite.checkpoints.training_state import read_training_state
from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.runner import run
from tests.tiny import CONFIG, ONE_THREAD, TINY_AMP, TINY_LSTM, TINY_PPO, TINY_SAC, TINY_STYLE
from tests.tiny import train_in as train

SHORT_EPISODES = "task.env.episodeLength=6"
AGENTS = {
    "ppo": ("task=Ant", *TINY_PPO, SHORT_EPISODES, f"{CONFIG}.lr_schedule=adaptive"),
    "ppo_randomized": ("task=Ant", *TINY_PPO, SHORT_EPISODES, "task.task.randomize=True"),
    "asymmetric": ("task=AnymalTerrain", "train=AnymalTerrainPPO", *TINY_PPO),
    "amp": ("task=HumanoidAMP", *TINY_AMP, SHORT_EPISODES, f"{CONFIG}.lr_schedule=adaptive"),
    "gen_amp": ("task=HumanoidASE", *TINY_AMP, *TINY_STYLE, SHORT_EPISODES),
    "lstm": (*TINY_LSTM, *ONE_THREAD, f"{CONFIG}.seq_length=4"),
    "sac": (*TINY_SAC, *ONE_THREAD, SHORT_EPISODES),
}


def state_of(run_folder: Path, epoch: int) -> dict[str, Any]:
    state = read_training_state(run_folder / "resume" / f"{epoch}.pth")
    assert state.memory is not None
    return {"checkpoint": state.checkpoint, "memory": state.memory, "buffers": state.buffers}


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


@pytest.mark.parametrize("words", AGENTS.values(), ids=AGENTS)
def test_resumed_run_is_the_run_that_never_stopped(words, tmp_path):
    folders = [tmp_path / name for name in ("whole", "stopped")]
    for folder in folders:
        folder.mkdir()
    whole = train(folders[0], [*words, "max_iterations=4"])
    stopped = train(folders[1], [*words, "max_iterations=2"])
    run(resumed_tree([f"resume={stopped}", "max_iterations=4"]))
    assert [path.name for path in stopped.parent.iterdir()] == [stopped.name]
    assert_same(state_of(stopped, 4), state_of(whole, 4))
