"""Which keys reach a task, and how many."""

from __future__ import annotations

import time
from typing import Any

import pytest

from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.viewers.task_keys import KEY_NAMES, TaskKeys
from tests.viewers.conftest import KeyedTask


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    now_s = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    return now_s


def test_the_names_are_those_that_tasks_expect():
    assert len(KEY_NAMES) == len(set(KEY_NAMES)) == 5 + 26 + 10
    documented = VecTask.on_key.__doc__ or ""
    assert all(f"`{name}`" in documented for name in KEY_NAMES[:5])


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize("name", ["", "A", "é", "up\n", "escape", "upup", "__class__", "\ufffd"])
def test_other_names_are_dropped(name):
    task = KeyedTask()
    keys = TaskKeys(task)
    keys.press(name)
    keys.press("up")
    assert task.pressed == ["up"]


def test_a_training_gets_none():
    task = KeyedTask()
    TaskKeys(task, are_passed=False).press("up")
    assert task.pressed == []


def test_a_flood_is_limited_to_20_keys_a_second(clock: list[Any]):
    task = KeyedTask()
    keys = TaskKeys(task)
    for _ in range(300):  # 3 s, 1,000 keys a second
        clock[0] += 0.01
        for _ in range(10):
            keys.press("up")
    assert 60 <= len(task.pressed) <= 80
    clock[0] += 1.0
    keys.press("down")
    assert task.pressed[-1] == "down"
