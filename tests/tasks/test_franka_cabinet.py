"""FrankaCabinet: formulas by hand, the cabinet and its boxes, the gripper, a user's arm."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.tasks.base.reward_terms import total
from isaacgymenvs_lite.tasks.base.vec_task import Done
from isaacgymenvs_lite.tasks.franka_cabinet import (
    FrankaCabinet,
    FrankaCabinetConfig,
    compute_franka_reward,
)
from isaacgymenvs_lite.utils.rotations import quat_conjugate, quat_mul

MakeTask = Callable[..., FrankaCabinet]
DEFAULT_POS = [1.157, -1.066, -0.155, -2.239, -1.841, 1.003, 0.469, 0.035, 0.035]
ASIDE_POS = [2.8, 0.0, 0.0, -2.0, 0.0, 2.0, 0.0, 0.035, 0.035]  # away from the cabinet
LOWER = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973, 0.0, 0.0]
UPPER = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973, 0.04, 0.04]
SPEEDS = torch.tensor([7.5] * 7 + [0.75] * 2)  # rad/s and m/s of a full action
STEP_S = 0.0166
DRAWER, DRAWER_JOINT, CABINET = "cabinet_drawer_top", "cabinet_drawer_top_joint", "cabinet_sektion"
DRAWER_KG, DAMPING = 5.33327, 10.0
UPRIGHT = [0.0, 0.0, 0.0, 1.0]
# Between two fingers, the upper one 2 cm above and the lower one 3 cm below the handle.
AROUND = ([0.4, 0.0, 0.72], [0.4, 0.0, 0.67])
BESIDE = ([0.4, 0.0, 0.67], [0.4, 0.0, 0.67])
HANDLE = [0.4, 0.0, 0.7]
CFG = FrankaCabinetConfig(open_bonus=0.0)


def _terms(
    opening: float = 0.0,
    distance: float = 1.0,
    hand_rot: list[float] = UPRIGHT,
    fingers: tuple[list[float], list[float]] = BESIDE,
    action: float = 0.0,
    cfg: FrankaCabinetConfig = CFG,
) -> dict[str, float]:
    left, right = fingers
    hand = [HANDLE[0] + distance, *HANDLE[1:]]
    poses = (hand, HANDLE, hand_rot, UPRIGHT, left, right)
    actions, openings = torch.full((1, 9), action), torch.tensor([opening])
    terms = compute_franka_reward(actions, openings, *(torch.tensor([p]) for p in poses), cfg)
    return {name: term.item() for name, term in terms.items()} | {"total": total(terms).item()}


def test_reward_of_the_specification() -> None:
    forward = np.array([-0.8, 0.6, 0.0])  # 0.8 along -x of the drawer
    up = np.array([0.75, 1.0, 0.0]) * math.sqrt(0.91) / 1.25 - [0.0, 0.0, 0.3]
    frame = np.stack((np.cross(up, forward), up, forward), axis=1)
    rot = Rotation.from_matrix(frame).as_quat().tolist()
    terms = _terms(0.25, 0.1, rot, AROUND, action=1.0)
    assert terms["action"] == pytest.approx(-0.01 * 9.0)
    # The specification's sum has a tenth of the action penalty of its table; float32.
    assert terms["total"] + 0.081 == pytest.approx(6.176592, abs=5e-6)


def test_rewards_of_distance_and_alignment_by_hand() -> None:
    near, far = _terms(distance=0.0199)["distance"], _terms(distance=0.0201)["distance"]
    # The distance is a float32 difference of numbers near 0.4.
    assert near == pytest.approx(2.0 * 2.0 / (1.0 + 0.0199**2) ** 2, rel=1e-5)
    assert far == pytest.approx(2.0 / (1.0 + 0.0201**2) ** 2, rel=1e-5)
    assert _terms(distance=2.0)["distance"] == pytest.approx(2.0 / 25.0)
    for degrees, share in ((0.0, 1.0), (60.0, 0.25), (120.0, -0.25), (180.0, -1.0)):
        # The hand looks along -x with y up, then it is turned about the vertical axis.
        frame = Rotation.from_euler("z", degrees, degrees=True) * Rotation.from_matrix(
            [[0, 0, -1], [-1, 0, 0], [0, 1, 0]]
        )
        rotation = _terms(hand_rot=frame.as_quat().tolist())["rotation"]
        assert rotation == pytest.approx(0.5 * 0.5 * (share + 1.0), abs=1e-6)


def test_rewards_of_the_fingers_and_the_drawer_by_hand() -> None:
    around, beside = _terms(0.3, fingers=AROUND), _terms(0.3, fingers=BESIDE)
    assert (around["around_handle"], beside["around_handle"]) == (0.125, 0.0)
    # Both are sums of float32 heights near 0.7.
    assert around["finger_distance"] == pytest.approx(5.0 * (0.02 + 0.01), abs=1e-6)
    assert beside["finger_distance"] == 0.0
    assert around["open"] == pytest.approx(7.5 * 0.3 * 1.5)
    assert beside["open"] == pytest.approx(7.5 * 0.3)
    swapped = _terms(0.3, fingers=(AROUND[1], AROUND[0]))
    assert swapped == beside


@pytest.mark.parametrize(
    ("opening", "around", "beside"),
    [(0.009, 0.0, 0.0), (0.011, 0.5, 0.5), (0.201, 1.0, 0.5), (0.389, 1.0, 0.5), (0.391, 2.0, 0.5)],
)
def test_bonuses_of_the_stages(opening: float, around: float, beside: float) -> None:
    assert _terms(opening, fingers=AROUND)["stages"] == around
    assert _terms(opening, fingers=BESIDE)["stages"] == beside


def test_an_open_drawer_pays_the_bonus_once_and_a_finger_behind_the_handle_costs() -> None:
    paid = dataclasses.replace(CFG, open_bonus=1500.0)
    assert _terms(0.389, cfg=paid) == _terms(0.389)
    assert _terms(0.391, cfg=paid)["total"] - _terms(0.391)["total"] == pytest.approx(1500.0)
    behind, before = [0.359, 0.0, 0.72], [0.361, 0.0, 0.72]
    for fingers in ((behind, AROUND[1]), (AROUND[0], behind)):
        assert _terms(0.391, fingers=fingers, cfg=paid)["total"] == -1.0
    assert _terms(fingers=(before, AROUND[1]))["total"] > 0.0


def _put(task: FrankaCabinet, pos: list[float], opening: float = 0.0) -> None:
    """Put all arms at joint positions (9,) with targets there, and the drawers at an opening."""
    n, sim = task.num_envs, task.simulation
    dof_pos = torch.zeros(n, len(sim.dof_names))
    dof_pos[:, :9] = torch.tensor(pos)
    dof_pos[:, sim.dof_names.index(DRAWER_JOINT)] = opening
    rest = torch.zeros_like(dof_pos)
    sim.write_state(torch.arange(n), torch.zeros(n, 13), dof_pos, rest)
    task.targets[:] = torch.tensor(pos)
    task.reset_buf.zero_()
    task.update_state()


def _opening(task: FrankaCabinet) -> torch.Tensor:
    sim = task.simulation
    return sim.dof_pos[:, sim.dof_names.index(DRAWER_JOINT)]


def test_places_of_the_default_pose(make_task: MakeTask) -> None:
    task = make_task("task=FrankaCabinet", num_envs=2)
    task.reset()
    _put(task, DEFAULT_POS)
    for found, expected in (
        (task.hand_grasp_pos, (0.78438, 0.08227, 0.81988)),
        (task.drawer_grasp_pos, (0.3515, 0.01, 0.7172)),
        (task.pos_w("left"), (0.75909, 0.07096, 0.8287)),
        (task.pos_w("right"), (0.75756, 0.06184, 0.75931)),
    ):
        assert found[1].tolist() == pytest.approx(expected, abs=1e-5)  # five digits are given
    torch.testing.assert_close(task.hand_grasp_rot, task.rot_w("hand"))


def test_order_and_scales_of_the_observation(make_task: MakeTask) -> None:
    task = make_task("task=FrankaCabinet", num_envs=2)
    assert sum(task.observation_groups().values()) == task.num_observations == 23
    task.reset()
    sim = task.simulation
    pos, vel = torch.zeros(2, 13), torch.zeros(2, 13)
    pos[:, :9] = torch.tensor(DEFAULT_POS)
    vel[:, :9] = torch.arange(1.0, 10.0)
    pos[1, 12], vel[1, 12] = 0.25, 0.7
    sim.write_state(torch.arange(2), torch.zeros(2, 13), pos, vel)
    task.update_state()
    observed = task.compute_obs()[1].tolist()
    shares = [
        2 * (q - low) / (high - low) - 1
        for q, low, high in zip(DEFAULT_POS, LOWER, UPPER, strict=True)
    ]
    assert observed[:9] == pytest.approx(shares, abs=1e-6)
    assert observed[9:18] == pytest.approx([0.1 * i for i in range(1, 10)])
    way = [0.3515 + 0.25 - 0.78438, 0.01 - 0.08227, 0.7172 - 0.81988]
    assert observed[18:21] == pytest.approx(way, abs=2e-5)
    assert observed[21:] == pytest.approx([0.25, 0.7])


def test_starts_are_near_the_default_pose(make_task: MakeTask) -> None:
    task = make_task("task=FrankaCabinet", num_envs=64)
    torch.manual_seed(0)
    observed = task.reset()["obs"]
    away = task.joint_pos() - torch.tensor(DEFAULT_POS)
    # 448 draws; fingers end at their limits.
    low, high = away[:, :7].aminmax()
    assert -0.125 <= low < -0.12 and 0.12 < high <= 0.125
    assert (task.joint_pos()[:, 7:].aminmax()) == (0.0, pytest.approx(0.04))
    torch.testing.assert_close(task.targets, task.joint_pos())
    assert (_opening(task) == 0.0).all()
    # The first observation has the place of the hand of the new episode.
    model, data = task.simulation.model, mujoco.MjData(task.simulation.model)
    data.qpos[:9] = task.joint_pos()[5].numpy()
    mujoco.mj_kinematics(model, data)
    link7 = data.body("panda_link7")
    grasp = link7.xpos + link7.xmat.reshape(3, 3) @ [0.0, 0.04, 0.1654]
    assert observed[5, 18:21].tolist() == pytest.approx([0.3515, 0.01, 0.7172] - grasp, abs=1e-6)


def test_actions_move_the_targets_and_the_joints_follow(make_task: MakeTask) -> None:
    task = make_task("task=FrankaCabinet", num_envs=2)
    task.reset()
    _put(task, ASIDE_POS)
    actions = torch.tensor([0.4, -0.3, 0.2, 0.1, -0.2, 0.3, -0.4, -0.1, -0.9]).repeat(2, 1)
    task.step(actions)
    moved = torch.tensor(ASIDE_POS) + STEP_S * SPEEDS * actions[0]
    torch.testing.assert_close(task.targets[1], moved, atol=1e-6, rtol=0.0)
    for _ in range(120):
        task.step(torch.zeros(2, 9))
    torch.testing.assert_close(task.targets[1], moved, atol=1e-6, rtol=0.0)
    # A drive of 400 and 80 Nm (s)/rad needs 0.2 s for a factor of e; these are 10 of them.
    torch.testing.assert_close(task.joint_pos()[1], moved, atol=1e-4, rtol=0.0)
    for _ in range(60):
        task.reset_buf.zero_()
        task.step(torch.tensor([[1.0] * 9, [-1.0] * 9]))
    assert task.targets[0].tolist() == pytest.approx(UPPER)
    assert task.targets[1].tolist() == pytest.approx(LOWER)


def test_an_open_drawer_ends_the_episode(make_task: MakeTask) -> None:
    task = make_task("task=FrankaCabinet", num_envs=4)
    task.reset()
    _put(task, ASIDE_POS, opening=0.393)
    closed = torch.tensor([2, 3])
    task.write_joints(closed, torch.tensor([ASIDE_POS] * 2), torch.zeros(2, 0))
    task.progress_buf[:] = torch.tensor([10, 498, 498, 10])
    *_, dones, infos = task.step(task.zero_actions())
    assert task.done_buf.tolist() == [Done.REACHED, Done.REACHED, Done.TIME_OUT, Done.RUNNING]
    assert dones.tolist() == [1, 1, 1, 0]
    assert infos["time_outs"].tolist() == [False, False, True, False]
    assert infos["successes"]["drawer_open"].tolist() == [True, True, False, False]
    task.step(task.zero_actions())
    assert (_opening(task)[:2] == 0.0).all()
    assert task.progress_buf.tolist() == [0, 0, 0, 12]


@pytest.mark.parametrize("num_props", [5, 16])
def test_boxes_rest_in_the_drawer_and_move_along(make_task: MakeTask, num_props: int) -> None:
    task = make_task("task=FrankaCabinet", f"task.env.numProps={num_props}", num_envs=2)
    task.reset()
    _put(task, ASIDE_POS)
    per_row = {5: 3, 16: 4}[num_props]
    first = -0.045 * (per_row - 1)
    grid = torch.tensor(
        [
            [0.0515 + first + 0.09 * (k % per_row), first + 0.09 * (k // per_row), 0.7172]
            for k in range(num_props)
        ]
    )
    boxes = task.simulation.object_states
    torch.testing.assert_close(boxes[1, :, :3], grid, atol=1e-6, rtol=0.0)
    for _ in range(60):
        task.step(task.zero_actions())
    # The drawer's floor is 0.4 mm lower; contacts give way by a fraction of a millimetre.
    torch.testing.assert_close(boxes[1, :, :3], grid, atol=1e-3, rtol=0.0)
    assert boxes[1, :, 7:].abs().max() < 1e-3
    # Friction accelerates the boxes with up to 9.8 m/s^2.
    _push(task, DRAWER, 20.0, lambda: bool(_opening(task).max() > 0.3))
    grid[:, 0] += _opening(task)[1]
    torch.testing.assert_close(boxes[1, :, :3], grid, atol=2e-3, rtol=0.0)


def _push(
    task: FrankaCabinet, body: str, newton: float, until: Callable[[], bool], most: int = 60
) -> int:
    """Push a body along x; return the number of control steps."""
    for number in range(1, most + 1):
        task.simulation.apply_forces((body,), torch.tensor([newton, 0.0, 0.0]).expand(2, 1, 3))
        task.step(task.zero_actions())
        if until():
            return number
    return most


def test_a_pushed_drawer_opens_against_its_damping(make_task: MakeTask) -> None:
    task = make_task("task=FrankaCabinet", "task.env.numProps=0", num_envs=2)
    task.reset()
    _put(task, ASIDE_POS)
    steps = _push(task, DRAWER, 20.0, lambda: bool(_opening(task).max() > 0.2))
    decay_s, time_s = DRAWER_KG / DAMPING, steps * STEP_S
    speed = 20.0 / DAMPING * (1.0 - math.exp(-time_s / decay_s))
    way = 20.0 / DAMPING * time_s - decay_s * speed
    velocity = task.simulation.dof_vel[:, task.simulation.dof_names.index(DRAWER_JOINT)]
    # Steps of 8 ms of a decay in 533 ms
    assert velocity.tolist() == pytest.approx([speed] * 2, rel=0.02)
    assert _opening(task).tolist() == pytest.approx([way] * 2, rel=0.03)
    _push(task, DRAWER, 20.0, lambda: bool((task.done_buf == Done.REACHED).any()))
    assert (task.done_buf == Done.REACHED).all()
    assert (_opening(task) < 0.42).all()  # 1.2 m/s into a soft limit at 0.4 m


def test_each_cabinet_stands_elsewhere_and_stays_there(make_task: MakeTask) -> None:
    task = make_task("task=FrankaCabinet", "task.env.startPositionNoise=0.06", num_envs=8)
    torch.manual_seed(0)
    task.reset()
    sim = task.simulation
    place = sim.body_names.index(CABINET)
    start = sim.body_pos[:, place].clone()
    away = start - torch.tensor([0.0, 0.0, 0.4])
    assert (away[:, :2].abs() <= 0.03).all() and (away[:, 2] >= 0.0).all()
    assert (away[:, 2] <= 0.03).all()
    assert (away.amax(0) - away.amin(0) > 0.015).all()  # half of each range; 8 draws
    inside = sim.object_states[:, :, :3] - sim.body_pos[:, None, sim.body_names.index(DRAWER)]
    # The boxes stand in the drawers, in their middle.
    assert inside[..., :2].mean(1).abs().max() < 1e-5
    assert inside[..., 2].abs().max() < 1e-5
    task.targets[:] = torch.tensor(ASIDE_POS)
    for _ in range(60):
        sim.apply_forces((CABINET,), torch.full((8, 1, 3), 100.0))
        task.step(task.zero_actions())
    # Slides with a damping of 1e7 N s/m
    torch.testing.assert_close(sim.body_pos[:, place], start, atol=5e-5, rtol=0.0)


def test_the_gripper_holds_the_handle_and_pulls_the_drawer_open(make_task: MakeTask) -> None:
    task = make_task("task=FrankaCabinet", num_envs=2)
    task.reset()
    _put(task, DEFAULT_POS)
    sim = task.simulation
    # The hand looks along -x, and its fingers move up and down.
    rot = Rotation.from_matrix([[0, 0, -1], [-1, 0, 0], [0, 1, 0]]).as_quat()
    goal = torch.from_numpy(rot).float().expand(2, 4)

    def move(beside_handle_m: float, fingers: float, steps: int) -> None:
        for _ in range(steps):
            # The middle of the handle is 9 mm above the drawer's grasp point.
            aim = task.drawer_grasp_pos + torch.tensor([beside_handle_m, 0.0, 0.009])
            turn = quat_mul(goal, quat_conjugate(task.rot_w("grip")))
            turn = 2.0 * turn[:, :3] * turn[:, 3:].sign()
            way = torch.cat((aim - task.pos_w("grip"), turn), dim=-1)[:, :, None]
            jacobian = sim.jacobian(task.body_names_of_franka["grip"], task.joint_names[:7])
            speeds = torch.linalg.lstsq(jacobian, 4.0 * way).solution.squeeze(-1) / 7.5
            both = torch.full((2, 2), fingers)
            task.step(torch.cat((speeds.clamp(-0.1, 0.1), both), dim=-1))

    move(0.12, 1.0, 100)
    move(0.0, 1.0, 60)
    assert (_opening(task) < 1e-3).all()
    move(0.0, -1.0, 30)
    # The handle is 24.3 mm thick; contacts give way.
    assert (task.joint_pos()[:, 7:].sum(-1) > 0.018).all()
    for _ in range(100):
        move(0.1, -1.0, 1)
        if (_opening(task) > 0.38).any():
            break
    assert (_opening(task) > 0.3).all()
    assert (task.joint_pos()[:, 7:].sum(-1) > 0.018).all()


def test_a_missing_joint_is_named(make_task: MakeTask, tmp_path: Path) -> None:
    path = tmp_path / "stump.xml"
    path.write_text(
        "<mujoco><worldbody><body name='panda_link7'><joint name='panda_joint1'/>"
        "<geom size='0.1'/><body name='panda_leftfinger'><joint name='panda_finger_joint1'/>"
        "<geom size='0.1'/></body><body name='panda_rightfinger'>"
        "<joint name='panda_finger_joint2'/><geom size='0.1'/></body></body></worldbody></mujoco>"
    )
    with pytest.raises(ConfigError) as error:
        make_task("task=FrankaCabinet", f"task.env.asset.assetFileName={path}")
    message = str(error.value)
    assert "no joint 'panda_joint2' or 'joint2' or 'fr3_joint2'" in message
    assert "it has panda_joint1, panda_finger_joint1, panda_finger_joint2" in message


def _as_in_menagerie(folder: Path, *, turned: bool) -> Path:
    """Write the arm with names and gripper of MuJoCo's menagerie, where a finger is turned."""
    spec = mujoco.MjSpec.from_file(str(assets_dir() / "mjcf/franka_panda.xml"))
    for name in ("panda_leftfinger_tip", "panda_rightfinger_tip", "panda_grip_site"):
        spec.delete(spec.body(name))
    spec.delete(spec.geom("floor"))
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = int(geom.contype > 0)
    if turned:
        right = spec.body("panda_rightfinger")
        right.quat = [0.0, 0.0, 0.0, 1.0]
        right.ipos = right.ipos * [-1.0, -1.0, 1.0]
        right.fullinertia = right.fullinertia * [1.0, 1.0, 1.0, 1.0, -1.0, -1.0]
        for geom in right.geoms:
            geom.pos = geom.pos * [-1.0, -1.0, 1.0]
        spec.joint("panda_finger_joint2").axis = [0.0, 1.0, 0.0]
    for element in (*spec.bodies[1:], *spec.joints):
        name = element.name.removeprefix("panda_")
        element.name = name.replace("tfinger", "t_finger")
    tendon = spec.add_tendon(name="split")
    for finger in ("finger_joint1", "finger_joint2"):
        tendon.wrap_joint(finger, 0.5)
    gripper = spec.add_actuator(name="gripper", target="split", trntype=mujoco.mjtTrn.mjTRN_TENDON)
    gripper.gainprm[0], gripper.biastype = 100.0, mujoco.mjtBias.mjBIAS_AFFINE
    equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT)
    equality.name1, equality.name2 = "finger_joint1", "finger_joint2"
    equality.data[:5] = [0.0, 1.0, 0.0, 0.0, 0.0]
    spec.compile()
    path = folder / "panda.xml"
    path.write_text(spec.to_xml())
    return path


