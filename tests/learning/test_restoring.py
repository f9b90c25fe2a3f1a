"""Checkpoints that do not fit: agents and players refuse them before they take anything over."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from isaacgymenvs_lite.checkpoints import files as checkpoints
from isaacgymenvs_lite.errors import CheckpointError
from tests.learning.test_gen_amp import GEN_AMP
from tests.learning.test_hrl import llc, overrides  # noqa: F401  a fixture
from tests.learning.test_recurrent_ppo import asymmetric
from tests.tiny import CONFIG, TINY_LSTM, TINY_SAC, fast_and_slow

PPO = (
    *("task=Cartpole", "num_envs=8", "train.params.network.mlp.units=[8]"),
    *(f"{CONFIG}.minibatch_size=32", f"{CONFIG}.horizon_length=8", f"{CONFIG}.mini_epochs=1"),
)
CLASSIC: dict[str, tuple[str, ...]] = {
    "ppo": PPO,
    "lstm": TINY_LSTM,
    "asymmetric": (
        *("task=Cartpole", "num_envs=16", "train.params.network.mlp.units=[8]"),
        *(f"{CONFIG}.minibatch_size=96", f"{CONFIG}.horizon_length=6"),
        *asymmetric(),
    ),
    "sac": (*TINY_SAC, f"{CONFIG}.num_warmup_steps=0", "task.env.episodeLength=20"),
}
KINDS = (*CLASSIC, "amp", "gen_amp", "hrl")
EACH_KIND = fast_and_slow({kind: kind for kind in KINDS}, "ppo", "sac", "amp")


@pytest.fixture
def make(request, make_agent, make_classic_agent) -> Callable[..., Any]:
    """Return a function (kind, *more) that makes an agent before its first epoch."""

    def make_kind(kind: str, *more: str) -> Any:
        more = ("max_iterations=1", *more)
        if kind in CLASSIC:
            return make_classic_agent(*CLASSIC[kind], *more)
        if kind == "hrl":
            return make_agent(*overrides(request.getfixturevalue("llc")), *more)
        return make_agent(*(GEN_AMP if kind == "gen_amp" else ()), *more)

    return make_kind


def content(agent: Any) -> dict[str, Any]:
    """All that a checkpoint would change, by its path."""
    return dict(flat("", copy.deepcopy(agent.get_full_state_weights())))


def flat(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    entries = value.items() if isinstance(value, dict) else enumerate(value)
    for key, entry in entries:
        if isinstance(entry, (dict, list, tuple)):
            yield from flat(f"{path}.{key}", entry)
        else:
            yield f"{path}.{key}", entry


def same(first: dict[str, Any], second: dict[str, Any]) -> bool:
    if first.keys() != second.keys():
        return False
    pairs = ((value, second[path]) for path, value in first.items())
    return all(
        torch.equal(own, other) if isinstance(own, torch.Tensor) else own == other
        for own, other in pairs
    )


def first_moment(state: dict[str, Any]) -> tuple[dict[str, Any], str]:
    key = "actor_optimizer" if "actor_optimizer" in state else "optimizer"
    return state[key], key


def test_whole_numbers_of_rows_load_as_rl_games_2_has_them(make):
    agent = make("ppo")
    state = copy.deepcopy(agent.get_full_state_weights())
    counts = [name for name in state["model"] if name.endswith(".count")]
    assert len(counts) == 2
    for name in counts:
        state["model"][name] = torch.tensor(77)
    agent.set_full_state_weights(state)
    assert {float(agent.model.state_dict()[name]) for name in counts} == {77.0}
    assert {agent.model.state_dict()[name].dtype for name in counts} == {torch.float64}


Change = Callable[[dict[str, Any]], None]


def of_moments(name: str, value: Callable[[torch.Tensor], Any]) -> Change:
    def change(state: dict[str, Any]) -> None:
        moments = first_moment(state)[0]["state"].values()
        entry = next(entry for entry in moments if entry["exp_avg"].ndim == 2)
        entry[name] = value(entry[name])

    return change


def of_networks(value: Callable[[torch.Tensor], Any]) -> Change:
    def change(state: dict[str, Any]) -> None:
        network = state["model"] if "model" in state else state["actor"]
        name = next(name for name in network if name.endswith("weight"))
        network[name] = value(network[name])

    return change


def renumbered(state: dict[str, Any]) -> None:
    optimizer = first_moment(state)[0]
    first = next(iter(optimizer["state"]))
    optimizer["state"][10**6] = optimizer["state"].pop(first)


def without_group(state: dict[str, Any]) -> None:
    first_moment(state)[0]["param_groups"].clear()


def entry(key: str, value: Any) -> Change:
    return lambda state: state.__setitem__(key, value)


WRONG: dict[str, tuple[Change, str]] = {
    "one number": (
        of_moments("exp_avg", lambda _: torch.zeros(1)),
        r"state.\d.exp_avg is 1 float32",
    ),
    "no numbers": (of_moments("exp_avg_sq", lambda _: torch.zeros(0)), "exp_avg_sq is 0 float32"),
    "double": (of_moments("exp_avg", lambda t: t.double()), "float64, expected .* float32"),
    "integers": (of_moments("exp_avg_sq", lambda t: t.long()), "int64, expected .* float32"),
    "transposed": (of_moments("exp_avg", lambda t: torch.zeros(t.shape[::-1])), "expected .*x"),
    "text": (of_moments("exp_avg", lambda _: "x"), "exp_avg is a str, expected"),
    "steps": (
        of_moments("step", lambda _: torch.zeros(7)),
        "step is 7 float32, expected one",
    ),
    "negative steps": (of_moments("step", lambda _: -1.0), "step has values below 0"),
    "nan": (of_moments("exp_avg", lambda t: t * math.nan), "exp_avg has .* not finite"),
    "below 0": (of_moments("exp_avg_sq", lambda t: t - 1.0), "exp_avg_sq has values below 0"),
    "another number": (renumbered, "optimizer is no state of this optimiser"),
    "no groups": (without_group, "0 groups of parameters, expected|no state of this optimiser"),
    "weight": (of_networks(lambda t: t[:1]), "weight is .* expected .* another network"),
    "half": (of_networks(lambda t: t.half()), "float16, expected .* float32"),
    "broken": (of_networks(lambda t: t.fill_(math.inf)), "weight has .* not finite"),
    "list": (of_networks(lambda t: t.tolist()), "weight is a list, expected a tensor"),
    "epoch": (entry("epoch", -3), "epoch is -3, expected a number"),
    "frame": (entry("frame", None), "frame is None, expected a number"),
    "best": (entry("last_mean_rewards", math.nan), "last_mean_rewards is nan"),
}


@pytest.mark.parametrize("kind", EACH_KIND)
def test_an_agent_takes_nothing_over_of_a_checkpoint_that_does_not_fit(kind, make, tmp_path):
    agent = make(kind, "max_iterations=3")  # SAC's optimisers have moments from the second on
    agent.train()
    agent.save(str(tmp_path / "real"))
    real = checkpoints.load_checkpoint(tmp_path / "real.pth")
    path = tmp_path / "wrong.pth"
    names = WRONG if kind in ("ppo", "amp", "sac") else ("one number", "nan", "no groups", "weight")
    for name in names:
        change, words = WRONG[name]
        state = copy.deepcopy(real)
        change(state)
        torch.save(state, path)
        before = content(agent)
        with pytest.raises(CheckpointError, match=words) as caught:
            agent.restore(str(path))
        assert str(path) in str(caught.value), name
        assert "\n" not in str(caught.value), name
        assert same(content(agent), before), name
    agent.restore(str(tmp_path / "real.pth"))
    agent.max_epochs = agent.epoch_num + 1
    agent.train()


@pytest.mark.parametrize("kind", EACH_KIND)
def test_every_part_is_compared(kind, make, tmp_path):
    """Of each part of a checkpoint the last tensor is cut; a missing part is named."""
    agent = make(kind, "max_iterations=3")  # SAC's optimisers have moments from the second on
    agent.train()
    agent.save(str(tmp_path / "real"))
    real = checkpoints.load_checkpoint(tmp_path / "real.pth")
    path = tmp_path / "wrong.pth"
    parts = agent._parts()
    assert len(parts.modules) + len(parts.optimizers) >= 2
    for key in (*parts.modules, *parts.optimizers):
        state = copy.deepcopy(real)
        del state[key]
        torch.save(state, path)
        if key not in parts.optional:
            with pytest.raises(CheckpointError, match=rf"has no {key}, so that|holds no model"):
                agent.restore(str(path))
    for key in parts.modules:
        state = copy.deepcopy(real)
        name = next(reversed(state[key]))
        state[key][name] = torch.zeros(3, 1, 4)
        torch.save(state, path)
        with pytest.raises(CheckpointError, match=rf"{key}\.{name} is 3x1x4 float.., expected"):
            agent.restore(str(path))
        state[key] = {**real[key], "another": torch.zeros(2)}
        torch.save(state, path)
        with pytest.raises(CheckpointError, match=rf"{key}\.another .* not expected"):
            agent.restore(str(path))


@pytest.mark.parametrize("kind", [each for each in EACH_KIND if each.id != "sac"])  # not packed
def test_a_packed_policy_begins_a_training(kind, make, tmp_path):
    """Its networks replace the agent's; optimiser, counts and best reward are as at first."""
    agent = make(kind, "max_iterations=2")
    agent.train()
    agent.save(str(tmp_path / "full"))
    full = checkpoints.load_checkpoint(tmp_path / "full.pth")
    parts = agent._parts()
    packed = {key: full[key] for key in (*parts.modules, "llc") if key in full}
    packed["policy"] = {"settings": {}}
    torch.save(packed, tmp_path / "packed.pth")
    agent.restore(str(tmp_path / "packed.pth"))
    assert (agent.epoch_num, agent.frame) == (0, 0)
    assert not agent.optimizer.state
    agent.train()
    assert agent.epoch_num == 2

    other = make(kind, "seed=11")
    other.restore(str(tmp_path / "packed.pth"))
    found = other.get_full_state_weights()
    for key in parts.modules:
        assert same(dict(flat("", found[key])), dict(flat("", full[key]))), key
    rate = other.optimizer.param_groups[0]["lr"]
    assert rate == make(kind).optimizer.param_groups[0]["lr"]


