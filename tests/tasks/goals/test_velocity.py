"""The goal velocity: commands, what earns the reward, errors over a second, keys."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.rendering.markers import ACTUAL_COLOUR, GO_COLOUR
from isaacgymenvs_lite.tasks.amp.robot_amp import RobotAMPVelocity
from isaacgymenvs_lite.tasks.goals.velocity import Velocity, compute_planar_motion

RANGES = "task.env.randomCommandVelocityRanges"


@pytest.fixture
def make(make_task: Callable[..., Any]) -> Callable[..., RobotAMPVelocity]:
    """Return a maker of the task with the G1, by words of the command line."""
    return lambda *words, num_envs=3: make_task("task=RobotAMPVelocity", *words, num_envs=num_envs)


def leaning(yaw: float) -> np.ndarray:
    """Rotation xyzw of a root that leans by 0.2 rad and faces along `yaw`, rad."""
    return Rotation.from_euler("ZYX", [yaw, 0.2, 0.1]).as_quat()


def move(task: RobotAMPVelocity, yaw: float, velocity: list[float], turn: float) -> None:
    """Let all robots face along `yaw` (rad) and move: m/s in the world, rad/s."""
    sim = task.simulation
    root = sim.root_states.clone()
    root[:, 3:7] = torch.from_numpy(leaning(yaw))
    root[:, 7:] = torch.tensor([*velocity, 0.0, 0.0, 0.0, turn])
    env_ids = torch.arange(task.num_envs)
    sim.write_state(env_ids, root, sim.dof_pos.clone(), torch.zeros_like(sim.dof_vel))


def test_motion_is_in_the_heading_frame():
    # Faces along +y, and moves there at 2 m/s and along +x, to its right, at 0.5 m/s.
    root = torch.zeros(1, 13)
    root[0, 3:7] = torch.from_numpy(leaning(math.pi / 2))
    root[0, 7:13] = torch.tensor([0.5, 2.0, 9.0, 7.0, 8.0, 0.3])
    np.testing.assert_allclose(compute_planar_motion(root), [[2.0, -0.5, 0.3]], atol=1e-6)


def test_clips_that_go_sideways_are_a_warning(make, caplog):
    """Seen from the y axis of the base, the shipped walk goes to the right."""
    words = ("task.env.motion_file=g1_walk", f"task.env.forwardYaw={math.pi / 2}")
    make(*words)
    (warning,) = [record.message for record in caplog.records if "forwardYaw" in record.message]
    assert warning.endswith("set task.env.forwardYaw=0.00")
    caplog.clear()
    task = make(words[0], "task.env.clipCommandShare=1")
    assert not [record for record in caplog.records if "forwardYaw" in record.message]
    task.reset()
    assert (task.goal.commands[:, 0] > 0.5).all()


def test_the_reward_of_a_known_miss(make):
    task = make(
        "task.env.linearVelocityXYRewardScale=0.5", "task.env.angularVelocityZRewardScale=2"
    )
    task.reset()
    task.goal.commands[:] = torch.tensor([1.0, 0.2, -0.5])
    move(task, math.pi / 2, [0.2, 0.6], -0.3)  # forward 0.6, left -0.2, turn -0.3
    task.goal.after_step()  # the first one of the episode
    terms = task.compute_reward_terms()
    # exp(-error^2 / 0.25) as Anymal: errors (0.4, 0.4) m/s and -0.2 rad/s
    assert terms["lin_vel_xy"].tolist() == pytest.approx([0.5 * math.exp(-0.32 / 0.25)] * 3)
    assert terms["ang_vel_z"].tolist() == pytest.approx([2.0 * math.exp(-0.04 / 0.25)] * 3)


def test_the_command_ends_the_observation_and_is_not_part_of_the_style(make):
    task = make()
    obs = task.reset()["obs"]
    assert list(task.observation_groups())[-1] == "command"
    torch.testing.assert_close(obs[:, -3:], task.goal.commands)
    assert task.num_obs == task.num_amp_obs // 2 + 3


def test_commands_are_drawn_from_the_ranges_and_some_are_to_stand(make):
    task = make(
        f"{RANGES}.linear_x=[0.4,1.2]", f"{RANGES}.linear_y=[-0.2,-0.1]", f"{RANGES}.yaw=[0.5,0.5]",
        "task.env.standingShare=0.3", num_envs=500,
    )  # fmt: skip
    task.goal.draw(torch.arange(500))
    commands = task.goal.commands
    stands = (commands == 0).all(dim=-1)
    assert 0.2 < stands.float().mean() < 0.4
    moving = commands[~stands]
    low, high = moving.amin(0), moving.amax(0)
    np.testing.assert_allclose(low, [0.4, -0.2, 0.5], atol=0.02)
    np.testing.assert_allclose(high, [1.2, -0.1, 0.5], atol=0.02)
    assert (low >= torch.tensor([0.4, -0.2, 0.5])).all()
    assert (high <= torch.tensor([1.2, -0.1, 0.5])).all()


def test_a_robot_that_does_not_go_as_commanded_stalls():
    for command, velocity, stalls in [
        ([0.8, 0.0, 0.0], [0.1, 0.0], True),
        ([0.8, 0.0, 0.0], [0.3, 0.0], False),
        ([0.3, -0.3, 0.0], [0.3, 0.3], True),  # to the wrong side
        ([0.2, 0.0, 1.0], [0.0, 0.0], False),  # mostly to turn
        ([0.0, 0.0, 0.0], [0.0, 0.0], False),
    ]:
        goal, root_states = attached(endStalled=True)
        goal.commands[:] = torch.tensor(command)
        root_states[:, 7:9] = torch.tensor(velocity)
        failed = []
        for _ in range(16):
            goal.after_step()
            failed.append(bool(goal.failures(torch.tensor([]))))
        # The command has 1.5 s of 10 steps each.
        assert failed == [False] * 14 + [stalls] * 2


def test_a_command_lasts_for_a_random_time(make):
    torch.manual_seed(0)  # two commands to stand in a row would look like one
    task = make("task.env.commandChangeStepsMin=3", "task.env.commandChangeStepsMax=6")
    task.reset()
    changes, before = [], task.goal.commands.clone()
    for step in range(1, 13):
        task.step(task.zero_actions())
        if (task.goal.commands[0] != before[0]).any():
            changes.append(step)
        before = task.goal.commands.clone()
    lengths = np.diff([1, *changes])
    assert len(lengths) >= 2
    assert all(3 <= length < 6 for length in lengths)


def attached(**env: Any) -> tuple[Velocity, Tensor]:
    """A goal of one environment with ten control steps in a second, and its root state."""

    class OneRobot:
        num_envs, device = 1, torch.device("cpu")
        root_states = torch.tensor([[0.0] * 6 + [1.0] + [0.0] * 6])

    goal = Velocity(env)
    goal.attach(OneRobot(), 0.1)  # type: ignore[arg-type]
    goal.reset(torch.tensor([0]))
    return goal, OneRobot.root_states


def test_the_mean_motion_of_a_second_counts_not_the_sway_of_a_step():
    goal, root = attached()
    goal.commands[:] = torch.tensor([0.6, 0.0, 0.4])
    for step in range(40):
        # Sways by half a metre per second at two steps a second, and is 0.2 too slow.
        sway = 0.5 * math.sin(2 * math.pi * step / 5)
        root[0, 7:9] = torch.tensor([0.4 + sway, sway])
        root[0, 12] = 0.1 + sway
        goal.after_step()
    errors = goal.errors()
    assert errors["velocity_error_m_s"].item() == pytest.approx(0.2, abs=1e-5)
    assert errors["turn_error_rad_s"].item() == pytest.approx(0.3, abs=1e-5)
    terms = goal.reward()
    assert terms["lin_vel_xy"].item() == pytest.approx(0.6 * math.exp(-0.04 / 0.25))
    assert terms["ang_vel_z"].item() == pytest.approx(0.4 * math.exp(-0.09 / 0.25))


# --- keys -----------------------------------------------------------------------------------------


def test_keys_steer_all_environments_within_the_ranges(make, caplog):
    task = make(f"{RANGES}.linear_x=[-0.5,1.0]")
    task.reset()
    task.on_key("space")
    assert not task.goal.commands.any()
    for key in ("up", "up", "q", "left"):
        task.on_key(key)
    # A fifth of the range's larger end at each press; forward, left, turn to the left.
    wanted = torch.tensor([0.4, 0.06, 0.2]).expand(3, 3)
    torch.testing.assert_close(task.goal.commands, wanted)
    obs = task.step(task.zero_actions())[0]["obs"]
    torch.testing.assert_close(obs[:, -3:], wanted)
    for key in ("down", "e", "right"):
        for _ in range(20):
            task.on_key(key)
    torch.testing.assert_close(task.goal.commands, torch.tensor([-0.5, -0.3, -1.0]).expand(3, 3))
    assert "command: forward 0.40 m/s, left 0.06 m/s, turn 0.20 rad/s" in caplog.text


def test_while_someone_steers_no_command_is_drawn(make):
    steps = ("task.env.commandChangeStepsMin=1", "task.env.commandChangeStepsMax=2")
    task = make(*steps, "task.env.standingShare=0")
    task.reset()
    task.on_key("space")
    task.on_key("up")
    steered = task.goal.commands.clone()
    task.reset()
    for _ in range(3):
        task.step(task.zero_actions())
    torch.testing.assert_close(task.goal.commands, steered)
    task.on_key("space")
    assert not task.goal.commands.any()
    task.on_key("space")  # random commands again
    assert len(task.goal.commands.unique(dim=0)) == 3  # one command for each


def test_space_stops_only_where_standing_is_trained(make):
    for standing, stops_at in [(0.0, 0.5), (0.1, 0.0)]:
        task = make(f"{RANGES}.linear_x=[0.5,1]", f"task.env.standingShare={standing}")
        task.on_key("space")
        torch.testing.assert_close(task.goal.commands, torch.tensor([stops_at, 0, 0]).expand(3, 3))


# --- pictures and errors --------------------------------------------------------------------------


def test_arrows_show_command_and_motion(make):
    task = make()
    task.reset()
    task.goal.commands[1] = torch.tensor([0.8, 0.0, -0.5])
    move(task, math.pi / 2, [-0.3, 0.4], 0.01)  # forward 0.4, left 0.3; hardly turns
    xy = task.simulation.root_states[1, :2].numpy()
    go, turn, actual = task.markers(1)
    assert (go.colour, turn.colour, actual.colour) == (GO_COLOUR, GO_COLOUR, ACTUAL_COLOUR)
    np.testing.assert_allclose(np.array(go.start_w)[:2], xy, atol=1e-6)
    np.testing.assert_allclose(np.array(go.end_w)[:2], xy + np.array([0.0, 0.8]), atol=1e-5)
    # To the right of one who faces +y is +x.
    np.testing.assert_allclose(np.array(turn.end_w)[:2], xy + np.array([0.5, 0.5]), atol=1e-5)
    np.testing.assert_allclose(np.array(actual.end_w)[:2], xy + np.array([-0.3, 0.4]), atol=1e-5)


def test_what_cannot_be_is_said_at_once(make):
    for word, message in [
        (f"{RANGES}.linear_x=[1,0.5]", r"Ranges.linear_x=\[1, 0.5\]: expected \[lowest, highest\]"),
        (f"{RANGES}.yaw=[]", "randomCommandVelocityRanges.yaw"),
        ("task.env.commandChangeStepsMax=90", "commandChangeStepsMin to be less than"),
        ("task.env.standingShare=2", "standingShare: got 2"),
        ("task.env.motion_file=g1_stand", "no clip moves along the ground"),
    ]:
        with pytest.raises(ConfigError, match=message):
            make(word)
