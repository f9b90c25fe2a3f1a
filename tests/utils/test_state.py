"""The state of an object goes through a file into another object of the same construction."""

from __future__ import annotations

import random
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite.checkpoints.archive import read_archive
from isaacgymenvs_lite.utils.state import Stateful, read_generators, write_generators


class Motion(NamedTuple):
    speed: Tensor
    count: int


class Part(Stateful):
    stored = ("history",)

    def __init__(self) -> None:
        self.history = deque([torch.zeros(2)], maxlen=3)
        self.cache = torch.zeros(1)


class Robot(Stateful):
    """A task as a user may write it."""

    not_stored = ("simulation",)
    left_out: Tensor | None = None

    def __init__(self) -> None:
        self.planes = torch.zeros(2, 3)
        self.commands = self.planes.t()
        self.actions = torch.zeros(3)
        self.last_actions = self.actions
        self.steps, self.name, self.on = 0, "robot", False
        self.rows = np.zeros((2, 2))
        self.drawn: tuple[Tensor, ...] = ()
        self.sums: dict[Any, Any] = {"a": torch.zeros(2), 3: 0.5}
        self.episodes: list[Any] = []
        self.motion = Motion(torch.zeros(1), 0)
        self.held: Tensor | None = None
        self.part = Part()
        self.simulation = Part()
        self.function = abs
        self.generators = (torch.Generator(), np.random.default_rng(0), random.Random(0))
        self.mean: Any = torch.nn.Module()
        self.mean.register_buffer("value", torch.zeros(1))

    def live(self) -> None:
        self.planes[:] = torch.arange(6.0).view(2, 3)
        self.last_actions, self.actions = torch.ones(3), torch.full((3,), 2.0)
        self.steps, self.on = 7, True
        self.left_out = torch.ones(2)
        self.made_later = torch.ones(3)
        self.rows += 4.0
        self.drawn = (torch.arange(3), torch.ones(2, 2))
        self.sums["a"] += 2.0
        self.sums["b"] = torch.ones(1)
        self.episodes += [1.0, 2.0]
        self.motion = Motion(torch.ones(1), 5)
        self.held = torch.ones(4)
        for part in (self.part, self.simulation):
            part.history.append(torch.ones(2))
            part.cache = torch.ones(5)
        self.generators[0].manual_seed(4)
        self.generators[1].random(3)
        self.generators[2].random()
        self.mean.value.add_(1.0)


@pytest.fixture
def restored(tmp_path: Path) -> tuple[Robot, Robot]:
    """Return a robot that has lived, and another robot with its state."""
    lived, other = Robot(), Robot()
    lived.live()
    torch.save(lived.state_dict(), tmp_path / "state.pth")
    other.load_state_dict(read_archive(tmp_path / "state.pth"))
    return lived, other


def test_tensors_arrays_and_numbers(restored):
    lived, other = restored
    for name in ("planes", "commands", "actions", "last_actions", "held", "left_out", "made_later"):
        assert torch.equal(getattr(other, name), getattr(lived, name)), name
    assert (other.steps, other.on, other.name) == (7, True, "robot")
    assert np.array_equal(other.rows, lived.rows)
    assert torch.equal(other.mean.value, torch.ones(1))


def test_containers_keep_their_kinds(restored):
    _, other = restored
    assert isinstance(other.motion, Motion)
    assert (other.motion.speed.item(), other.motion.count) == (1.0, 5)
    assert isinstance(other.drawn, tuple)
    assert [rows.tolist() for rows in other.drawn] == [[0, 1, 2], [[1.0, 1.0], [1.0, 1.0]]]
    assert {name: torch.as_tensor(part).tolist() for name, part in other.sums.items()} == {
        "a": [2.0, 2.0],
        3: 0.5,
        "b": [1.0],
    }
    assert other.episodes == [1.0, 2.0]
    assert other.part.history.maxlen == 3
    assert [entry.tolist() for entry in other.part.history] == [[0.0, 0.0], [1.0, 1.0]]


def test_views_stay_views(restored):
    _, other = restored
    other.commands[0, 0] = 42.0
    assert other.planes[0, 0] == 42.0


def test_tensors_that_were_one_become_two(restored):
    _, other = restored
    other.actions.zero_()
    assert torch.equal(other.last_actions, torch.ones(3))


def test_a_class_chooses_what_is_stored(restored):
    _, other = restored
    assert torch.equal(other.part.cache, torch.zeros(1))
    assert len(other.simulation.history) == 1


def test_generators_go_on(restored):
    lived, other = restored
    assert lived.generators[0].get_state().equal(other.generators[0].get_state())
    assert lived.generators[1].random() == other.generators[1].random()
    assert lived.generators[2].random() == other.generators[2].random()


def test_global_generators_go_on(tmp_path):
    def draw() -> list[float]:
        return [random.gauss(0, 1), np.random.normal(), torch.randn(1).item()]

    draw()  # normal numbers come in pairs: the generators remember the second number
    torch.save(read_generators(), tmp_path / "generators.pth")
    expected = draw()
    draw()
    write_generators(read_archive(tmp_path / "generators.pth"))
    assert draw() == expected


def test_a_state_is_a_copy():
    robot = Robot()
    state = robot.state_dict()
    robot.live()
    assert state["planes"].sum() == 0.0
    assert state["rows"].sum() == 0.0


def test_a_state_of_another_object_is_refused():
    for state in [
        {"planes": {"a": 1}},
        {"live": 3},
        {"__class__": torch.zeros(1)},
        {"motion": [torch.zeros(1), {"a": 1}]},
        {"steps": torch.zeros(3)},
        {"part": {"cache": torch.zeros(1)}},
        {"simulation": {}},
    ]:
        with pytest.raises((TypeError, ValueError)):
            Robot().load_state_dict(state)
