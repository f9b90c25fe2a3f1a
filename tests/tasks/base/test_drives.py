"""Implicit drives: one step by hand, and inside a chain that constraints close."""

from __future__ import annotations

import mujoco
import pytest

from isaacgymenvs_lite.tasks.base.drives import integrate_drives_implicitly

_STEP_S = 0.01
_SLIDES = """
<mujoco>
  <option gravity="0 0 0" timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="driven" type="slide"/><geom size="0.1" mass="2"/></body>
    <body pos="0 1 0"><joint name="other" type="slide"/><geom size="0.1" mass="3"/></body>
    <body pos="0 2 0"><joint name="pushed" type="slide"/><geom size="0.1" mass="1"/></body>
  </worldbody>
  <equality>{equality}</equality>
  <actuator>
    <position joint="driven" kp="{kp}" kv="{kv}"/>
    <motor joint="pushed"/>
  </actuator>
</mujoco>
"""
_COUPLED = '<joint joint1="driven" joint2="other" solref="0.02 1" solimp="0.9999 0.9999 1"/>'


def _after_a_step(kp: float, kv: float, equality: str = "") -> mujoco.MjData:
    """Return the state 0.01 s after the driven joint had 0.5 m/s and 0.1 m to its target."""
    spec = mujoco.MjSpec.from_string(_SLIDES.format(kp=kp, kv=kv, equality=equality))
    integrate_drives_implicitly(spec, _STEP_S)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[0] = 0.5
    data.qvel[1] = 0.5 if equality else 0.0
    data.ctrl[:] = 0.1, 3.0
    mujoco.mj_step(model, data)
    return data


def test_a_drive_acts_on_the_state_after_the_step() -> None:
    for kp, kv in [(4000.0, 100.0), (1000.0, 0.0), (1e7, 0.0), (0.0, 50.0)]:
        inertia = 2.0 + _STEP_S * kv + _STEP_S**2 * kp
        expected = (2.0 * 0.5 + _STEP_S * kp * 0.1) / inertia
        data = _after_a_step(kp, kv)
        assert data.qvel[0] == pytest.approx(expected, rel=1e-9)
        assert data.qpos[0] == pytest.approx(_STEP_S * expected, rel=1e-9)


def test_motors_and_what_is_not_driven_are_left_alone() -> None:
    data = _after_a_step(4000.0, 100.0)
    assert data.qvel[1] == 0.0
    assert data.qvel[2] == pytest.approx(3.0 / 1.0 * _STEP_S, rel=1e-9)


def test_constraints_are_solved_for_the_joint_that_the_drive_makes_stiff() -> None:
    """With MuJoCo's implicit damping the two coupled joints part in this step."""
    data = _after_a_step(4000.0, 100.0, _COUPLED)
    inertia = 2.0 + 3.0 + _STEP_S * 100.0 + _STEP_S**2 * 4000.0
    expected = (5.0 * 0.5 + _STEP_S * 4000.0 * 0.1) / inertia
    # The softness of the coupling: 1e-4 of what would part them.
    assert data.qvel[0] == pytest.approx(expected, rel=1e-3)
    assert data.qvel[1] == pytest.approx(data.qvel[0], rel=1e-3)
