"""Which keys reach a task."""

from __future__ import annotations

from isaacgymenvs_lite.tasks.base.vec_task import VecTask
from isaacgymenvs_lite.viewers.window import KEY_NAMES, press_key
from tests.viewers.conftest import KeyedTask


def test_the_names_are_those_that_tasks_expect():
    assert len(KEY_NAMES) == len(set(KEY_NAMES)) == 5 + 26 + 10
    documented = VecTask.on_key.__doc__ or ""
    assert all(f"`{name}`" in documented for name in KEY_NAMES[:5])


def test_other_names_are_dropped():
    for name in ["", "A", "é", "up\n", "escape", "upup", "__class__", "\ufffd"]:
        task = KeyedTask()
        press_key(task, name)
        press_key(task, "up")
        assert task.pressed == ["up"]