@pytest.mark.parametrize("turned", [True, False])
def test_a_file_with_menageries_names_makes_the_same_task(
    make_task: MakeTask, tmp_path: Path, turned: bool
) -> None:
    path = _as_in_menagerie(tmp_path, turned=turned)
    own = make_task("task=FrankaCabinet")
    other = make_task("task=FrankaCabinet", f"task.env.asset.assetFileName={path}")
    assert other.joint_names == tuple(name.removeprefix("panda_") for name in own.joint_names)
    for name in ("panda_link2", "panda_hand", "panda_rightfinger"):
        found, expected = (task.simulation.model.geom(name) for task in (other, own))
        assert (found.contype, found.conaffinity) == (expected.contype, expected.conaffinity)
    torch.manual_seed(0)
    noise = 0.12 * torch.rand(4, 9) - 0.06
    pos = (torch.tensor(ASIDE_POS) + noise).clamp(torch.tensor(LOWER), torch.tensor(UPPER))
    actions = 0.2 * (torch.rand(30, 4, 9) - 0.5)  # the drives do not reach their largest forces
    for task in (own, other):
        task.reset()
        task.write_joints(torch.arange(4), pos, torch.zeros(4, 0))
        task.targets[:] = pos

    def compare(tolerance: float) -> None:
        for task in (own, other):
            task.update_state()
        found, expected = other.hand_grasp_pos, own.hand_grasp_pos
        torch.testing.assert_close(found, expected, atol=tolerance, rtol=0.0)
        torch.testing.assert_close(other.joint_pos(), own.joint_pos(), atol=tolerance, rtol=0.0)
        for part in own.body_names_of_franka:
            found, expected = other.pos_w(part), own.pos_w(part)
            torch.testing.assert_close(found, expected, atol=tolerance, rtol=0.0)

    compare(1e-6)
    for action in actions:
        for task in (own, other):
            task.step(action)
    compare(5e-5)  # the file has six digits, and no fingertips of 0.7 g


def test_a_users_cabinet_comes_without_its_actuators(make_task: MakeTask, tmp_path: Path) -> None:
    spec = mujoco.MjSpec.from_file(str(assets_dir() / "mjcf/sektion_cabinet.xml"))
    spec.add_actuator(name="motor", target="drawer_top_joint", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    path = tmp_path / "cabinet.xml"
    path.write_text(spec.to_xml())
    task = make_task("task=FrankaCabinet", f"task.env.asset.assetFileNameCabinet={path}")
    task.step(task.zero_actions())
    assert task.simulation.model.nu == 9
