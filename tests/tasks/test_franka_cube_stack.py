"""FrankaCubeStack: formulas by hand, the control of the hand, the gripper, starts."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.tasks.base.reward_terms import total
from isaacgymenvs_lite.tasks.base.vec_task import Done
from isaacgymenvs_lite.tasks.franka_cube_stack import (
    FrankaCubeStack,
    FrankaCubeStackConfig,
    compute_franka_reward,
    compute_osc_torques,
    compute_stacked,
    draw_cubes,
)

MakeTask = Callable[..., FrankaCubeStack]
DEFAULT_POS = [0.0, 0.1963, 0.0, -2.6180, 0.0, 2.9416, 0.7854, 0.035, 0.035]
EFFORTS = [87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0]
TABLE_M = 1.025
STEPS_PER_S = 60
BOTH = torch.arange(2)
# Cube A on cube B, whose centre is at (0.1, 0.2), and a hand 5 cm above it.
CUBE_B = [0.1, 0.2, TABLE_M + 0.035]
CUBE_A = [0.1, 0.2, TABLE_M + 0.07 + 0.025]
HAND = [0.1, 0.2, CUBE_A[2] + 0.05]


def _rows(*rows: list[float]) -> tuple[torch.Tensor, ...]:
    return tuple(torch.tensor([row]) for row in rows)


def test_reward_of_the_specification() -> None:
    a, b = [0.1, 0.05, 1.15], [0.12, 0.02, 1.06]
    grip, left, right = [0.13, 0.05, 1.15], [0.1, 0.01, 1.15], [0.1, 0.05, 1.10]
    terms = compute_franka_reward(*_rows(a, b, grip, left, right), FrankaCubeStackConfig())
    # float32 of six digits
    assert terms["distance"].item() == pytest.approx(0.1 * 0.620051, abs=1e-6)
    assert terms["align"].item() == pytest.approx(2.0 * 0.562575, abs=1e-5)
    assert total(terms).item() == pytest.approx(2.687156, abs=1e-5)


def test_rewards_by_hand() -> None:
    def terms_of(height: float, hand_above: float) -> dict[str, float]:
        a = [0.0, 0.0, TABLE_M + height]
        hand = [0.0, 0.0, a[2] + hand_above]
        terms = compute_franka_reward(*_rows(a, CUBE_B, hand, hand, hand), FrankaCubeStackConfig())
        return {name: term.item() for name, term in terms.items()}

    low, lifted = terms_of(0.05 + 0.039, 0.1), terms_of(0.05 + 0.041, 0.1)
    # A float32 difference of numbers near 1
    assert low["distance"] == pytest.approx(0.1 * (1.0 - math.tanh(1.0)), abs=1e-6)
    assert (low["lift"], low["align"]) == (0.0, 0.0)
    assert lifted["lift"] == 1.5
    to_place = math.hypot(0.1, 0.2, 0.035 + 0.06 - 0.091)
    aligned = 1.0 - math.tanh(10.0 * to_place)
    assert lifted["align"] == pytest.approx(2.0 * aligned, abs=1e-6)
    # Of nearness and alignment the larger one counts.
    far = terms_of(0.05 + 0.041, 3.0)
    assert far["distance"] == pytest.approx(0.1 * aligned, abs=1e-6)


def test_shaping_rewards_by_hand() -> None:
    cfg = FrankaCubeStackConfig(shaping_reward_scale=1.0)

    def terms_of(rise: float, left: list[float], right: list[float]) -> tuple[float, float]:
        a = [0.3, 0.0, TABLE_M + 0.025 + rise]
        tips = [[x + y for x, y in zip(a, tip, strict=True)] for tip in (left, right)]
        terms = compute_franka_reward(*_rows(a, CUBE_B, tips[0], *tips), cfg)
        return terms["grasp"].item(), terms["carry"].item()

    def near(gap: float) -> float:
        return 0.5 * (1.0 - math.tanh(20.0 * gap))

    # A float32 difference of numbers near 1
    closed, opened = terms_of(0.0, [0.025, 0, 0], [-0.025, 0, 0]), [0.04, 0, 0]
    assert closed == pytest.approx((0.5, 0.0), abs=1e-5)
    assert terms_of(0.0, opened, [-0.04, 0, 0])[0] == pytest.approx(near(0.015), abs=1e-5)
    # The fingertips are seen at a right angle, or at one place.
    assert terms_of(0.0, opened, [0, 0, 0.04])[0] == pytest.approx(0.5 * near(0.015), abs=1e-5)
    assert terms_of(0.0, opened, opened)[0] == pytest.approx(0.0, abs=1e-6)
    for rise, share in ((-0.01, 0.0), (0.013, 0.2), (0.2, 1.0), (1.2, 0.0)):
        to_place_m = math.hypot(0.2, 0.2, 0.07 - rise)
        expected = 2.0 * share * (1.0 - to_place_m)
        assert terms_of(rise, opened, opened)[1] == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize(
    ("aside", "gap", "released"),
    [(0.0, 0.0, 0.0), (0.0, 0.015, 0.5), (0.0, 0.04, 1.0), (0.03, 0.04, 1.0 - math.tanh(0.3))],
)
def test_a_release_is_paid_near_the_place(aside: float, gap: float, released: float) -> None:
    x, y, z = CUBE_A[0] + aside, *CUBE_A[1:]
    left, right = [x + 0.025 + gap, y, z], [x - 0.025 - gap, y, z]
    cfg = FrankaCubeStackConfig(shaping_reward_scale=1.0)
    terms = compute_franka_reward(*_rows([x, y, z], CUBE_B, [x, y, z], left, right), cfg)
    # A float32 difference of numbers near 0.1
    assert terms["release"].item() == pytest.approx(1.5 * released, abs=1e-5)


def test_a_stacked_cube_replaces_the_other_rewards() -> None:
    terms = compute_franka_reward(
        *_rows(CUBE_A, CUBE_B, HAND, HAND, HAND), FrankaCubeStackConfig(stack_reward_scale=16.0)
    )
    assert {n: t.item() for n, t in terms.items()} == {
        **dict.fromkeys(("distance", "lift", "align", "grasp", "carry", "release"), 0.0),
        "stack": 16.0,
    }


@pytest.mark.parametrize(
    ("aside", "above", "hand_above", "stacked"),
    [
        *[((0.019, 0.0), 0.0, 0.05, True), ((0.0, -0.021), 0.0, 0.05, False)],
        *[((0.015, 0.015), 0.0, 0.05, False), ((0.0, 0.0), 0.019, 0.05, True)],
        *[((0.0, 0.0), 0.021, 0.05, False), ((0.0, 0.0), -0.021, 0.05, False)],
        *[((0.0, 0.0), 0.0, 0.039, False), ((0.0, 0.0), 0.0, 0.041, True)],
    ],
)
def test_limits_of_a_stack(
    aside: tuple[float, float], above: float, hand_above: float, stacked: bool
) -> None:
    a = [CUBE_A[0] + aside[0], CUBE_A[1] + aside[1], CUBE_A[2] + above]
    hand = [a[0], a[1], a[2] + hand_above]
    assert compute_stacked(*_rows(a, CUBE_B, hand)).item() == stacked


def test_cubes_start_apart_on_the_table() -> None:
    torch.manual_seed(0)
    states = draw_cubes(torch.arange(4000), 0.25, 0.785)
    assert (states[:, 0, 2] - (TABLE_M + 0.025)).abs().max() < 1e-6
    assert (states[:, 1, 2] - (TABLE_M + 0.035)).abs().max() < 1e-6
    apart = (states[:, 0, :2] - states[:, 1, :2]).norm(dim=-1)
    least = 0.12 * math.sqrt(2.0)
    # 4000 draws come as near to each limit as this.
    assert least <= apart.min() < least + 0.002
    yaw = 2.0 * torch.atan2(states[..., 5], states[..., 6])
    for values, limit in ((states[..., :2], 0.25), (yaw, 0.785)):
        for cube in (values[:, 0], values[:, 1]):
            assert -limit <= cube.min() < -0.99 * limit
            assert 0.99 * limit < cube.max() <= limit
    torch.testing.assert_close(states[..., 3:7].norm(dim=-1), torch.ones(4000, 2))
    assert (states[..., 3:5] == 0.0).all() and (states[..., 7:] == 0.0).all()


def test_cubes_start_apart_in_the_smallest_area(make_task: MakeTask) -> None:
    torch.manual_seed(0)
    states = draw_cubes(torch.arange(1000), 0.1, 0.0)
    assert states[..., :2].abs().max() <= 0.1
    assert (states[:, 0, :2] - states[:, 1, :2]).norm(dim=-1).min() >= 0.12 * math.sqrt(2.0)
    with pytest.raises(ConfigError, match=r"^task\.env\.startPositionNoise[^\n]*0\.1"):
        make_task("task=FrankaCubeStack", "task.env.startPositionNoise=0.05")


def test_an_unknown_kind_of_control_is_one_line(make_task: MakeTask) -> None:
    with pytest.raises(ConfigError, match=r"^[^\n]*controlType[^\n]*osc, joint_tor[^\n]*$"):
        make_task("task=FrankaCubeStack", "task.env.controlType=ocs")


def _random_arm(seed: int, n: int = 16) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, 7, 7))
    return {
        "motion": rng.uniform(-0.1, 0.1, (n, 6)),
        "jacobian": rng.normal(size=(n, 6, 7)),
        "mass_matrix": root @ root.transpose(0, 2, 1) + 2.0 * np.eye(7),
        "velocity": rng.normal(size=(n, 6)),
        "dof_pos": rng.uniform(-3.0, 3.0, (n, 7)),
        "dof_vel": rng.normal(size=(n, 7)),
        "default_dof_pos": rng.uniform(-3.0, 3.0, 7),
    }


def _torques(arm: dict[str, np.ndarray]) -> np.ndarray:
    return compute_osc_torques(*map(torch.from_numpy, arm.values())).numpy()


def test_torques_of_operational_space_control_by_hand() -> None:
    arm = _random_arm(0)
    found = compute_osc_torques(*(torch.from_numpy(v).float() for v in arm.values())).numpy()
    for row, torques in enumerate(found):
        motion, jac, mass, speed, pos, vel = (v[row] for v in list(arm.values())[:-1])
        inertia = np.linalg.inv(jac @ np.linalg.inv(mass) @ jac.T)
        hand = jac.T @ inertia @ (150.0 * motion - 2.0 * math.sqrt(150.0) * speed)
        wrapped = np.angle(np.exp(1j * (arm["default_dof_pos"] - pos)))
        posture = mass @ (10.0 * wrapped - 2.0 * math.sqrt(10.0) * vel)
        projected = np.eye(7) - jac.T @ (inertia @ jac @ np.linalg.inv(mass))
        # float32 solutions of systems with condition numbers up to some thousand
        expected = hand + projected @ posture
        assert torques == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())


def test_torques_of_the_posture_do_not_accelerate_the_hand() -> None:
    arm = _random_arm(1)
    arm["motion"][:] = 0.0
    arm["velocity"][:] = 0.0
    torques = _torques(arm)[:, :, None]
    assert np.abs(torques).max() > 1.0
    accelerations = arm["jacobian"] @ np.linalg.solve(arm["mass_matrix"], torques)
    assert np.abs(accelerations).max() < 1e-10 * np.abs(torques).max()


def _start(task: FrankaCubeStack) -> None:
    """Start at the default pose with the cubes on the table, away from the arm."""
    n, sim = task.num_envs, task.simulation
    task.reset()
    ids = torch.arange(n)
    bases = sim.dof_pos[:, [sim.dof_names.index(name) for name in task.placing_joints]]
    task.write_joints(ids, torch.tensor(DEFAULT_POS).repeat(n, 1), bases)
    cubes = torch.zeros(n, 2, 13)
    cubes[..., 6] = 1.0
    cubes[:, 0, :3] = torch.tensor([-0.3, 0.5, TABLE_M + 0.025])
    cubes[:, 1, :3] = torch.tensor([-0.3, -0.5, TABLE_M + 0.035])
    sim.write_object_states(ids, BOTH, cubes)


def test_places_of_the_default_pose(make_task: MakeTask) -> None:
    task = make_task("task=FrankaCubeStack", num_envs=2)
    _start(task)
    grip = task.pos_w("grip")[1]
    assert grip.tolist() == pytest.approx([0.0080, 0.0, 1.21811], abs=1e-5)
    x, y, z, w = task.rot_w("grip")[1].tolist()
    sign = math.copysign(1.0, -x)
    assert [sign * v for v in (w, x, y, z)] == pytest.approx([0, -0.99798, 0, -0.06361], abs=1e-5)
    for tip, side in (("left_tip", -0.0365), ("right_tip", 0.0365)):
        place = [grip[0].item(), side, grip[2].item()]
        assert task.pos_w(tip)[1].tolist() == pytest.approx(place, abs=1e-5)


@pytest.mark.parametrize("control", ["osc", "joint_tor"])
def test_parts_of_the_observation(make_task: MakeTask, control: str) -> None:
    task = make_task("task=FrankaCubeStack", f"task.env.controlType={control}", num_envs=2)
    observed = task.reset()["obs"][1]
    sim, sizes = task.simulation, {"osc": (19, 7), "joint_tor": (26, 8)}[control]
    assert (task.num_observations, task.num_actions) == sizes
    assert list(task.observation_groups().values()) == [4, 3, 3, 3, 4, sizes[0] - 17]
    a, b = sim.object_states[1]
    joints = sim.dof_pos[1, 7:] if control == "osc" else sim.dof_pos[1]
    parts = (a[3:7], a[:3], b[:3] - a[:3], task.pos_w("grip")[1], task.rot_w("grip")[1], joints)
    torch.testing.assert_close(observed, torch.cat(parts))


def test_joint_torques_and_the_gripper(
    make_task: MakeTask, controls_of: Callable[..., list[torch.Tensor]]
) -> None:
    overrides = ("task.env.controlType=joint_tor", "task.env.actionScale=2.0")
    task = make_task("task=FrankaCubeStack", *overrides, num_envs=3)
    task.reset()
    actions = torch.tensor([0.5, -1.0, 0.2, 1.0, -0.5, 0.1, 1.0]).repeat(3, 1)
    seen = controls_of(task)
    task.step(torch.cat((actions, torch.tensor([[0.0], [1.0], [-0.01]])), dim=-1))
    torch.testing.assert_close(seen[0][:, :7], actions * torch.tensor(EFFORTS) / 2.0)
    open_m = pytest.approx(0.04)
    assert seen[0][:, 7:].tolist() == [[open_m, open_m], [open_m, open_m], [0.0, 0.0]]


def test_torques_are_limited_and_reach_the_joints(
    make_task: MakeTask, controls_of: Callable[..., list[torch.Tensor]]
) -> None:
    task = make_task("task=FrankaCubeStack", num_envs=2)
    _start(task)
    vel = torch.zeros(2, 9)
    vel[:, :7] = 2.0  # a hand that is braked with more than the motors have
    pos = torch.tensor(DEFAULT_POS).repeat(2, 1)
    task.simulation.write_state(torch.arange(2), torch.zeros(2, 13), pos, vel)
    seen = controls_of(task)
    task.step(torch.zeros(2, 7))
    limits = torch.tensor(EFFORTS)
    assert (seen[0][:, :7].abs() <= limits).all()
    assert (seen[0][:, :7].abs() == limits).any()


def test_a_hand_without_actions_stays(make_task: MakeTask) -> None:
    torch.manual_seed(0)
    task = make_task("task=FrankaCubeStack", num_envs=8)
    task.reset()
    start = task.pos_w("grip").clone()
    for _ in range(STEPS_PER_S):
        task.step(torch.zeros(8, 7))
    # The posture moves the joints meanwhile.
    assert (task.joint_pos()[:, :7] - torch.tensor(DEFAULT_POS[:7])).abs().mean() > 0.01
    assert (task.pos_w("grip") - start).norm(dim=-1).max() < 1e-3


def _velocities(task: FrankaCubeStack, actions: torch.Tensor, steps: int) -> torch.Tensor:
    for _ in range(steps):
        task.step(actions)
    sim = task.simulation
    grip = sim.body_names.index("panda_grip_site")
    return torch.cat((sim.body_lin_vel[:, grip], sim.body_ang_vel[:, grip]), dim=-1)


def test_actions_move_the_hand_along_their_axes(make_task: MakeTask) -> None:
    task = make_task("task=FrankaCubeStack", num_envs=6)
    _start(task)
    actions = torch.zeros(6, 7)
    axes = torch.cat((torch.eye(3), -torch.eye(3)))
    actions[:, :3] = 0.3 * axes
    velocities = _velocities(task, actions, 10)[:, :3]
    # Where 150 times 3 cm equals 24.5 times the speed. The joints' drag takes up to 13 %.
    speed = 0.15 * 30.0 / (2.0 * math.sqrt(150.0))
    torch.testing.assert_close(velocities, speed * axes, atol=0.15 * speed, rtol=0.0)


def test_the_gripper_lifts_and_holds_a_cube(make_task: MakeTask) -> None:
    task = make_task("task=FrankaCubeStack", num_envs=4)
    _start(task)
    sim = task.simulation
    cubes = torch.zeros(4, 2, 13)
    cubes[..., 6] = 1.0
    cubes[:, 0, :3] = torch.tensor([0.0, 0.0, TABLE_M + 0.025])
    cubes[:, 0, :2] = torch.tensor([[-0.1, 0.0], [0.1, 0.1], [0.0, -0.1], [0.05, 0.05]])
    cubes[:, 1, :3] = torch.tensor([0.4, 0.5, TABLE_M + 0.035])
    sim.write_object_states(torch.arange(4), BOTH, cubes)
    start = cubes[:, 0, :3]

    def move(above_m: float, gripper: float, steps: int) -> torch.Tensor:
        """Move the hands to places above the starts of the cubes; return where cubes A are."""
        for _ in range(steps):
            actions = torch.full((4, 7), gripper)
            actions[:, 3:6] = 0.0
            aim = start + torch.tensor([0.0, 0.0, above_m])
            actions[:, :3] = (10.0 * (aim - task.pos_w("grip"))).clamp(-1.0, 1.0)
            task.step(actions)
        return sim.object_states[:, 0, :3]

    move(0.1, 1.0, 50)
    move(0.0, 1.0, 50)
    torch.testing.assert_close(task.pos_w("grip"), start, atol=1e-3, rtol=0.0)
    move(0.0, -1.0, 30)
    # The cube is 5 cm wide; contacts give way.
    assert (task.joint_pos()[:, 7:].sum(-1) > 0.03).all()
    lifted = start + torch.tensor([0.0, 0.0, 0.1])
    torch.testing.assert_close(move(0.1, -1.0, 60), lifted, atol=5e-3, rtol=0.0)
    assert (task.reward_terms["lift"] == 1.5).all()
    torch.testing.assert_close(move(0.1, -1.0, 60), lifted, atol=5e-3, rtol=0.0)
    dropped = move(0.1, 1.0, 40)
    assert (dropped[:, 2] - start[:, 2]).abs().max() < 1e-3
    assert (task.progress_buf == 290).all()  # in the same episode


def test_a_released_stack_ends_the_episode(make_task: MakeTask) -> None:
    task = make_task("task=FrankaCubeStack", "task.env.stackRewardScale=16", num_envs=3)
    _start(task)
    cubes = torch.zeros(3, 2, 13)
    cubes[..., 6] = 1.0
    cubes[:, 0, :3], cubes[:, 1, :3] = torch.tensor(CUBE_A), torch.tensor(CUBE_B)
    cubes[2, 0, 0] += 0.2
    task.simulation.write_object_states(torch.arange(3), BOTH, cubes)
    task.progress_buf[:] = torch.tensor([10, 298, 298])
    _, rewards, dones, infos = task.step(torch.zeros(3, 7))
    assert task.done_buf.tolist() == [Done.REACHED, Done.REACHED, Done.TIME_OUT]
    assert dones.tolist() == [1, 1, 1]
    assert infos["time_outs"].tolist() == [False, False, True]
    assert infos["successes"]["stacked"].tolist() == [True, True, False]
    assert rewards[:2].tolist() == [16.0, 16.0]


def test_each_base_stands_elsewhere_for_all_episodes(make_task: MakeTask) -> None:
    torch.manual_seed(0)
    noise = ("task.env.frankaPositionNoise=0.05", "task.env.frankaRotationNoise=0.4")
    task = make_task("task=FrankaCubeStack", *noise, num_envs=12)
    task.reset()
    sim = task.simulation
    base = sim.body_names.index("panda_link0")
    places, rots = sim.body_pos[:, base].clone(), sim.body_rot[:, base].clone()
    away = places - torch.tensor([-0.45, 0.0, 1.125])
    yaw = 2.0 * torch.atan2(rots[:, 2], rots[:, 3])
    assert (rots[:, :2].abs() < 1e-6).all() and (away[:, 2].abs() < 1e-6).all()
    for values, limit in ((away[:, 0], 0.05), (away[:, 1], 0.05), (yaw, 0.4)):
        # 12 draws spread over at least half of the range.
        assert -limit <= values.min() < -0.25 * limit
        assert 0.25 * limit < values.max() <= limit
    task.reset()
    torch.testing.assert_close(sim.body_pos[:, base], places)
    _start(task)
    expected = Rotation.from_euler("z", yaw.numpy()[:, None]).apply([0.458, 0.0, 0.09311])
    found = (task.pos_w("grip") - places).numpy()
    assert found == pytest.approx(expected, abs=2e-5)  # five digits are given
    actions = torch.zeros(12, 7)
    actions[:, 0] = 0.3
    velocities = _velocities(task, actions, 10)[:, :3]
    # The axes are the world's, also of a turned base.
    torch.testing.assert_close(
        velocities, torch.tensor([0.1837, 0.0, 0.0]).repeat(12, 1), atol=0.028, rtol=0.0
    )
    torch.testing.assert_close(sim.body_pos[:, base], places, atol=1e-5, rtol=0.0)
