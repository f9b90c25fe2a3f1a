"""Every value that the schema of a train file allows trains an epoch, or is refused in one line."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any

import pytest

from isaacgymenvs_lite.config import rl_games_settings as settings
from isaacgymenvs_lite.errors import UserError
from isaacgymenvs_lite.learning.amp_config import GenAMPParams
from isaacgymenvs_lite.registration import build_runner, known_names
from isaacgymenvs_lite.runner import run
from tests.tiny import ASYMMETRIC_CRITIC, CONFIG, TINY_AMP, TINY_PPO, TINY_STYLE, composed

NETWORK = "train.params.network"
GAUSSIAN = f"{NETWORK}.space.continuous"
CRITIC = f"{CONFIG}.central_value_config"
INITIALIZER = {"const_initializer": "{name: const_initializer, val: 0.1}"}
PPO = ("task=Cartpole", *TINY_PPO, "train.params.network.mlp.units=[8]")
ASYMMETRIC = ("task.env.asymmetric_observations=True", f"+{CRITIC}={ASYMMETRIC_CRITIC}")
RECURRENT = (f"+{NETWORK}.rnn={{name: lstm, units: 8, layers: 1}}",)
AMP = ("task=HumanoidASE", *TINY_AMP, *TINY_STYLE, f"{CONFIG}.imitation_frequency=0")


def choices(cls: type[Any], path: str) -> Iterator[str]:
    """Yield a word for each choice, and each truth value, of a settings class."""
    kinds = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        values = field.metadata["choices"] or ((True, False) if kinds[field.name] is bool else ())
        yield from (f"++{path}.{field.name}={value}" for value in values)


def cases() -> Iterator[tuple[str, ...]]:
    """Yield the words of each training."""
    sections: tuple[tuple[type[Any], str, tuple[str, ...]], ...] = (
        (settings.PPOSettings, CONFIG, PPO),
        (settings.RewardShaperSettings, f"{CONFIG}.reward_shaper", PPO),
        (settings.NetworkSettings, NETWORK, PPO),
        (settings.LayerSettings, f"{NETWORK}.mlp", PPO),
        (settings.GaussianSettings, GAUSSIAN, PPO),
        (settings.RecurrentSettings, f"{NETWORK}.rnn", (*PPO, *RECURRENT)),
        (settings.CentralValueSettings, CRITIC, (*PPO, *ASYMMETRIC)),
        (GenAMPParams, CONFIG, AMP),
    )
    for cls, path, words in sections:
        yield from ((*words, word) for word in choices(cls, path))
    for name in settings.INITIALIZERS:
        given = INITIALIZER.get(name, f"{{name: {name}}}")
        yield (*PPO, f"~{NETWORK}.mlp.initializer", f"+{NETWORK}.mlp.initializer={given}")
        for key in ("mu_init", "sigma_init"):
            for fixed in (True, False):
                replaced = (f"~{GAUSSIAN}.{key}", f"+{GAUSSIAN}.{key}={given}")
                yield (*PPO, f"{GAUSSIAN}.fixed_sigma={fixed}", *replaced)
    registered = known_names(build_runner())
    for words in (PPO, AMP):
        yield from ((*words, f"train.params.model.name={name}") for name in registered.models)
        yield from ((*words, f"{NETWORK}.name={name}") for name in registered.networks)
        yield from ((*words, f"train.params.algo.name={name}") for name in registered.algos)
    for word in ("lr_schedule=adaptive", "lr_schedule=linear", "lr_schedule=other"):
        yield (*PPO, f"++{CONFIG}.{word}")
        yield (*PPO, *ASYMMETRIC, f"++{CRITIC}.{word}", f"++{CRITIC}.kl_threshold=0.01")
    yield (*PPO, f"++{CONFIG}.bounds_loss_coef=null")
    yield (*PPO, *ASYMMETRIC, f"~{CRITIC}.network.central_value")
    yield (*PPO, *ASYMMETRIC, f"++{CRITIC}.network.rnn={{name: gru, units: 8, layers: 1}}")


@pytest.mark.slow
@pytest.mark.parametrize("words", list(cases()), ids=lambda words: words[-1])
def test_a_value_trains_or_is_refused(words: tuple[str, ...], tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        run(composed([*words, "max_iterations=1"]))
    except UserError as error:
        assert "\n" not in str(error)
