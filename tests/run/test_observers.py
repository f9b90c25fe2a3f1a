from __future__ import annotations

import types
from typing import Any

import torch
from rl_games.common.algo_observer import AlgoObserver

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import check_config
from isaacgymenvs_lite.run import DiagnosticsObserver, MultiObserver, TrainingObservers
from isaacgymenvs_lite.run.stop_request import StopRequest


def test_calls_reach_all_observers_in_order():
    calls_made = []

    class Recorder(AlgoObserver):
        def __init__(self, name: str) -> None:
            super().__init__()
            self.name = name

        def before_init(self, *args: Any) -> None:
            calls_made.append((self.name, "before_init", args))

        def after_init(self, *args: Any) -> None:
            calls_made.append((self.name, "after_init", args))

        def process_infos(self, *args: Any) -> None:
            calls_made.append((self.name, "process_infos", args))

        def after_steps(self) -> None:
            calls_made.append((self.name, "after_steps", ()))

        def after_clear_stats(self) -> None:
            calls_made.append((self.name, "after_clear_stats", ()))

        def after_print_stats(self, *args: Any) -> None:
            calls_made.append((self.name, "after_print_stats", args))

    class Plain(AlgoObserver):
        """rl_games' base class has no after_clear_stats."""

    both = MultiObserver([Recorder("a"), Plain(), Recorder("b")])
    calls = {
        "before_init": ("run", {}, "name"),
        "after_init": ("algo",),
        "process_infos": ({"x": 1}, torch.tensor([0])),
        "after_steps": (),
        "after_clear_stats": (),
        "after_print_stats": (10, 2, 3.0),
    }
    for name, args in calls.items():
        getattr(both, name)(*args)
    assert calls_made == [(who, name, args) for name, args in calls.items() for who in ("a", "b")]


def test_the_advice_depends_on_whether_episodes_keep_to_their_clip():
    for words, limits in [
        (["task=HumanoidAMP"], ["clipDeviation", "clipTravel", "clipTempo"]),
        (["task=HumanoidAMP", "task.env.clipDeviation=0"], ["clipTravel", "clipTempo"]),
        (["task=HumanoidAMP", "task.env.clipTravel=0"], ["clipDeviation", "clipTempo"]),
        (["task=Ant"], []),
    ]:
        cfg = compose([*words, "rl_device=cpu"])
        observers = TrainingObservers(cfg, check_config(cfg), "run", None, 300, StopRequest())
        (advice,) = (one for one in observers.observers if isinstance(one, DiagnosticsObserver))
        advice.after_init(types.SimpleNamespace(config={}))
        assert advice.clip_limits == limits
