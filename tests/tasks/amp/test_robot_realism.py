"""RobotAMP with a policy that observes what a robot measures, and with what disturbs it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from isaacgymenvs_lite import make
from isaacgymenvs_lite.config.compose import compose
from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.utils.rotations import quat_rotate_inverse
from tests.tasks.amp.test_robot_amp import clip, make_walker, walker  # noqa: F401  fixtures

DEPLOYABLE = {"observations": "deployable"}
FRAME, FULL = 6 + 3 * 8, 1 + 6 + 3 + 3 + 8 + 8 + 3 * 2
NOISE = {
    "observationNoise.root_ang_vel_b": 0.2,
    "observationNoise.gravity_b": 0.05,
    "observationNoise.dof_pos_offset": 0.02,
    "observationNoise.dof_vel": 1.5,
}


def started(task: Any) -> dict[str, Tensor]:
    torch.manual_seed(3)
    return task.reset()


def actions_at(step: int) -> Tensor:
    return 0.3 * torch.rand(4, 8, generator=torch.Generator().manual_seed(step)) - 0.15


def frame_of(task: Any, last_action: Tensor) -> Tensor:
    """What the robots measure, from the simulation."""
    root, sim = task.simulation.root_states, task.simulation
    down = torch.tensor([0.0, 0.0, -1.0]).expand(len(root), 3)
    base = [quat_rotate_inverse(root[:, 3:7], vector) for vector in (root[:, 10:13], down)]
    start = task.default_pose()[1]
    return torch.cat((*base, sim.dof_pos - start, sim.dof_vel, last_action), dim=-1)


def test_frames_are_of_the_last_control_steps(make_walker):  # noqa: F811
    task = make_walker(**DEPLOYABLE, historySteps=3, startPose="{left_knee: 0.4, right_knee: 0.4}")
    obs = started(task)["obs"]
    assert obs.shape == (4, 3 * FRAME)
    first = frame_of(task, torch.zeros(4, 8))
    torch.testing.assert_close(obs, first.repeat(1, 3))
    frames = [first] * 2
    for step in range(4):
        action = 5.0 * actions_at(step) if step == 2 else actions_at(step)
        obs = task.step(action)[0]["obs"]
        frames.insert(0, frame_of(task, action.clamp(-1.0, 1.0)))
        torch.testing.assert_close(obs, torch.cat(frames[:3], dim=-1), atol=1e-5, rtol=1e-5)
    # one episode ends, the others go on
    task.reset_buf[1] = 1
    obs = task.reset_done()[0]["obs"]
    torch.testing.assert_close(obs[1], frame_of(task, torch.zeros(4, 8))[1].repeat(3))
    torch.testing.assert_close(obs[0], torch.cat(frames[:3], dim=-1)[0], atol=1e-5, rtol=1e-5)


def test_critic_and_discriminator_see_what_they_did(make_walker):  # noqa: F811
    """The same episodes, with both kinds of observations and with noise on one of them."""
    whole, robot = make_walker(), make_walker(**DEPLOYABLE, historySteps=2)
    alone = make_walker(**DEPLOYABLE, asymmetric_observations=False)
    noisy = make_walker(**DEPLOYABLE, **NOISE)
    tasks = (whole, robot, alone, noisy)
    assert [task.num_states for task in tasks] == [0, FULL + 8 + 1, 0, FULL + 8 + 1]
    for task in tasks:
        started(task)
    sim = whole.simulation
    for task in reversed(tasks):  # the same starts, noise or not
        everywhere = torch.arange(4)
        task.simulation.write_state(everywhere, sim.root_states, sim.dof_pos, sim.dof_vel)
    for step in range(3):
        results = [task.step(actions_at(step)) for task in tasks]
        full = results[0][0]["obs"]
        for obs in (results[1][0], results[3][0]):
            torch.testing.assert_close(obs["states"][:, :FULL], full)
            assert torch.equal(obs["states"][:, FULL:-1], actions_at(step))
            assert not obs["states"][:, -1].any()  # no delay
        for _, _, _, infos in results[1:]:
            newest = infos["amp_obs"][:, :FULL]
            torch.testing.assert_close(newest, results[0][3]["amp_obs"][:, :FULL])


def test_noise_is_on_the_policys_frames_and_stays_in_their_history(make_walker):  # noqa: F811
    task = make_walker(**DEPLOYABLE, **NOISE, historySteps=2)
    started(task)
    widths = torch.cat([torch.full((n,), w) for n, w in ((3, 0.2), (3, 0.11), (8, 0.02), (8, 1.5))])
    before = torch.zeros(4, FRAME)
    for step in range(4):
        obs = task.step(actions_at(step))[0]["obs"]
        noise = obs[:, :FRAME] - frame_of(task, actions_at(step))
        assert (noise[:, : len(widths)].abs() <= widths + 1e-5).all()
        assert noise[:, : len(widths)].all()
        torch.testing.assert_close(obs[:, 3:6].norm(dim=-1), torch.ones(4))
        assert torch.equal(obs[:, FRAME - 8 : FRAME], actions_at(step))
        assert step == 0 or torch.equal(obs[:, FRAME:], before)
        before = obs[:, :FRAME]


def test_an_action_takes_effect_after_the_delay(make_walker, controls_of):  # noqa: F811
    task = make_walker(**DEPLOYABLE, actionDelay=[2, 2])
    seen = controls_of(task)
    started(task)
    states = [task.step(actions_at(step))[0]["states"] for step in range(4)]
    _, offset, scale = task.action_scaling()
    expected = [torch.zeros(4, 8), torch.zeros(4, 8), actions_at(0), actions_at(1)]
    for controls, action in zip(seen, expected, strict=True):
        torch.testing.assert_close(controls, offset + scale * action)
    # The critic observes what was chosen last, and the delay.
    assert torch.equal(states[3][:, FULL:-1], actions_at(3))
    assert states[3][:, -1].tolist() == [2.0] * 4


def test_pushes_come_when_they_are_due(make_walker):  # noqa: F811
    task = make_walker(
        *(4,),
        **{"pushRobots": True, "pushInterval_s": 0.1, "pushVelocity": 0.5},
        stateInit="Default",
        enableEarlyTermination=False,
    )
    started(task)
    root, dof_pos = (state.repeat(4, 1) for state in task.default_pose())
    root[:, 2] = 10.0  # in free fall nothing else changes the velocity over the ground
    task.simulation.write_state(torch.arange(4), root, dof_pos, torch.zeros(4, 8))
    speeds = []
    for _ in range(7):
        task.step(torch.zeros(4, 8))
        speeds.append(task.simulation.root_states[:, 7:9].clone())
    still, once, twice = speeds[2], speeds[3], speeds[6]
    assert float(still.abs().max()) < 1e-3
    torch.testing.assert_close(speeds[5], once, atol=1e-2, rtol=0)
    for change in (once - still, twice - once):
        assert 0.1 < float(change.abs().max()) < 0.51
        assert len(set(change[:, 0].tolist())) == 4


def test_robots_differ_from_their_model(walker, clip):  # noqa: F811
    words = [f"task.env.asset.assetFileName={walker}", f"task.env.motion_file={clip}"]
    cfg = compose(["task=RobotAMP", "num_envs=16", "task.task.randomize=True", *words])
    task = make(cfg=cfg)
    model, sim = task.simulation.model, task.simulation
    fields = {
        "body_mass": (model.body_mass[1:], sim.expand("body_mass")[:, 1:], 0.1),
        "stiffness": (model.actuator_gainprm[:, 0], sim.expand("actuator_gainprm")[..., 0], 0.1),
        "damping": (model.actuator_biasprm[:, 2], sim.expand("actuator_biasprm")[..., 2], 0.1),
    }
    for name, (original, drawn, width) in fields.items():
        ratio = drawn / original
        assert 0.5 * width < np.abs(ratio - 1.0).max() <= width + 1e-6, name
        assert len(np.unique(ratio[:, 0])) == 16, name
    geoms = np.flatnonzero(model.geom_bodyid > 0)
    friction = sim.expand("geom_friction")[:, geoms, 0]
    assert 0.69 < friction.min() < 0.75 and 1.25 < friction.max() < 1.31  # half is the floor's
    started(task)
    task.step(torch.zeros(16, 8))
    task.close()


@pytest.mark.parametrize(
    ("env", "message"),
    [
        ({"observations": "foo"}, r"observations: got 'foo', expected one of full, deployable"),
        ({**DEPLOYABLE, "historySteps": 0}, r"historySteps: got 0.*at least 1"),
        ({"historySteps": 2}, r"historySteps=2.*task.env.observations=deployable"),
        ({"observationNoise.dof_vel": 1.0}, r"observationNoise.*task.env.observations=deployable"),
        ({**DEPLOYABLE, "observationNoise.dof_vel": -1}, r"dof_vel: got -1.*at least 0"),
        ({"actionDelay": [-1, 2]}, r"actionDelay: got \[-1, 2\].*at least 0"),
        ({"actionDelay": [3, 2]}, r"actionDelay=\[3, 2\]: expected \[least"),
        ({"pushInterval_s": 0}, r"pushInterval_s: got 0.*above 0"),
    ],
)
def test_what_cannot_be(make_walker, env, message):  # noqa: F811
    with pytest.raises(ConfigError, match=message):
        make_walker(**{key: str(value).replace(" ", "") for key, value in env.items()})
