"""What MuJoCo's viewer receives; the viewer itself runs in the process of a page only."""

from __future__ import annotations

import os
import pickle
import socket
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

pytest.importorskip("mujoco.studio.web_viewer")

from mujoco.studio import messages

from isaacgymenvs_lite.rendering.markers import Sphere
from isaacgymenvs_lite.viewers.web_server import KEYS, BesideSnapshot, LinkEndpoint, PagePlugin
from isaacgymenvs_lite.viewers.window import KEY_NAMES

XML = '<mujoco><worldbody><body><freejoint/><geom size="{}"/></body></worldbody></mujoco>'


@pytest.fixture
def link():
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with here, there:
        yield here, there


def send_model(task: socket.socket, model: mujoco.MjModel) -> None:
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    with os.fdopen(os.memfd_create("model.mjb"), "wb") as file:
        file.write(content.data)
        file.flush()
        socket.send_fds(task, [b"model"], [file.fileno()])


def test_the_viewer_receives_models_states_and_the_end(link):
    task, page = link
    model = mujoco.MjModel.from_xml_string(XML.format(0.5))
    send_model(task, model)
    endpoint = LinkEndpoint(page, os.getppid())
    assert endpoint.wait_for_model() is not None
    assert endpoint.get_sim_events() == endpoint.get_sim_snapshots() == []
    qpos = np.array((1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0))
    goal = Sphere((1.0, 2.0, 0.5), 0.1, (1.0, 0.0, 0.0))
    task.send(pickle.dumps((qpos, qpos + 1.0, [goal])))
    assert endpoint.get_sim_events() == []
    state, beside = endpoint.get_sim_snapshots()
    assert isinstance(state, messages.StateSnapshot)
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, state.state, state.state_sig)
    np.testing.assert_array_equal(data.qpos, qpos)
    assert isinstance(beside, BesideSnapshot)
    np.testing.assert_array_equal(beside.reference, qpos + 1.0)
    assert beside.markers == (goal,)
    assert endpoint.get_sim_snapshots() == []
    send_model(task, mujoco.MjModel.from_xml_string(XML.format(0.7)))
    (event,) = endpoint.get_sim_events()
    assert isinstance(event, messages.ModelEvent)
    assert event.model.geom_size[0, 0] == 0.7
    task.close()
    (event,) = endpoint.get_sim_events()
    assert isinstance(event, messages.ExitEvent)


def test_what_is_beside_is_drawn_with_the_newest_model(link):
    plugin = PagePlugin(link[1])
    for radius_m in (0.5, 0.7):
        model = mujoco.MjModel.from_xml_string(XML.format(radius_m))
        viewer: Any = SimpleNamespace(model=model, extra_geoms=[])
        plugin.viewer = viewer
        plugin.on_model(messages.PostModelEvent(model, mujoco.MjData(model)))
        plugin.on_beside(BesideSnapshot(np.array((1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0))))
        plugin.add_beside(messages.UpdateEvent())
        (geom,) = viewer.extra_geoms
        np.testing.assert_allclose(geom.pos, (1.0, 2.0, 3.0))
        assert geom.size[0] == pytest.approx(radius_m)
        assert geom.rgba[3] == pytest.approx(0.35)
        plugin.on_beside(BesideSnapshot(markers=(Sphere((4.0, 5.0, 6.0), 0.2, (1.0, 0.0, 0.0)),)))
        plugin.add_beside(messages.UpdateEvent())
        (geom,) = viewer.extra_geoms
        np.testing.assert_allclose(geom.pos, (4.0, 5.0, 6.0))
        np.testing.assert_allclose(geom.rgba, (1.0, 0.0, 0.0, 1.0))
        plugin.on_beside(BesideSnapshot())
        plugin.add_beside(messages.UpdateEvent())
        assert viewer.extra_geoms == []


def test_the_page_sends_every_key_that_tasks_receive():
    assert sorted(KEYS.values()) == sorted(KEY_NAMES)