def test_what_other_versions_of_torch_write_is_taken_over(make, tmp_path):
    """Steps were plain numbers before torch 1.12, and groups had fewer switches."""
    agent = make("amp")
    agent.train()
    agent.save(str(tmp_path / "new"))
    state = checkpoints.load_checkpoint(tmp_path / "new.pth")
    for entry in state["optimizer"]["state"].values():
        entry["step"] = int(entry["step"])
    kept = ("lr", "betas", "eps", "weight_decay", "params")
    groups = state["optimizer"]["param_groups"]
    state["optimizer"]["param_groups"] = [{key: group[key] for key in kept} for group in groups]
    torch.save(state, tmp_path / "old.pth")
    resumed = make("amp", "max_iterations=2")
    resumed.restore(str(tmp_path / "old.pth"))
    for own, other in zip(
        resumed.optimizer.state.values(), agent.optimizer.state.values(), strict=True
    ):
        assert own["step"] == other["step"]
        assert torch.equal(own["exp_avg"], other["exp_avg"])
    assert resumed.optimizer.param_groups[0]["fused"] is True
    resumed.train()
    assert resumed.epoch_num == 2


def test_switches_of_a_strangers_optimiser_are_not_taken_over(make, tmp_path):
    agent = make("ppo")
    agent.train()
    agent.save(str(tmp_path / "real"))
    state = checkpoints.load_checkpoint(tmp_path / "real.pth")
    odd = {"amsgrad": True, "capturable": True, "differentiable": True, "maximize": True}
    state["optimizer"]["param_groups"][0] |= odd | {"fused": False}
    torch.save(state, tmp_path / "odd.pth")
    agent.restore(str(tmp_path / "odd.pth"))
    (group,) = agent.optimizer.param_groups
    assert {name: group[name] for name in odd} == dict.fromkeys(odd, False)
    assert group["fused"] is True


