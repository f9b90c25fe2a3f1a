from __future__ import annotations

import types

import torch
from rl_games.common.algo_observer import AlgoObserver

from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.config.launch import read_config
from isaacgymenvs_lite.run.diagnostics import DiagnosticsObserver
from isaacgymenvs_lite.run.observers import MultiObserver, TrainingObservers
from isaacgymenvs_lite.run.stop_request import StopRequest

CALLS = {
    "before_init": ("run", {}, "name"),
    "after_init": ("algo",),
    "process_infos": ({"x": 1}, torch.tensor([0])),
    "after_steps": (),
    "after_clear_stats": (),
    "after_print_stats": (10, 2, 3.0),
}


def test_calls_reach_all_observers_in_order():
    made = []

    def recorder(name: str) -> AlgoObserver:
        observer = AlgoObserver()
        for call in CALLS:
            setattr(observer, call, lambda *args, call=call: made.append((name, call, args)))
        return observer

    # rl_games' base class in the middle has no after_clear_stats.
    every = MultiObserver([recorder("a"), AlgoObserver(), recorder("b")])
    for call, args in CALLS.items():
        getattr(every, call)(*args)
    assert made == [(who, call, args) for call, args in CALLS.items() for who in ("a", "b")]


def test_the_advice_depends_on_whether_episodes_keep_to_their_clip():
    for words, limits in [
        (["task=HumanoidAMP"], ["clipDeviation", "clipTravel", "clipTempo"]),
        (["task=HumanoidAMP", "task.env.clipDeviation=0"], ["clipTravel", "clipTempo"]),
        (["task=HumanoidAMP", "task.env.clipTravel=0"], ["clipDeviation", "clipTempo"]),
        (["task=Ant"], []),
    ]:
        cfg = compose([*words, "rl_device=cpu"])
        observers = TrainingObservers(read_config(cfg), "run", None, 300, StopRequest())
        (advice,) = (one for one in observers.observers if isinstance(one, DiagnosticsObserver))
        advice.after_init(types.SimpleNamespace(config={}))
        assert advice.clip_limits == limits
