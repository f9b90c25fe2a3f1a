from __future__ import annotations

import logging
import shlex
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from isaacgymenvs_lite.checkpoints.files import load_checkpoint, resolve_checkpoint
from isaacgymenvs_lite.checkpoints.packed import pack_policy
from isaacgymenvs_lite.checkpoints.policy_arguments import (
    as_override,
    complete_arguments,
    inherited_settings,
)
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.errors import CheckpointError
from isaacgymenvs_lite.runner import run
from isaacgymenvs_lite.typed_command import TypedCommand
from tests.tiny import CONFIG, TINY_AMP


@pytest.fixture
def tiny(full_checkpoint, shipped_dir) -> str:
    """The name of a shipped policy with networks of [16, 8]."""
    pack_policy(full_checkpoint, "tiny")
    return "tiny"


def resolved(section: Any) -> Any:
    return OmegaConf.to_container(section, resolve=True)


def test_a_policy_brings_its_settings_along(tiny):
    cfg = compose(complete_arguments(["test=True", "checkpoint=tiny", "num_envs=2"]))
    assert cfg.task.name == "HumanoidAMP"
    assert cfg.train.params.network.mlp.units == [16, 8]
    assert cfg.train.params.network.disc.units == [12, 6]
    assert cfg.task.env.localRootObs is True
    assert cfg.num_envs == 2


def test_what_was_typed_wins(tiny):
    typed = ["task.env.motion_file=run.npz", "test=True", "checkpoint=tiny", "task=HumanoidAMP"]
    completed = complete_arguments(typed)
    assert completed[-4:] == typed
    assert [word for word in completed if word.startswith("task=")] == ["task=HumanoidAMP"]
    assert compose(completed).task.env.motion_file == "run.npz"


def test_a_policy_of_another_algorithm_brings_its_train_file_along():
    """The train file of HumanoidASE trains skills, and a hierarchy needs other settings."""
    typed = ["checkpoint=heading", "num_envs=2"]
    cfg = compose(complete_arguments(["test=True", *typed]))
    assert (cfg.task.name, cfg.train.params.config.llc_steps) == ("HumanoidASE", 5)
    assert "train=HumanoidASEHRLPPO" in inherited_settings(typed)
    own = ["test=True", "train=HumanoidHeadingPPO", *typed]
    assert compose(complete_arguments(own)).train.params.algo.name == "hrl"


def test_other_command_lines_stay_as_they_are(tiny):
    for typed in [
        ["checkpoint=other", "max_iterations=3"],
        ["test=True", "checkpoint=other"],
        ["test=True", "checkpoint=last"],
        ["test=True"],
        ["--help"],
        [],
    ]:
        assert complete_arguments(typed) == typed


def test_a_policy_is_played_by_its_name(tiny, tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    games = "+train.params.config.player.games_num=2"
    typed = ["test=True", "checkpoint=tiny", "num_envs=2", "num_threads=1", "rl_device=cpu", games]
    with caplog.at_level(logging.INFO):
        run(compose(complete_arguments(typed)))
    (line,) = [message for message in caplog.messages if message.startswith("played ")]
    assert "pose error" in line
    assert not (tmp_path / "runs").exists()


def test_a_run_that_began_with_a_policy_is_played_as_it(tiny):
    """By the words that its training prints: what today's files have need not be repeated."""
    typed = ["checkpoint=tiny", "task.env.motion_file=run.npz", "num_envs=16"]
    words = inherited_settings(typed)
    keys = {word.partition("=")[0] for word in words}
    assert "++task.env.localRootObs" in keys  # differ from the files
    assert "++train.params.network.mlp.units" in keys
    assert "++task.env.controlFrequencyInv" not in keys
    command = TypedCommand(("train.py",), (*words, *typed))
    hint = shlex.split(command.play("HumanoidAMP", Path("x.pth")))
    cfg = compose([word for word in hint[1:] if not word.startswith("checkpoint=")])
    trained = compose(complete_arguments(typed))
    for section in ("task.env", "train.params.network"):
        expected, found = (OmegaConf.select(tree, section) for tree in (trained, cfg))
        assert resolved(found) == resolved(expected), section


def test_a_training_begins_with_a_policy(tiny, shipped_dir, tmp_path, monkeypatch, caplog):
    """With its networks and settings, on another clip; at its first epoch, and no warm start."""
    monkeypatch.chdir(tmp_path)
    typed = [
        *("checkpoint=tiny", "task.env.motion_file=run.npz", *TINY_AMP),
        f"{CONFIG}.warm_start_steps=5",  # which a policy does not need
        *("num_threads=1", "rl_device=cpu", f"{CONFIG}.learning_rate=1e-9", "seed=3"),
    ]
    with caplog.at_level(logging.INFO):
        run(compose(complete_arguments(typed)))
    (saved,) = (tmp_path / "runs").rglob("HumanoidAMP.pth")
    policy, trained = load_checkpoint(shipped_dir / "tiny.pth"), load_checkpoint(saved)
    assert trained["epoch"] == 2  # TINY_AMP's, though the policy has had two itself
    for name, tensor in policy["model"].items():
        if "mean_std." not in name:  # statistics change at any rate
            # Adam moves a weight by its rate a step, here 5e-5 in the discriminator; another
            # seed's weights differ by 0.1.
            torch.testing.assert_close(trained["model"][name], tensor, rtol=0, atol=2e-4)
    text = "\n".join(caplog.messages)
    assert "a new training begins with the networks of this policy" in text
    assert "warm start" not in text


def test_a_name_becomes_the_shipped_file(tiny, shipped_dir, tmp_path):
    path = resolve_checkpoint("tiny", tmp_path, "HumanoidAMP")
    assert path == str(shipped_dir / "tiny.pth")


def test_a_wrong_name_lists_the_policies(tiny, tmp_path):
    with pytest.raises(CheckpointError, match="a shipped policy: tiny") as caught:
        resolve_checkpoint("tyni", tmp_path, "HumanoidAMP")
    assert "\n" not in str(caught.value)


def test_values_survive_the_command_line():
    values = [
        *(None, True, False, 3, -2.5, 1e-06),
        *("walk.npz", "", "None", "true", "3", "it's", "it\\'s", "a,b", "a b", "%{x}", "c:\\d"),
        *("on", "no", "NaN", "inf", "Null", "e5", "_1", "1_0", "deepmimic:walk"),
        *([1, 2], [], ["a", "b c"], [0.0, 0.0, -9.81], {}, {"name": "default"}),
    ]
    words = [f"++task.env.v{i}={as_override(value)}" for i, value in enumerate(values)]
    stored = OmegaConf.to_container(compose(words).task.env)
    assert isinstance(stored, dict)
    for i, value in enumerate(values):
        assert stored[f"v{i}"] == value
        assert type(stored[f"v{i}"]) is type(value)
