"""The published observer of Weights & Biases, with a wandb that notes what it is asked for."""

from __future__ import annotations

import importlib.util
import sys
import types
from typing import Any

import pytest
from omegaconf import OmegaConf

from isaacgymenvs_lite.isaacgymenvs_compat.wandb_utils import WandbAlgoObserver

TREE = {
    "num_envs": 4,
    "wandb_project": "p",
    "wandb_tags": ["a"],
    "wandb_name": "${train.params.config.name}",
    "train": {"params": {"config": {"name": "Ant"}}},
}


@pytest.fixture
def installed(monkeypatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())


@pytest.mark.parametrize("kind", [OmegaConf.create, dict])
def test_a_run_has_the_experiment_s_name(kind, installed, monkeypatch) -> None:
    asked: list[dict[str, Any]] = []
    fake = types.ModuleType("wandb")
    monkeypatch.setattr(fake, "init", lambda **keys: asked.append(keys), raising=False)
    monkeypatch.setitem(sys.modules, "wandb", fake)
    observer = WandbAlgoObserver(kind(TREE))
    assert asked == []
    observer.before_init("run", {}, "Ant_22-10")
    (keys,) = asked
    assert (keys["id"], keys["name"]) == ("uid_Ant_22-10", "Ant_22-10")
    assert (keys["project"], keys["tags"], keys["config"]["num_envs"]) == ("p", ["a"], 4)
