"""What goes through the socket between a task and its page, in one process."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from isaacgymenvs_lite.rendering.markers import Arrow, Sphere
from isaacgymenvs_lite.viewers.web_link import PageEnd, TaskEnd, make_link

XML = """<mujoco><worldbody><body><joint type="slide"/><geom name="{}" size="{}"/></body>
<body><joint/><geom size="1"/></body></worldbody></mujoco>"""


def model_of(size: float) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML.format("ball", size))


@pytest.fixture
def sockets() -> Iterator[tuple[socket.socket, socket.socket]]:
    here, there = make_link()
    with here, there:
        yield here, there


@pytest.fixture
def ends(sockets) -> tuple[TaskEnd, PageEnd]:
    """Both ends; the page has received a model of a ball of 0.5 m, with two joints."""
    task, page = TaskEnd(sockets[0]), PageEnd(sockets[1])
    assert task.send_model(model_of(0.5))
    model = page.wait_for_model()
    assert model is not None
    assert model.geom("ball").size[0] == 0.5
    return task, page


def test_of_several_states_the_last_one_counts(ends):
    task, page = ends
    assert page.receive().qpos is None
    for position_m in (1.0, 2.0, 3.0):
        assert task.send_state(np.array((position_m, 0.25)), np.array((position_m, -1.0)))
    update = page.receive()
    np.testing.assert_array_equal(update.qpos, (3.0, 0.25))
    np.testing.assert_array_equal(update.reference, (3.0, -1.0))
    assert update.model is None
    assert not update.has_ended
    markers = (
        Arrow((0.0, 1.0, 2.0), (3.0, 4.0, 5.0), (0.1, 0.2, 0.3)),
        Sphere((1.0, 0.0, 2.0), 0.25, (0.4, 0.5, 0.6)),
    )
    task.send_state(np.zeros(2), markers=markers)
    update = page.receive()
    np.testing.assert_array_equal(update.qpos, (0.0, 0.0))
    assert update.reference is None
    assert update.markers == markers


def test_a_state_before_a_new_model_is_not_the_new_ones(ends):
    task, page = ends
    task.send_state(np.ones(2))
    task.send_model(model_of(0.7))
    update = page.receive()
    assert update.model is not None
    assert update.model.geom("ball").size[0] == 0.7
    assert update.qpos is None


def test_a_page_that_does_not_read_is_not_waited_for(ends):
    task, page = ends
    qpos = np.arange(2.0)
    while task.send_state(qpos):
        qpos += 1.0
    assert not task.send_model(model_of(0.7))
    last = page.receive().qpos
    assert last is not None
    assert last[0] == qpos[0] - 1.0
    assert task.send_state(qpos)
    assert task.send_model(model_of(0.7))


def test_models_leave_no_open_files(ends):
    task, page = ends
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        task.send_model(model_of(0.7))
        page.receive()
    assert len(os.listdir("/proc/self/fd")) == before


def test_either_end_may_go_first(ends, sockets):
    task, page = ends
    page.send_key("up")  # unread
    task.close()
    assert page.receive().has_ended
    page.send_key("up")
    assert task.pressed_keys() == []


def test_a_task_does_without_its_page(ends, sockets):
    task, _ = ends
    sockets[1].close()
    assert task.pressed_keys() == []
    assert not task.send_state(np.zeros(2))
    assert not task.send_model(model_of(0.7))
    assert task.wait_for_start(1.0) is None


def test_a_task_does_not_trust_what_a_page_sends(ends, sockets):
    task, page = ends
    for packet in (b"up", b"\xff\x00", b"x" * 1000, b"down"):
        sockets[1].send(packet)
    first, *others, last = task.pressed_keys()
    assert (first, last) == ("up", "down")
    assert max(map(len, others)) <= 16
    for _ in range(200):
        page.send_key("up")
    assert len(task.pressed_keys()) == 64


def test_the_start_is_reported_or_waited_for_in_vain(ends):
    task, page = ends
    with pytest.raises(TimeoutError):
        task.wait_for_start(0.05)
    page.send_start(port=8080, token="é")
    assert task.wait_for_start(1.0) == json.loads('{"port": 8080, "token": "\\u00e9"}')
    assert task.pressed_keys() == []
