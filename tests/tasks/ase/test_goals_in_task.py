"""Goals in the life of the task: when they are drawn, what is rewarded, which keys they hear."""

from __future__ import annotations

import math

import pytest
import torch

from isaacgymenvs_lite.tasks.ase.humanoid_ase import HumanoidASE, HumanoidHeading, HumanoidReach
from isaacgymenvs_lite.tasks.goals.heading import (
    compute_heading_observations,
    compute_heading_reward,
)
from isaacgymenvs_lite.tasks.goals.location import compute_location_reward
from isaacgymenvs_lite.tasks.goals.planar import facing
from isaacgymenvs_lite.tasks.goals.strike import compute_strike_reward

DT = 1.0 / 30.0
# float32 of numbers of order 1
ATOL = 1e-6
TIMED_GOALS = {"heading": "tar_dir", "location": "tar_pos", "reach": "tar_pos"}
timed_goals = pytest.mark.parametrize("goal", TIMED_GOALS)


def _goal_of(task: HumanoidASE) -> torch.Tensor:
    """What the task's goal asks for now, (N, ...)."""
    return getattr(task.goal, TIMED_GOALS[task.env_cfg.goal]).clone()


def _random_step(task: HumanoidASE):
    return task.step(0.3 * torch.randn(task.num_envs, task.num_actions))


# --- when goals are drawn ---------------------------------------------------------------------


def test_the_first_observation_shows_the_goal_of_its_episode(make_ase) -> None:
    torch.manual_seed(0)
    task = make_ase(8, cls=HumanoidHeading, stateInit="Random")
    observed = task.reset_done()[0]["obs"]
    goal = task.goal
    # Before a goal is drawn the speed is 1.
    assert (goal.tar_speed >= 1.5).all()
    root = task.simulation.root_states
    expected = compute_heading_observations(root, goal.tar_dir, goal.tar_speed, goal.tar_face_dir)
    torch.testing.assert_close(observed[:, -5:], expected, rtol=0.0, atol=ATOL)


def test_a_reset_draws_for_its_environments_only(make_ase) -> None:
    for goal in [*TIMED_GOALS, "strike"]:
        torch.manual_seed(0)
        task = make_ase(4, goal=goal, stateInit="Default")
        task.reset_done()
        _random_step(task)
        size = task.get_task_obs_size()
        before = task.goal.observe(None).clone()
        task.reset_buf[2] = 1
        observed, done_ids = task.reset_done()
        assert done_ids.tolist() == [2]
        changed = (task.goal.observe(None) != before).any(dim=-1)
        assert changed.tolist() == [False, False, True, False]
        torch.testing.assert_close(observed["obs"][:, -size:], task.goal.observe(None))


@timed_goals
def test_a_goal_lasts_for_a_number_of_steps_inside_its_range(make_ase, goal: str) -> None:
    prefix = "heading" if goal == "heading" else "tar"
    limits = {f"{prefix}ChangeStepsMin": 3, f"{prefix}ChangeStepsMax": 5}
    torch.manual_seed(0)
    task = make_ase(8, goal=goal, enableEarlyTermination=False, **limits)
    task.reset_done()
    now, age, lasted = _goal_of(task), torch.zeros(8, dtype=torch.int64), []
    for _ in range(20):
        task.step(task.zero_actions())  # with the goal of the observation, or with a new one
        changed = (_goal_of(task) != now).any(dim=-1)
        lasted += age[changed].tolist()
        age = torch.where(changed, 1, age + 1)
        now = _goal_of(task)
    # 8 characters, at least 4 goals each; the upper end is exclusive.
    assert len(lasted) >= 32
    assert set(lasted) == {3, 4}


# --- rewards ----------------------------------------------------------------------------------


def test_the_reward_uses_the_way_of_the_whole_control_step(make_ase) -> None:
    for goal in ["heading", "location", "strike"]:
        torch.manual_seed(0)
        # Starts in the clip walk at 1 m/s, so that the velocity counts.
        task = make_ase(8, goal=goal, stateInit="Random", tarSpeedMin=0.0, tarSpeedMax=2.0)
        task.reset_done()
        asked, sim = task.goal, task.simulation
        for _ in range(3):
            before = sim.root_states[:, :3].clone()
            rewards = _random_step(task)[1]
            pos, rot = sim.root_states[:, :3], sim.root_states[:, 3:7]
            if goal == "heading":
                wanted = (asked.tar_dir, asked.tar_speed, asked.tar_face_dir)
                expected = compute_heading_reward(pos, before, rot, *wanted, DT)
            elif goal == "location":
                expected = compute_location_reward(pos, before, rot, asked.tar_pos, 1.0, DT)
            else:
                box = sim.object_states[:, 0]
                expected = compute_strike_reward(box[:, :3], box[:, 3:7], pos, before, DT)
            # Velocities are differences of float32 positions of about 1 m over 1/30 s.
            torch.testing.assert_close(rewards, expected, rtol=0.0, atol=2e-5)
            assert rewards.unique().numel() > 1