def test_an_agent_that_nobody_registered_reads_safely(make, tmp_path, monkeypatch):
    """`register` puts our reader in rl_games' place; an agent does not depend on it."""
    from rl_games.algos_torch import torch_ext

    agent = make("ppo")
    agent.train()

    def unsafe(*_args: Any) -> Any:
        pytest.fail("rl_games' own function")

    monkeypatch.setattr(torch_ext, "load_checkpoint", unsafe)
    monkeypatch.setattr(torch_ext, "save_checkpoint", unsafe)
    agent.save(str(tmp_path / "saved"))
    agent.restore(str(tmp_path / "saved.pth"))


def test_the_critic_alone_is_compared_too(make, tmp_path):
    agent = make("asymmetric")
    agent.save(str(tmp_path / "real"))
    agent.restore_central_value_function(str(tmp_path / "real.pth"))
    state = checkpoints.load_checkpoint(tmp_path / "real.pth")
    name = next(iter(state["assymetric_vf_nets"]))
    state["assymetric_vf_nets"][name] = torch.zeros(9)
    torch.save(state, tmp_path / "wrong.pth")
    with pytest.raises(CheckpointError, match=rf"assymetric_vf_nets.{name} is 9 float32"):
        agent.restore_central_value_function(str(tmp_path / "wrong.pth"))


