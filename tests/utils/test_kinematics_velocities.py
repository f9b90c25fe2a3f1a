"""Velocities of the bodies against MuJoCo's own."""

from __future__ import annotations

import mujoco
import numpy as np

from isaacgymenvs_lite.simulation.model_layout import ModelLayout
from isaacgymenvs_lite.simulation.state_buffers import StateBuffers, StateConverter


def _random_state(model: mujoco.MjModel, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Random qpos (n, nq), its quaternions not of unit length, and qvel (n, nv)."""
    generator = np.random.default_rng(0)
    return generator.normal(size=(n, model.nq)), generator.normal(size=(n, model.nv))


def _velocities(
    model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Our linear and angular velocities, (n, B, 3) each."""
    layout = ModelLayout.from_model(model)
    buffers, converter = StateBuffers(layout, len(qpos)), StateConverter(model, layout)
    converter.fill(buffers, qpos, qvel)
    converter.fill_bodies(buffers)
    assert not buffers.has_body_velocities
    converter.fill_body_velocities(buffers)
    assert buffers.has_body_velocities
    return buffers.body_lin_vel.T, buffers.body_ang_vel.T


def _assert_velocities_are_mujoco_s(
    model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray
) -> None:
    lin_vel, ang_vel = _velocities(model, qpos, qvel)
    data = mujoco.MjData(model)
    velocity = np.zeros(6)  # angular first
    for state in range(len(qpos)):
        data.qpos[:], data.qvel[:] = qpos[state], qvel[state]
        mujoco.mj_forward(model, data)
        for body in range(model.nbody - 1):
            mujoco.mj_objectVelocity(
                model, data, mujoco.mjtObj.mjOBJ_XBODY, 1 + body, velocity, flg_local=0
            )
            # float32: each level of the tree rounds sums and products of numbers up to about 10
            # (half a unit in the last place is 5e-7 there) some times.
            np.testing.assert_allclose(ang_vel[state, body], velocity[:3], rtol=0.0, atol=5e-6)
            np.testing.assert_allclose(lin_vel[state, body], velocity[3:], rtol=0.0, atol=1e-5)


def test_a_model_with_all_types_of_joints(made_up_model) -> None:
    _assert_velocities_are_mujoco_s(made_up_model, *_random_state(made_up_model, 50))


def test_the_humanoid(humanoid_model) -> None:
    _assert_velocities_are_mujoco_s(humanoid_model, *_random_state(humanoid_model, 50))


# Several joints on one body in all orders that MuJoCo allows: a ball may only be followed by
# slides. On a turned body that hangs on a turning one, as every term counts there.
_HINGE = '<joint type="hinge" axis="{} 1 0.5" pos="0.1 {} -0.2" ref="0.3"/>'
_FREE_HINGE = '<joint type="hinge" axis="0 {} 1"/>'
_SLIDE = '<joint type="slide" axis="1 {} 0.3" ref="-0.2"/>'
_BALL = '<joint type="ball" pos="{} 0.1 0.2"/>'


def test_several_joints_on_one_body() -> None:
    for joints in [
        (_SLIDE, _SLIDE, _SLIDE),
        (_HINGE, _HINGE, _HINGE),
        (_FREE_HINGE, _FREE_HINGE, _FREE_HINGE),
        (_HINGE, _SLIDE, _HINGE),
        (_SLIDE, _HINGE, _SLIDE),
        (_FREE_HINGE, _SLIDE),
        (_FREE_HINGE, _HINGE, _SLIDE),
        (_HINGE, _SLIDE, _BALL),
        (_BALL, _SLIDE, _SLIDE),
        (_SLIDE, _FREE_HINGE, _BALL, _SLIDE),
    ]:
        stack = "".join(joint.format(0.4 * place, -0.3) for place, joint in enumerate(joints))
        model = mujoco.MjModel.from_xml_string(
            '<mujoco><worldbody><body pos="0 0 1" quat="0.5 0.1 -0.4 0.2"><joint axis="1 1 1"/>'
            f'<geom size="0.1"/><body pos="0.3 0.2 0.1" quat="0.3 0.5 0.4 -0.2">{stack}'
            '<geom size="0.1"/><body pos="0.2 0 0.3"><joint/><geom size="0.1"/></body>'
            # A neighbour has one joint of the first type.
            f'</body><body pos="-0.3 0 0">{joints[0].format(1, 0.2)}<geom size="0.1"/></body>'
            "</body></worldbody></mujoco>"
        )
        _assert_velocities_are_mujoco_s(model, *_random_state(model, 20))


def test_two_bars_by_hand() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint axis="0 0 1"/><geom size="0.1"/>'
        '<body pos="2 0 0"><joint axis="0 0 1"/><geom size="0.1"/>'
        '<body pos="3 0 0"><geom size="0.1"/></body></body></body></worldbody></mujoco>'
    )
    # The first along x at 1 rad/s; the second, a quarter turn on, along y at 1 + 4 rad/s.
    lin_vel, ang_vel = _velocities(model, np.array([[0.0, np.pi / 2.0]]), np.array([[1.0, 4.0]]))
    np.testing.assert_allclose(ang_vel[0], [[0, 0, 1], [0, 0, 5], [0, 0, 5]], atol=1e-6)
    # 2 m away at 1 rad/s: 2 m/s along y. 3 m further along y at 5 rad/s: 15 m/s along -x more.
    np.testing.assert_allclose(lin_vel[0], [[0, 0, 0], [0, 2, 0], [-15, 2, 0]], atol=5e-6)