# --- goals of clips ---------------------------------------------------------------------------


def test_a_start_in_a_clip_may_go_on_as_the_clip(make_ase) -> None:
    torch.manual_seed(0)
    words = {"goal": "heading", "stateInit": "Random", "motion_file": "walk_backward.npz"}
    for share in (1.0, 0.5):
        task = make_ase(64, **words, clipCommandShare=share)
        task.reset_done()
        ahead = facing(task.simulation.root_states[:, 3:7])
        goes_back = (ahead * task.goal.tar_dir).sum(-1) < -0.9
        looks_ahead = (ahead * task.goal.tar_face_dir).sum(-1) > 0.9
        # Random goals do so by chance, with a probability of 0.14 each.
        assert (goes_back & looks_ahead).float().mean() == pytest.approx(share, abs=0.2)
        assert (task.goal.tar_speed >= 1.5).all()


def test_points_and_boxes_are_where_the_hand_goes_in_the_clip(make_ase) -> None:
    words = {"stateInit": "Start", "motion_file": "reach_forward.npz", "clipCommandShare": 1}
    task = make_ase(32, goal="reach", **words)
    task.reset_done()
    clip = torch.zeros(32, dtype=torch.int64)
    starts_s = torch.zeros(32)
    hand_at = [
        task.motion_lib.get_motion_state(clip, starts_s + later_s)[-1][:, 0]
        for later_s in (0.5, 0.75, 1.0, 1.25, 1.5)
    ]
    missed = torch.stack([(task.goal.tar_pos - pos).norm(dim=-1) for pos in hand_at])
    assert missed.min(0).values.max() < 1e-4
    assert task.goal.tar_pos.unique(dim=0).shape[0] > 1

    task = make_ase(32, goal="strike", **words)
    task.reset_done()
    root, box = task.simulation.root_states, task.simulation.object_states[:, 0]
    offset = box[:, :2] - root[:, :2]
    # The hand reaches 0.6 m ahead, and the box is at least so far away.
    assert ((offset * facing(root[:, 3:7])).sum(-1) > 0.5).all()
    assert offset.norm(dim=-1).max() < 1.0
    assert _random_step(task)[2].sum() == 0  # no character touches the box


def test_points_lie_where_the_clip_goes(make_ase) -> None:
    torch.manual_seed(0)
    words = {"stateInit": "Start", "motion_file": "walk_slow.npz", "clipCommandShare": 1}
    task = make_ase(32, goal="location", **words)
    task.reset_done()
    root = task.simulation.root_states
    offset = task.goal.tar_pos - root[:, :2]
    distance = offset.norm(dim=-1)
    # The walk has 0.74 m/s, and the points are two to four seconds ahead.
    assert 1.2 < distance.min() < distance.max() < 3.3
    assert ((offset * facing(root[:, 3:7])).sum(-1) > 0.95 * distance).all()


def test_points_are_near_the_place_where_an_episode_begins(make_ase) -> None:
    torch.manual_seed(0)
    words = {"goal": "reach", "stateInit": "Random", "motion_file": "walk.npz", "tarDistMax": 0.5}
    for relative in (True, False):
        task = make_ase(64, **words, reachObsRelative=relative)
        task.reset_done()
        start_w = task.simulation.root_states[:, :2]
        assert start_w.norm(dim=-1).max() > 1.0
        centre = start_w if relative else torch.zeros(2)
        assert (task.goal.tar_pos[:, :2] - centre).abs().max() <= 0.5