# --- players ------------------------------------------------------------------------------------

PLAYED = {name: WRONG[name] for name in ("weight", "half", "broken", "list", "best")}


@pytest.mark.parametrize("kind", EACH_KIND)
def test_a_player_takes_nothing_over_either(
    kind, make, make_runner, make_classic_runner, request, tmp_path
):
    agent = make(kind)
    agent.save(str(tmp_path / "real"))
    if kind in CLASSIC:
        player = make_classic_runner(*CLASSIC[kind]).create_player()
    else:
        own = overrides(request.getfixturevalue("llc")) if kind == "hrl" else ()
        own = GEN_AMP if kind == "gen_amp" else own
        player = make_runner(*own, "test=True").create_player()
    player.restore(str(tmp_path / "real.pth"))
    real = checkpoints.load_checkpoint(tmp_path / "real.pth")
    path = tmp_path / "wrong.pth"
    for name, (change, words) in PLAYED.items():
        state = copy.deepcopy(real)
        change(state)
        torch.save(state, path)
        with pytest.raises(CheckpointError, match=words) as caught:
            player.restore(str(path))
        assert str(path) in str(caught.value), name
        for own_tensor, other in zip(
            player.model.state_dict().values(), agent.model.state_dict().values(), strict=True
        ):
            assert torch.equal(own_tensor, other), name


def test_so_does_a_low_level_controller(llc, make_agent, tmp_path):  # noqa: F811  the fixture
    state = checkpoints.load_checkpoint(llc[2])
    wrong = str(tmp_path / "wrong.pth")
    given = (*llc[:2], wrong)
    for key, name, value, words in (
        ("model", "a2c_network.actor_mlp._dense_layers.0.bias", torch.zeros(1), "is 1 float32"),
        ("model", "a2c_network.mu.bias", torch.tensor(1.0), "expects 0 dimensions of actions"),
        ("amp_input_mean_std", "running_var", torch.zeros(2).double(), "is 2 float64"),
        ("model", "a2c_network.mu.bias", torch.full((28,), math.nan), "not finite"),
    ):
        changed = {**state, key: {**state[key], name: value}}
        assert set(changed[key]) == set(state[key])
        torch.save(changed, wrong)
        with pytest.raises(CheckpointError, match=words) as caught:
            make_agent(*overrides(given))
        assert wrong in str(caught.value)
        assert "\n" not in str(caught.value)


def test_levels_of_a_terrain_are_compared_as_well(make_classic_agent):
    small = ("task=AnymalTerrain", "num_envs=4", "task.env.terrain.numLevels=2")
    agent = make_classic_agent(*small, "task.env.terrain.numTerrains=2", "max_iterations=1")
    task = agent.vec_env.env
    levels = task.curriculum.levels.clone()
    for odd in (
        [1, 1, 1, 1],
        {"terrain_levels": levels.float()},
        {"terrain_levels": levels[:2]},
        {"terrain_levels": levels - 5},
        {"terrain_levels": levels + 100},
        {"terrain_levels": "high"},
    ):
        task.set_env_state(odd)
        assert torch.equal(task.curriculum.levels, levels)
    task.set_env_state({"terrain_levels": 1 - levels.clamp(max=1)})
    assert torch.equal(task.curriculum.levels, 1 - levels.clamp(max=1))


def test_a_file_of_the_working_folder_is_named_as_it_was_given(make, tmp_path, monkeypatch):
    agent = make("ppo")
    monkeypatch.chdir(tmp_path)
    torch.save({"model": {}}, Path("empty.pth"))
    with pytest.raises(CheckpointError, match=r"^checkpoint=empty\.pth: has no optimizer, epoch"):
        agent.restore("empty.pth")
