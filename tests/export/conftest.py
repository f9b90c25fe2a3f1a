"""Players of every kind of agent, with tiny networks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.learning import conftest as learning
from tests.learning.test_gen_amp import GEN_AMP
from tests.learning.test_hrl import overrides as hierarchy
from tests.learning.test_hrl import train_low_level
from tests.learning.test_ppo_player import PPO
from tests.tiny import TINY_LSTM, TINY_PPO, TINY_SAC

make_runner = learning.make_runner
make_agent = learning.make_agent
make_classic_runner = learning.make_classic_runner

_RNN = "train.params.network.rnn"
CLASSIC = {
    "ppo": ("task=Cartpole", *TINY_PPO),
    "lstm": TINY_LSTM,
    "lstm_apart": (*TINY_LSTM, "train.params.network.separate=True"),
    "gru": (*TINY_LSTM, f"{_RNN}.name=gru"),
    "sac": TINY_SAC,
}
HUMANOID = {"amp": (), "ppo_unclipped": (*PPO, "+train.params.config.clip_actions=False")}


def scramble(model: torch.nn.Module) -> None:
    """Give the normaliser of observations noticeable statistics, and actions some size."""
    generator = torch.Generator().manual_seed(5)
    normalizer: Any = getattr(model, "running_mean_std", None)
    if normalizer is not None:
        shape = normalizer.running_mean.shape
        normalizer.running_mean.copy_(torch.rand(shape, generator=generator) - 0.5)
        normalizer.running_var.copy_(torch.rand(shape, generator=generator) + 0.1)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.endswith("mu.weight") or "actor.trunk" in name:
                parameter.copy_(0.3 * torch.randn(parameter.shape, generator=generator))


@pytest.fixture
def make_player(
    make_classic_runner: Callable[..., Any],
    make_runner: Callable[..., Any],
    make_agent: Callable[..., Any],
    tmp_path: Path,
) -> Callable[[str], Any]:
    """Return make(kind), an rl_games player."""

    def make(kind: str) -> Any:
        if kind in CLASSIC:
            runner = make_classic_runner(*CLASSIC[kind])
        elif kind in HUMANOID:
            runner = make_runner(*HUMANOID[kind])
        elif kind == "gen_amp":
            runner = make_runner(*GEN_AMP)
        else:
            runner = make_runner(*hierarchy(train_low_level(make_agent, tmp_path)))
        player = runner.create_player()
        scramble(player.model)
        return player

    return make