def test_the_goals_of_a_warm_start_are_those_of_the_clips(make_ase) -> None:
    torch.manual_seed(0)
    back = make_ase(4, goal="heading", motion_file="walk_backward.npz").fetch_tracking_demo(50)
    # Direction to go, speed, direction to face; the hips rotate by some degrees.
    expected = torch.tensor([-1.0, 0.0, 1.5, 1.0, 0.0]).expand(50, 5)
    torch.testing.assert_close(back.obs[:, -5:], expected, rtol=0.0, atol=0.25)
    points = make_ase(4, goal="location", motion_file="walk_slow.npz").fetch_tracking_demo(50)
    forward, left = points.obs[:, -2:].unbind(-1)
    # The walk has 0.74 m/s, and the clip may end before two seconds are over.
    assert (forward <= 2 * 2 * 0.9).all()
    assert 1.0 < forward.median() < 3.0
    assert (left.abs() <= 0.2 * forward.clamp(min=0.5)).all()
    reaches = {"motion_file": "reach_forward.npz", "reachObsRelative": True}
    hands = make_ase(4, goal="reach", **reaches).fetch_tracking_demo(50).obs[:, -3:]
    assert 0.4 < hands[:, 0].max() < 0.8  # m ahead of the root
    assert (hands[:, 2] > 0.7).all()
    boxes = make_ase(4, goal="strike", motion_file="reach_forward.npz").fetch_tracking_demo(50)
    assert boxes.obs[:, -15].median() > 0.4  # m ahead; at the end of the clip the hand hangs down
    assert boxes.obs[:, -15:-13].norm(dim=-1).min() > 0.59
    # Clips do not show where the head of the character should be, so that the points are anywhere.
    points = make_ase(4, goal="reach", reachBodyName="head").fetch_tracking_demo(50)
    assert points.obs[:, -3:].unique(dim=0).shape[0] == 4


# --- successes --------------------------------------------------------------------------------


def test_on_course_is_a_share_of_the_time(make_ase) -> None:
    task = make_ase(4, goal="heading", stateInit="Default")
    task.reset_done()
    goal, east = task.goal, torch.tensor([1.0, 0.0])
    goal.tar_dir[:], goal.tar_face_dir[:], goal.tar_speed[:] = east, east, 1.5
    speeds = torch.tensor([1.5, 1.3, 1.2, 1.5])
    turns = torch.tensor([0.0, 0.3, 0.0, 0.4])  # rad; 20 degrees are 0.35 rad
    root = task.simulation.root_states.clone()
    root[:, 5], root[:, 6], root[:, 7] = (turns / 2).sin(), (turns / 2).cos(), speeds
    root[:, 8:] = 0.0
    rows = torch.arange(4)
    task.simulation.write_state(rows, root, *(torch.zeros(4, task.num_actions) for _ in "pv"))
    goal._mean_vel_w[:] = root[:, 7:9]
    goal.after_step()
    assert task.episode_successes()["on_course"].tolist() == [1.0, 1.0, 0.0, 0.0]
    goal.tar_dir[0] = -east
    for _ in range(3):
        goal.after_step()
    assert task.episode_successes()["on_course"].tolist() == [0.25, 1.0, 0.0, 0.0]


def test_reached_is_a_share_of_the_points(make_ase) -> None:
    for name, reached_m in [("location", 0.5), ("reach", 0.2)]:
        task = make_ase(3, goal=name, stateInit="Default")
        task.reset_done()
        goal, sim = task.goal, task.simulation
        hand = sim.body_names.index("right_hand")
        here = sim.root_states[:, :2] if name == "location" else sim.body_pos[:, hand]
        for near in ([True, True, False], [True, False, False]):
            goal.tar_pos[:] = here
            goal.tar_pos[:, 0] += reached_m * torch.tensor([0.9 if x else 1.1 for x in near])
            for _ in range(2):  # a point that is reached twice counts once
                goal.after_step()
            found = task.episode_successes()["reached"]
            goal.before_step(goal.change_steps)  # draws the next point
        assert found.tolist() == [1.0, 0.5, 0.0]


def test_a_box_that_lies_has_fallen(make_ase) -> None:
    task = make_ase(2, goal="strike")
    task.reset_done()
    states = task.simulation.object_states.clone()
    states[1, 0, 3:7] = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5])
    task.simulation.write_object_states(torch.arange(2), torch.tensor([0]), states)
    assert task.episode_successes()["box_fell"].tolist() == [0.0, 1.0]


def test_successes_reach_the_infos(make_ase) -> None:
    for goal, name in [("heading", "on_course"), ("reach", "reached"), ("strike", "box_fell")]:
        task = make_ase(2, goal=goal)
        task.reset_done()
        assert list(_random_step(task)[3]["successes"]) == [name]


# --- where points are -------------------------------------------------------------------------


