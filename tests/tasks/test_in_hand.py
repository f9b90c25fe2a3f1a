"""ShadowHand and AllegroHand: formulas by hand, goals, forces, observations, a user's hand."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path

import mujoco
import pytest
import torch
from scipy.spatial.transform import Rotation

from isaacgymenvs_lite.errors import ConfigError
from isaacgymenvs_lite.paths import assets_dir
from isaacgymenvs_lite.tasks.base.in_hand import (
    HandConfig,
    InHandTask,
    compute_hand_reward,
    randomize_rotation,
    randomize_rotation_pen,
    update_consecutive_successes,
)
from isaacgymenvs_lite.tasks.base.reward_terms import total
from isaacgymenvs_lite.tasks.base.vec_task import Done
from isaacgymenvs_lite.utils.rotations import (
    quat_apply,
    quat_conjugate,
    quat_diff_rad,
    quat_mul,
)

MakeTask = Callable[..., InHandTask]
ROTATION = [0.102598, -0.205196, 0.307794, 0.923381]  # normalised (0.1, -0.2, 0.3, 0.9)
NO_TURN, HALF_TURN = [0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]
CALL_S = 0.01667  # one simulator call
TIPS = tuple(f"robot0:{finger}distal" for finger in ("ff", "mf", "rf", "lf", "th"))
SHADOW_JOINTS = (
    *("WRJ1", "WRJ0", "FFJ3", "FFJ2", "FFJ1", "FFJ0", "MFJ3", "MFJ2", "MFJ1", "MFJ0", "RFJ3"),
    *("RFJ2", "RFJ1", "RFJ0", "LFJ4", "LFJ3", "LFJ2", "LFJ1", "LFJ0"),
    *("THJ4", "THJ3", "THJ2", "THJ1", "THJ0"),
)
NOT_DRIVEN = ("FFJ0", "MFJ0", "RFJ0", "LFJ0")


def _terms(
    cfg: HandConfig, distance: float = 0.0, angle: float = 1.0, *, reached=False, late=False
) -> dict[str, float]:
    values = (torch.tensor([v]) for v in (distance, angle))
    flags = (torch.tensor([v]) for v in (reached, late))
    terms = compute_hand_reward(*values, torch.full((1, 20), 0.5), *flags, cfg)
    return {name: term.item() for name, term in terms.items()} | {"total": total(terms).item()}


def test_reward_of_the_specification() -> None:
    angle = quat_diff_rad(torch.tensor([ROTATION]), torch.tensor([NO_TURN])).item()
    assert angle == pytest.approx(0.788002, abs=3e-6)  # six digits are given
    assert _terms(HandConfig(), 0.05, angle)["total"] == pytest.approx(0.625124, abs=1e-5)


def test_rewards_by_hand() -> None:
    cfg = HandConfig(fall_penalty=-50.0, max_consecutive_successes=5)
    plain = _terms(cfg)["total"]
    assert plain == pytest.approx(1.0 / 1.1 - 0.0002 * 5.0)
    for changes, added in (
        ({"reached": True}, 250.0),
        ({"late": True}, -25.0),
        ({"distance": 0.239}, -2.39),
        ({"distance": 0.24}, -2.4 - 50.0),
        ({"angle": -1.0}, 0.0),
    ):
        # float32 sums of some hundred
        assert _terms(cfg, **changes)["total"] - plain == pytest.approx(added, abs=5e-5)
    unlimited = HandConfig(fall_penalty=-50.0)
    assert _terms(unlimited, late=True)["total"] == pytest.approx(plain)


def test_moving_average_of_successes_by_hand() -> None:
    average, successes = torch.tensor(4.0), torch.tensor([3.0, 7.0, 0.0, 20.0])
    updated = update_consecutive_successes(average, successes, torch.tensor([1, 0, 1, 0]), 0.1)
    assert updated.item() == pytest.approx(0.1 * 1.5 + 0.9 * 4.0)
    unchanged = update_consecutive_successes(average, successes, torch.zeros(4), 0.1)
    assert unchanged.item() == 4.0


@pytest.mark.parametrize(("rand0", "rand1"), [(0.5, 0.0), (0.0, -0.5), (0.7, -0.2), (-1.0, 1.0)])
def test_random_rotations_by_hand(rand0: float, rand1: float) -> None:
    draws = torch.tensor([rand0]), torch.tensor([rand1])
    x, y, z = torch.eye(3)[:, None]
    a, b = 0.5 * math.pi * rand0, 0.5 * math.pi * rand1
    about_x_and_y = [
        *(math.sin(a) * math.cos(b), math.cos(a) * math.sin(b)),
        *(math.sin(a) * math.sin(b), math.cos(a) * math.cos(b)),
    ]
    assert randomize_rotation(*draws, x, y)[0].tolist() == pytest.approx(about_x_and_y, abs=1e-6)
    tilt = 0.25 * math.pi + 0.15 * rand0
    lying = [
        *(math.sin(tilt) * math.cos(a), -math.sin(tilt) * math.sin(a)),
        *(math.cos(tilt) * math.sin(a), math.cos(tilt) * math.cos(a)),
    ]
    found = randomize_rotation_pen(*draws, 0.3, x, y, z)[0].tolist()
    assert found == pytest.approx(lying, abs=1e-6)


@pytest.mark.parametrize(
    ("task_name", "sizes"),
    [
        ("ShadowHand", {"full_state": 211, "full": 157, "full_no_vel": 77, "openai": 42}),
        ("AllegroHand", {"full_state": 88, "full": 72, "full_no_vel": 50}),
    ],
)
def test_sizes_of_observations(make_task: MakeTask, task_name: str, sizes: dict[str, int]) -> None:
    for kind, size in sizes.items():
        asymmetric = kind != "full"
        overrides = (f"observationType={kind}", f"asymmetric_observations={asymmetric}")
        task = make_task(f"task={task_name}", *(f"task.env.{o}" for o in overrides), num_envs=1)
        states = sizes["full_state"] if asymmetric else 0
        assert (task.num_observations, task.num_states) == (size, states)
        assert sum(task.observation_groups().values()) == size
        assert ("states" in task.reset()) == asymmetric


@pytest.mark.parametrize(
    ("task_name", "override", "message"),
    [
        ("ShadowHand", "observationType=no_vel", "full, full_no_vel, full_state, openai"),
        ("AllegroHand", "observationType=openai", "full, full_no_vel, full_state"),
        ("ShadowHand", "objectType=ball", "block, egg, pen"),
    ],
)
def test_an_unknown_type_is_one_line(
    make_task: MakeTask, task_name: str, override: str, message: str
) -> None:
    key = override.partition("=")[0]
    with pytest.raises(ConfigError, match=rf"^task\.env\.{key}[^\n]*{message}$"):
        make_task(f"task={task_name}", f"task.env.{override}")


@pytest.mark.parametrize(
    ("overrides", "length"),
    [
        (("task=ShadowHand",), 600),
        (("task=ShadowHandOpenAI_FF", "task.env.episodeLength=7"), 160),
        (("task=ShadowHandTest",), 1600),
        (("task=AllegroHand", "task.env.resetTime=5"), 150),
    ],
)
def test_length_of_an_episode(make_task: MakeTask, overrides: tuple[str], length: int) -> None:
    task = make_task(*overrides, num_envs=2)
    assert task.max_episode_length == length
    torch.manual_seed(0)
    task.reset()
    task.progress_buf[:] = torch.tensor([length - 3, length - 2])
    *_, infos = task.step(task.zero_actions())
    assert infos["time_outs"].tolist() == [False, True]


@pytest.mark.parametrize(
    ("task_name", "kind", "mass_kg", "start_m"),
    [
        ("ShadowHand", "block", 0.0709, (0.0, -0.39, 0.6)),
        ("ShadowHand", "egg", 0.151, (0.0, -0.39, 0.6)),
        ("ShadowHand", "pen", 0.0424, (0.0, -0.39, 0.52)),
        ("AllegroHand", "block", 0.1099, (0.0, -0.2, 0.56)),
        ("AllegroHand", "pen", 0.0424, (0.0, -0.2, 0.52)),
    ],
)
def test_starts_of_objects_and_hands(
    make_task: MakeTask, task_name: str, kind: str, mass_kg: float, start_m: tuple[float, ...]
) -> None:
    overrides = (f"objectType={kind}", "resetDofVelRandomInterval=0.5")
    task = make_task(f"task={task_name}", *(f"task.env.{o}" for o in overrides), num_envs=16)
    torch.manual_seed(0)
    task.reset()
    sim = task.simulation
    assert task.object_mass_kg == pytest.approx(mass_kg, rel=2e-3)  # three digits are given
    away = sim.object_states[:, 0, :3] - torch.tensor(start_m)
    assert -0.01 - 1e-6 < away.min() < -0.008 and 0.008 < away.max() < 0.01 + 1e-6
    assert (away.std(0) > 0.003).all()  # of 16 draws; 0.0058 is expected
    below = torch.tensor(start_m) - torch.tensor([0.0, 0.0, 0.04])
    torch.testing.assert_close(task.goal_pos, below)
    ranges = torch.tensor([sim.model.joint(name).range.tolist() for name in task.joint_names])
    share = (sim.dof_pos / 0.2 - ranges[:, 0]) / (ranges[:, 1] - ranges[:, 0])
    assert -1e-5 < share.min() < 0.02 and 0.98 < share.max() < 1.0 + 1e-5
    assert -0.5 <= sim.dof_vel.min() < -0.45 and 0.45 < sim.dof_vel.max() <= 0.5
    torch.testing.assert_close(task.prev_targets, sim.dof_pos)
    # A pen lies, with a tilt of up to 0.3 rad, other objects and all goals have any orientation.
    up = quat_apply(sim.object_states[:, 0, 3:7], torch.tensor([0.0, 0.0, 1.0]).expand(16, 3))[:, 2]
    assert (up.abs().max() < math.sin(0.3) + 1e-5) == (kind == "pen")
    assert task.goal_rot.std(0).min() > 0.2


def _put(task: InHandTask, pos: list[float], rots: list[list[float]], dof: float = 0.0) -> None:
    """Put objects at rest at a position and at rotations (N, 4), and all joints at `dof` rad."""
    n, sim = task.num_envs, task.simulation
    dof_pos = torch.full((n, len(sim.dof_names)), dof)
    sim.write_state(torch.arange(n), torch.zeros(n, 13), dof_pos, torch.zeros_like(dof_pos))
    states = torch.zeros(n, 1, 13)
    states[:, 0, :3], states[:, 0, 3:7] = torch.tensor(pos), torch.tensor(rots)
    sim.write_object_states(torch.arange(n), torch.zeros(1, dtype=torch.int64), states)
    task.prev_targets[:] = dof_pos
    task.goal_rot[:] = torch.tensor(NO_TURN)
    task.reset_goal_buf.zero_()
    task.successes.zero_()


AT_GOAL, FAR_AWAY = [0.0, -0.39, 0.56], [1.0, 1.0, 8.0]


@pytest.mark.parametrize(("kind", "reached"), [("block", [1, 0, 0]), ("pen", [1, 1, 0])])
def test_angle_of_a_reached_goal(make_task: MakeTask, kind: str, reached: list[int]) -> None:
    task = make_task("task=ShadowHand", f"task.env.objectType={kind}", num_envs=3)
    task.reset()
    rots = Rotation.from_euler("y", [[0.09], [0.19], [0.21]]).as_quat().tolist()
    _put(task, [0.0, -0.39, 0.65], rots)  # above the hand, so that it does not turn
    task.step(task.zero_actions())
    assert task.goal_angle.tolist() == pytest.approx([0.09, 0.19, 0.21], abs=1e-4)
    assert task.successes.tolist() == reached


def test_a_reached_goal_is_replaced_in_the_next_step(make_task: MakeTask) -> None:
    task = make_task("task=ShadowHand", num_envs=3)
    torch.manual_seed(0)
    task.reset()
    _put(task, AT_GOAL, [NO_TURN, HALF_TURN, NO_TURN])
    _, rewards, dones, infos = task.step(task.zero_actions())
    assert task.reward_terms["goal"].tolist() == [250.0, 0.0, 250.0]
    assert (rewards > 200.0).tolist() == [True, False, True]
    assert infos["successes"]["consecutive_successes"].tolist() == [1.0, 0.0, 1.0]
    assert dones.tolist() == [0, 0, 0]
    assert (task.goal_rot == torch.tensor(NO_TURN)).all()
    observed = task.step(task.zero_actions())[0]["obs"]
    assert task.goal_rot[1].tolist() == NO_TURN
    assert task.goal_rot[0].tolist() != NO_TURN and task.goal_rot[2].tolist() != NO_TURN
    assert (task.goal_rot[0] - task.goal_rot[2]).abs().max() > 0.1
    torch.testing.assert_close(observed[:, 88:92], task.goal_rot)
    assert task.successes.tolist() == [1.0, 0.0, 1.0]


def test_the_last_goal_ends_the_episode_and_each_goal_prolongs_it(make_task: MakeTask) -> None:
    overrides = ("task.env.maxConsecutiveSuccesses=3", "task.env.fallPenalty=-50")
    task = make_task("task=ShadowHand", *overrides, num_envs=4)
    torch.manual_seed(0)
    task.reset()
    _put(task, AT_GOAL, [NO_TURN, NO_TURN, HALF_TURN, HALF_TURN])
    task.successes[:] = torch.tensor([2.0, 1.0, 1.0, 2.0])
    task.progress_buf[:] = torch.tensor([598, 598, 10, 598])
    *_, infos = task.step(task.zero_actions())
    assert task.done_buf.tolist() == [Done.REACHED, Done.RUNNING, Done.RUNNING, Done.TIME_OUT]
    assert infos["successes"]["consecutive_successes"].tolist() == [3.0, 2.0, 1.0, 2.0]
    assert infos["consecutive_successes"].item() == pytest.approx(0.1 * 2.5)
    assert task.progress_buf.tolist() == [0, 0, 11, 599]
    assert task.reward_terms["late"].tolist() == [0.0, 0.0, 0.0, -25.0]
    task.step(task.zero_actions())
    assert task.successes.tolist() == [0.0, 2.0, 1.0, 0.0]


def test_a_lost_object_is_a_failure(make_task: MakeTask, caplog: pytest.LogCaptureFixture) -> None:
    overrides = ("task.env.fallPenalty=-7", "task.env.printNumSuccesses=True")
    task = make_task("task=AllegroHand", *overrides, num_envs=2)
    task.reset()
    _put(task, FAR_AWAY, [HALF_TURN] * 2)
    states = task.simulation.object_states[:1].clone()
    states[0, 0, :3] = task.goal_pos + torch.tensor([0.0, 0.2, 0.1])  # 22 cm away
    task.simulation.write_object_states(torch.tensor([0]), torch.tensor([0]), states)
    task.successes[:] = torch.tensor([1.0, 4.0])
    task.progress_buf[:] = torch.tensor([10, 598])
    with caplog.at_level(logging.INFO):
        *_, infos = task.step(task.zero_actions())
    assert task.done_buf.tolist() == [Done.RUNNING, Done.FAILED]
    assert infos["terminate"].tolist() == [False, True]
    assert infos["time_outs"].tolist() == [False, False]
    assert task.reward_terms["fall"].tolist() == [0.0, -7.0]
    # 5 successes in one ended and two running episodes; the ended one had 4.
    assert "1.7 with running episodes, 4.0 of ended" in caplog.text


@pytest.mark.parametrize("task_name", ["ShadowHand", "AllegroHand"])
def test_targets_by_hand(
    make_task: MakeTask, controls_of: Callable[..., list[torch.Tensor]], task_name: str
) -> None:
    for relative in (False, True):
        overrides = ("actionsMovingAverage=0.3", f"useRelativeControl={relative}")
        task = make_task(f"task={task_name}", *(f"task.env.{o}" for o in overrides), num_envs=2)
        task.reset()
        before = [task.prev_targets[:, i].clone() for i in task.drives]
        seen = controls_of(task)
        actions = torch.linspace(-1.0, 1.0, task.num_actions).repeat(2, 1)
        task.step(actions)
        for action, joint in enumerate(task.drives):
            low, high = task.simulation.model.joint(task.joint_names[joint]).range.tolist()
            value, old = actions[0, action].item(), before[action]
            aim = low + 0.5 * (value + 1.0) * (high - low)
            target = old + 20.0 * CALL_S * value if relative else 0.3 * aim + 0.7 * old
            target = target.clamp(low, high)
            torch.testing.assert_close(seen[0][:, action], target)
            torch.testing.assert_close(task.prev_targets[:, joint], target)


def _action_to(task: InHandTask, wanted: dict[str, float]) -> torch.Tensor:
    """Return the action whose targets are some angles (rad) and zero, or the nearest limit."""
    values = []
    for joint in task.drives:
        name = task.joint_names[joint]
        low, high = task.simulation.model.joint(name).range
        aim = min(max(wanted.get(name, 0.0), low), high)
        values.append(2.0 * (aim - low) / (high - low) - 1.0)
    return torch.tensor(values, dtype=torch.float32).expand(task.num_envs, -1)


@pytest.mark.parametrize("task_name", ["ShadowHand", "AllegroHand"])
def test_joints_follow_their_targets(make_task: MakeTask, task_name: str) -> None:
    task = make_task(f"task={task_name}", "task.env.fallDistance=1e9", num_envs=2)
    if task_name == "ShadowHand":
        names = tuple(f"robot0:{joint}" for joint in SHADOW_JOINTS)
        driven = [n for n in names if n.removeprefix("robot0:") not in NOT_DRIVEN]
    else:
        fingers = ("index", "middle", "ring", "thumb")
        driven = names = tuple(f"{f}_joint_{i}" for f in fingers for i in range(4))
    assert task.joint_names == names
    task.reset()
    _put(task, FAR_AWAY, [NO_TURN] * 2)
    # Another angle for each joint
    ranges = {name: task.simulation.model.joint(name).range for name in driven}
    shares = {name: 0.3 + 0.01 * i for i, name in enumerate(driven)}
    wanted = {n: low + shares[n] * (high - low) for n, (low, high) in ranges.items()}
    for _ in range(120):
        task.step(_action_to(task, wanted))
    found = dict(zip(task.simulation.dof_names, task.simulation.dof_pos[1].tolist(), strict=True))
    # Nothing loads the joints: the damping of 0.1 s is over.
    assert {n: found[n] for n in driven} == pytest.approx(wanted, abs=5e-3)


def test_a_tendon_couples_the_last_two_joints_of_a_finger(make_task: MakeTask) -> None:
    task = make_task("task=ShadowHand", "task.env.fallDistance=1e9", num_envs=2)
    task.reset()
    _put(task, FAR_AWAY, [NO_TURN] * 2)
    joints = [task.joint_names.index(f"robot0:FFJ{i}") for i in (1, 0)]
    others = [task.joint_names.index(f"robot0:{f}J0") for f in ("MF", "RF", "LF")]
    for _ in range(90):
        task.step(_action_to(task, {"robot0:FFJ1": 1.0}))
        middle, distal = task.simulation.dof_pos[:, joints].unbind(-1)
        # The soft limit gives way by 0.7 mm while the finger moves.
        assert (0.00705 * distal - 0.00805 * middle).abs().max() < 0.002
    # The tendon is slack by 1 mm; 1 rad is then 0.00705 rad of 0.00705 m.
    assert middle.tolist() == pytest.approx([1.0] * 2, abs=0.01)
    assert distal.tolist() == pytest.approx([1.0] * 2, abs=0.02)
    assert task.simulation.dof_pos[:, others].abs().max() < 1e-3


@pytest.mark.parametrize("calls", [1, 3])
def test_forces_push_the_object(make_task: MakeTask, calls: int) -> None:
    overrides = ("forceScale=1.0", "forceProbRange=[1,1]", f"controlFrequencyInv={calls}")
    overrides = (*overrides, "fallDistance=1e9")
    task = make_task("task=ShadowHand", *(f"task.env.{o}" for o in overrides), num_envs=16)
    torch.manual_seed(0)
    task.reset()
    _put(task, FAR_AWAY, Rotation.random(16, random_state=0).as_quat().tolist())
    drawn = []
    for _ in range(20):
        before = task.simulation.object_states[:, 0].clone()
        task.step(task.zero_actions())
        after = task.simulation.object_states[:, 0]
        # The impulse of one simulator call, along the axes of the object
        accelerated = after[:, 7:10] - before[:, 7:10] + torch.tensor([0, 0, 9.81 * calls * CALL_S])
        pushed = quat_apply(before[:, 3:7], task.object_forces) * CALL_S / task.object_mass_kg
        # float32 of a fall at up to 10 m/s
        torch.testing.assert_close(accelerated, pushed, atol=5e-6, rtol=0.0)
        drawn.append(task.object_forces / task.object_mass_kg)
    # 960 draws: standard errors of 3 and 2 %
    assert torch.stack(drawn).mean().item() == pytest.approx(0.0, abs=0.1)
    assert torch.stack(drawn).std().item() == pytest.approx(1.0, abs=0.08)


def test_forces_decay_until_the_next_push(make_task: MakeTask) -> None:
    rare = ("task.env.forceScale=1.0", "task.env.forceProbRange=[1e-9,1e-9]")
    task = make_task("task=AllegroHand", *rare, num_envs=2)
    task.reset()
    task.object_forces[:] = torch.tensor([[0.1, -0.2, 0.3], [0.0, 0.5, 0.0]])
    for _ in range(3):
        task.step(task.zero_actions())
    decay = 0.99 ** (CALL_S / 0.08 * 3)
    assert task.object_forces[0].tolist() == pytest.approx([0.1 * decay, -0.2 * decay, 0.3 * decay])
    task.reset_buf[0] = 1
    task.step(task.zero_actions())
    assert task.object_forces[0].tolist() == [0.0] * 3
    assert task.object_forces[1, 1].item() == pytest.approx(0.5 * 0.99 ** (CALL_S / 0.08 * 4))


def test_probabilities_of_pushes_are_log_uniform(make_task: MakeTask) -> None:
    task = make_task("task=ShadowHand", num_envs=16)
    torch.manual_seed(0)
    logs = []
    for _ in range(20):
        task.reset()
        logs.append(task.force_prob.log10())
    values = torch.stack(logs)
    # 320 draws of a width of 2: standard error 0.03
    assert -3.0 <= values.min() < -2.95 and -1.05 < values.max() <= -1.0
    assert values.mean().item() == pytest.approx(-2.0, abs=0.12)


def _expected_parts(task: InHandTask, actions: torch.Tensor) -> dict[str, torch.Tensor]:
    sim = task.simulation
    ranges = torch.tensor([sim.model.joint(name).range.tolist() for name in task.joint_names])
    low, high = ranges.float().unbind(-1)
    state = sim.object_states[:, 0]
    tips = [sim.body_names.index(tip) for tip in TIPS if tip in sim.body_names]
    bodies = (sim.body_pos, sim.body_rot, sim.body_lin_vel, sim.body_ang_vel)
    return {
        "joints": 2.0 * (sim.dof_pos - low) / (high - low) - 1.0,
        "joint_vel": 0.2 * sim.dof_vel,
        "torques": 10.0 * sim.dof_forces,
        "object": state[:, :7],
        "object_pos": state[:, :3],
        "object_vel": torch.cat((state[:, 7:10], 0.2 * state[:, 10:]), dim=-1),
        "goal": torch.cat((task.goal_pos.expand(task.num_envs, 3), task.goal_rot), dim=-1),
        "turn": quat_mul(state[:, 3:7], quat_conjugate(task.goal_rot)),
        "tip_pos": sim.body_pos[:, tips].flatten(1),
        "tips": torch.cat([values[:, tips] for values in bodies], dim=-1).flatten(1),
        "wrenches": torch.zeros(task.num_envs, 6 * len(tips)),
        "actions": actions,
    }


PARTS = {
    "openai": "tip_pos object_pos turn actions",
    "full_no_vel": "joints object goal turn tip_pos actions",
    "full": "joints joint_vel object object_vel goal turn tips actions",
    "full_state": "joints joint_vel torques object object_vel goal turn tips wrenches actions",
}


@pytest.mark.parametrize(
    ("task_name", "kind"),
    [
        *(("ShadowHand", kind) for kind in PARTS),
        ("AllegroHand", "full"),
        ("AllegroHand", "full_no_vel"),
    ],
)
def test_parts_of_the_observation(make_task: MakeTask, task_name: str, kind: str) -> None:
    overrides = (f"observationType={kind}", "asymmetric_observations=True", "fallDistance=1e9")
    task = make_task(f"task={task_name}", *(f"task.env.{o}" for o in overrides), num_envs=2)
    torch.manual_seed(0)
    task.reset()
    _put(task, FAR_AWAY, [ROTATION, NO_TURN])
    task.goal_rot[:] = torch.tensor([ROTATION[::-1], HALF_TURN])
    spin = task.simulation.object_states.clone()
    spin[..., 10:] = torch.tensor([1.0, 2.0, 3.0])
    task.simulation.write_object_states(torch.arange(2), torch.tensor([0]), spin)
    actions = 0.6 * torch.rand(2, task.num_actions)
    for _ in range(2):
        task.step(actions)
    parts = _expected_parts(task, actions)
    assert parts["torques"].abs().max() > 0.1
    for observed, names in ((task.obs_buf, PARTS[kind]), (task.states_buf, PARTS["full_state"])):
        expected = torch.cat([parts[name] for name in names.split()], dim=-1)
        torch.testing.assert_close(observed, expected, atol=1e-5, rtol=0.0)


def test_fingertips_feel_the_object(make_task: MakeTask) -> None:
    task = make_task("task=ShadowHand", num_envs=1)
    task.reset()
    sim = task.simulation
    _put(task, FAR_AWAY, [NO_TURN])
    tips = [sim.body_names.index(tip) for tip in TIPS]
    first = sim.body_pos[0, tips[0]].tolist()
    # The block, 5 cm wide, reaches 3 mm into the tip of the first finger, but not to the next one.
    place = [first[0] - 0.012, first[1] - 0.012, first[2] + 0.025 + 0.004]
    _put(task, place, [NO_TURN])
    task.step(task.zero_actions())
    wrenches = task.obs_buf[0, 161:191].reshape(5, 6) / 10.0
    pushed = quat_apply(sim.body_rot[0, tips[:1]], wrenches[:1, :3])
    assert pushed[0, 2] < -task.object_mass_kg * 9.81
    assert (wrenches[1:] == 0.0).all()


def _users_file(task_name: str, folder: Path) -> Path:
    """Write the hand with the joints' names of menagerie, elsewhere; return the path."""
    own = {"ShadowHand": "shadow_hand", "AllegroHand": "allegro_hand"}[task_name]
    spec = mujoco.MjSpec.from_file(str(assets_dir() / f"mjcf/{own}.xml"))
    root = spec.worldbody.first_body()
    root.pos, root.quat = [0.3, -0.2, 1.0], [0.5, 0.1, -0.7, 0.4]
    short = {"index": "ff", "middle": "mf", "ring": "rf", "thumb": "th"}
    for joint in spec.joints:
        if task_name == "ShadowHand":
            name = joint.name.removeprefix("robot0:")
            joint.name = f"rh_{name[:-1]}{int(name[-1]) + 1}"
        else:
            finger, _, number = joint.name.split("_")
            joint.name = f"{short[finger]}j{number}"
    for body in spec.bodies[1:]:
        body.name = body.name.replace("robot0:", "rh_")
    spec.compile()
    path = folder / "hand.xml"
    path.write_text(spec.to_xml())
    return path


