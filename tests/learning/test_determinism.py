"""With `torch_deterministic=True` any number of threads trains the same networks, bit by bit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from isaacgymenvs_lite.checkpoints.training_state import read_training_state
from tests.tiny import CONFIG, TINY_AMP, TINY_LSTM, TINY_PPO, TINY_SAC, TINY_STYLE, fast_and_slow
from tests.tiny import train_in as train

# Enough rows for several slices in the rollout and in the update, and layers that torch's own
# threads would share.
WIDE = ("train.params.network.mlp.units=[256,128]", f"{CONFIG}.minibatch_size=2048")
MANY = ("num_envs=1024", f"{CONFIG}.horizon_length=2", *WIDE)
MANY_MOTIONS = (f"{CONFIG}.amp_minibatch_size=2048", f"{CONFIG}.amp_batch_size=256")
AGENTS = {
    "ppo": ("task=Ant", *TINY_PPO, *MANY),
    "amp": ("task=HumanoidAMP", *TINY_AMP, *MANY, *MANY_MOTIONS),
    "gen_amp": ("task=HumanoidASE", *TINY_AMP, *TINY_STYLE, *MANY, *MANY_MOTIONS),
    "lstm": (*TINY_LSTM, "num_envs=512", "train.params.network.rnn.units=64"),
    "sac": (
        *TINY_SAC,
        "num_envs=256",
        "max_iterations=2",
        f"{CONFIG}.batch_size=1024",
        "train.params.network.mlp.units=[256,256]",
    ),
}


def trained(folder: Path, words: Sequence[str], num_threads: int) -> dict[str, Any]:
    folder = folder / f"{num_threads}"
    folder.mkdir()
    settings = ("rl_device=cpu", "torch_deterministic=True", f"num_threads={num_threads}")
    state = read_training_state(train(folder, [*words, *settings]) / "resume" / "2.pth")
    return state.checkpoint["model" if "model" in state.checkpoint else "actor"]


def assert_same_bits(folder: Path, words: Sequence[str]) -> None:
    one, other = (trained(folder, words, num_threads) for num_threads in (1, 3))
    assert not [name for name, value in one.items() if not torch.equal(value, other[name])]


@pytest.mark.parametrize("words", fast_and_slow(AGENTS, "ppo", "amp"))
def test_threads_do_not_change_a_bit(words, tmp_path):
    assert_same_bits(tmp_path, words)


@pytest.mark.slow
def test_threads_do_not_change_a_bit_of_a_hierarchy(tmp_path):
    words = ["task=HumanoidASE", *TINY_AMP, *TINY_STYLE, "max_iterations=1"]
    low = train(tmp_path, words)
    llc = (
        f"{CONFIG}.llc_config={low / 'config.yaml'}",
        f"{CONFIG}.llc_checkpoint={next(low.glob('nn/*.pth'))}",
    )
    stand = "task.env.motion_file=stand"
    assert_same_bits(tmp_path, ("task=HumanoidHeading", stand, *TINY_PPO, *MANY, *llc))