def _draws(task: HumanoidASE) -> torch.Tensor:
    """Goals of 20 draws for characters in their places, (20, N, ...)."""
    # Environments may be named in any order.
    env_ids = torch.arange(task.num_envs).flip(0)
    drawn = []
    for _ in range(20):
        task.goal.reset(env_ids)
        drawn.append(_goal_of(task))
    return torch.stack(drawn)


def test_headings_point_anywhere_each_by_itself(make_ase) -> None:
    torch.manual_seed(0)
    task = make_ase(16, goal="heading")
    env_ids, pairs = torch.arange(16), []
    for _ in range(20):
        task.goal.reset(env_ids)
        pairs.append(torch.cat((task.goal.tar_dir, task.goal.tar_face_dir), dim=-1))
    drawn = torch.cat(pairs)
    going, facing = drawn[:, :2], drawn[:, 2:]
    for directions in (going, facing):
        torch.testing.assert_close(directions.norm(dim=-1), torch.ones(320))
        # Of 320 unit vectors: the mean has a standard deviation of sqrt(0.5 / 320) = 0.04.
        assert directions.mean(dim=0).abs().max() < 0.2
    assert (going * facing).sum(-1).mean().abs() < 0.2


def test_locations_lie_in_a_square_about_the_character(make_ase) -> None:
    torch.manual_seed(0)
    # In the clip the characters are at x = 0 to 1.5 m.
    task = make_ase(16, goal="location", stateInit="Random", tarDistMax=0.1)
    task.reset_done()
    places = task.simulation.root_states[:, :2]
    assert places[:, 0].max() > 1.0
    offsets = _draws(task) - places
    # float32 of places of about 1 m
    assert offsets.abs().max() <= 0.1 + 1e-6
    # 320 points: each side comes near 0.1, and the corners are used, 2 (1 - pi / 4) of the radius.
    assert offsets.amax(dim=(0, 1)).min() > 0.095
    assert offsets.amin(dim=(0, 1)).max() < -0.095
    corners = (offsets.norm(dim=-1) > 0.1).float().mean()
    assert float(corners) == pytest.approx(1.0 - math.pi / 4.0, abs=0.1)


def test_points_to_reach_lie_about_the_origin(make_ase) -> None:
    torch.manual_seed(0)
    limits = {"tarDistMax": 0.5, "tarHeightMin": 1.0, "tarHeightMax": 1.5}
    task = make_ase(16, goal="reach", stateInit="Random", **limits)
    task.reset_done()
    points = _draws(task).flatten(0, 1)
    low, high = points.amin(dim=0), points.amax(dim=0)
    assert low.tolist() == pytest.approx([-0.5, -0.5, 1.0], abs=0.03)
    assert high.tolist() == pytest.approx([0.5, 0.5, 1.5], abs=0.03)
    assert (low >= torch.tensor([-0.5, -0.5, 1.0])).all()
    assert (high <= torch.tensor([0.5, 0.5, 1.5])).all()


# --- reach ------------------------------------------------------------------------------------


def test_the_body_to_reach_with(make_ase) -> None:
    for armed, name, expected in [
        (False, "", "right_hand"),
        (False, None, "right_hand"),
        (True, "", "sword"),
        (True, "left_foot", "left_foot"),
    ]:
        task = make_ase(2, cls=HumanoidReach, armed=armed, reachBodyName=name)
        task.reset_done()
        rewards = _random_step(task)[1]
        sim = task.simulation
        body = sim.body_pos[:, sim.body_names.index(expected)]
        distance2 = (task.goal.tar_pos - body).square().sum(-1)
        torch.testing.assert_close(rewards, torch.exp(-4.0 * distance2), rtol=0.0, atol=ATOL)


def test_where_the_point_is_told(make_ase) -> None:
    for relative in [False, True]:
        task = make_ase(1, goal="reach", reachObsRelative=relative)
        task.reset_done()
        task.goal.tar_pos[0] = torch.tensor([2.0, 3.0, 1.5])
        root = torch.zeros(1, 13)
        # A quarter turn to the left: what is at +y is ahead.
        root[0, :7] = torch.tensor([1.0, 1.0, 0.9, 0.0, 0.0, 0.5**0.5, 0.5**0.5])
        zeros = torch.zeros(1, 28)
        task.simulation.write_state(torch.tensor([0]), root, zeros, zeros)
        seen = task.goal.observe(None)
        # The height is the one above the ground in both.
        expected = [[2.0, -1.0, 1.5]] if relative else [[3.0, -2.0, 1.5]]
        torch.testing.assert_close(seen, torch.tensor(expected), rtol=0.0, atol=ATOL)