@pytest.mark.parametrize("task_name", ["ShadowHand", "AllegroHand"])
def test_a_users_hand_is_where_the_own_hand_is(
    make_task: MakeTask, tmp_path: Path, task_name: str
) -> None:
    path = _users_file(task_name, tmp_path)
    own = make_task(f"task={task_name}", num_envs=2)
    other = make_task(f"task={task_name}", f"task.env.asset.assetFileName={path}", num_envs=2)
    assert other.joint_names != own.joint_names
    torch.manual_seed(0)
    actions = torch.rand(20, 2, own.num_actions) - 0.5
    for task in (own, other):
        task.reset()
        _put(task, FAR_AWAY, [NO_TURN] * 2, dof=0.1)
    # The file has six digits.
    found, expected = other.simulation, own.simulation
    torch.testing.assert_close(found.body_pos, expected.body_pos, atol=2e-5, rtol=0.0)
    for action in actions:
        for task in (own, other):
            task.reset_buf.zero_()
            task.step(action)
    torch.testing.assert_close(found.dof_pos, expected.dof_pos, atol=1e-3, rtol=0.0)
    torch.testing.assert_close(found.body_pos, expected.body_pos, atol=2e-4, rtol=0.0)


@pytest.mark.parametrize("task_name", ["AllegroHand", "ShadowHand"])
def test_a_spinning_pen_does_not_gain_speed(make_task: MakeTask, task_name: str) -> None:
    task = make_task(f"task={task_name}", "task.env.objectType=pen", num_envs=2)
    task.reset()
    states = torch.zeros(2, 1, 13)
    states[:, 0, 2], states[:, 0, 6] = 3.0, 1.0
    states[:, 0, 10:] = torch.tensor([5.0, 0.0, 150.0])
    task.simulation.write_object_states(torch.arange(2), torch.tensor([0]), states)
    for _ in range(30):
        task.simulation.step()
        assert not task.simulation.failed.any()
        assert task.simulation.object_states[:, 0, 10:].norm(dim=-1).max() < 151.0
