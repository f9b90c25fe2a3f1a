"""Trifinger: formulas by hand, goals, starts, torques, observations, ends of terms."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import mujoco
import pytest
import torch

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.tasks import trifinger
from isaacgymenvs_lite.tasks.trifinger import RewardTerms, Trifinger, gen_keypoints, lgsk_kernel
from isaacgymenvs_lite.utils.rotations import quat_apply

MakeTask = Callable[..., Trifinger]
PLAIN = ("task=Trifinger", "task.task.randomize=False")
ROTATION = [0.102598, -0.205196, 0.307794, 0.923381]  # normalised (0.1, -0.2, 0.3, 0.9)
NO_TURN = [0.0, 0.0, 0.0, 1.0]
CUBE, GOAL = [0.05, 0.02, 0.0325, *ROTATION], [0.0, 0.0, 0.08, *NO_TURN]
DEFAULT_POS, LOWER, UPPER = [0.0, 0.9, -2.0] * 3, [-0.33, 0.0, -2.7] * 3, [1.0, 1.57, 0.0] * 3
TIPS_M = [[0.0860, 0.0332, 0.1180], [-0.0142, -0.0911, 0.1180], [-0.0718, 0.0579, 0.1180]]
FARTHEST_M = 0.195 - 0.0325 * math.sqrt(3.0)
WEIGHTS = RewardTerms()


def _terms(
    weights: RewardTerms, cube: list[float] = CUBE, goal: list[float] = GOAL, reaches: bool = True
) -> dict[str, float]:
    """Return the terms after a cube moved by -0.1 m along x and the tips as told below."""
    now, before = torch.tensor([cube]), torch.tensor([cube[:3]]) + torch.tensor([0.1, 0.0, 0.0])
    tips = torch.tensor([[0.3, 0.4, 0.0], [0.0, 0.0, 0.1], [0.3, 0.0, 0.0]]) + now[:, None, :3]
    old = torch.tensor([[0.0, 0.3, 0.0], [0.0, 0.0, 0.2], [0.3, 0.0, 0.0]]) + before[:, None]
    poses = (now, before, torch.tensor([goal]), tips, old)
    terms = trifinger.compute_trifinger_reward(*poses, 0.02, reaches, weights)
    return {name: term.item() for name, term in terms.items()}


def test_order_of_the_corners() -> None:
    pose = torch.tensor([[1.0, 2.0, 3.0, *NO_TURN]])
    signs = ["+++", "-++", "+-+", "--+", "++-", "-+-", "+--", "---"]
    halves = torch.tensor([[float(f"{sign}0.5") for sign in corner] for corner in signs])
    corners = gen_keypoints(pose, size=(0.2, 0.4, 0.6))[0]
    torch.testing.assert_close(corners, pose[:, :3] + halves * torch.tensor([0.2, 0.4, 0.6]))
    turned = gen_keypoints(torch.tensor([GOAL, CUBE]))[1]
    assert turned[0].tolist() == pytest.approx([0.0435, 0.0525, 0.078], abs=5e-5)
    assert turned[1].tolist() == pytest.approx([-0.003711, 0.018289, 0.049263], abs=1e-6)


def test_reward_by_hand() -> None:
    terms = _terms(WEIGHTS)
    assert terms["pose"] == pytest.approx(3.552570, abs=2e-6)  # of the specification
    # The tips move by (0.2, 0.1, 0), (-0.1, 0, -0.1) and (-0.1, 0, 0) m in 0.02 s.
    assert terms["finger_movement"] == pytest.approx(-0.5 * (0.05 + 0.02 + 0.01) / 0.02**2)
    # From distances of 0.3, 0.2 and 0.3 m to distances of 0.5, 0.1 and 0.3 m
    assert terms["finger_reach"] == pytest.approx(-250.0 * 0.1, rel=1e-5)
    assert _terms(WEIGHTS, reaches=False) == {**terms, "finger_reach": 0.0}
    halved = dataclasses.replace(WEIGHTS.object_dist, weight=1000.0)
    assert _terms(dataclasses.replace(WEIGHTS, object_dist=halved))["pose"] == terms["pose"] / 2


def test_rewards_of_position_and_rotation_by_hand() -> None:
    off = dataclasses.replace(WEIGHTS.keypoints_dist, activate=False)
    rotation = dataclasses.replace(WEIGHTS.object_rot, weight=500.0)
    weights = dataclasses.replace(WEIGHTS, keypoints_dist=off, object_rot=rotation)
    a_third = [0.0, 0.0, -0.5, -math.sqrt(0.75)]  # of a half turn about z
    terms = _terms(weights, [0.03, 0.0, 0.04, *a_third], [0.0, 0.0, 0.0, *NO_TURN])
    assert set(terms) == {"finger_movement", "finger_reach", "position", "rotation"}
    kernel = 1.0 / (2.0 + 2.0 * math.cosh(50.0 * 0.05))
    assert terms["position"] == pytest.approx(0.02 * 2000.0 * kernel, rel=1e-5)
    assert terms["rotation"] == pytest.approx(0.02 * 500.0 / (math.pi + 0.01), rel=1e-5)
    assert lgsk_kernel(torch.tensor([0.0, 10.0])).tolist() == [0.25, 0.0]
    near = 1.0 / (1.0 + 2.0 * math.cosh(0.3))
    assert lgsk_kernel(torch.tensor(0.01), scale=30.0, eps=1.0).item() == pytest.approx(near)


@pytest.mark.parametrize(
    ("difficulty", "far", "low", "high", "squares"),
    [
        (-1, FARTHEST_M, 0.0325, 0.0325, [0.0, 0.0, 0.5, 0.5]),
        (1, FARTHEST_M, 0.0325, 0.0325, [0.0, 0.0, 0.0, 1.0]),
        (2, 0.0, 0.0825, 0.0825, [0.0, 0.0, 0.0, 1.0]),
        (3, FARTHEST_M, 0.0325, 0.1, [0.0, 0.0, 0.0, 1.0]),
        (4, FARTHEST_M, 0.056292, 0.1, [0.25] * 4),
    ],
)
def test_goals(difficulty: int, far: float, low: float, high: float, squares: list[float]) -> None:
    torch.manual_seed(0)
    goals = trifinger.draw_goals(20000, difficulty, "cpu")  # standard errors of 1/141
    radius, height, rot = goals[:, :2].norm(dim=-1), goals[:, 2], goals[:, 3:]
    assert 0.999 * far <= radius.max() <= far * (1.0 + 1e-6)
    # Uniform in the disc: the mean radius is 2/3 of the largest one, its deviation 0.236.
    assert radius.mean().item() == pytest.approx(2.0 / 3.0 * far, abs=0.01 * far)
    assert goals[:, :2].mean(0).abs().max() <= 0.02 * far
    found = [value.item() for value in (height.min(), height.mean(), height.max())]
    assert found == pytest.approx([low, 0.5 * (low + high), high], abs=0.01 * (high - low) + 1e-6)
    torch.testing.assert_close(rot.norm(dim=-1), torch.ones(20000))
    products = (rot[:, :, None] * rot[:, None]).mean(0)
    torch.testing.assert_close(products, torch.diag(torch.tensor(squares)), atol=0.02, rtol=0.0)


def test_mistakes_are_one_line(make_task: MakeTask, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^task\.env\.task_difficulty[^\n]*-1, 1, 2, 3, 4$"):
        make_task(*PLAIN, "task.env.task_difficulty=0")
    spec = mujoco.MjSpec.from_file(str(assets_dir() / "mjcf/trifinger.xml"))
    spec.delete(spec.body("finger_tip_link_120"))
    spec.compile()
    (tmp_path / "fingers.xml").write_text(spec.to_xml())
    missing = r"^task\.env\.asset: [^\n]*no body 'finger_tip_link_120' or 'tip_120'[^\n]*$"
    with pytest.raises(ConfigError, match=missing):
        make_task(*PLAIN, f"task.env.asset.assetFileName={tmp_path}/fingers.xml")


def _put(task: Trifinger, cubes: list[list[float]], pos: object = DEFAULT_POS, vel: float = 0.0):
    """Put cubes (N, 7) at rest, and the joints (9,) or (N, 9) at positions (rad) and a speed."""
    sim, n, ids = task.simulation, task.num_envs, torch.arange(task.num_envs)
    dof_pos, states = torch.as_tensor(pos).expand(n, 9), torch.zeros(n, 1, 13)
    states[:, 0, :7] = torch.tensor(cubes)
    sim.write_state(ids, torch.zeros(n, 13), dof_pos, torch.full((n, 9), vel))
    sim.write_object_states(ids, torch.tensor([0]), states)
    task.reset_buf.zero_()


def _tips(task: Trifinger) -> list[int]:
    return [task.simulation.body_names.index(f"finger_tip_link_{i}") for i in (0, 120, 240)]


@pytest.mark.parametrize("kind", ["random", "default", "none"])
def test_starts(make_task: MakeTask, kind: str) -> None:
    start = "task.env.reset_distribution"
    types = [f"{start}.{what}_initial_state.type={kind}" for what in ("robot", "object")]
    task = make_task(*PLAIN, *types, "task.env.task_difficulty=2", num_envs=64)
    torch.manual_seed(0)
    _put(task, [CUBE] * 64, pos=[0.3, 0.8, -1.5] * 3, vel=0.7)
    task.step(task.zero_actions())
    sim = task.simulation
    before = [values.clone() for values in (sim.dof_pos, sim.dof_vel, sim.object_states)]
    task.reset()
    assert task.goal_poses.tolist() == [[0.0, 0.0, pytest.approx(0.0825), *NO_TURN]] * 64
    if kind == "none":
        torch.testing.assert_close([sim.dof_pos, sim.dof_vel, sim.object_states], before)
        return
    spread, cubes = float(kind == "random"), sim.object_states[:, 0]
    for values, most in ((sim.dof_pos - torch.tensor(DEFAULT_POS), 0.4), (sim.dof_vel, 0.2)):
        ends = [value.item() for value in values.aminmax()]  # of 576 draws
        assert ends == pytest.approx([-most * spread, most * spread], abs=0.02 * most)
    assert (cubes[:, 7:] == 0.0).all()
    torch.testing.assert_close(cubes[:, 2], torch.full((64,), 0.0325 + 0.0015 * spread))
    assert cubes[:, :2].norm(dim=-1).max() <= FARTHEST_M * spread
    assert (cubes[:, :2].std(0) >= 0.05 * spread).all()  # 0.069 is expected
    expected = [0.0, 0.0, 0.5 * spread, 1.0 - 0.5 * spread]
    assert cubes[:, 3:7].square().mean(0).tolist() == pytest.approx(expected, abs=0.2 * spread)
    if kind == "default":
        tips = sim.body_pos[5, _tips(task)]
        torch.testing.assert_close(tips, torch.tensor(TIPS_M), atol=5e-5, rtol=0.0)


@pytest.mark.parametrize("mode", ["torque", "position"])
@pytest.mark.parametrize("damped", [True, False])
def test_torques_by_hand(
    make_task: MakeTask, controls_of: Callable[..., list[torch.Tensor]], mode: str, damped: bool
) -> None:
    damping = f"task.env.apply_safety_damping={damped}"
    task = make_task(*PLAIN, f"task.env.command_mode={mode}", damping, num_envs=3)
    seen, pos, vel = controls_of(task), [0.3, 0.8, -1.5] * 3, 1.5
    _put(task, [CUBE] * 3, pos, vel)
    # About the middle, at the limits, and a little above the present positions
    near = [2.0 * (q - a) / (b - a) - 0.96 for q, a, b in zip(pos, LOWER, UPPER, strict=True)]
    actions = [[0.1 * i - 0.4 for i in range(9)], [-1.0, 1.0, 5.0] * 3, near]
    task.step(torch.tensor(actions))
    for row, joint in ((row, joint) for row in range(3) for joint in range(9)):
        share = min(max(actions[row][joint], -1.0), 1.0)
        torque = 0.36 * share
        if mode == "position":
            aim = LOWER[joint] + 0.5 * (share + 1.0) * (UPPER[joint] - LOWER[joint])
            torque = 10.0 * (aim - pos[joint]) - (0.1, 0.3, 0.001)[joint % 3] * vel
        torque = min(max(torque, -0.36), 0.36)
        if damped:
            torque = min(max(torque - (0.08, 0.08, 0.04)[joint % 3] * vel, -0.36), 0.36)
        assert seen[0][row, joint].item() == pytest.approx(torque, abs=2e-6)


@pytest.mark.parametrize("normal", [True, False])
def test_observation_and_state(
    make_task: MakeTask, controls_of: Callable[..., list[torch.Tensor]], normal: bool
) -> None:
    task = make_task(*PLAIN, f"task.env.normalize_action={normal}", num_envs=2)
    sim = task.simulation
    _put(task, [[0.15, -0.3, 0.3, *ROTATION]] * 2, torch.tensor([LOWER, UPPER]), 5.0)
    task.goal_poses[:] = torch.tensor([-0.3, 0.0, 0.15, *ROTATION[::-1]])
    task.actions = actions = 0.04 * torch.arange(9.0).repeat(2, 1)
    last = (actions[0] / (1.0 if normal else 0.36)).tolist()
    others = [*[0.5] * 9, 0.5, -1.0, 1.0, *ROTATION, -1.0, 0.0, 0.0, *ROTATION[::-1], *last]
    expected = torch.tensor([[-1.0] * 9 + others, [1.0] * 9 + others])
    torch.testing.assert_close(task.compute_obs(), expected)
    # The cube lies below the second fingertip of env 0 and is elsewhere in env 1.
    under = [*TIPS_M[1][:2], TIPS_M[1][2] - 0.041, *NO_TURN]
    _put(task, [under, [0.0, 0.0, 0.3, *ROTATION]])
    torques = controls_of(task)
    task.step(actions)
    torch.testing.assert_close(torques[0], actions * (0.36 if normal else 1.0))
    found, bodies = task.states_buf, (sim.body_pos, sim.body_rot, sim.body_lin_vel)
    tips = torch.cat([v[:, _tips(task)] for v in (*bodies, sim.body_ang_vel)], dim=-1).flatten(1)
    cube, joints = sim.object_states[:, 0], (sim.dof_pos, sim.dof_vel)
    parts = (*joints, cube[:, :7], task.goal_poses, actions, cube[:, 7:], tips, sim.dof_forces)
    torch.testing.assert_close(found[:, :95], torch.cat(parts, dim=-1))
    wrenches = found[:, 95:].reshape(2, 3, 6)
    up = quat_apply(sim.body_rot[0, _tips(task)], wrenches[0, :, :3])[:, 2]
    assert up[1] > 0.1 and (wrenches[0, ::2] == 0.0).all() and (wrenches[1] == 0.0).all()
    assert (task.num_observations, task.num_states) == (41, 113)


def test_an_episode_starts_without_the_tips_of_the_last_one(make_task: MakeTask) -> None:
    task = make_task(*PLAIN, "task.env.reset_distribution.object_initial_state.type=default")
    terms = []
    for step in range(25):
        task.step(task.zero_actions())
        terms.append({name: term[0].item() for name, term in task.reward_terms.items()})
        task.reset_buf[:] = int(step == 23)
    assert -0.5 < terms[0]["finger_movement"] < 0.0  # the fingers fall for 0.02 s
    for name in ("finger_movement", "finger_reach"):
        assert terms[24][name] == pytest.approx(terms[0][name], rel=1e-3)


def test_the_reach_term_ends(make_task: MakeTask) -> None:
    task = make_task(*PLAIN, num_envs=2)
    for steps, is_on in ((0, True), (25_000_000, True), (25_000_001, False)):
        task.control_steps = steps  # of two environments each
        task.step(task.zero_actions())
        assert (task.reward_terms["finger_reach"] != 0.0).tolist() == [is_on] * 2


@pytest.mark.parametrize("difficulty", [1, 4])
def test_a_cube_at_its_goal(make_task: MakeTask, difficulty: int) -> None:
    task = make_task(*PLAIN, f"task.env.task_difficulty={difficulty}", num_envs=5)
    task.goal_poses[:] = torch.tensor([0.0, 0.0, 0.0325, *NO_TURN])
    aside = torch.tensor([0.0, 0.019, 0.021, 0.0, 0.0])  # m
    half = 0.5 * torch.tensor([0.0, 0.0, 0.0, 0.39, 0.41])  # rad about z
    none, height = torch.zeros(5), torch.full((5,), 0.0325)
    cubes = (aside, none, height, none, none, half.sin(), half.cos())
    _put(task, torch.stack(cubes, dim=-1).tolist())
    task.progress_buf[3:] = torch.tensor([747, 748])
    *_, dones, infos = task.step(task.zero_actions())
    assert infos["successes"]["at_goal"].tolist() == [True, True, False, True, difficulty == 1]
    assert dones.tolist() == [0, 0, 0, 0, 1]  # by its length
